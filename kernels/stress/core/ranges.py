"""Values of a tensor by the name of their range."""

from __future__ import annotations

import torch
from torch import Tensor

RANGES = (
    "normal", "uniform", "zeros", "ones", "alternating", "constant", "tiny", "denormal", "huge",
    "spread", "spikes",
)  # fmt: skip


def fill(shape: tuple[int, ...], kind: str, g: torch.Generator) -> Tensor:
    """Draws float32 numbers of one of ``RANGES``.

    "alternating" changes sign along dimension 1, "tiny" is around 1e-12, "denormal" around 1e-40
    and "huge" around 1e4. "spread" is log-uniform in 1e-6..1e4 with either sign. "spikes" is 0,
    except for one number in sixteen, which is around 1e3.
    """
    normal = torch.randn(shape, generator=g)
    if kind == "uniform":
        return torch.rand(shape, generator=g)
    if kind == "zeros":
        return torch.zeros(shape)
    if kind in ("ones", "alternating"):
        ones = torch.ones(shape)
        if kind == "alternating" and len(shape) > 1:
            ones[:, 1::2] = -1
        return ones
    if kind == "constant":
        return torch.full(shape, torch.randn((), generator=g).item())
    if kind in ("tiny", "denormal", "huge"):
        return normal * {"tiny": 1e-12, "denormal": 1e-40, "huge": 1e4}[kind]
    if kind == "spread":
        return normal.sign() * 10 ** (10 * torch.rand(shape, generator=g) - 6)
    if kind == "spikes":
        return 1e3 * normal * (torch.rand(shape, generator=g) < 1 / 16)
    return normal
