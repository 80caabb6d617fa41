"""The rasterizer at realistic size against the float64 oracle: row by row, and pixels at the cuts.

Image and gradient are compared pixel by pixel and Gaussian by Gaussian, with both cuts on. Where
float32 decides a cut otherwise than float64 the image jumps: such pixels are counted, bounded,
and each must lie within rounding of a cut.
"""

import pytest
import torch
from helpers.raster import BAND, NAMES, assert_gradients, both, make, mapped

from gamba_warp.kernels.rasterize import rasterization, reference
from gamba_warp.kernels.rasterize.constants import ALPHA_MIN

FLIPS = 2e-4  # the fraction of pixels that may fall on the other side of a cut


def ordinary(num=2000, **changes):
    return make(1, 2, num, width=96, height=80, **{"size": 0.02, **changes})


def opaque():
    scene = ordinary(1500, size=0.06)
    scene["opacities"] = 0.9 + 0.0999 * torch.rand(1, 1500)
    return scene


def flat():
    """Discs and needles of any length, as training makes them."""
    scene = ordinary()
    scene["scales"] = 0.02 * torch.exp(1.5 * torch.randn(1, 2000, 3))
    return scene


def wide():
    """Most Gaussians beside the image or behind the camera, the Jacobian clamped for many."""
    scene = ordinary(size=0.1)
    scene["means"] = scene["means"] * 4
    scene["Ks"][..., 0, 0] *= 0.3
    scene["Ks"][..., 1, 1] *= 0.5
    return scene


SCENES = {
    "ordinary": (ordinary, dict(mode="RGB+D")),
    "antialiased": (lambda: ordinary(size=0.01), dict(mode="RGB+ED", antialiased=True)),
    "opaque": (opaque, dict(mode="RGB+ED")),
    "flat": (flat, dict()),
    "wide": (wide, dict(mode="RGB+D")),
    "without rotation": (lambda: dict(ordinary(), quats=None), dict(antialiased=True)),
}


@pytest.mark.parametrize("name", SCENES)
def test_realistic_size(name):
    build, options = SCENES[name]
    found = both(build(), **options)
    assert found.flipped.float().mean() <= FLIPS, f"{found.flipped.sum()} pixels flipped"
    assert (found.distance < BAND).float().mean() < 0.02, "the band is too wide"
    assert found.meta["pairs"] > 5000
    assert_gradients(found)


def test_flips_only_at_alpha_min():
    """Each Gaussian is made to have alpha_min at one pixel to the last bit: about half flip."""
    num = 600
    scene = ordinary(num)
    meta = rasterization(**scene)[2]
    center = meta["means2d"][0, 0].double()
    a, k, e = meta["conics"][0, 0].double().unbind(-1)

    def q(d):
        return a * (d[:, 0] + k * d[:, 1]) ** 2 + e * d[:, 1] ** 2

    direction = torch.randn(num, 2, dtype=torch.float64)
    reach = ((6 + 4 * torch.rand(num)) / q(direction)).sqrt()[:, None]
    pixel = (center + reach * direction).floor() + 0.5
    opacity = ALPHA_MIN * torch.exp(0.5 * q(pixel - center))
    chosen = (opacity < 0.95) & ((pixel > 0) & (pixel < torch.tensor([96, 80]))).all(1)
    assert chosen.sum() > num / 2
    scene["opacities"] = torch.where(chosen, opacity, 0.5).float()[None]
    flipped = both(scene).flipped
    assert 0.1 * chosen.sum() < flipped[0, 0].sum() < chosen.sum()
    assert flipped[0, 1].sum() <= 2, "the other view has nothing at its cuts"


def test_flips_only_at_the_stop():
    """Four layers of 0.9 leave 1e-4, to rounding, at every pixel: some stop before the last one."""
    scene = ordinary(4, size=1.0)
    scene["means"] = 0.01 * torch.randn(1, 4, 3)
    scene["scales"] = torch.full((1, 4, 3), 100.0)
    scene["opacities"] = torch.full((1, 4), 0.900005)
    scene["colors"] = torch.rand(1, 4, 3)
    found = both(scene)
    assert found.flipped.any() and (found.got[2] - found.want[2]).abs().max() < 1e-3


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("focal", [1.3, 0.3])
def test_oracle_by_finite_differences(one_thread, antialiased, focal):
    """Every entry of the oracle's Jacobian in float64; no pixel sits at a cut for this seed."""
    scene = mapped(make(1, 1, num=4, width=7, height=5, size=0.3), torch.Tensor.double)
    scene["means"] = scene["means"] * (1.0 if focal > 1 else 3.0)
    tensors = [scene[k][0].clone().requires_grad_() for k in NAMES[:5]]
    tensors.append(scene["viewmats"][0, 0].clone().requires_grad_())
    K = scene["Ks"][0, 0].clone()
    K[0, 0] = focal * 7

    def image(means, quats, scales, opacities, colors, viewmat):
        inputs = (means, quats, scales, opacities, colors, viewmat, K, 7, 5)
        parts = reference.render_view(*inputs, alpha_min=1e-12, antialiased=antialiased)
        return torch.cat(parts, -1)

    assert image(*tensors)[..., -1].mean() > 0.2
    assert torch.autograd.gradcheck(image, tensors, eps=1e-6, atol=1e-6, rtol=1e-5)
