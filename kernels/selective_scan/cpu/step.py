"""One token through the convolution and through the scan on a CPU: a kernel each, no gradient.

A state of sixteen numbers is one SIMD value here, so the lanes are the states of a channel and not
channels as in ``kernels.py``. Everything else is done for sixteen channels at once. What these
kernels do not take is left to the caller: both functions then return None and touch nothing.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from ...runtime.lanes import ACTIVATIONS, PRELUDE, W, flush_denormals, restore_denormals
from ...runtime.launch import parallel_launch

_PLAIN = (Tensor, torch.nn.Parameter)  # no fake tensor, which has no memory
_FEW = 64  # tasks of sixteen channels below which one thread is as fast as several

_MATRIX, _VECTOR = wp.array2d[wp.float32], wp.array[wp.float32]
_STATES = wp.array3d[wp.float32]

_CONV = """
const float* x = (const float*)((const char*)x_in.data + (size_t)b * x_in.strides[0]) + d;
const float* w = weight_in.data + (size_t)d * taps;
float* seen = state_out.data + ((size_t)b * channels + d) * taps;
F sum = bias_in.shape[0] ? *(const F*)(bias_in.data + d) : F{};
for (int c = 0; c < 16; ++c, seen += taps, w += taps) {
    float old = 0.0f;
    for (int k = 0; k < taps - 1; ++k) {
        seen[k] = seen[k + 1];
        old += seen[k] * w[k];
    }
    seen[taps - 1] = x[c];
    sum[c] += old + x[c] * w[taps - 1];
}
*(F*)(x_out.data + (size_t)b * channels + d) = use_silu ? sum * sigmoid_(sum) : sum;
"""

_SUM = """
typedef float Eight __attribute__((vector_size(32)));
typedef float Four __attribute__((vector_size(16)));
auto sum_ = [](F v) -> float {
    const Eight e = __builtin_shufflevector(v, v, 0, 1, 2, 3, 4, 5, 6, 7)
        + __builtin_shufflevector(v, v, 8, 9, 10, 11, 12, 13, 14, 15);
    const Four f = __builtin_shufflevector(e, e, 0, 1, 2, 3)
        + __builtin_shufflevector(e, e, 4, 5, 6, 7);
    return (f[0] + f[1]) + (f[2] + f[3]);
};
auto row_ = [&](auto& array) -> const float* {
    return (const float*)((const char*)array.data + (size_t)b * array.strides[0]);
};
"""
_SCAN = """
F step = *(const F*)(row_(dt_in) + d);
if (bias_in.shape[0]) step += *(const F*)(bias_in.data + d);
if (use_softplus) step = softplus_(step);
const F u = *(const F*)(row_(x_in) + d), du = step * u, rate = step * LOG2E;
F y = skip_in.shape[0] ? *(const F*)(skip_in.data + d) * u : F{};
for (int n = 0; n < states; n += 16) {
    const F b_n = *(const F*)(row_(b_in) + n), c_n = *(const F*)(row_(c_in) + n);
    const float* a = a_in.data + (size_t)d * states + n;
    float* h = state_out.data + ((size_t)b * channels + d) * states + n;
    for (int c = 0; c < 16; ++c, a += states, h += states) {
        const F log = *(const F*)a;
        const F slope = logs ? -exp2_(log * LOG2E) : log;
        const F next = fma_(*(F*)h, exp2_(slope * rate[c]), b_n * du[c]);
        *(F*)h = next;
        y[c] += sum_(next * c_n);
    }
}
if (z_in.shape[0]) {
    const F z = *(const F*)(row_(z_in) + d);
    y *= z * sigmoid_(z);
}
*(F*)(y_out.data + (size_t)b * channels + d) = y;
"""


@wp.func_native(PRELUDE + ACTIVATIONS + _CONV)
def _conv_leaf(
    x_in: _MATRIX,
    weight_in: _MATRIX,
    bias_in: _VECTOR,
    b: int,
    d: int,
    channels: int,
    taps: int,
    use_silu: int,
    state_out: _STATES,
    x_out: _MATRIX,
): ...


@wp.func_native(PRELUDE + ACTIVATIONS + _SUM + _SCAN)
def _scan_leaf(
    x_in: _MATRIX,
    dt_in: _MATRIX,
    a_in: _MATRIX,
    b_in: _MATRIX,
    c_in: _MATRIX,
    skip_in: _VECTOR,
    z_in: _MATRIX,
    bias_in: _VECTOR,
    b: int,
    d: int,
    channels: int,
    states: int,
    use_softplus: int,
    logs: int,
    state_out: _STATES,
    y_out: _MATRIX,
): ...


@wp.kernel(enable_backward=False)
def _conv_step(
    offset: wp.int32,
    blocks: int,
    taps: int,
    use_silu: int,
    x_in: _MATRIX,
    weight_in: _MATRIX,
    bias_in: _VECTOR,
    state_out: _STATES,
    x_out: _MATRIX,
):
    i = offset + wp.tid()
    b = i // blocks
    d = (i - b * blocks) * 16
    _conv_leaf(x_in, weight_in, bias_in, b, d, blocks * 16, taps, use_silu, state_out, x_out)


@wp.kernel(enable_backward=False)
def _scan_step(
    offset: wp.int32,
    blocks: int,
    states: int,
    use_softplus: int,
    logs: int,
    x_in: _MATRIX,
    dt_in: _MATRIX,
    a_in: _MATRIX,
    b_in: _MATRIX,
    c_in: _MATRIX,
    skip_in: _VECTOR,
    z_in: _MATRIX,
    bias_in: _VECTOR,
    state_out: _STATES,
    y_out: _MATRIX,
):
    i = offset + wp.tid()
    b = i // blocks
    d = (i - b * blocks) * 16
    before = flush_denormals()
    _scan_leaf(
        x_in, dt_in, a_in, b_in, c_in, skip_in, z_in, bias_in,
        b, d, blocks * 16, states, use_softplus, logs, state_out, y_out,
    )  # fmt: skip
    restore_denormals(before)


def conv_step(
    x: Tensor, weight: Tensor, bias: Tensor | None, state: Tensor, silu: bool
) -> Tensor | None:
    """Convolves one more token, and shifts it into the state; all float32 on the CPU.

    Args:
        x: ``[B, D]``, D a multiple of 16; its rows may be strided.
        weight: ``[D, W]``, contiguous.
        bias: ``[D]``, or None for 0.
        state: ``[B, D, W]``, contiguous, updated in place.
        silu: whether SiLU follows.

    Returns:
        ``[B, D]``; None, and nothing done, where an argument is not as above.
    """
    if not isinstance(x, Tensor) or not isinstance(weight, Tensor):
        return None
    if x.dim() != 2 or weight.dim() != 2 or x.shape[1] % W:
        return None
    (batch, channels), taps = x.shape, weight.shape[1]
    whole = [(weight, (channels, taps)), (state, (batch, channels, taps))]
    if bias is not None:
        whole.append((bias, (channels,)))
    if not _fit([(x, (batch, channels))], whole):
        return None
    out = x.new_empty(batch, channels)
    sizes = [channels // W, taps, int(silu)]
    inputs = [x, weight, _or_none(bias, x)]
    _launch(_conv_step, batch * channels // W, [*sizes, *inputs, state, out])
    _changed(state)
    return out


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
        dt_softplus: whether the step is a softplus.
        logs: whether ``A`` holds the logarithms of -A, as a layer's ``A_log``.

    Returns:
        ``[B, D]``; None, and nothing done, where an argument is not as above.
    """
    if not isinstance(state, Tensor) or state.dim() != 3:
        return None
    batch, channels, states = state.shape
    if channels % W or states % W:
        return None
    token, matrix = (batch, channels), (batch, states)
    rows = [(x, token), (dt, token), (B, matrix), (C, matrix)]
    whole = [(state, state.shape), (A, (channels, states))]
    if z is not None:
        rows.append((z, token))
    whole += [(v, (channels,)) for v in (D, dt_bias) if v is not None]
    if not _fit(rows, whole):
        return None
    out = x.new_empty(batch, channels)
    sizes = [channels // W, states, int(dt_softplus), int(logs)]
    gate = x.new_empty(0, 1) if z is None else z
    inputs = [x, dt, A, B, C, _or_none(D, x), gate, _or_none(dt_bias, x)]
    _launch(_scan_step, batch * channels // W, [*sizes, *inputs, state, out])
    _changed(state)
    return out


def _fit(rows: list[tuple], whole: list[tuple]) -> bool:
    """Whether all are float32 tensors in memory, of their shapes, with dense rows, or whole."""
    if torch.compiler.is_compiling():
        return False
    for x, shape in rows + whole:
        if type(x) not in _PLAIN or x.dtype != torch.float32 or x.shape != shape or not x.is_cpu:
            return False
    for x, _ in whole:
        if not x.is_contiguous():
            return False
    for x, _ in rows:
        if x.stride(1) != 1:
            return False
    return True


def _or_none(vector: Tensor | None, like: Tensor) -> Tensor:
    return like.new_empty(0) if vector is None else vector


def _changed(state: Tensor) -> None:
    """Tells torch that a kernel wrote into the state: a gradient that needs the old one fails."""
    if not state.is_inference():
        torch.autograd.graph.increment_version(state)


def _launch(kernel, tasks: int, arguments: list) -> None:
    threads = torch.get_num_threads() if tasks >= _FEW else 1
    parallel_launch(kernel, tasks, arguments, threads=threads)
