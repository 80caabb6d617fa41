"""Inputs of a scan, and the rules by which a step of the continuous state becomes f and g.

A rule (equations 2 to 4 of README.md) is an entry here, a branch on both devices in
``discretize.h``, and the oracle's formula in ``reference.py``.
"""

from __future__ import annotations

from typing import NamedTuple

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
        initial_state: ``[B, D, N]``, or None; of packed rows ``[S, D, N]``.
        packed: the sequences of packed rows (``runtime.packed``), or None.
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
    packed: Tensor | None
    softplus: bool
    discretization: str
    save: bool

    @property
    def sequences(self) -> int:
        """Number of sequences: B, or S of packed rows."""
        return len(self.u if self.packed is None else self.packed)


class Discretization(NamedTuple):
    """A rule.

    Attributes:
        exponential: whether f is e^x: then a product of f is one exponential of a sum.
        weighted: whether g is not 1.
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
    the bits of a sequence on the others beside it.
    """
    first, *rest = parts.unbind(2)
    for part in rest:
        first += part
    return first


def macros(name: str, on_cpu: bool) -> dict[str, object]:
    """For the kernels' C++: MODE is that of the numbers MAMBA, BILINEAR, ZOH."""
    numbers: dict[str, object] = {key.upper(): i for i, key in enumerate(DISCRETIZATIONS)}
    numbers |= {"MODE": name.upper(), "WEIGHTED": DISCRETIZATIONS[name].weighted}
    return numbers | {"ON_CPU": on_cpu}
