"""Splitting of the front to the image's resolution: cells, children, and errors."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.model import FIELDS, micro, quick, run_reconstruct
from helpers.refusals import refused
from scipy.ndimage import minimum_filter

from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.conventions import over_background
from gamba_warp.data.preprocess import resize_rgba
from gamba_warp.formats.ply import load_ply
from gamba_warp.gaussians import Gaussians, quat_multiply
from gamba_warp.image_metrics import psnr
from gamba_warp.images import save_image
from gamba_warp.model import detail as subject
from gamba_warp.model.checkpoint import load_model, save_model
from gamba_warp.model.config import GambaConfig
from gamba_warp.model.detail import (
    MIN_SIZE,
    OFFSET_FRACTION,
    checked_detail,
    fill_gaps,
    split_front,
)
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.posing import reference_cameras
from gamba_warp.model.predict import model_input, reconstruct
from gamba_warp.render import render


def rays(**changes) -> GambaConfig:
    """24 x 24 cells of a pixel each, and three layers."""
    wanted = {"decoder": "rays", "encoder": "none", "ray_cells": 8, "ray_layers": 3}
    return micro(**(wanted | {"ray_features": 5, "image_size": 24, "patch_size": 8} | changes))


def fresh(**changes) -> Gamba:
    """Untrained model, whose front is an opaque plane with the colours of the image."""
    torch.manual_seed(4)
    return Gamba(rays(**changes)).eval()


def board(size: int, square: int, radius: float = 0.4) -> np.ndarray:
    """A disc ``[size, size, 4]`` of a black and orange checkerboard with sharp edges."""
    y, x = np.mgrid[:size, :size]
    colors = np.where((((x // square) + (y // square)) % 2 == 0)[..., None], [1, 0.6, 0.2], 0.05)
    inside = np.hypot(x + 0.5 - size / 2, y + 0.5 - size / 2) < radius * size
    return np.dstack([colors, inside]).astype(np.float32)


def box(size: int, first: int, last: int, color=(0.2, 0.5, 0.9)) -> np.ndarray:
    """A square of one colour, ``[size, size, 4]``, between two rows and the same columns."""
    rgba = np.zeros((size, size, 4), np.float32)
    rgba[first:last, first:last] = (*color, 1)
    return rgba


def input_view(gaussians: Gaussians, config: GambaConfig, rgba: np.ndarray) -> float:
    """PSNR of the input view on white, at the size of ``rgba``."""
    camera = reference_cameras(config, 1).resized(len(rgba), len(rgba))
    seen = render(gaussians, camera, background=torch.ones(3)).rgb[0]
    return float(psnr(seen.clamp(0, 1), torch.from_numpy(over_background(rgba, 1.0))))


def same(one: Gaussians, other: Gaussians) -> bool:
    return all(torch.equal(getattr(one, name), getattr(other, name)) for name in FIELDS)


def filled(model: Gamba, rgba: np.ndarray) -> Gaussians:
    whole = reconstruct(model, rgba, detail=1)
    return fill_gaps(whole, model.config, reference_cameras(model.config, 1))


def test_detail_1_is_what_the_network_gave_bit_for_bit():
    model, rgba = fresh(), board(96, 8)
    with torch.inference_mode():
        want = model(model_input(rgba, model.config), reference_cameras(model.config, 1))[0]
    assert same(reconstruct(model, rgba, detail=1), want)
    assert reconstruct(model, rgba, detail=2).num > want.num


def test_the_default_is_what_the_image_has_the_pixels_for():
    sides = {23: 1, 47: 1, 48: 2, 95: 2, 96: 4, 5000: 4}
    assert {side: checked_detail(None, rays(), side) for side in sides} == sides
    halves = rays(ray_cells=4)  # cells of 2 x 2 pixels
    assert [checked_detail(None, halves, side) for side in (23, 24, 48)] == [1, 2, 4]
    model = fresh()
    assert same(reconstruct(model, board(47, 4)), filled(model, board(47, 4)))
    assert same(reconstruct(model, board(96, 4)), reconstruct(model, board(96, 4), detail=4))


@pytest.mark.parametrize("size, changes", [(24, {}), (96, {}), (24, {"predict_rotation": True})])
def test_a_plain_image_has_no_gaps_when_it_is_drawn_large(size, changes):
    """Four pixels a cell; the network's own Gaussians let the background through between them.

    Along the view, where no gap can be, they stay as they are.
    """
    model, rgba = fresh(**changes), box(size, size // 4, 3 * size // 4)
    model.decoder.scale_bias.data[0] = math.log(0.2)  # sides of a cell
    camera = reference_cameras(model.config, 1).resized(96, 96)
    inside = slice(32, 64)
    after, before = (reconstruct(model, rgba, detail=k) for k in (None, 1))
    found, raw = (render(g, camera).alpha[0, inside, inside].min() for g in (after, before))
    assert raw < 0.4 < 0.75 < found
    grown = filled(model, rgba).scales > before.scales
    assert (grown[::3].sum(-1) == 2).all()  # of the first layer


def test_what_is_plain_does_not_split():
    model = fresh()
    for detail in (2, 4):
        full = box(24 * detail, 0, 24 * detail)
        before = filled(model, full)
        assert same(reconstruct(model, full, detail=detail), before)
        # A mark on one cell splits this one and its neighbours.
        full[12 * detail, 12 * detail, :3] = 0
        assert reconstruct(model, full, detail=detail).num == before.num + 9 * (detail**2 - 1)
        # A square of 8 x 8 cells has 28 with background beside them, of which each becomes four.
        # The 36 around it have a little of its alpha, by the filter, but their pixels have none.
        square = box(24 * detail, 8 * detail, 16 * detail)
        more = reconstruct(model, square, detail=detail).num
        assert more == reconstruct(model, square, detail=1).num + 28 * 3 - 36


@pytest.mark.parametrize(
    "changes",
    [{}, {"patch_size": 24, "ray_cells": 24, "ray_layers": 2}, {"ray_cells": 4, "ray_layers": 1}],
    ids=["patch 8", "patch 24", "cells of 2 x 2 pixels"],
)
def test_the_input_view_becomes_sharp(changes):
    """An untrained front has no error of depth, so only that of the splitting remains."""
    model = fresh(**changes)
    side = 24 // (model.config.patch_size // model.config.ray_cells)
    rgba = board(4 * side, 3)
    found = {k: input_view(reconstruct(model, rgba, detail=k), model.config, rgba) for k in (1, 4)}
    assert found[1] < 17 and found[4] > found[1] + 3, found


def test_a_checkerboard_at_512_becomes_sharp_with_the_shipped_model():
    model, rgba = load_model(), board(512, 12)
    found = [input_view(reconstruct(model, rgba, detail=k), model.config, rgba) for k in (1, 4)]
    assert found[1] > 17 and found[1] - found[0] > 5, found  # dB; weights differ in the first


def test_what_lies_behind_a_faint_front_does_not_show_through():
    model, rgba = fresh(ray_layers=2, ray_back="opaque"), board(96, 8)
    with torch.inference_mode():
        model.decoder.opacity_bias[0] = -1.0
        given = model_input(rgba, model.config)
        made = model(given, reference_cameras(model.config, 1))[0]
        made.colors[1::2] = 0.0  # a black back
        camera = reference_cameras(model.config, 1)
        sharp = split_front(made, given[0], rgba, model.config, 4, camera)
        image = render(sharp, camera.resized(96, 96)).rgb[0]
    inside = minimum_filter(rgba[..., 3], 9) > 0  # without the outline, which is soft
    error = (image.numpy() - rgba[..., :3])[inside]
    assert -10 * np.log10((error**2).mean()) > 17  # dB; 14.2 if it did


def test_no_crack_opens_from_the_side():
    """The ball's shading tells the shipped model its depth; its alpha from 60° and 90° stays."""
    size = 512
    y, x = (np.mgrid[:size, :size] + 0.5) / size * 2.5 - 1.25
    height = np.sqrt(np.clip(1 - x**2 - y**2, 0, None))
    light = (0.3 + 0.7 * height) * np.where((np.floor(x * 12) + np.floor(y * 12)) % 2, 0.7, 1.0)
    rgba = np.dstack([light, 0.6 * light, 0.3 * light, height > 0]).astype(np.float32)
    model = load_model()
    viewmats = orbit(torch.tensor([60.0, 90.0, -90.0]))
    cameras = Cameras(viewmats, intrinsics(256, 256).expand(3, 3, 3), 256, 256)
    made = (render(reconstruct(model, rgba, detail=k), cameras).alpha[..., 0] for k in (1, 4))
    for one, other in zip(*made):
        full = one > 0.95
        assert full.sum() > 5000
        # One pixel in two thousand may lose a tenth of its alpha; cracks would be whole lines.
        assert (other[full] < one[full] - 0.1).float().mean() < 5e-4
        assert (other - one).abs().mean() < 0.02


