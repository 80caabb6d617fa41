"""Every skip of the rasterizer, on and off: the same image, the same gradients, its own count."""

from dataclasses import fields, replace

import pytest
import torch

from gamba_warp.kernels.cases.raster import LEAVES, orbit_cameras, shell
from gamba_warp.kernels.rasterize import Skip, rasterization

WIDTH, HEIGHT, VIEWS = 150, 139, 2
NAMES = [field.name for field in fields(Skip)]


def render(skip=None, wanted=LEAVES, mode="classic"):
    """An opaque shell, much of it hidden, empty tiles around it, no gradient on the right half."""
    torch.manual_seed(0)
    gaussians = {k: x.clone() for k, x in shell(6000, 3).items()}
    gaussians["opacities"][::5] = 0.004  # touches almost nothing
    gaussians["opacities"].clamp_(max=0.98)
    viewmats, Ks = orbit_cameras(VIEWS, 128)
    inputs = {k: x.requires_grad_(k in wanted) for k, x in gaussians.items()}
    options = {} if skip is None else {"skip": skip}
    renders, alphas, meta = rasterization(
        **inputs,
        viewmats=viewmats,
        Ks=Ks,
        width=WIDTH,
        height=HEIGHT,
        rasterize_mode=mode,
        **options,
    )
    v, w = torch.randn_like(renders), torch.randn_like(alphas)
    v[:, :, 64:] = w[:, :, 64:] = 0
    gradients = torch.autograd.grad([renders, alphas], [inputs[k] for k in wanted], [v, w])
    return dict(zip(("image", "alpha", *wanted), (renders, alphas, *gradients))), meta


def close(got, want):
    """Equal to rounding: 1e-6 of the largest value."""
    assert got.keys() == want.keys()
    return {
        k: float((got[k] - want[k]).detach().abs().max() / want[k].detach().abs().max())
        for k in want
    }


def test_default_is_every_skip():
    assert all(getattr(Skip(), name) for name in NAMES)
    assert rasterization.__kwdefaults__["skip"] == Skip()


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("name", [*NAMES, "all of them"])
def test_same_with_and_without(name, mode):
    want, counts = render(mode=mode)
    assert want["image"].mean() > 0.1 and counts["tiles_empty"] > 5
    off = {name: False} if name in NAMES else dict.fromkeys(NAMES, False)
    got, _ = render(replace(Skip(), **off), mode=mode)
    errors = close(got, want)
    assert max(errors.values()) < 1e-6, errors


def test_counts_tell_what_each_leaves_out():
    got, on = render()
    assert (got["means"].abs().sum(1) == 0).sum() > 50  # those that are hidden
    tiles = on["tiles"] - on["tiles_empty"]
    metas = {name: render(replace(Skip(), **{name: False}))[1] for name in NAMES}
    assert metas["tile_test"]["pairs"] == on["pairs_box"] > on["pairs"]
    assert metas["block_test"]["blocks_traversed"] > 1.5 * on["blocks_traversed"]
    assert metas["stopped"]["pairs_traversed"] == on["pairs"] > on["pairs_traversed"]
    assert metas["zero_upstream"]["tiles_skipped"] == on["tiles_empty"]
    assert on["tiles_empty"] + tiles / 5 < on["tiles_skipped"] < on["tiles"]
    assert on["blocks_traversed"] > on["blocks_used"] > on["pairs_used"] > on["gaussians_used"] > 0
    assert on["gaussians_used"] < VIEWS * 6000
    for name in NAMES:  # what had an effect does not depend on what was looked at
        assert metas[name]["blocks_used"] == on["blocks_used"]
