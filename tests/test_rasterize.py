"""The rasterizer against its float64 oracle, and its conventions."""

import torch
from helpers import assert_rel_rms

from gamba_warp.kernels.rasterize import rasterization
from gamba_warp.kernels.rasterize.reference import rasterization_reference

NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")
PICTURE = 1e-5  # float32 sums of some hundred terms in [0, 1]
GRADIENT = 1e-4  # as above, with factors up to 1 / (1 - alpha_max)


def look(batch, views, width, height):
    """Cameras around the origin: rotated, off-centre, with two focal lengths."""
    from gamba_warp.cameras import orbit

    azimuths = torch.arange(batch * views) * 47.0
    viewmats = orbit(azimuths, elevation=20.0, distance=1.6).view(batch, views, 4, 4)
    K = torch.tensor([[1.3 * width, 0, 0.55 * width], [0, 0.9 * height, 0.45 * height], [0, 0, 1]])
    return viewmats, K.expand(batch, views, 3, 3).clone()


def make(batch=2, views=3, num=60, width=37, height=53, channels=3, size=0.06):
    means = 0.3 * torch.randn(batch, num, 3)
    quats = torch.randn(batch, num, 4)
    scales = size * torch.exp(0.5 * torch.randn(batch, num, 3))
    opacities = 0.05 + 0.9499 * torch.rand(batch, num)
    colors = torch.rand(batch, num, channels)
    viewmats, Ks = look(batch, views, width, height)
    backgrounds = torch.rand(batch, views, channels)
    return dict(
        means=means, quats=quats, scales=scales, opacities=opacities, colors=colors,
        viewmats=viewmats, Ks=Ks, width=width, height=height, backgrounds=backgrounds,
    )  # fmt: skip


def leaves(scene, dtype):
    return {
        k: v.to(dtype).clone().requires_grad_(k != "Ks") if isinstance(v, torch.Tensor) else v
        for k, v in scene.items()
    }


def near_a_cut(scene, options):
    """Pixels whose float64 alpha changes when alpha_min does a little: there rounding decides."""
    scene = {k: v.double() if isinstance(v, torch.Tensor) else v for k, v in scene.items()}
    alpha_min = options.get("alpha_min", 1 / 255)
    options = {k: v for k, v in options.items() if k != "alpha_min"}
    with torch.no_grad():
        low, high = (
            rasterization_reference(**scene, **options, alpha_min=alpha_min * (1 + s))[2]
            for s in (-1e-5, 1e-5)
        )
    return (low != high)[..., 0]


def compare(scene, mode="RGB", antialiased=False, **options):
    """Pictures and gradients under a random cotangent, against the oracle in float64."""
    flip = near_a_cut(scene, {**options, "antialiased": antialiased})
    assert flip.float().mean() < 0.05
    got, want = leaves(scene, torch.float32), leaves(scene, torch.float64)
    renders, alphas, _ = rasterization(
        **got,
        render_mode=mode,
        rasterize_mode="antialiased" if antialiased else "classic",
        **options,
    )
    color, depth, alpha = rasterization_reference(**want, antialiased=antialiased, **options)
    if mode.endswith("ED"):
        depth = depth / alpha.clamp_min(1e-10)
    expected = {"RGB": [color], "D": [depth], "ED": [depth]}.get(mode, [color, depth])
    expected = torch.cat(expected, -1)
    assert alpha.mean() > 0.1 and renders.std() > 0.01, "the picture is empty"
    keep = ~flip[..., None]
    assert ((renders - expected) * keep).abs().max() <= PICTURE * max(1.0, expected.max().item())
    assert ((alphas - alpha) * keep).abs().max() <= PICTURE
    v_renders = torch.randn_like(renders) * keep
    v_alphas = torch.randn_like(alphas) * keep
    (renders * v_renders).sum().add((alphas * v_alphas).sum()).backward()
    (expected * v_renders).sum().add((alpha * v_alphas).sum()).backward()
    for name in NAMES:
        if isinstance(got[name], torch.Tensor) and want[name].grad is not None:
            assert_rel_rms(got[name].grad, want[name].grad, GRADIENT, name)


def test_against_oracle():
    compare(make())