def test_children_go_half_of_the_way_that_parents_lie_off_their_rays():
    model, rgba = fresh(), board(48, 2)
    with torch.inference_mode():
        image, camera = model_input(rgba, model.config), reference_cameras(model.config, 1)
        found = []
        for off in (0.0, 0.004):
            made = model(image, camera)[0]
            made.means[:, 0] += off
            split = split_front(made, image[0], rgba, model.config, 2, camera)
            found.append(split.means[-200:])
    want = torch.tensor([0.002, 0.0, 0.0]).expand(200, 3)
    torch.testing.assert_close(found[1] - found[0], want, atol=1e-6, rtol=0)


def test_children_lie_on_the_rays_of_their_own_pixels(monkeypatch):
    """Except for the fraction of their parent's offset from its ray."""
    monkeypatch.setitem(OFFSET_FRACTION, 2, 0.0)
    model, rgba = fresh(), board(48, 2)
    model.decoder.scale_bias.data[0] = math.log(0.9)  # sides of a cell
    found = reconstruct(model, rgba, detail=2)
    whole = reconstruct(model, rgba, detail=1)
    children = found.select(torch.arange(found.num) >= found.num - 200)
    camera = reference_cameras(model.config, 1).resized(48, 48)
    points = children.means + camera.viewmats[0, :3, 3]
    pixels = points[:, :2] / points[:, 2:] * camera.Ks[0, 0, 0] + 24
    torch.testing.assert_close(pixels % 1, torch.full_like(pixels, 0.5), atol=1e-3, rtol=0)
    assert len(pixels.round(decimals=2).unique(dim=0)) == 200  # and each has its own pixel
    # Half as wide across the view as their parents, and as long along it.
    parents = whole.scales[::3].mean(0)
    ratio = children.scales.mean(0) / parents
    torch.testing.assert_close(ratio, torch.tensor([0.5, 0.5, 1.0]), rtol=0.02, atol=0)
    # Children of small parents are still wide enough to cover the image.
    model.decoder.scale_bias.data[0] = math.log(0.1)
    small = reconstruct(model, rgba, detail=2).scales[-200:]
    side = 0.5 * parents[:2].max() / 0.9
    torch.testing.assert_close(small[:, :2], (MIN_SIZE[2] * side).expand(200, 2), rtol=0.02, atol=0)


