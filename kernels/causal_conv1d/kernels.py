"""Causal depthwise convolution of at most four taps, with SiLU: the step before the scan.

``conv.h`` serves both devices: its values are sixteen channels on a CPU and four on CUDA.
"""

import functools
from pathlib import Path
from typing import Any

import torch
import warp as wp

from ..runtime.native import WARP_DTYPES, W, constants, lanes, native, native_kernel

TAPS = 4
# Tokens of a forward task; on a CPU few, because each row may be in another page, but many where x
# is transposed.
STRIP = {"cpu": 16, "cuda": 128}
TRANSPOSED_STRIP = 512
# Tokens of a backward task, each with its own sum for the gradient of the weight.
CHUNK = {"cpu": 64, "cuda": 128}
# Tokens that a CPU adds one after the other: equal terms would round to the same side 64 times.
# CUDA has none: a second level of sums costs registers there.
RUN = 16
AHEAD = 8  # tokens whose loads a CUDA thread has under way
_INDICES = {False: "task, k", True: "k, task"}  # of a launch: adjacent memory follows last
VALUES = {"cpu": (lanes, W), "cuda": (wp.vec4, 4)}  # type of a value, and its channels


def _source(direction: str, device_type: str, tokens: int, transposed: bool) -> tuple[str, str]:
    """Return a function of ``conv.h``, or where it is ``transposed`` its twin, and the header."""
    on_cpu = device_type == "cpu"
    config = constants(
        "Config", TOKENS=tokens, RUN=RUN if on_cpu else 0, AHEAD=0 if on_cpu else AHEAD
    )
    header = native(Path(__file__).with_name(f"conv_{device_type}.h")) + config
    return f"gamba::conv::{direction}{'_transposed' if transposed else ''}<Config>", header


def _window(device_type: str, io: torch.dtype) -> dict[str, Any]:
    """Return the parameters that both kernels begin with."""
    value, rows = VALUES[device_type][0], wp.array3d(dtype=WARP_DTYPES[io])
    parameters = {"weight_in": wp.array2d(dtype=value), "bias_in": wp.array(dtype=value)}
    return {
        "use_silu": int,
        "pieces_in": wp.array2d(dtype=wp.int32),  # ``runtime.packed.pieces``, or none
        "x_in": rows,
        **parameters,
        "state_in": rows,
    }


@functools.cache
def forward_kernel(device_type: str, io: torch.dtype, transposed: bool) -> Any:
    """The kernel for tensors of dtype ``io`` on a device of that type (README, equation 1).

    If x is ``transposed`` (``runtime.views``), the launch's first dimension is channels.
    """
    piece = TRANSPOSED_STRIP if transposed else STRIP[device_type]
    inputs = {**_window(device_type, io), "stream": int}
    outputs = {"y_out": wp.array3d(dtype=WARP_DTYPES[io])}
    function, header = _source("forward", device_type, piece, transposed)
    indices = _INDICES[transposed]
    return native_kernel("conv_forward", function, inputs, outputs, header, indices, grouped=True)


@functools.cache
def backward_kernel(device_type: str, io: torch.dtype, transposed: bool) -> Any:
    """The kernel of the gradients (README, equation 2); the weight's are one sum per chunk.

    It is ``transposed`` where x or the gradient of the output is.
    """
    rows = wp.array3d(dtype=WARP_DTYPES[io])
    inputs = {**_window(device_type, io), "dout_in": rows}
    sums = wp.array3d(dtype=VALUES[device_type][0])
    outputs = {"dx_out": rows, "dstate_out": rows, "dweight_out": sums}
    function, header = _source("backward", device_type, CHUNK[device_type], transposed)
    indices = _INDICES[transposed]
    return native_kernel("conv_backward", function, inputs, outputs, header, indices, grouped=True)
