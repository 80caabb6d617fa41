"""The leaves of ``lanes.py`` for one channel per thread, in plain Warp: what CUDA kernels use."""

import torch
import warp as wp

from .lanes import WARP_DTYPES

VALUE = wp.float32
WIDTH = 1


@wp.func
def sigmoid(x: float) -> float:
    e = wp.exp(-wp.abs(x))
    return wp.where(x < 0.0, e, 1.0) / (1.0 + e)


# As in lanes.py: branch-free, and relatively accurate for x << 0.
@wp.func
def softplus(x: float) -> float:
    e = wp.exp(-wp.abs(x))
    s = e / (e + 2.0)
    w = s * s
    p = 0.20010849594358543 + w * (0.13999569703388653 + w * 0.1401223282424694)
    return wp.max(x, 0.0) + 2.0 * s * (1.0 + w * (0.33333206564805135 + w * p))


@wp.func
def times(a: float, b: float) -> float:
    return a * b


@wp.func
def fma(a: float, b: float, c: float) -> float:
    return a * b + c


def _accessors(dtype: torch.dtype):
    scalar = WARP_DTYPES[dtype]

    @wp.func
    def load(x: wp.array3d(dtype=scalar), b: int, t: int, d: int, count: int) -> float:
        return float(x[b, t, d])

    @wp.func
    def store(x: wp.array3d(dtype=scalar), b: int, t: int, d: int, count: int, v: float):
        x[b, t, d] = scalar(v)

    return load, store


ACCESSORS = {dtype: _accessors(dtype) for dtype in WARP_DTYPES}