def test_a_cell_counts_as_much_as_its_alpha():
    """Faint cells far behind do not pull the children of the full ones beside them."""
    model, rgba = fresh(), board(96, 2, radius=1.0)
    rgba[:, 48:, 3] = 0.05
    before, image = reconstruct(model, rgba, detail=1), model_input(rgba, model.config)[0]
    faint = before.means[:, 0] > 0.02
    moved = replace(before, means=before.means * torch.where(faint, 1.2, 1.0)[:, None])
    moved.means[faint, 2] += 0.3
    about = image, rgba, model.config, 2, reference_cameras(model.config, 1)
    depths = []
    for each in (split_front(one, *about) for one in (before, moved)):
        depths.append(each.means[(each.means[:, 0] < -0.01) & (each.scales[:, 0] < 0.013), 2])
    assert len(depths[0]) == len(depths[1]) > 500
    assert (depths[1] - depths[0]).abs().max() < 0.02


def test_children_of_turned_gaussians_keep_the_axis_along_the_view():
    quarter = math.sqrt(0.5)
    turns = torch.tensor([[1.0, 0, 0, 0], [quarter, quarter, 0, 0], [quarter, 0, quarter, 0]])
    # Turned about x the axis y looks along the view, about y it is the axis x.
    want = torch.tensor([[0, 0, 1], [0, 1, 0], [1, 0, 0]], dtype=torch.bool)
    assert torch.equal(subject._along_the_view(3 * turns, turns), want)
    some = torch.randn(50, 4, generator=torch.Generator().manual_seed(1))
    axes = torch.cat([torch.zeros(3, 1), torch.eye(3)], 1).expand(50, 3, 4)
    back = some * torch.tensor([1.0, -1, -1, -1])
    turned = quat_multiply(quat_multiply(some[:, None].expand(50, 3, 4), axes), back[:, None])
    want = turned[..., 3].abs().argmax(1)
    assert torch.equal(subject._along_the_view(some, some).float().argmax(1), want)
    model = fresh(predict_rotation=True)
    found = reconstruct(model, board(48, 2), detail=2)
    assert found.quats is not None and found.num > reconstruct(model, board(48, 2), detail=1).num


