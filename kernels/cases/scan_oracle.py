"""The scan's and the convolution's formulas in float64, rounded sample by sample."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from .rounding import UNDERFLOW, Rounding

TOKENS = ("u", "delta", "B", "C", "z", "x")  # leaves that have a value for each token
EXP_ULPS = 5.0  # the kernels' exponential: 3e-7 relative to its argument's fraction


def factors(x: Tensor, discretization: str, r: Rounding) -> tuple[Tensor, Tensor | None]:
    """Factors f and g (None for 1) of x = δA; README.md of the scan, equations 2 to 4."""
    if discretization == "bilinear":
        g = r(1 / r(1 - x / 2))
        return r(1 + r(x * g)), g
    f = r.exp(x, EXP_ULPS)
    if discretization == "mamba":
        return f, None
    small = x.abs() < 1e-4
    safe = torch.where(small, torch.ones_like(x), x)
    series = 1 + x / 2 * (1 + x / 3 * (1 + x / 4 * (1 + x / 5)))
    return f, r(torch.where(small, series, torch.expm1(safe) / safe), EXP_ULPS)


def _recur(f: Tensor, w: Tensor, first: Tensor) -> Tensor:
    """All states h ← f h + w, ``[S, B, L, D, N]``, from ``first [S, B, D, N]``, in float64.

    Pieces of tokens are traversed side by side, each from 0, and joined: as many steps as √L.
    """
    length = f.shape[2]
    piece = max(1, math.isqrt(length))
    pad = (0, 0, 0, 0, 0, -length % piece)
    cut = (*f.shape[:2], -1, piece, *f.shape[3:])
    f = F.pad(f, pad, value=1.0).reshape(cut)
    w = F.pad(w, pad).reshape(cut)
    h, p = torch.zeros_like(f[:, :, :, 0]), torch.ones_like(f[:, :, :, 0])
    local, decay = [], []
    for f_t, w_t in zip(f.unbind(3), w.unbind(3)):
        h, p = f_t * h + w_t, f_t * p
        local.append(h)
        decay.append(p)
    starts = [first]
    for d, own in zip(decay[-1].unbind(2)[:-1], local[-1].unbind(2)[:-1]):
        starts.append(d * starts[-1] + own)
    start = torch.stack(starts, 2)[:, :, :, None]
    joined = torch.stack(local, 3) + torch.stack(decay, 3) * start
    return joined.flatten(2, 3)[:, :, :length]


def _walk_rounded(f: Tensor, w: Tensor, first: Tensor, r: Rounding) -> tuple[Tensor, Tensor]:
    """The states of ``_recur`` with product and sum rounded at each token, and those before them.

    The rounding of a token enters the next with the state, as another input does. So it is found
    for all tokens of the exact recurrence at once, and a second one takes it along.
    """

    def before(h: Tensor) -> Tensor:
        return torch.cat([first[:, :, None], h[:, :, :-1]], 2)

    h = _recur(f, w, first)
    products = f * before(h)
    rounded = r.rounded(products, 1.0) - products + (r.rounded(h, 1.0) - h)
    h = _recur(f, w + rounded, first)
    return h, before(h)


class _States(torch.autograd.Function):
    @staticmethod
    def forward(ctx, f: Tensor, w: Tensor, first: Tensor, r: Rounding) -> Tensor:
        h, before = _walk_rounded(f, w, first, r)
        ctx.r = r
        ctx.save_for_backward(f, before)
        return h

    @staticmethod
    def backward(ctx, gradient: Tensor):
        r, (f, before) = ctx.r, ctx.saved_tensors
        later = torch.cat([f[:, :, 1:], torch.ones_like(f[:, :, :1])], 2)
        none = torch.zeros_like(f[:, :, 0])
        dh, _ = _walk_rounded(later.flip(2), gradient.flip(2), none, r)
        dh = dh.flip(2)
        lost = r.underflow(dh * f)  # the slope of e^x is used as (dh f) h
        df = (dh + lost / f.abs().clamp_min(UNDERFLOW)) * before
        return df, dh, dh[:, :, 0] * f[:, :, 0], None


def states(f: Tensor, w: Tensor, first: Tensor, r: Rounding) -> Tensor:
    """All states h ← f h + w, ``[S, B, L, D, N]``, from ``first [S, B, D, N]``."""
    return _States.apply(f, w, first, r)


def over_tokens(x: Tensor, like: Tensor, r: Rounding) -> Tensor:
    """``[S, ..]`` to ``[S, B, L, ..]``: the same for all tokens of ``like [S, B, L, D]``."""
    return r.share(x[:, None, None], -1, *like.shape[1:3], *[-1] * (x.dim() - 1))


def _channels(x: Tensor, channels: int, r: Rounding) -> Tensor:
    """``[S, B, L, G, N]`` to ``[S, B, L, D, N]``."""
    groups = x.shape[3]
    return r.share(x[:, :, :, :, None], -1, -1, -1, -1, channels // groups, -1).flatten(3, 4)


def scan(x: dict, softplus: bool, discretization: str, r: Rounding) -> tuple[Tensor, Tensor]:
    """Output and last state of leaves ``[S, ..]`` by name; B and C are ``[S, B, L, G, N]``."""
    x = {name: None if t is None else r(t) for name, t in x.items()}
    u, step = x["u"], x["delta"]
    if x["delta_bias"] is not None:
        step = r(step + over_tokens(x["delta_bias"], u, r))
    if softplus:
        step = r.softplus(step, EXP_ULPS)
    A, B, C = over_tokens(x["A"], u, r), *(_channels(x[k], u.shape[3], r) for k in "BC")
    steps, inputs = (
        r.share(v[..., None], -1, -1, -1, -1, A.shape[-1]) for v in (step, r(step * u))
    )
    f, g = factors(r(steps * A), discretization, r)
    w = r(inputs * B)
    first = x["initial_state"]
    if first is None:
        first = torch.zeros_like(f[:, :, :1].sum(2))
    if not u.shape[2]:
        return torch.zeros_like(u), first
    h = states(f, w if g is None else r(w * g), first, r)
    y = r(r.sum(r(h * C), -1))
    if x["D"] is not None:
        y = r(y + r(over_tokens(x["D"], u, r) * u))
    if x["z"] is not None:
        y = r(y * r(x["z"] * r.sigmoid(x["z"], EXP_ULPS)))
    return y, h[:, :, -1]


def of_sequences(
    function: Callable[[dict], tuple[Tensor, Tensor]], x: dict, cuts: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Output and last states of sequences packed in one row, each computed alone.

    Args:
        function: gives output ``[S, 1, L, D]`` and last state ``[S, 1, ..]`` of such leaves.
        x: the leaves ``[S, ..]`` by name, with a state for each sequence.
        cuts: where sequences begin, and where the last ends; None: nothing is packed.
    """
    if cuts is None:
        return function(x)
    results = []
    for s, (i, j) in enumerate(cuts.unfold(0, 2, 1).tolist()):
        place = {k: (slice(None), slice(None), slice(i, j)) for k in TOKENS}
        place |= {"initial_state": (slice(None), slice(s, s + 1))}
        part = {k: t if t is None or k not in place else t[place[k]] for k, t in x.items()}
        results.append(function(part))
    outs, lasts = zip(*results)
    return torch.cat(outs, 2), torch.cat(lasts, 1)


def conv(x: dict, silu: bool, dtype: torch.dtype, r: Rounding) -> tuple[Tensor, Tensor]:
    """Output and final state of leaves ``[S, ..]`` by name: x, weight, bias, initial_state.

    Both results send ``dtype`` gradients to x.
    """
    x = {name: None if t is None else r(t) for name, t in x.items()}
    tokens, weight = x["x"], x["weight"]
    width, length = weight.shape[2], tokens.shape[2]
    first = x["initial_state"]
    if first is None:
        first = tokens.new_zeros(*tokens.shape[:2], width - 1, tokens.shape[3])
    whole = torch.cat([first, tokens], 2)
    padded = r.stored(whole, dtype)
    out = tokens.new_zeros(()) if x["bias"] is None else over_tokens(x["bias"], tokens, r)
    weight = over_tokens(weight, tokens, r)
    for k in range(width):
        out = r(out + r(weight[..., k] * padded[:, :, k : k + length]))
    if silu:
        out = r(out * r.sigmoid(out, EXP_ULPS))
    return out, whole[:, :, whole.shape[2] - (width - 1) :]
