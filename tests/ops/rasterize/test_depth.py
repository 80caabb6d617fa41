"""Expected depth, Σ w z / Σ w, where pixels are so faint that 1 - T has lost the digits of Σ w."""

import pytest
import torch
from helpers import assert_rel_rms
from helpers.raster import NAMES, leaves, make, near_a_cut

from gamba_warp.kernels.rasterize import rasterization
from gamba_warp.kernels.rasterize.reference import rasterization_reference

DEPTH = 1e-6  # relative: rounding of the weights, of which a mean of depths sees a part
GRADIENT = 5e-6  # a depth minus the mean depth loses a digit


@pytest.mark.parametrize("mode", ["ED", "RGB+ED"])
@pytest.mark.parametrize("alpha_min", [1 / 255, 1e-3])
def test_faint_pixels(mode, alpha_min):
    scene = make(1, 2, num=60, size=0.1)
    scene["opacities"] = alpha_min * (1.1 + 2 * torch.rand(1, 60))
    got, want = leaves(scene, torch.float32), leaves(scene, torch.float64)
    renders, alphas, _ = rasterization(**got, render_mode=mode, alpha_min=alpha_min)
    _, depth, weight = rasterization_reference(**want, alpha_min=alpha_min)
    # where nothing is in sight the depth is 0
    expected = depth / weight.clamp_min(1e-10)
    faint = (weight > 0) & (weight < 12 * alpha_min)
    keep = ~near_a_cut(scene, {"alpha_min": alpha_min})[..., None]
    assert (faint & keep).float().mean() > 0.4 and (weight == 0).any()
    error = (renders[..., -1:] - expected).abs() * keep
    assert (error / expected.clamp_min(1e-3)).max() < DEPTH
    assert ((alphas - weight).abs() * keep).max() < 1e-6  # alphas is still 1 - T
    v = torch.randn_like(expected) * (faint & keep)
    (renders[..., -1:] * v).sum().backward()
    (expected * v).sum().backward()
    for name in NAMES[:4]:
        assert_rel_rms(got[name].grad, want[name].grad, GRADIENT, name)
    assert got["colors"].grad is None or not got["colors"].grad.any()


def test_one_gaussian_has_its_own_depth_wherever_it_is_seen():
    """The weights cancel, even where alpha has three digits left beside 1."""
    scene = make(1, 1, num=1, size=0.1)
    scene["means"][:], scene["opacities"][:] = 0.0, 0.9
    renders, alphas, meta = rasterization(**scene, render_mode="ED", alpha_min=1e-5)
    seen = alphas > 0
    assert alphas[seen].min() < 2e-5 and seen.any() and not seen.all()
    assert (renders[seen] / meta["depths"] - 1).abs().max() < 2.5e-7
    assert (renders[~seen] == 0).all()
