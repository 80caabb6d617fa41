"""``eval-views --checkpoint`` measures the output of ``reconstruct``."""

import re

import numpy as np
import pytest
import torch
from helpers.micro import write_split
from helpers.model import micro, run_reconstruct
from helpers.views import around, eval_views, write_views

from gamba_warp.model.checkpoint import save_model
from gamba_warp.model.gamba import Gamba

CELLS = 24


def write_model(path, **changes):
    """An untrained one, whose front is a plane with the colours of the image: 24 x 24 cells."""
    torch.manual_seed(4)
    wanted = {"decoder": "rays", "encoder": "none", "ray_cells": 8, "ray_layers": 3}
    wanted |= {"ray_features": 5, "image_size": CELLS, "patch_size": 8}
    save_model(path, Gamba(micro(**(wanted | changes))))
    return path


@pytest.fixture
def model(tmp_path):
    return write_model(tmp_path / "rays.safetensors")


def disc(size: int) -> torch.Tensor:
    """A checkerboard on a disc, ``[size, size, 4]``."""
    y, x = np.mgrid[:size, :size]
    colors = np.where((((x // 3) + (y // 3)) % 2 == 0)[..., None], [1, 0.6, 0.2], 0.05)
    inside = np.hypot(x + 0.5 - size / 2, y + 0.5 - size / 2) < 0.35 * size
    return torch.from_numpy(np.dstack([colors, inside]).astype(np.float32))


def dataset(folder, size: int, fov: float = 49.1):
    """One object whose three views all show the disc."""
    cameras = around([0, 90, 180], 0, 1.5, size, fov)
    write_views(folder / "a", disc(size).expand(3, -1, -1, -1), cameras)
    write_split(folder, test=["a"])
    return folder


@pytest.mark.parametrize("detail", [None, 1, 2])
def test_the_figures_are_those_of_the_file_that_reconstruct_writes(tmp_path, detail):
    # It sees all pixels, so that nothing depends on the filter by which an image is made smaller.
    model = write_model(tmp_path / "rays.safetensors", image_size=4 * CELLS, patch_size=32)
    data = dataset(tmp_path / "data", 4 * CELLS)
    words = [] if detail is None else ["--detail", str(detail)]
    options = ["--no-baselines", "--strips", 0, "--sheet", 0]
    _, report = eval_views(model, data, tmp_path / "own", *options, *words)
    out = tmp_path / "written"
    places = [data / "a" / "000.png", "--out", out, "--checkpoint", model, "--no-recenter"]
    words += ["--min-opacity", "0", "--turntable", "none", "--no-page"]
    assert run_reconstruct(*places, *words) == 0
    (written,) = out.glob("*.ply")
    written.rename(out / "a.ply")
    _, again = eval_views(out, data, tmp_path / "again", *options)
    (mine,), (theirs,) = report["objects"], again["objects"]
    assert mine["gaussians"] == theirs["gaussians"]
    for metric in ("psnr", "ssim", "mask_iou"):
        for own, other in ((mine, theirs), (mine["input"], theirs["input"])):
            assert own[metric] == pytest.approx(other[metric], abs=1e-3), metric
    said = report["protocol"]["source"]["detail"]
    assert said == ("as the image has pixels" if detail is None else str(detail))


def number_and_psnr(model, data, out, *words):
    _, report = eval_views(model, data, out, *words, "--no-baselines", "--strips", 0, "--sheet", 0)
    (record,) = report["objects"]
    return record["gaussians"], record["input"]["psnr"]


def test_the_size_that_is_compared_decides_by_default(model, tmp_path):
    data = dataset(tmp_path / "data", 4 * CELLS)
    numbers = {}
    for size in (4 * CELLS, 2 * CELLS, CELLS):
        words = ["--size", size]
        numbers[size], _ = number_and_psnr(model, data, tmp_path / f"{size}", *words)
    assert numbers[4 * CELLS] > numbers[2 * CELLS] > numbers[CELLS]
    for size, detail in ((4 * CELLS, 4), (2 * CELLS, 2), (CELLS, 1)):
        words = ["--size", size, "--detail", detail]
        assert number_and_psnr(model, data, tmp_path / "told", *words)[0] == numbers[size]


@pytest.mark.parametrize("fov", [25.0, 70.0])
def test_the_front_splits_along_the_rays_of_the_view_s_own_camera(model, tmp_path, fov):
    data = dataset(tmp_path / "data", 4 * CELLS, fov)
    outs = {detail: tmp_path / f"{detail}" for detail in (4, 1)}
    sharp, plain = (number_and_psnr(model, data, outs[k], "--detail", k)[1] for k in (4, 1))
    assert sharp > plain + 3, (sharp, plain)  # dB; with another camera's rays it is less than plain


def test_a_detail_that_cannot_be_is_refused(model, tmp_path, capsys):
    data = dataset(tmp_path / "data", 2 * CELLS)
    save_model(tmp_path / "bins.safetensors", Gamba(micro(encoder="none")))
    for pred, said in (
        (tmp_path / "bins.safetensors", "detail 2 needs a model with the decoder rays"),
        (data, "--detail: .*holds no model"),
    ):
        assert eval_views(pred, data, tmp_path / "out", "--detail", 2)[0] == 2
        assert re.search(said, capsys.readouterr().err)
