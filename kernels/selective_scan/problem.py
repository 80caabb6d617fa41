"""What is scanned, and the rules by which a step of the continuous state becomes f and g.

A rule (equations 2 to 4 of README.md) is an entry here, with the oracle's formula, and a branch in
``cpu/discretize.h`` and in ``cuda/discretize.h``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..runtime.scalars import LOG2E


class Scan(NamedTuple):
    """The arguments of a scan, checked: the tensors of ``selective_scan`` and its options.

    Attributes:
        u: ``[B, L, D]``.
        delta: as u.
        A: ``[D, N]``.
        B: ``[B, L, G, N]``.
        C: as B; None where the last state alone is asked for.
        D: ``[D]``, or None.
        z: as u, or None.
        delta_bias: ``[D]``, or None.
        initial_state: ``[B, D, N]``, or None.
        softplus: whether δ is a softplus.
        discretization: one of ``DISCRETIZATIONS``.
        save: whether the states are kept that a gradient starts from.
    """

    u: Tensor
    delta: Tensor
    A: Tensor
    B: Tensor
    C: Tensor | None
    D: Tensor | None
    z: Tensor | None
    delta_bias: Tensor | None
    initial_state: Tensor | None
    softplus: bool
    discretization: str
    save: bool


def _zoh(x: Tensor) -> tuple[Tensor, Tensor]:
    small = x.abs() < 1e-5
    safe = torch.where(small, torch.ones_like(x), x)
    series = 1 + x / 2 + x * x / 6 + x * x * x / 24
    return torch.exp(x), torch.where(small, series, torch.expm1(safe) / safe)


class Discretization(NamedTuple):
    """A rule.

    Attributes:
        factors: of x = δA, f and g of the step h ← f·h + g·δ·B·u, in the dtype of x.
        exponential: whether f is e^x: then a product of f is one exponential of a sum.
        weighted: whether g is not 1.
    """

    factors: Callable[[Tensor], tuple[Tensor, Tensor]]
    exponential: bool = True
    weighted: bool = True

    @property
    def scale(self) -> float:
        """What the kernels multiply A by: exponentials are computed as powers of two."""
        return LOG2E if self.exponential else 1.0


DISCRETIZATIONS = {
    "mamba": Discretization(lambda x: (torch.exp(x), torch.ones_like(x)), weighted=False),
    "bilinear": Discretization(
        lambda x: ((1 + x / 2) / (1 - x / 2), 1 / (1 - x / 2)), exponential=False
    ),
    "zoh": Discretization(_zoh),
}


def macros(name: str) -> dict[str, object]:
    """For the kernels' C++: MODE is that of the numbers MAMBA, BILINEAR, ZOH."""
    numbers: dict[str, object] = {key.upper(): i for i, key in enumerate(DISCRETIZATIONS)}
    return numbers | {"MODE": name.upper(), "WEIGHTED": DISCRETIZATIONS[name].weighted}
