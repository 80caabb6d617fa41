"""Scenes for the rasterizer's tests, and a comparison with the oracle pixel by pixel.

A scene is a dict of the arguments of ``rasterization``, so that a test may change one by name.
``Cuts`` makes the dense oracle fast enough and records the distance of each pixel from a cut (alpha
from alpha_min, T from its limit), where rounding decides; ``both`` and ``assert_gradients``
compare.
"""

from collections.abc import Mapping
from functools import partial
from typing import NamedTuple
from unittest.mock import patch

import torch

from gamba_warp.cameras import orbit
from gamba_warp.kernels.rasterize import rasterization, reference
from gamba_warp.kernels.rasterize.constants import T_MIN
from gamba_warp.kernels.rasterize.reference import rasterization_reference
from helpers import assert_rel_rms, on_threads

NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")
IMAGE = 1e-5  # float32 sums of some hundred terms in [0, 1]
GRADIENT = 1e-4  # as above, with factors up to 1 / (1 - alpha_max)
ROW = 1e-3  # of one Gaussian's gradient: a sum over few pixels, some of which cancel
ROWS = 0.999  # the fraction of Gaussians that must keep to it
BAND = 5e-5  # relative: rounding of q <= 11.1, of 1e-6 pixels of mean2d over half a pixel of sigma
COTANGENTS = 2  # one number per Gaussian may cancel under one of them, hardly under both


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
    draw = partial(torch.randn, generator=torch.Generator().manual_seed(1), dtype=torch.float32)
    v = [draw(x.shape).to(x.device) for x in (renders, alphas)]
    edit(v)
    ((renders * v[0]).sum() + (alphas * v[1]).sum()).backward()
    grads = {name: x.grad for name, x in asked.items() if x.grad is not None}
    return {"renders": renders, "alphas": alphas, **grads}, meta


def near_a_cut(scene, options):
    """Pixels whose float64 alpha changes with a small change of alpha_min, so rounding decides."""
    alpha_min = options.get("alpha_min", 1 / 255)
    options = {k: v for k, v in options.items() if k != "alpha_min"}
    scene = mapped(scene, torch.Tensor.double)
    render = partial(rasterization_reference, **scene, **options)
    low, high = (render(alpha_min=alpha_min * (1 + s))[2] for s in (-1e-5, 1e-5))
    return (low != high)[..., 0]


def to_the_cuts(raw, alpha_min, alpha_max):
    """Relative distance of each pixel from its nearest cut: alpha to alpha_min or T to T_MIN."""
    alpha = torch.where(raw >= alpha_min, raw.clamp_max(alpha_max), 0.0)
    after = torch.cumprod(1 - alpha, 1)
    going = torch.nn.functional.pad(after, (1, 0), value=1.0)[:, :-1] > T_MIN
    from_alpha = torch.where(going, (raw / alpha_min - 1).abs(), torch.inf)
    from_stop = torch.where(going & (alpha > 0), (after / T_MIN - 1).abs(), torch.inf)
    none = raw.new_full((len(raw), 1), torch.inf)
    return torch.cat([from_alpha, from_stop, none], 1).amin(1)


def alphas_in_reach(mean2d, conic, opacity, pixels, alpha_min):
    """Alpha before any cut, ``[pixels, n]``, of the n Gaussians that come near alpha_min here."""
    # q >= d² / (trace of the covariance), and the inverse of a 2 x 2 matrix has trace / det
    size = conic.diagonal(dim1=1, dim2=2).sum(1) / torch.linalg.det(conic)
    low, high = pixels.amin(0), pixels.amax(0)
    far = (mean2d - mean2d.clamp(low, high)).square().sum(1)
    near = (far <= 2 * torch.log(opacity / (0.9 * alpha_min)) * size).nonzero()[:, 0]
    (x, y), c = (pixels[:, None] - mean2d[near]).unbind(-1), conic[near]
    q = c[:, 0, 0] * x * x + 2 * c[:, 0, 1] * x * y + c[:, 1, 1] * y * y
    raw = opacity[near] * torch.exp(-0.5 * q)
    reach = (raw >= 0.9 * alpha_min).any(0)
    return near[reach], raw[:, reach]


