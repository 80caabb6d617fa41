"""The harmonics on the CPU: sixteen Gaussians as lanes, in C++ (``harmonics.h``).

A thread takes chunks of Gaussians with all views of them, so that no two add to the same place.
README.md §6 of the rasterizer holds the maths.
"""

import functools
from pathlib import Path

from ...runtime.native import constants, native, native_kernel
from .shared import SHORTEST, Arrays, Size

CHUNK = 256  # Gaussians of a task; their gradient by a centre is one partial sum


def _header(degree: int, channels: int, clamped: bool) -> str:
    of_kind = dict(DEGREE=degree, D=channels, CLAMPED=clamped)
    config = constants("Config", **of_kind, CHUNK=CHUNK, SHORTEST=SHORTEST)
    return config + native(Path(__file__).with_name("harmonics.h"))


@functools.cache
def forward_kernel(degree: int, channels: int, clamped: bool):
    """Fills the colours, or the bare sums unless ``clamped``."""
    call, header = "gamba::harmonics::forward<Config>", _header(degree, channels, clamped)
    return native_kernel("harmonics", call, {"size": Size}, {"arrays": Arrays}, header=header)


@functools.cache
def backward_kernel(degree: int, channels: int, clamped: bool):
    """The gradient of ``forward_kernel``: from ``v_arrays``'s colours to its other arrays."""
    call, header = "gamba::harmonics::backward<Config>", _header(degree, channels, clamped)
    inputs, outputs = {"size": Size, "arrays": Arrays}, {"v_arrays": Arrays}
    return native_kernel("harmonics_vjp", call, inputs, outputs, header=header)
