"""Scenes for the rasterizer's tests: random Gaussians and cameras, and error limits.

A scene is a dict of the arguments of ``rasterization``, so that a test may change one by name.
"""

import torch

from gamba_warp.cameras import orbit
from gamba_warp.kernels.rasterize import rasterization
from gamba_warp.kernels.rasterize.reference import rasterization_reference
from helpers import assert_rel_rms

NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")
IMAGE = 1e-5  # float32 sums of some hundred terms in [0, 1]
GRADIENT = 1e-4  # as above, with factors up to 1 / (1 - alpha_max)


def look(batch, views, width, height):
    """Cameras around the origin: rotated, off-centre, with two focal lengths."""
    azimuths = torch.arange(batch * views) * 47.0
    viewmats = orbit(azimuths, elevation=20.0, distance=1.6).view(batch, views, 4, 4)
    K = torch.tensor([[1.3 * width, 0, 0.55 * width], [0, 0.9 * height, 0.45 * height], [0, 0, 1]])
    return viewmats, K.expand(batch, views, 3, 3).clone()


def make(batch=2, views=3, num=60, width=37, height=53, channels=3, size=0.06):
    """A scene of float32 tensors: standard deviations around ``size``, all opacities."""
    viewmats, Ks = look(batch, views, width, height)
    return dict(
        means=0.3 * torch.randn(batch, num, 3),
        quats=torch.randn(batch, num, 4),
        scales=size * torch.exp(0.5 * torch.randn(batch, num, 3)),
        opacities=0.05 + 0.9499 * torch.rand(batch, num),
        colors=torch.rand(batch, num, channels),
        viewmats=viewmats,
        Ks=Ks,
        width=width,
        height=height,
        backgrounds=torch.rand(batch, views, channels),
    )


def crowded(channels=3, num=90):
    """Some pixels stop early, some alphas are clamped; lists of up to three batches of a warp."""
    scene = make(1, 2, num=num, width=37, height=21, channels=channels, size=0.15)
    scene["opacities"][:, ::2] = 0.9999
    return scene


def mapped(scene, function):
    """The scene with ``function`` of each tensor."""
    return {k: function(v) if isinstance(v, torch.Tensor) else v for k, v in scene.items()}


def one(mean=(0.0, 0.0, 2.0), scale=0.1, opacity=0.8, size=(33, 31), focal=40.0):
    """One round Gaussian before a camera at the origin."""
    width, height = size
    return dict(
        means=torch.tensor([mean]),
        quats=None,
        scales=torch.full((1, 3), scale),
        opacities=torch.tensor([opacity]),
        colors=torch.tensor([[0.2, 0.5, 1.0]]),
        viewmats=torch.eye(4)[None],
        Ks=torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]]]),
        width=width,
        height=height,
    )


def leaves(scene, dtype):
    """A copy of another dtype, in which every tensor but Ks requires a gradient."""
    scene = mapped(scene, lambda v: v.detach().to(dtype).clone().requires_grad_())
    scene["Ks"].requires_grad_(False)
    return scene


def drawn(scene, mode="RGB", needs=NAMES, edit=lambda v: None, **options):
    """Renders, alphas and gradients by name, under cotangents that repeat; the meta.

    Args:
        scene: of float32 tensors.
        mode: of rendering.
        needs: names of the inputs that require gradients.
        edit: changes the cotangents of renders and alphas, a list, in place.
        options: further ones of ``rasterization``.
    """
    tensors = leaves(scene, torch.float32)
    asked = {k: tensors[k] for k in NAMES if tensors.get(k) is not None}
    for name, tensor in asked.items():
        tensor.requires_grad_(name in needs)
    renders, alphas, meta = rasterization(**tensors, render_mode=mode, **options)
    generator = torch.Generator().manual_seed(1)
    v = [torch.randn(x.shape, generator=generator).to(x) for x in (renders, alphas)]
    edit(v)
    ((renders * v[0]).sum() + (alphas * v[1]).sum()).backward()
    grads = {name: x.grad for name, x in asked.items() if x.grad is not None}
    return {"renders": renders, "alphas": alphas, **grads}, meta


def near_a_cut(scene, options):
    """Pixels whose float64 alpha changes with a small change of alpha_min, so rounding decides."""
    alpha_min = options.get("alpha_min", 1 / 255)
    options = {k: v for k, v in options.items() if k != "alpha_min"}
    scene = mapped(scene, torch.Tensor.double)
    low, high = (
        rasterization_reference(**scene, **options, alpha_min=alpha_min * (1 + s))[2]
        for s in (-1e-5, 1e-5)
    )
    return (low != high)[..., 0]


def rendered(scene, mode="RGB", antialiased=False, **options):
    """Leaves, renders and alphas of the rasterizer, the same of the oracle in float64; the meta."""
    got, want = leaves(scene, torch.float32), leaves(scene, torch.float64)
    kind = "antialiased" if antialiased else "classic"
    renders, alphas, meta = rasterization(**got, render_mode=mode, rasterize_mode=kind, **options)
    color, depth, alpha = rasterization_reference(**want, antialiased=antialiased, **options)
    if mode.endswith("ED"):
        depth = depth / alpha.clamp_min(1e-10)
    parts = {"RGB": [color], "D": [depth], "ED": [depth]}.get(mode, [color, depth])
    expected = torch.cat(parts, -1)
    assert alpha.mean() > 0.1 and expected.std() > 0.01, "the image is empty"
    return (got, renders, alphas), (want, expected, alpha), meta


def compare(scene, mode="RGB", antialiased=False, gradient=GRADIENT, **options):
    """Images and gradients under a random cotangent, against the oracle in float64; the meta."""
    flip = near_a_cut(scene, {**options, "antialiased": antialiased})
    assert flip.float().mean() < 0.05
    (got, renders, alphas), theirs, meta = rendered(scene, mode, antialiased, **options)
    want, expected, alpha = theirs
    keep = ~flip[..., None]
    assert ((renders - expected) * keep).abs().max() <= IMAGE * max(1.0, expected.max().item())
    assert ((alphas - alpha) * keep).abs().max() <= IMAGE
    v_renders = torch.randn_like(renders) * keep
    v_alphas = torch.randn_like(alphas) * keep
    ((renders * v_renders).sum() + (alphas * v_alphas).sum()).backward()
    ((expected * v_renders).sum() + (alpha * v_alphas).sum()).backward()
    for name in NAMES:
        if isinstance(got[name], torch.Tensor) and want[name].grad is not None:
            if got[name].grad is None:  # depth alone does not see colours
                assert name in ("colors", "backgrounds") and (want[name].grad == 0).all()
            else:
                assert_rel_rms(got[name].grad, want[name].grad, gradient, name)
    return meta
