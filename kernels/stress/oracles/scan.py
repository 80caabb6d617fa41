"""The scan's and the convolution's formulas in float64, rounded sample by sample."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from ..core.rounding import Rounding

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


def states(f: Tensor, w: Tensor, first: Tensor, r: Rounding) -> Tensor:
    """All states h ← f h + w, ``[S, B, L, D, N]``, from ``first [S, B, D, N]``.

    Pieces of tokens are walked side by side, each from 0, and joined: as many steps as √L.
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
        h, p = r(r.decay(f_t, h) + w_t), r.decay(f_t, p)
        local.append(h)
        decay.append(p)
    starts = [first]
    for d, own in zip(decay[-1].unbind(2)[:-1], local[-1].unbind(2)[:-1]):
        starts.append(r(r(d * starts[-1]) + own))
    start = torch.stack(starts, 2)[:, :, :, None]
    joined = torch.stack(local, 3) + r(torch.stack(decay, 3) * start)
    return r(joined.flatten(2, 3)[:, :, :length])


def _channels(x: Tensor, channels: int) -> Tensor:
    """``[S, B, L, G, N]`` to ``[S, B, L, D, N]``."""
    return x.repeat_interleave(channels // x.shape[3], dim=3)


def scan(x: dict, softplus: bool, discretization: str, r: Rounding) -> tuple[Tensor, Tensor]:
    """Output and last state of leaves ``[S, ..]`` by name; B and C are ``[S, B, L, G, N]``."""
    x = {name: None if t is None else r(t) for name, t in x.items()}
    u, step = x["u"], x["delta"]
    if x["delta_bias"] is not None:
        step = r(step + x["delta_bias"][:, None, None])
    if softplus:
        step = r.softplus(step, EXP_ULPS)
    f, g = factors(r(step[..., None] * x["A"][:, None, None]), discretization, r)
    w = r(r(step * u)[..., None] * _channels(x["B"], u.shape[3]))
    first = x["initial_state"]
    if first is None:
        first = torch.zeros_like(f[:, :, :1].sum(2))
    if not u.shape[2]:
        return torch.zeros_like(u), first
    h = states(f, w if g is None else r(w * g), first, r)
    y = r(r(h * _channels(x["C"], u.shape[3])).sum(-1))
    if x["D"] is not None:
        y = r(y + r(x["D"][:, None, None] * u))
    if x["z"] is not None:
        y = r(y * r(x["z"] * r.sigmoid(x["z"], EXP_ULPS)))
    return y, h[:, :, -1]


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
    out = tokens.new_zeros(()) if x["bias"] is None else x["bias"][:, None, None]
    for k in range(width):
        out = r(out + r(weight[:, None, None, :, k] * padded[:, :, k : k + length]))
    out = out.expand_as(tokens)
    if silu:
        out = r(out * r.sigmoid(out, EXP_ULPS))
    return out, whole[:, :, whole.shape[2] - (width - 1) :]
