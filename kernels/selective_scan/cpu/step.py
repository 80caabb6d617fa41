"""One token through the convolution and through the scan on a CPU: a kernel each, no gradient.

A state of sixteen numbers is one SIMD value here, so the lanes are the states of a channel and not
channels as in ``kernels.py``. Everything else is done for sixteen channels at once. For
arguments that the kernels do not take, both functions return None and change nothing.
"""

from __future__ import annotations

from pathlib import Path

import torch
import warp as wp
from torch import Tensor

from ...runtime.launch import parallel_launch
from ...runtime.native import PRELUDE, W, native, native_kernel
from ...runtime.operator import has_tangent

_PLAIN = (Tensor, torch.nn.Parameter)  # no fake tensor, which has no memory
_FEW = 64  # tasks of sixteen channels below which one thread is as fast as several

_HERE = Path(__file__).parent
_MATRIX, _VECTOR = wp.array2d[wp.float32], wp.array[wp.float32]
_RESULTS = {"state_out": wp.array3d[wp.float32], "y_out": _MATRIX}

conv_kernel = native_kernel(
    "conv_step",
    PRELUDE + native(_HERE / "conv_step.inl"),
    inputs={
        **dict.fromkeys(("blocks", "taps", "use_silu"), int),
        **dict.fromkeys(("x_in", "weight_in"), _MATRIX),
        "bias_in": _VECTOR,
    },
    outputs=_RESULTS,
)
scan_kernel = native_kernel(
    "scan_step",
    PRELUDE + native(_HERE / "scan_step.inl"),
    inputs={
        **dict.fromkeys(("blocks", "states", "use_softplus", "logs"), int),
        **dict.fromkeys(("x_in", "dt_in", "b_in", "c_in", "z_in", "a_in"), _MATRIX),
        **dict.fromkeys(("skip_in", "bias_in"), _VECTOR),
    },
    outputs=_RESULTS,
)


def conv_step(
    x: Tensor, weight: Tensor, bias: Tensor | None, state: Tensor, silu: bool
) -> Tensor | None:
    """Convolves one more token, and shifts it into the state; all float32 on the CPU.

    Args:
        x: ``[B, D]``, D a multiple of 16; its rows may be strided.
        weight: ``[D, W]``, contiguous.
        bias: ``[D]``, or None for 0.
        state: ``[B, D, W]``, contiguous, updated in place.
        silu: True to apply SiLU.

    Returns:
        ``[B, D]``; None, and nothing done, where an argument is not as above.
    """
    tensors = isinstance(state, Tensor) and isinstance(weight, Tensor)
    if not tensors or state.dim() != 3 or weight.dim() != 2:
        return None
    channels, taps = weight.shape
    rows, whole = [(x, (len(state), channels))], [(weight, (channels, taps))]
    sizes = [taps, int(silu)]
    return _step(conv_kernel, state, taps, sizes, rows, whole, [(bias, (channels,))])


def scan_step(
    state: Tensor,
    x: Tensor,
    dt: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor | None,
    z: Tensor | None,
    dt_bias: Tensor | None,
    dt_softplus: bool,
    logs: bool = False,
) -> Tensor | None:
    """Takes the state one token further in place; all float32 on the CPU.

    Args:
        state: ``[B, D, N]``, contiguous, D and N multiples of 16.
        x: ``[B, D]``, the token; rows of it and of the others may be strided.
        dt: as x.
        A: ``[D, N]``, contiguous.
        B: ``[B, N]``.
        C: as B.
        D: ``[D]``, or None for 0.
        z: as x, or None for no gate.
        dt_bias: ``[D]``, or None for 0.
        dt_softplus: True to apply softplus to the step.
        logs: True if ``A`` holds the logarithms of -A, as a layer's ``A_log``.

    Returns:
        ``[B, D]``; None, and nothing done, where an argument is not as above.
    """
    if not isinstance(state, Tensor) or state.dim() != 3 or state.shape[2] % W:
        return None
    batch, channels, states = state.shape
    token, matrix, vector = (batch, channels), (batch, states), (channels,)
    rows = [(x, token), (dt, token), (B, matrix), (C, matrix)]
    if z is not None:
        rows.append((z, token))
    whole = [(A, (channels, states))]
    sizes = [states, int(dt_softplus), int(logs)]
    return _step(scan_kernel, state, states, sizes, rows, whole, [(D, vector), (dt_bias, vector)])


def _step(kernel, state: Tensor, last: int, sizes: list, rows, whole, vectors) -> Tensor | None:
    """Launches a kernel if all are float32 tensors in memory, of the shapes beside them.

    Args:
        kernel: of sixteen channels; its tensors are these, then the state and the result.
        state: ``[B, D, last]``, whole.
        last: of the state's shape.
        sizes: the kernel's.
        rows: tensors whose last dimension is dense; a fifth is the gate, and may be left out.
        whole: contiguous tensors.
        vectors: contiguous too, or None.
    """
    (batch, channels), x = rows[0][1], rows[0][0]
    given = [*whole, *((v, shape) for v, shape in vectors if v is not None)]
    given.append((state, (batch, channels, last)))
    if torch.compiler.is_compiling() or channels % W:
        return None
    if has_tangent(*(v for v, _ in rows + given)):  # formulas in torch carry it on
        return None
    for v, shape in rows + given:
        if type(v) not in _PLAIN or v.dtype != torch.float32 or v.shape != shape or not v.is_cpu:
            return None
    if not all(v.is_contiguous() for v, _ in given) or any(v.stride(1) != 1 for v, _ in rows):
        return None
    out = x.new_empty(batch, channels)
    if len(rows) == 4:
        rows = [*rows, (x.new_empty(0, 1), ())]
    inputs = [v for v, _ in rows + whole] + [x.new_empty(0) if v is None else v for v, _ in vectors]
    tasks = batch * channels // W
    threads = torch.get_num_threads() if tasks >= _FEW else 1
    arguments = [channels // W, *sizes, *inputs, state, out]
    parallel_launch(kernel, tasks, arguments, threads=threads)
    if not state.is_inference():  # a gradient that needs the old state is to fail
        torch.autograd.graph.increment_version(state)
    return out
