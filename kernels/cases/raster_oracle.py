"""The rasterizer in float64, dense, rounded sample by sample; and what rounding decides.

Which pairs of pixel and Gaussian count, and in which order, is decided by sample 0. Where another
sample comes near a decision, the pixel is undecided (README.md of kernels/stress).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..rasterize.constants import ALPHA_MAX, COMPENSATION_MIN, FRUSTUM_MARGIN, T_MIN
from ..rasterize.harmonics.formula import colors_by_formula
from .random_case import FACTOR
from .rounding import UNIT, Rounding
from .scan_oracle import EXP_ULPS

_RANGE = 3.4e38  # largest float32


class ViewOptions(NamedTuple):
    """Arguments of ``rasterization`` besides tensors and modes, under the same names."""

    width: int
    height: int
    near_plane: float = 0.01
    far_plane: float = 1e10
    radius_clip: float = 0.0
    eps2d: float = 0.3
    alpha_min: float = 1 / 255
    alpha_max: float = ALPHA_MAX
    antialiased: bool = False
    sh_degree: int | None = None


class View(NamedTuple):
    """One object in one view.

    Attributes:
        blended: ``[SAMPLES, H W, C + 3]``: colours, depth Σ w z, weight Σ w, alpha.
        allowance: ``[H W, C + 3]``: by how much a pixel may differ besides, if it is undecided, and
            by the scale of its rounding.
        undecided: ``[H W, 1]``: a cut or an order is within rounding.
        loose: ``[H W, 1]``: or a slope (a clamp) is: no gradient is asked of these pixels.
    """

    blended: Tensor
    allowance: Tensor
    undecided: Tensor
    loose: Tensor


def _band(x: Tensor) -> Tensor:
    """Return the distance ``[..]`` that rounding may move ``x [SAMPLES, ..]``."""
    x = x.detach()
    return FACTOR * ((x[1:] - x[0]).abs().amax(0) + UNIT * x[0].abs())


def _near(x: Tensor, bound: float) -> Tensor:
    return (x[0].detach() - bound).abs() <= _band(x)


def _dot(a: Tensor, b: Tensor, r: Rounding) -> Tensor:
    return r(r(a * b).sum(-1))


def _product(a: Tensor, b: Tensor, r: Rounding) -> Tensor:
    """Matrices ``[.., i, j]`` times ``[.., j, k]``."""
    return r(r(a[..., :, :, None] * b[..., None, :, :]).sum(-2))


def _rotation(q: Tensor, r: Rounding) -> Tensor:
    size = q.norm(dim=-1, keepdim=True)
    identity = q.new_tensor([1.0, 0, 0, 0]).expand_as(q)
    w, x, y, z = r(torch.where(size > 0, q / size.clamp_min(1e-300), identity)).unbind(-1)

    def two(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
        return r(2 * (r(a * b) + r(c * d)))

    rows = [
        [r(1 - two(y, y, z, z)), two(x, y, -w, z), two(x, z, w, y)],
        [two(x, y, w, z), r(1 - two(x, x, z, z)), two(y, z, -w, x)],
        [two(x, z, -w, y), two(y, z, w, x), r(1 - two(x, x, y, y))],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _jacobian(t: Tensor, K: Tensor, options: ViewOptions, r: Rounding) -> tuple[Tensor, Tensor]:
    """``[S, n, 2, 3]``, and which Gaussians are at the clamp of a slope ``[n]``."""
    rows, at_clamp = [], torch.zeros(t.shape[1], dtype=torch.bool)
    for axis, size in ((0, options.width), (1, options.height)):
        focal, center = K[axis, axis].item(), K[axis, 2].item()
        margin = FRUSTUM_MARGIN * 0.5 * size / focal
        slope = r(t[..., axis] / t[..., 2])
        low, high = -(center / focal + margin), (size - center) / focal + margin
        for bound in (low, high):  # the bound is itself rounded
            at_clamp |= (slope[0].detach() - bound).abs() <= _band(slope) + 32 * UNIT * abs(bound)
        f = r(focal / t[..., 2])
        row = [torch.zeros_like(f), torch.zeros_like(f), r(-f * r(slope.clamp(low, high)))]
        row[axis] = f
        rows.append(torch.stack(row, -1))
    return torch.stack(rows, -2), at_clamp


class _Splats(NamedTuple):
    """Gaussians of a view, front to back; ``[SAMPLES, n, ..]``, the last four ``[n]``.

    Channels are colours, depth and a channel of ones, whose sum is the weight.
    """

    center: Tensor
    conic: tuple[Tensor, Tensor, Tensor]
    opacity: Tensor
    depth: Tensor
    channels: Tensor
    seen: Tensor
    unsure: Tensor
    loose: Tensor
    index: Tensor


def _splats(x: dict, W: Tensor, w: Tensor, K: Tensor, options: ViewOptions, r: Rounding) -> _Splats:
    """Project Gaussians that may be visible: ``[SAMPLES, N, ..]`` of one object, of one view."""
    t = r(_product(W[:, None], x["means"][..., None], r)[..., 0] + w[:, None])
    z, opacity = t[..., 2], x["opacities"]
    unsure = (
        _near(z, options.near_plane)
        | _near(z, options.far_plane)
        | _near(opacity, options.alpha_min)
    )
    seen = (
        (z[0] >= options.near_plane)
        & (z[0] <= options.far_plane)
        & (opacity[0] >= options.alpha_min)
    )
    index = (seen | unsure).nonzero()[:, 0]
    index = index[torch.argsort(z[0, index].detach(), stable=True)]
    t, opacity, channels = t[:, index], opacity[:, index], x["colors"][:, index]
    seen, unsure = seen[index], unsure[index]
    J, loose = _jacobian(t, K, options, r)
    M = _product(J, W[:, None], r)
    if x["quats"] is not None:
        M = _product(M, _rotation(x["quats"][:, index], r), r)
    M = r(M * x["scales"][:, index, None])
    m0, m1 = M[..., 0, :], M[..., 1, :]
    n = r(torch.linalg.cross(m0, m1))
    det0, s0, s1 = _dot(n, n, r), _dot(m0, m0, r), _dot(m1, m1, r)
    eps2d = r.constant(options.eps2d)
    det = r(det0 + r(eps2d * r(s0 + s1)) + r(eps2d * eps2d))
    fits = det[0] < _RANGE
    unsure = unsure | ((det[0] > 1e-2 * _RANGE) & (det[0] < 1e2 * _RANGE))
    sxx, syy = r(s0 + eps2d), r(s1 + eps2d)
    conic = r(syy / det), r(-_dot(m0, m1, r) / syy), r(1 / syy)
    if options.antialiased:
        ratio = r(det0 / det)
        loose = loose | _near(ratio, COMPENSATION_MIN**2)
        opacity = r(opacity * r(ratio.clamp_min(COMPENSATION_MIN**2).sqrt()))
    if options.radius_clip > 0:
        cut = r((2 * torch.log((opacity / options.alpha_min).clamp_min(1 + 1e-9))).sqrt())
        extent = r(cut * r(torch.maximum(sxx, syy).sqrt()))
        unsure = unsure | _near(extent, options.radius_clip)
        seen = seen & (extent[0] > options.radius_clip)
    scaled = [r(r(K[i, i] * t[..., i]) / t[..., 2]) for i in (0, 1)]
    center = torch.stack([r(scaled[i] + r.constant(K[i, 2])) for i in (0, 1)], -1)
    depth = t[..., 2]
    channels = torch.cat([channels, depth[..., None], torch.ones_like(depth)[..., None]], -1)
    return _Splats(center, conic, opacity, depth, channels, seen & fits, unsure, loose, index)


def _order_swaps(s: _Splats, weight: Tensor, active: Tensor) -> tuple[Tensor, Tensor]:
    """Return the change by depths that rounding swaps, ``[P, C]``, and a mask ``[P]`` of any."""
    depth, band = s.depth[0].detach(), _band(s.depth)
    behind = depth[None] - depth[:, None]
    swaps = (behind > 0) & (behind <= band[None] + band[:, None])
    change = weight.new_zeros(len(weight), s.channels.shape[-1])
    touched = torch.zeros(len(weight), dtype=torch.bool)
    colors = s.channels[0].detach()
    for i, j in swaps.nonzero().tolist():
        both = active[:, i] & active[:, j]
        if both.any():
            touched |= both
            change += (weight[:, i] * both)[:, None] * (colors[i] - colors[j]).abs()
    return change, touched


def _blend(s: _Splats, pixels: Tensor, options: ViewOptions, r: Rounding) -> View:
    offset = r(pixels[None, :, None] - s.center[:, None])
    a, k, e = (c[:, None] for c in s.conic)
    dx, dy = offset.unbind(-1)
    u = r(dx + r(k * dy))
    q = r(r(a * r(u * u)) + r(e * r(dy * dy)))
    raw = r(s.opacity[:, None] * r.exp(-0.5 * q, EXP_ULPS))
    with torch.no_grad():
        value, band = raw[0], _band(raw) + FACTOR * EXP_ULPS * UNIT * raw[0]
        on = (value >= options.alpha_min) & s.seen
        clamped = value > options.alpha_max
    alpha = torch.where(clamped, r.constant(options.alpha_max)[..., None], raw)
    alpha = torch.where(on, alpha, 0.0)
    after = torch.cumprod(torch.where(on, r(1 - alpha), 1.0), -1)
    with torch.no_grad():
        going = (after[0] > T_MIN).cummin(-1).values
    before = torch.cat([torch.ones_like(after[..., :1]), after[..., :-1]], -1)
    # The gradients of the two factors are numbers of their own, whose difference may cancel; and
    # backwards, T is reckoned from the last Gaussian to the first.
    before, alpha_ = (r.stored(x, torch.float32) for x in (before, alpha))
    back = r.drift(before, on & going)
    weight = r(before * alpha_.detach() + back * (alpha_ - alpha_.detach()))
    weight = torch.where(going, weight, 0.0)
    back = (back * alpha).detach() * going
    channels = s.channels[:, None]
    moved = back[..., None] * (channels - channels.detach())
    blended = r(r(weight[..., None] * channels.detach() + moved).sum(2))
    # alpha is 1 - T_end, and its gradient that of Σ T α: the rasterizer's README, eq. 7 and 10
    alphas = r(r.stored(weight, torch.float32).sum(-1))
    left = torch.cumprod(torch.where(on & going, r(1 - alpha), 1.0), -1)[..., -1]
    alphas = alphas + (r(1 - left) - alphas).detach()
    blended = torch.cat([blended, alphas[..., None]], -1)
    with torch.no_grad():  # decisions that depend on rounding, and their effect
        stops = (on & ~going).any(-1)
        reached = before[0] > T_MIN * (1 - FACTOR * len(s.seen) * UNIT) - _band(after).amax()
        cut = (value - options.alpha_min).abs() <= band
        cut |= s.unsure & (value >= options.alpha_min - band)
        cut &= reached & (s.seen | s.unsure)
        stop = on & reached & ((after[0] - T_MIN).abs() <= _band(after))
        # a Gaussian that appears or vanishes changes its pixels by its weight, and shows or hides
        # those behind it; so does a stop with all the light that is left
        fraction = (before[0] * value * cut).sum(-1) + (before[0] * stop).amax(-1)
        top = torch.cat([s.channels[0].abs().amax(0), torch.ones(1, dtype=fraction.dtype)])
        allowance = 2 * fraction[:, None] * top
        swap, swapped = _order_swaps(
            s, before[0] * value.clamp_max(options.alpha_max), on & reached
        )
        allowance[:, :-1] += 2 * swap
        undecided = cut.any(-1) | stop.any(-1) | swapped
        # undecided Gaussians before a stop may move the stop: this light at most is then left
        elsewhere = undecided & (stops | stop.any(-1))
        allowance[elsewhere] += 2 * T_MIN / (1 - options.alpha_max) * top
        bend = on & ((value - options.alpha_max).abs() <= band) | (on & s.loose)
        allowance += FACTOR * UNIT * top
        loose = undecided | (bend & reached).any(-1)
        return View(blended, allowance, undecided[:, None], loose[:, None])


def render_view(
    x: dict, W: Tensor, w: Tensor, K: Tensor, options: ViewOptions, r: Rounding
) -> View:
    """One object in one view.

    Args:
        x: leaves ``[SAMPLES, N, ..]`` by name: means, quats or None, scales, opacities, colors of
            this view (or coefficients ``[SAMPLES, N, K, 3]``).
        W: rotation ``[SAMPLES, 3, 3]`` of the view.
        w: translation ``[SAMPLES, 3]``.
        K: ``[3, 3]`` float64.
        options: the rest.
        r: rounds.
    """
    x = {name: None if t is None else r(t) for name, t in x.items()}
    bent = None
    if options.sh_degree is not None:
        centers = -(r(W).mT @ r(w)[..., None])[..., 0]
        colors = colors_by_formula(options.sh_degree, x["colors"], x["means"], centers[:, None])[
            :, 0
        ]
        x["colors"] = r(colors, EXP_ULPS)
        with torch.no_grad():  # the clamp at 0
            bent = (colors[0] <= _band(colors) + 1e-6).any(-1) & (colors[0] >= 0).any(-1)
    s = _splats(x, r(W), r(w), K, options, r)
    if bent is not None:
        s = s._replace(loose=s.loose | bent[s.index])
    rows, columns = torch.meshgrid(
        torch.arange(options.height), torch.arange(options.width), indexing="ij"
    )
    pixels = torch.stack([columns, rows], -1).reshape(-1, 2).double() + 0.5
    if len(s.seen):
        return _blend(s, pixels, options, r)
    blank = x["means"].new_zeros(len(W), len(pixels), x["colors"].shape[-1] + 3)
    allowance = blank[0].clone()
    allowance[:, -1] = FACTOR * UNIT
    none = torch.zeros(len(pixels), 1, dtype=torch.bool)
    return View(blank, allowance, none, none)
