"""Scenes for the rasterizer's tests: random Gaussians and cameras, and error limits.

gsplat's own torch functions need the last two functions to blend on the CPU.

A scene is a dict of the arguments of ``rasterization``, so that a test may change one by name.
"""

import types

import torch

from gamba_warp.cameras import orbit
from gamba_warp.kernels.rasterize import api, rasterization
from gamba_warp.kernels.rasterize.constants import ALPHA_MIN
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


def leaves(scene, dtype):
    """A copy of another dtype, in which every tensor but Ks requires a gradient."""
    scene = mapped(scene, lambda v: v.detach().to(dtype).clone().requires_grad_())
    scene["Ks"].requires_grad_(False)
    return scene


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


def absolute_gradients(monkeypatch):
    """A list to which calls from there on add their absolute gradients of means2d."""
    found, composite = [], api.composite

    def with_sums(means2d, conics, opacities, colors, bins, skipped, absolute, *options):
        found.append(torch.zeros_like(means2d))
        return composite(means2d, conics, opacities, colors, bins, skipped, found[-1], *options)

    monkeypatch.setattr(api, "composite", with_sums)
    return found


def weights_by_pixel(means2d, conics, opacities, width, height):
    """Centres of every pixel by itself ``[H W, N, 2]`` and their weights ``[H W, N]``, in float64.

    Gaussians come front to back; conics are gsplat's xx, xy, yy. The gradient of the centres, a
    leaf, has a row for each pixel.
    """
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    each = means2d.detach().double().expand(height * width, *means2d.shape).clone().requires_grad_()
    d = torch.stack([x, y], -1).view(-1, 1, 2) - each
    xx, xy, yy = conics.double().unbind(-1)
    q = xx * d[..., 0] ** 2 + 2 * xy * d[..., 0] * d[..., 1] + yy * d[..., 1] ** 2
    alpha = (opacities.double() * torch.exp(-0.5 * q)).clamp_max(0.999)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)
    after = (1 - alpha).cumprod(1)
    return each, torch.where(after > 1e-4, after / (1 - alpha) * alpha, 0.0)


def nerfacc():
    """The two functions of nerfacc that gsplat's ``accumulate`` asks for; pairs come ray by ray."""

    def render_weight_from_alpha(alphas, ray_indices, n_rays):
        order = torch.arange(len(alphas))
        first = torch.full((n_rays,), len(alphas)).scatter_reduce(
            0, ray_indices, order, "amin", include_self=True
        )
        light = torch.log1p(-alphas)
        before = torch.cumsum(light, 0) - light
        transmittances = torch.exp(before - before[first[ray_indices]])
        return transmittances * alphas, transmittances

    def accumulate_along_rays(weights, values, ray_indices, n_rays):
        values = weights[:, None] if values is None else weights[:, None] * values
        return values.new_zeros(n_rays, values.shape[-1]).index_add(0, ray_indices, values)

    module = types.ModuleType("nerfacc")
    module.render_weight_from_alpha = render_weight_from_alpha
    module.accumulate_along_rays = accumulate_along_rays
    return module


def visible_pairs(projected, opacities, width, height):
    """Every (image, pixel, Gaussian) with alpha >= alpha_min, ray by ray and front to back."""
    _, means2d, depths, conics, _ = projected
    images, num = depths.flatten(0, 1).shape
    means2d, conics = means2d.view(images, num, 2), conics.view(images, num, 3)
    order = torch.argsort(depths.view(images, num), stable=True)
    parts = []
    for image in range(images):
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        pixels = torch.stack([x, y], -1).view(-1, 1, 2) + 0.5
        d = pixels - means2d[image, order[image]]
        a, b, c = conics[image, order[image]].unbind(-1)
        q = a * d[..., 0] ** 2 + 2 * b * d[..., 0] * d[..., 1] + c * d[..., 1] ** 2
        alpha = opacities.reshape(images, num)[image, order[image]] * torch.exp(-0.5 * q)
        pixel, rank = (alpha >= ALPHA_MIN).nonzero(as_tuple=True)
        parts.append((order[image][rank], pixel, torch.full_like(pixel, image)))
    return tuple(torch.cat(p) for p in zip(*parts))
