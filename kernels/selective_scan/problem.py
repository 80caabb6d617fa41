"""Arguments of a scan, and the rules that discretize a step of the state to f and g.

A rule (equations 2 to 4 of README.md) is an entry here, a branch in the C++ of each device
(``cpu/discretize.h``, ``cuda/discretize.cuh``), and the oracle's formula in ``reference.py``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..runtime.scalars import LOG2E


class Inputs(NamedTuple):
    """Tensors of a scan, their gradients, or a bool for each: True to compute its gradient.

    Attributes:
        u: ``[B, L, D]``. A gradient that is not needed is None.
        delta: as u.
        A: ``[D, N]`` float32.
        B: ``[B, L, G, N]``.
        C: as B; None to compute only the last state.
        D: ``[D]``, or None.
        z: as u, or None.
        delta_bias: ``[D]``, or None.
        initial_state: ``[B, D, N]`` float32, or None; of packed rows ``[S, D, N]``.
    """

    u: Any
    delta: Any
    A: Any
    B: Any
    C: Any
    D: Any
    z: Any
    delta_bias: Any
    initial_state: Any


class Options(NamedTuple):
    """Arguments of a scan without a gradient.

    Attributes:
        packed: the sequences of packed rows (``runtime.packed``), or None.
        softplus: True if δ is a softplus.
        discretization: one of ``DISCRETIZATIONS``.
        save: True to save the states from which a gradient starts.
    """

    packed: Tensor | None
    softplus: bool
    discretization: str
    save: bool


class Scan(NamedTuple):
    """A scan with checked arguments."""

    inputs: Inputs
    options: Options

    @classmethod
    def of(cls, *arguments: Any) -> Scan:
        """Return the scan of an operator's arguments: the inputs, then the options."""
        count = len(Inputs._fields)
        return cls(Inputs(*arguments[:count]), Options(*arguments[count:]))

    @property
    def sequences(self) -> int:
        """Number of sequences: B, or S of packed rows."""
        # not len(), which would fix a traced batch
        return (self.inputs.u if self.options.packed is None else self.options.packed).shape[0]


def like_inputs(gradients: Inputs, inputs: Inputs, needs: Inputs) -> Inputs:
    """Return the needed gradients in the dtypes of their inputs, B's and C's in their layout.

    Only those for u, delta and z have that layout; others are dense. ``initial_state``'s, which a
    backward pass does not have, is float32 as ``A``.
    """

    def like_input(name: str, x: Tensor, like: Tensor) -> Tensor:
        if name not in ("B", "C") or (x.dtype, x.stride()) == (like.dtype, like.stride()):
            return x.to(like.dtype)
        return torch.empty_like(like).copy_(x)

    likes = inputs._replace(initial_state=inputs.A)
    each = zip(Inputs._fields, gradients, likes, needs)
    return Inputs(
        *(like_input(name, x, like) if needed else None for name, x, like, needed in each)
    )


class Discretization(NamedTuple):
    """A rule.

    Attributes:
        exponential: True if f is e^x: then a product of f is one exponential of a sum.
        weighted: True if g is not 1.
    """

    exponential: bool = True
    weighted: bool = True

    @property
    def scale(self) -> float:
        """Factor of A in the kernels: exponentials are computed as powers of two."""
        return LOG2E if self.exponential else 1.0


DISCRETIZATIONS = {
    "mamba": Discretization(weighted=False),
    "bilinear": Discretization(exponential=False),
    "zoh": Discretization(),
}


def sum_parts(parts: Tensor) -> Tensor:
    """Sums ``[B, G, parts, ..]`` over the parts, in the memory of the first.

    One is added after the other. The order of torch's own sum depends on the shape, and so would
    the bits of a sequence on the other sequences.
    """
    first, *rest = parts.unbind(2)
    for part in rest:
        first += part
    return first