def test_the_count_is_bounded(monkeypatch):
    model = fresh()
    noise = np.random.default_rng(1).random((96, 96, 4)).astype(np.float32)
    noise[..., 3] = 1
    noise[:, :48, :3] *= 0.3
    before = reconstruct(model, noise, detail=1).num
    assert reconstruct(model, noise, detail=4).num == before + 24 * 24 * 15
    monkeypatch.setattr(subject, "MAX_CHILDREN", 4000)
    found = reconstruct(model, noise, detail=4)
    others = before - 24 * 24
    assert 3900 < found.num - others <= 4000
    # Those with the most contrast split in 4 x 4: all are in the right half,
    # or in the column of cells (0.06 wide) beside it.
    widths = found.scales[others:, 0]
    assert (found.means[others:][widths < 1.5 * widths.min(), 0] > -0.07).all()


@pytest.mark.parametrize("detail", [2, 4])
def test_alpha_that_is_soft_everywhere(detail):
    model, rgba = fresh(), board(96, 5)
    y, x = np.mgrid[:96, :96] / 95
    rgba[..., 3] = 0.2 + 0.5 * x * y
    found = reconstruct(model, rgba, detail=detail)
    assert all(getattr(found, name).isfinite().all() for name in FIELDS)
    assert found.num <= model.config.num_gaussians + 3 * 24 * 24  # no cell is inner: 2 x 2 at most
    small = resize_rgba(rgba, 48, 48)
    before = input_view(reconstruct(model, rgba, detail=1), model.config, small)
    assert input_view(found, model.config, small) > before


def test_children_of_what_is_not_finite_are_not_left_out():
    """Writers of files can then reject them."""
    model, rgba = fresh(), board(96, 4)
    image = model_input(rgba, model.config)[0]
    made = reconstruct(model, rgba, detail=1)
    with torch.inference_mode():
        made.opacities[3 * 200] = math.nan  # of the first layer
        found = split_front(made, image, rgba, model.config, 4, reference_cameras(model.config, 1))
    assert found.opacities.isnan().sum() >= 16


def test_three_pixels_and_none():
    model = fresh()
    empty = np.zeros((96, 96, 4), np.float32)
    assert reconstruct(model, empty, detail=4).num == 0
    three = empty.copy()
    three[50, 50:53] = (0.9, 0.1, 0.1, 1)
    found = reconstruct(model, three, detail=4)
    assert all(getattr(found, name).isfinite().all() for name in FIELDS)
    red = found.colors[-1]
    assert red[0] > 0.6 and red[1:].max() < 0.3


def test_the_option_reaches_the_network_and_its_default_is_the_images(tmp_path, capsys):
    model = tmp_path / "model.safetensors"
    save_model(model, fresh())
    save_image(tmp_path / "a.png", board(120, 4))
    counts = {}
    for detail in ((), ("--detail", 1), ("--detail", 2), ("--detail", 4)):
        assert run_reconstruct(tmp_path / "a.png", *quick(model, tmp_path), *detail) == 0
        counts[detail[1:]] = load_ply(tmp_path / "a.ply").num
    assert counts[()] == counts[(4,)] > counts[(2,)] > counts[(1,)]


def test_other_decoders_and_other_numbers_are_refused():
    torch.manual_seed(1)
    bins = Gamba(micro(encoder="none")).eval()
    rgba = board(96, 4)
    said = "detail 2 needs a model with the decoder rays, and this one has bins"
    refused(said, reconstruct, bins, rgba, detail=2)
    assert same(reconstruct(bins, rgba), reconstruct(bins, rgba, detail=1))
    refused("detail is 3, it must be 1, 2 or 4", reconstruct, fresh(), rgba, detail=3)


def test_no_background_gets_into_the_colours():
    """A plain object keeps its colour at its boundary: the correction adds no white."""
    model, color = fresh(), torch.tensor([0.5, 0.3, 0.1])
    found = reconstruct(model, box(96, 29, 67, color.tolist()), detail=4)
    front = found.colors[found.opacities > 0.05]
    assert len(front) > 200 and (front - color).abs().max() < 0.1
