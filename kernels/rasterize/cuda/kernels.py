"""The kernels of the CUDA compositor: sizes and types for ``composite_forward.cuh``."""

import functools
from pathlib import Path

from ...runtime.native import constants, cuda_kernel, native
from ...runtime.views import struct_of
from ..skip import BLOCK_TEST, STOPPED
from ..tiles import Bins, Pixels, RasterParams, Saved
from .records import Gaussians

WARP = 32
RECORD = 12  # floats of a Gaussian in shared memory
_HERE = Path(__file__).parent


@functools.cache
def forward_kernel(channels: int, parts: int):
    """The kernel for so many channels, at most 4, and parts of a tile: 1, 2 or 4."""
    shared = WARP * (RECORD + 2)
    sizes = {"CHANNELS": channels, "PARTS": parts, "SHARED": shared}
    config = constants("Config", **sizes, BLOCK_TEST=BLOCK_TEST, STOPPED=STOPPED)
    return cuda_kernel(
        "composite",
        "gamba::raster::composite<Config>",
        {"params": RasterParams, "gaussians": Gaussians, "lists": struct_of(Bins)},
        {"saved": struct_of(Saved), "pixels": Pixels},
        config + native(_HERE / "composite_forward.cuh"),
        shared,
        (WARP, 24 if channels < 4 else 20),  # as many warps as the registers allow
    )
