"""Rows of a ``[B, L, D]`` tensor as lanes: ``rows.h``, and what of it a Warp kernel calls."""

from collections.abc import Sequence
from pathlib import Path

import torch
import warp as wp
from torch import Tensor

from .lanes import LANES, PRELUDE, WARP_DTYPES, W, fma, lanes, sigmoid, times
from .native import native

__all__ = [
    "ACCESSORS",
    "ROWS",
    "VALUE",
    "WIDTH",
    "fma",
    "sigmoid",
    "streams",
    "times",
]

VALUE, WIDTH = lanes, W  # scalars.py has these names too, as kernels for both devices need them

# C++ text of ``rows_``, ``read_``, ``write_`` and ``put_``, for after that of ``lanes.py``.
ROWS = native(Path(__file__).with_name("rows.h"))

_STREAMED = 32 << 20  # bytes: no cache of a few cores holds a result of this size


def streams(results: Sequence[Tensor]) -> bool:
    """Whether results ``[B, L, D]`` may go past the caches: they are too large to be kept there.

    Of float32 each, dense, with whole cache lines; results without elements do not count.
    """
    written = [x for x in results if x.numel()]
    return bool(written) and all(
        x.dtype == torch.float32
        and x.shape[-1] % W == 0
        and x.data_ptr() % 64 == 0
        and 4 * x.numel() >= _STREAMED
        for x in written
    )


def _accessors(dtype: torch.dtype):
    scalar = WARP_DTYPES[dtype]
    head = PRELUDE + ROWS

    @wp.func_native(f"{head} {LANES} r; *(F*)&r = read_(rows_(x_in, b, t, d, width), 0); return r;")
    def load(x_in: wp.array3d(dtype=scalar), b: int, t: int, d: int, width: int) -> lanes: ...

    @wp.func_native(f"{head} write_(rows_(x_out, b, t, d, width), 0, *(const F*)&v);")
    def store(x_out: wp.array3d(dtype=scalar), b: int, t: int, d: int, width: int, v: lanes): ...

    return load, store


# ``(load, store)`` by element type; both address row [b, t] from channel d on.
ACCESSORS = {dtype: _accessors(dtype) for dtype in WARP_DTYPES}
