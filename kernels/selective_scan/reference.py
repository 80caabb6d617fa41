"""The oracle: the selective scan as a plain torch loop, in any float dtype."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor


class Off(NamedTuple):
    """Relative errors of the formulas, to measure their effect on the results.

    Attributes:
        decay: of every f.
        step: of every softplus.
    """

    decay: float = 0.0
    step: float = 0.0


EXACT = Off()


def discretize(x: Tensor, discretization: str) -> tuple[Tensor, Tensor]:
    """Factors f and g of x = δA: the step is h ← f·h + g·δ·B·u (README, equations 2 to 4)."""
    if discretization == "mamba":
        return torch.exp(x), torch.ones_like(x)
    if discretization == "bilinear":
        return (1 + x / 2) / (1 - x / 2), 1 / (1 - x / 2)
    if discretization == "zoh":
        small = x.abs() < 1e-5
        safe = torch.where(small, torch.ones_like(x), x)
        series = 1 + x / 2 + x * x / 6 + x * x * x / 24
        return torch.exp(x), torch.where(small, series, torch.expm1(safe) / safe)
    raise ValueError(f"discretization is {discretization!r}")


def selective_scan_reference(
    u: Tensor,
    delta: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor | None = None,
    z: Tensor | None = None,
    delta_bias: Tensor | None = None,
    delta_softplus: bool = False,
    *,
    initial_state: Tensor | None = None,
    discretization: str = "mamba",
    off: Off = EXACT,
) -> tuple[Tensor, Tensor]:
    """One token after the other; arguments as ``selective_scan``. Returns (out, last state)."""
    batch, _, channels = u.shape
    if B.dim() == 3:
        B = B[:, :, None]
    if C.dim() == 3:
        C = C[:, :, None]
    B = B.repeat_interleave(channels // B.shape[2], dim=2)
    C = C.repeat_interleave(channels // C.shape[2], dim=2)
    if delta_bias is not None:
        delta = delta + delta_bias
    if delta_softplus:
        delta = F.softplus(delta) * (1 - off.step)
    h = u.new_zeros(batch, channels, A.shape[1]) if initial_state is None else initial_state
    rows = []
    tokens = (u.unbind(1), delta.unbind(1), B.unbind(1), C.unbind(1))  # indexing costs a fill each
    for u_t, delta_t, B_t, C_t in zip(*tokens):
        f, g = discretize(delta_t[..., None] * A, discretization)
        h = f * (1 - off.decay) * h + g * delta_t[..., None] * B_t * u_t[..., None]
        rows.append((h * C_t).sum(-1))
    y = torch.stack(rows, 1) if rows else torch.zeros_like(u)
    if D is not None:
        y = y + D * u
    if z is not None:
        y = y * F.silu(z)
    return y, h
