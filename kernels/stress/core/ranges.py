"""Dtypes of tensors, and their values by the name of a range."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
RANGES = (
    "normal", "uniform", "zeros", "ones", "alternating", "constant", "tiny", "denormal", "huge",
    "spread", "spikes",
)  # fmt: skip
COTANGENTS = ("normal", "normal", "ones", "spikes", "zeros")


def fill(shape: Sequence[int], kind: str, g: torch.Generator) -> Tensor:
    """Draws float32 numbers of one of ``RANGES``.

    "alternating" changes sign along dimension 1, "tiny" is around 1e-12, "denormal" around 1e-40
    and "huge" around 1e4. "spread" is log-uniform in 1e-6..1e4 with either sign. "spikes" is 0,
    except for one number in sixteen, which is around 1e3.
    """
    normal = torch.randn(shape, generator=g)
    if kind == "uniform":
        return torch.rand(shape, generator=g)
    if kind == "spread":
        return normal.sign() * 10 ** (10 * torch.rand(shape, generator=g) - 6)
    if kind == "spikes":
        return 1e3 * normal * (torch.rand(shape, generator=g) < 1 / 16)
    if kind == "constant":
        return torch.full(shape, torch.randn((), generator=g).item())
    if kind in ("zeros", "ones", "alternating"):
        values = torch.full(shape, float(kind != "zeros"))
        if kind == "alternating" and len(shape) > 1:
            values[:, 1::2] = -1
        return values
    return normal * {"tiny": 1e-12, "denormal": 1e-40, "huge": 1e4}.get(kind, 1.0)