class Cuts:
    """The oracle's blending in blocks of 8 x 8 pixels, each with the Gaussians that reach a pixel.

    The others have alpha 0 at each of its pixels, so leaving them out changes no bit. The distance
    of each pixel from its nearest cut is recorded.
    """

    def __init__(self):
        self.blend, self.views = reference._blend, []

    def __call__(self, mean2d, conic, opacity, channels, pixels, alpha_min, alpha_max, t_min):
        key = (pixels // 8).long() @ torch.tensor([1, 100_000])
        order = torch.argsort(key, stable=True)
        out = []
        for index in order.split(torch.unique(key, return_counts=True)[1].tolist()):
            with torch.no_grad():
                reach, raw = alphas_in_reach(mean2d, conic, opacity, pixels[index], alpha_min)
                distance = to_the_cuts(raw, alpha_min, alpha_max)
            chosen = (x[reach] for x in (mean2d, conic, opacity, channels))
            blended = self.blend(*chosen, pixels[index], alpha_min, alpha_max, t_min)
            out.append((*blended, distance))
        back = torch.argsort(order)
        blended, alpha, distance = (torch.cat(parts)[back] for parts in zip(*out))
        self.views.append(distance)
        return blended, alpha


class Found(NamedTuple):
    """Results of the rasterizer, and of the oracle in float64.

    Attributes:
        got: leaves by name, renders and alphas.
        want: the same of the oracle.
        flipped: pixels on the other side of a cut.
        distance: of each pixel from its nearest cut.
        meta: of the rasterizer.
    """

    got: tuple
    want: tuple
    flipped: torch.Tensor
    distance: torch.Tensor
    meta: Mapping


def both(scene, mode="RGB", antialiased=False, **options):
    """Render by the rasterizer and the oracle: each pixel that differs lies near a cut."""
    got, want = leaves(scene, torch.float32), leaves(scene, torch.float64)
    kind, cuts = "antialiased" if antialiased else "classic", Cuts()
    # one thread is faster for so few pixels; the recorder cuts the image itself
    with on_threads(1), patch.multiple(reference, _blend=cuts, _CHUNK=10**9):
        found = rasterization(**got, render_mode=mode, rasterize_mode=kind, **options)
        renders, alphas, meta = found
        color, depth, alpha = rasterization_reference(**want, antialiased=antialiased, **options)
    if mode.endswith("ED"):
        depth = depth / alpha.clamp_min(1e-10)
    parts = {"RGB": [color], "D": [depth], "ED": [depth]}.get(mode, [color, depth])
    expected = torch.cat(parts, -1)
    assert alpha.mean() > 0.1 and expected.std() > 0.01, "the image is empty"
    assert torch.isfinite(renders).all() and torch.isfinite(alphas).all()
    scale = expected.abs().amax(tuple(range(expected.dim() - 1))).clamp_min(1.0)
    error = ((renders - expected).abs() / scale).amax(-1)
    error = torch.maximum(error, (alphas - alpha).abs()[..., 0])
    flipped, distance = error > IMAGE, torch.stack(cuts.views).view(error.shape)
    wrong = error[flipped & (distance > BAND)]
    assert not len(wrong), (
        f"{len(wrong)} pixels differ without a cut in reach, by {wrong.max():.3g}"
    )
    return Found((got, renders, alphas), (want, expected, alpha), flipped, distance, meta)


def assert_rows(got, want, name, least):
    """Rows are Gaussians, ``[rows, anything]``: errors one by one, and the same rows are zero."""
    error, size = (got - want).norm(dim=-1), want.norm(dim=-1)
    assert torch.equal(size == 0, got.norm(dim=-1) == 0), f"{name}: other rows are zero"
    relative = (error / size)[size > 0]
    assert len(relative) > 100, f"{name}: hardly a row has a gradient"
    fraction = (relative <= ROW).double().mean().item()
    said = f"{name}: {fraction:.5f} of the rows are within {ROW}, {least} must be"
    assert fraction >= least, said


def assert_gradients(found, least=ROWS):
    """All gradients under random cotangents, zero at flipped pixels; ``least`` as ``assert_rows``.

    None asks nothing of single rows.
    """
    keep = ~found.flipped[..., None]
    gathered = {k: ([], []) for k in NAMES if found.got[0].get(k) is not None}
    for _ in range(COTANGENTS):
        v = [torch.randn_like(x) * keep for x in found.got[1:]]
        for side, (tensors, *results) in enumerate((found.got, found.want)):
            asked = [tensors[name] for name in gathered]
            heads = [x.to(results[0].dtype) for x in v]
            # depth alone does not see colours
            options = {"retain_graph": True, "materialize_grads": True}
            grads = torch.autograd.grad(results, asked, heads, **options)
            for pair, grad in zip(gathered.values(), grads):
                pair[side].append(grad.double())
    for name, (a, b) in gathered.items():
        a, b = torch.stack(a, -1), torch.stack(b, -1)
        assert_rel_rms(a, b, GRADIENT, name)
        if least is not None and name in NAMES[:5]:
            count = found.got[0]["opacities"].numel()
            assert_rows(a.reshape(count, -1), b.reshape(count, -1), name, least)


def compare(scene, mode="RGB", antialiased=False, **options):
    """Images and gradients under random cotangents, against the oracle in float64; the meta."""
    found = both(scene, mode, antialiased, **options)
    assert found.flipped.float().mean() < 0.05
    assert_gradients(found, least=None)
    return found.meta
