"""--elevation, --fov and --distance of reconstruct, export and view."""

import html
import json
import math
import re

import numpy as np
import pytest
import torch
from helpers.gaussians import some
from helpers.images import cut_out
from helpers.model import SMALLEST, run_reconstruct
from PIL import Image

from gamba_warp import pipeline
from gamba_warp.cli import run
from gamba_warp.formats.ply import load_ply, save_ply
from gamba_warp.model.checkpoint import save_model
from gamba_warp.model.gamba import Gamba
from gamba_warp.surfaces.extract import Surface, unit_frame
from gamba_warp.trajectories.movies import turntable_frames
from gamba_warp.trajectories.paths import Viewpoint, upright


def first_frame(path):
    with Image.open(path) as movie:
        return np.asarray(movie.convert("RGB")).astype(float)


def camera_of(page):
    home = json.loads(re.search(r'"home": (\{[^}]*\})', html.unescape(page))[1])
    return home["distance"], home["fov"], pytest.approx(math.degrees(home["elevation"]))


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "model.safetensors"
    torch.manual_seed(4)  # its Gaussians are faint: of some seeds no difference is visible
    save_model(path, Gamba(SMALLEST))
    return path


def test_a_image_from_above_stands_upright(tmp_path, model, monkeypatch):
    meshed = []

    def extracted(gaussians, *_):
        meshed.append(gaussians)
        return Surface(np.eye(4, 3), np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]]))

    monkeypatch.setattr(pipeline, "surface_of", extracted)
    image = cut_out(tmp_path / "thing.png")
    plain, turned = tmp_path / "plain", tmp_path / "turned"
    common = [image, "--checkpoint", model, "--size", 48, "--frames", 4]
    assert run_reconstruct(*common, "--out", plain, "--elevation", 0) == 0
    options = ["--elevation", 30, "--mesh", "ply"]
    assert run_reconstruct(*common, "--out", turned, *options) == 0
    before, after = load_ply(plain / "thing.ply"), load_ply(turned / "thing.ply")
    want = before.transformed(upright(30.0), torch.zeros(3))
    torch.testing.assert_close(after.means, want.means, rtol=1e-4, atol=1e-5)
    assert float((after.means - before.means).abs().max()) > 0.05
    torch.testing.assert_close(meshed[0].means, after.means)  # meshes are made of what is turned
    # The first view of both turntables is the input's, where the camera stood.
    straight, above, lying = (
        turntable_frames(gaussians, Viewpoint(elevation), size=48, frames=1)[0].astype(int)
        for gaussians, elevation in ((before, 0.0), (after, 30.0), (before, 30.0))
    )
    assert np.abs(straight - above).max() <= 3 < np.abs(straight - lying).max() - 2  # rounding
    for folder in (plain, turned):
        assert np.abs(first_frame(folder / "thing.gif") - straight).mean() < 1  # 255 colours
    assert camera_of((turned / "thing.html").read_text()) == (1.5, 49.1, 30)


def test_field_of_view_and_distance_are_those_of_what_is_rendered(tmp_path, model):
    image = cut_out(tmp_path / "thing.png")
    common = [image, "--checkpoint", model, "--size", 48, "--frames", 2, "--elevation", 0]
    assert run_reconstruct(*common, "--out", tmp_path / "a", "--fov", 20, "--distance", 4) == 0
    assert run_reconstruct(*common, "--out", tmp_path / "b") == 0
    same = load_ply(tmp_path / "a" / "thing.ply"), load_ply(tmp_path / "b" / "thing.ply")
    assert torch.equal(same[0].means, same[1].means)  # the Gaussians do not depend on it
    assert camera_of((tmp_path / "a" / "thing.html").read_text()) == (4, 20, 0)
    want = turntable_frames(same[0], Viewpoint(0.0, 4.0, 20.0), size=48, frames=1)[0]
    assert np.abs(first_frame(tmp_path / "a" / "thing.gif") - want).mean() < 1


def test_export_and_view_start_from_there(tmp_path, monkeypatch):
    gaussians = some(60)
    gaussians.means, gaussians.scales = gaussians.means * 4 + 9, gaussians.scales * 4
    save_ply(tmp_path / "a.ply", gaussians)
    view = ["--elevation", "25", "--fov", "30", "--distance", "3"]
    options = ["--mesh", "--turntable", "gif", "--page", "--size", "48", "--frames", "2"]
    out = tmp_path / "out"
    assert run("export", [str(tmp_path / "a.ply"), "--out", str(out), *options, *view]) == 0
    moved = load_ply(tmp_path / "a.ply").in_unit(*unit_frame(gaussians))
    want = turntable_frames(moved, Viewpoint(25.0, 3.0, 30.0), size=48, frames=1)[0]
    assert np.abs(first_frame(out / "a.gif") - want).mean() < 3
    assert camera_of((out / "a.html").read_text()) == (3, 30, 25)
    page = tmp_path / "view.html"
    arguments = [str(tmp_path / "a.ply"), "--out", str(page), "--no-open-browser", *view]
    assert run("view", arguments) == 0
    assert camera_of(page.read_text()) == (3, 30, 25)
