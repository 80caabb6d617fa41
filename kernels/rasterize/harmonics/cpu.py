"""The harmonics on the CPU: sixteen Gaussians as lanes, in C++.

A thread takes chunks of Gaussians with all views of them, so that no two add to the same place.
README.md §6 of the rasterizer holds the maths.
"""

import functools
from pathlib import Path

from ...runtime.native import native, native_kernel
from .shared import SHORTEST, Arrays, Size

CHUNK = 256  # Gaussians of a task; their gradient by a centre is one partial sum
_UNROLLED = 96  # floats of a row up to which its loops are written out
_HERE = Path(__file__).parent


def _text(name: str, degree: int, channels: int, clamped: bool) -> str:
    unroll = (degree + 1) ** 2 * channels <= _UNROLLED
    return native(
        _HERE / name,
        DEGREE=degree,
        D=channels,
        CLAMPED=clamped,
        CHUNK=CHUNK,
        SHORTEST=SHORTEST,
        UNROLL='_Pragma("clang loop unroll(full)")' if unroll else "",
    )


@functools.cache
def forward_kernel(degree: int, channels: int, clamped: bool):
    """Fills the colours, or the bare sums unless ``clamped``."""
    text = _text("forward.inl", degree, channels, clamped)
    return native_kernel("harmonics", text, {"size": Size}, {"arrays": Arrays})


@functools.cache
def backward_kernel(degree: int, channels: int, clamped: bool):
    """The gradient of ``forward_kernel``: from ``v_arrays``'s colours to its other arrays."""
    text = _text("backward.inl", degree, channels, clamped)
    return native_kernel(
        "harmonics_vjp", text, {"size": Size, "arrays": Arrays}, {"v_arrays": Arrays}
    )
