"""Content of the viewer's page: precise as stated, small, and self-contained."""

import json
import re

import numpy as np
import pytest
import torch
from helpers.gaussians import rotations, some
from helpers.refusals import refused

from gamba_warp.formats.meshes import load_mesh
from gamba_warp.surfaces.extract import Surface
from gamba_warp.surfaces.files import save_mesh
from gamba_warp.viewer.pack import (
    RECORD,
    Frame,
    own_frame,
    pack_gaussians,
    pack_mesh,
    viewed_mesh,
    visible,
)
from gamba_warp.viewer.page import viewer_page, write_viewer

UNMOVED = Frame(np.zeros(3), 1.0)
ONE_FACE = np.array([[0, 1, 2]])


def test_records_hold_what_was_packed():
    gaussians = some(500)
    gaussians.quats[0] = torch.tensor([0.0, 0.6, 0.0, -0.8])  # a half turn: w is 0
    gaussians.harmonics = torch.randn(500, 3, 3)
    packed = pack_gaussians(gaussians, UNMOVED)
    records, texels = np.frombuffer(packed[0], RECORD), np.frombuffer(packed[1], "<f2")
    assert RECORD.itemsize == 32
    np.testing.assert_array_equal(records["means"], gaussians.means)
    half = 2.0**-11  # of a value: float16 has 11 bits
    np.testing.assert_allclose(records["scales"], gaussians.scales, rtol=half, atol=1e-7)
    np.testing.assert_allclose(records["look"][:, 0], gaussians.opacities, rtol=half)
    np.testing.assert_allclose(records["look"][:, 1:], gaussians.colors, rtol=half, atol=1e-7)
    texels, harmonics = texels.reshape(500, 16), gaussians.harmonics.reshape(500, -1)
    np.testing.assert_allclose(texels[:, :9], harmonics, rtol=half, atol=1e-7)  # whole texels of 8
    assert not texels[:, 9:].any()
    p = records["turns"] / 32767
    k = 2 / (1 + (p * p).sum(1, keepdims=True))
    turns = rotations(torch.from_numpy(np.hstack([k - 1, k * p])))
    # half a step of 1/32767 in each number, at most twice and four times as much in a rotation
    assert (turns - rotations(gaussians.quats.double())).abs().max() < 4 * 3 / 32767


def test_the_largest_come_first_and_the_invisible_not_at_all():
    gaussians = some(50)
    gaussians.opacities[:20] = 0.003  # below 1/255
    found = visible(gaussians, "a")
    sides = found.scales.sort(-1).values
    cover = found.opacities * sides[:, 1] * sides[:, 2]
    assert found.num == 30 and (cover.diff() <= 0).all()


def test_what_floats_far_away_does_not_count():
    gaussians = some(1000)
    gaussians.means[0] = torch.tensor([500.0, 0, 0])
    frame = own_frame(gaussians, "a")
    assert np.abs(frame.center).max() < 0.05 and 0.9 < frame.size < 1.1


def test_the_page_is_small_and_loads_nothing(tmp_path):
    write_viewer(tmp_path / "a.html", "A chair", some(1))
    assert (tmp_path / "a.html").stat().st_size <= 300_000
    page = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "http" not in page.replace("http-equiv", "") and "import(" not in page
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page)
    assert policy.startswith("default-src 'none'") and "worker-src blob:" in policy
    assert not re.search(r"<(link|iframe)|src\s*=\s*[\"']", page)


def about(page):
    """The object's data in a page."""
    (text,) = re.findall(r'id="object">(.*?)</script>', page)
    return json.loads(text)


def test_text_is_escaped_and_slots_in_it_stay():
    nasty = '</script><b onload="x">&{{gaussians}}'
    page = viewer_page(nasty, some(3), note=nasty)
    assert "<b onload" not in page and page.count("</script>") == 5
    found = about(page)
    assert found["title"] == found["note"] == nasty and found["input"] is None


def test_cameras():
    found = about(viewer_page("a", some(9), camera=(2.0, 40.0, 30.0)))
    assert found["input"] == found["home"] and found["frame"]["size"] == 1
    assert found["home"]["distance"] == 2 and found["home"]["fov"] == 40
    assert found["home"]["elevation"] == pytest.approx(np.pi / 6)
    other = about(viewer_page("a", some(9), view=(2.5, 30.0, 0.0)))
    assert other["home"]["distance"] == 2.5


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda g: g.means[3].fill_(float("nan")), "1 of 9 Gaussians are not finite"),
        (lambda g: g.opacities.fill_(0.001), "no Gaussian has an opacity"),
        (lambda g: (g.means.fill_(0), g.scales.fill_(0)), "at one point"),
    ],
)
def test_bad_gaussians(tmp_path, break_it, message):
    gaussians = some(9)
    break_it(gaussians)
    refused(message, write_viewer, tmp_path / "a.html", "a.ply", gaussians)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("faces", "message"), [(np.zeros((0, 3), int), "no faces"), (ONE_FACE + 1, "names vertex 3")]
)
def test_bad_meshes(faces, message):
    refused(message, pack_mesh, Surface(np.eye(3), faces), UNMOVED, "a")


@pytest.mark.parametrize("kind", ["glb", "ply", "obj"])
def test_a_mesh_file_comes_back_in_the_axes_of_the_gaussians(tmp_path, kind):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    colors = np.array([[0.2, 0.4, 0.6], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]], np.float32)
    save_mesh(tmp_path / f"a.{kind}", Surface(vertices, faces, colors))
    found = viewed_mesh(load_mesh(tmp_path / f"a.{kind}"))
    np.testing.assert_allclose(found.vertices[found.faces], vertices[faces], atol=1e-6)
    # 8 bits; those of .glb are linear light, which is coarser in the dark
    np.testing.assert_allclose(found.colors[found.faces], colors[faces], atol=0.02)
    turned = viewed_mesh(load_mesh(tmp_path / f"a.{kind}"), "opencv")
    assert np.abs(turned.vertices[turned.faces] - vertices[faces] * [1, -1, -1]).max() < 1e-6
