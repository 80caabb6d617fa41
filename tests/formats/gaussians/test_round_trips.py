"""Round trips of every format of Gaussians, with a line about its losses."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from formats.gaussians.differences import check, differences
from helpers.gaussians import khr_glb, some
from helpers.refusals import refused

from gamba_warp.cameras import Cameras, intrinsics
from gamba_warp.errors import UserError
from gamba_warp.formats.gaussians.files import write_gaussians
from gamba_warp.formats.names import SPLAT_FORMATS, splat_suffix
from gamba_warp.formats.ply import flip_axes
from gamba_warp.formats.read import read, read_gaussians
from gamba_warp.gaussians import Gaussians
from gamba_warp.render import render

HOLD_HARMONICS = [kind for kind in SPLAT_FORMATS if kind != "splat"]


def written(folder, gaussians, kind, **options):
    path = folder / f"a{splat_suffix(kind)}"
    return path, write_gaussians(path, gaussians, kind, **options)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("kind", SPLAT_FORMATS)
def test_what_is_written_is_read(tmp_path, kind, degree):
    gaussians = some(601, degree=degree)  # three chunks, the last one not full
    path, lost = written(tmp_path, gaussians, kind)
    loaded = read_gaussians(path)
    if kind == "splat" and degree:
        assert loaded.degree == 0 and "no place for harmonics" in lost and str(path) in lost
        gaussians.colors.clamp_(0, 1)
    else:
        assert lost is None and loaded.degree == degree
    check(kind, gaussians, loaded)


@pytest.mark.parametrize("kind", SPLAT_FORMATS)
def test_one_gaussian_without_rotation(tmp_path, kind):
    gaussians = some(1, rotated=False)
    path, _ = written(tmp_path, gaussians, kind)
    gaussians.quats = torch.tensor([[1.0, 0, 0, 0]])
    check(kind, gaussians, read_gaussians(path))


def test_a_splat_has_the_largest_and_most_opaque_first(tmp_path):
    gaussians = some()
    path, _ = written(tmp_path, gaussians, "splat")
    means = np.frombuffer(path.read_bytes(), "<f4").reshape(37, 8)[:, :3]
    order = (gaussians.scales.prod(1) * gaussians.opacities).argsort(descending=True)
    np.testing.assert_array_equal(means, gaussians.means[order])


@pytest.mark.parametrize("kind", ["ply", "compressed-ply"])
def test_files_of_older_versions_are_turned_back(tmp_path, kind):
    """Older files state y up in a comment, which is not copied."""
    gaussians = some(300, degree=2)
    comments = ["two\nlines", "é", "frame opengl"]
    path, _ = written(tmp_path, flip_axes(gaussians), kind, comments=comments)
    head = path.read_bytes()[:900]
    assert b"comment frame opengl" in head and b"comment two lines" in head
    check(kind, gaussians, read_gaussians(path))
    assert read(path).comments[1:] == ["two lines", "?"]


@pytest.mark.parametrize("kind", SPLAT_FORMATS)
def test_what_comments_say(tmp_path, kind):
    """At most as many as a header can hold."""
    path, _ = written(tmp_path, some(), kind, comments=["from a chair", *map(str, range(40))])
    if "ply" not in kind:
        assert not read(path).comments
        return
    ours, *others = read(path).comments
    assert ours.startswith("gamba_warp ") and others == ["from a chair", *map(str, range(30))]
    head, end, rest = path.read_bytes().partition(b"comment from a chair\n")
    path.write_bytes(head + b"comment " + b"x" * 60_000 + b"\n" + end + rest)
    again, _ = written(tmp_path, read_gaussians(path), kind, comments=read(path).comments)
    assert again.read_bytes().count(b"x") < 260 and "from a chair" in read(again).comments


@pytest.mark.parametrize("kind", HOLD_HARMONICS)
def test_harmonics_show_the_same_colours_after_a_turn(tmp_path, kind):
    """.spz has other axes than ours: the coefficients are turned with the object."""
    from gamba_warp.kernels.rasterize.harmonics import harmonics_basis

    gaussians = some(40, degree=3)
    path, _ = written(tmp_path, gaussians, kind)
    loaded = read_gaussians(path)
    order = torch.cdist(gaussians.means, loaded.means).argmin(1)
    directions = torch.nn.functional.normalize(torch.randn(40, 3), dim=1)
    basis = harmonics_basis(3, directions)[:, 1:, None]
    want = (basis * gaussians.harmonics).sum(1)
    got = (basis * loaded.harmonics[order]).sum(1)
    # 15 coefficients, each half a step of up to 1/32 off, at harmonics of size about 0.7
    assert (want - got).abs().max() < 15 * 0.7 / 64


@pytest.mark.parametrize("kind, ends", [("spz", [-1, 127 / 128]), ("compressed-ply", [-4, 4])])
def test_harmonics_out_of_range_are_clipped_and_that_is_said(tmp_path, kind, ends):
    gaussians = some(9, degree=1)
    for value, end in zip([-5.0, 5.0], ends):
        gaussians.harmonics[4, 2, 1] = value  # of x, which .spz does not turn
        path, lost = written(tmp_path, gaussians, kind)
        assert f"±{-ends[0]}" in lost and "\n" not in lost
        found = read_gaussians(path).harmonics.flatten()
        assert found[found.abs().argmax()] == end


def test_a_compressed_ply_without_bounds_of_colours(tmp_path):
    """As early writers made it: colours are between 0 and 1, as those are that we write here."""
    gaussians = some(200)
    gaussians.colors[:2] = torch.tensor([[0.0], [1.0]])
    path, _ = written(tmp_path, gaussians, "compressed-ply")
    head, end, body = path.read_bytes().partition(b"end_header\n")
    head = re.sub(b"property float (min|max)_[rgb]\n", b"", head)
    path.write_bytes(head + end + body[:48] + body[72:])  # 12 of the chunk's 18 bounds
    check("compressed-ply", gaussians, read_gaussians(path))


def test_spz_far_and_wide(tmp_path):
    gaussians = some(50)
    gaussians.means *= 1e4
    # of logarithms from -10 to 5.94, in steps of 1/16
    gaussians.scales[:5] = torch.tensor([9.2, 6.1, 5.98, -10.05, -10.08]).exp()[:, None]
    path, lost = written(tmp_path, gaussians, "spz")
    assert "scales of 3 Gaussians" in lost
    found = differences(gaussians, read_gaussians(path))
    assert found["means"] <= 0.9 / 2**10  # 5,000 leaves ten bits behind the point
    one = some(1)
    for reach in (-128.0, 128.0, 2.0**23 - 1):  # the sign is one of 24 bits
        one.means[:] = torch.tensor([0, reach, 0])
        written(tmp_path, one, "spz")
        assert read_gaussians(path).means[0, 1] == reach
    one.means[0, 1], before = 2.0**23, path.read_bytes()
    refused("an .spz holds", written, tmp_path, one, "spz")
    assert path.read_bytes() == before


@pytest.mark.parametrize("kind", SPLAT_FORMATS)
def test_refusals(tmp_path, kind):
    gaussians = some(degree=1)
    path, _ = written(tmp_path, gaussians, kind)
    before = path.read_bytes()
    refused("a.*: not written, there are no Gaussians", written, tmp_path, some(0), kind)
    for name, value in gaussians.tensors().items():
        bad = replace(gaussians, **{name: value.clone()})
        getattr(bad, name)[4] = float("nan")
        refused("a.*: not written, 1 of 37 Gaussians", written, tmp_path, bad, kind)
    with pytest.raises(ValueError, match=r"leading shape \(1,\)"):
        written(tmp_path, gaussians.map(lambda value: value[None]), kind)
    with pytest.raises(UserError, match="cannot write /dev/null/a"):
        write_gaussians(f"/dev/null/a{splat_suffix(kind)}", some(), kind)
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_an_unknown_format(tmp_path):
    with pytest.raises(ValueError, match="ksplat"):
        write_gaussians(tmp_path / "a", some(), "ksplat")


def test_the_content_decides_and_not_the_name(tmp_path):
    gaussians = some()
    for kind in ("ply", "spz", "glb", "compressed-ply"):
        path = tmp_path / "a"
        if kind == "glb":
            path.write_bytes(khr_glb(gaussians))
        else:
            write_gaussians(path, gaussians, kind)
        path = path.rename(tmp_path / "a.splat")
        check("ply" if kind == "glb" else kind, gaussians, read_gaussians(path))


def test_version_1_and_2_of_spz(tmp_path):
    """Built by hand from the published layout, with values that it holds exactly."""
    import gzip
    import struct

    head = [struct.pack("<4sIIBBBB", b"NGSP", version, 2, 0, 12, 0, 0) for version in (1, 2)]
    halves = np.array([[1.5, -2, 0.25], [0, 1, 2]], "<f2").tobytes()
    fixed = np.array([[6144, -8192, 1024], [0, 4096, 8192]], "<i4")
    low = fixed[:, :, None].view(np.uint8)[..., :3].tobytes()
    rest = bytes([255, 51]) + bytes([0, 128, 255] * 2) + bytes([160, 144, 128] * 2)
    rest += bytes([255, 128, 128, 128, 128, 128])  # 1 about x, then none nearly
    for start, positions in zip(head, (halves, low)):
        (tmp_path / "a.spz").write_bytes(gzip.compress(start + positions + rest))
        got: Gaussians = read_gaussians(tmp_path / "a.spz")
        assert got.means.tolist() == [[1.5, 2, -0.25], [0, -1, -2]]  # turned to ours
        torch.testing.assert_close(got.opacities, torch.tensor([1.0, 0.2]))
        torch.testing.assert_close(got.scales[0].log(), torch.tensor([0.0, -1.0, -2.0]))


@pytest.mark.parametrize("kind", SPLAT_FORMATS)
def test_antialiasing_is_kept_and_drawn(tmp_path, kind):
    """By bit 0 of the flags of .spz, and a comment of .ply; .splat says that it has no place."""
    gaussians = replace(some(), antialiased=True)
    path, said = written(tmp_path, gaussians, kind)
    loaded = read_gaussians(path)
    assert loaded.antialiased == (kind != "splat")
    assert kind != "splat" or said == f"{path}: a .splat has no place for antialiasing."
    assert loaded.select(loaded.opacities > 0.5).antialiased == loaded.antialiased
    camera = Cameras(torch.eye(4)[None], intrinsics(16, 16)[None], 16, 16)
    camera.viewmats[0, 2, 3] = 9
    shown = render(loaded, camera).alpha
    mode = "antialiased" if loaded.antialiased else "classic"
    plain = render(replace(loaded, antialiased=False), camera, rasterize_mode=mode).alpha
    assert torch.equal(shown, plain) and shown.any()
