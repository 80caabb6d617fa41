"""The kernels of the CUDA compositor: sizes and types for its two headers, ``composite_*.cuh``."""

import functools
from pathlib import Path
from typing import Any

import warp as wp

from ...runtime.native import constants, cuda_kernel, native
from ...runtime.views import struct, struct_of
from ..skip import BLOCK_TEST, STOPPED, UNUSED, ZERO_UPSTREAM
from ..tiles import CHUNK, Bins, Pixels, RasterParams, Saved
from .records import Gaussians

WARP = 32
RECORD = 12  # floats of a Gaussian in shared memory
PITCH = WARP + 4  # floats of a row of partial sums
HEAD = 8  # columns of a chunk in ``heads``: a sector of memory
_HERE = Path(__file__).parent
_INPUTS = {"params": RasterParams, "gaussians": Gaussians, "lists": struct_of(Bins)}


@struct
class Rows:
    """Outputs of a gradient's launch: rows of pairs, and marks of skipped tiles.

    A row has for each chunk of channels the six moments, the two sums of absolute values if they
    are asked for, and the colours: the first HEAD of these in ``heads``, the others in ``tails``.
    A row of a pair that is not ``written`` is undefined.
    """

    heads: wp.array2d[wp.float32]
    tails: wp.array2d[wp.float32]
    written: wp.array[wp.int32]  # a bit for each pair's row
    skipped: wp.array[wp.int32]


def row_sizes(channels: int, absolute: bool) -> tuple[int, int]:
    """Floats per row of ``heads`` and of ``tails``."""
    chunks = [min(CHUNK, channels - first) for first in range(0, channels, CHUNK)]
    moments = 8 if absolute else 6
    return HEAD * len(chunks), sum(max(0, moments + count - HEAD) for count in chunks)


@functools.cache
def forward_kernel(channels: int, parts: int) -> Any:
    """The kernel for so many channels, at most 4, and parts of a tile: 1, 2 or 4."""
    shared = WARP * (RECORD + 2)
    sizes = {"CHANNELS": channels, "PARTS": parts, "SHARED": shared}
    config = constants("Config", **sizes, BLOCK_TEST=BLOCK_TEST, STOPPED=STOPPED)
    return cuda_kernel(
        "composite",
        "gamba::raster::composite<Config>",
        _INPUTS,
        {"saved": struct_of(Saved), "pixels": Pixels},
        config + native(_HERE / "composite_forward.cuh"),
        shared,
        (WARP, 24 if channels < 4 else 20),  # as many warps as the registers allow
    )


@functools.cache
def backward_kernel(channels: int, parts: int, geometry: bool, absolute: bool, passes: bool) -> Any:
    """The gradient's kernel: a block for each tile, a warp for each of its 1, 2 or 4 parts.

    Args:
        channels: of colours, at most 4; 0: only the moments, of any number of channels.
        parts: of a tile.
        geometry: True to sum the moments of h (README eq. 11).
        absolute: True if rows have the two sums of absolute values (eq. 14).
        passes: True if the gradient passes the clamp of alpha (README §7).
    """
    sums = geometry * (8 if absolute else 6) + channels
    shared = parts * (WARP * RECORD + WARP + WARP // sums * sums * PITCH)
    sizes = {"CHANNELS": channels, "PARTS": parts, "SHARED": shared, "HEAD": HEAD}
    rules = {"GEOMETRY": geometry, "ABSOLUTE": absolute, "PASSES": passes}
    config = constants("Config", **sizes, **rules, ZERO_UPSTREAM=ZERO_UPSTREAM, UNUSED=UNUSED)
    warps = (24 if parts == 4 else 20) if channels < 4 else 16  # as the registers allow
    return cuda_kernel(
        "composite_vjp",
        "gamba::raster::composite_vjp<Config>",
        _INPUTS | {"saved": struct_of(Saved), "v_pixels": Pixels},
        {"rows": Rows},
        config + native(_HERE / "composite_backward.cuh"),
        shared,
        (WARP * parts, warps // parts),
    )
