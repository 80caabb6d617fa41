"""Causal depthwise convolution of at most four taps, with SiLU: the step before the scan.

One kernel body serves both devices: its values are lanes of sixteen channels on a CPU and single
floats, one thread each, on CUDA. Equations 13 and 14 of README.md.
"""

import functools

import torch
import warp as wp
from torch import Tensor

from ..interop import cuda_launch, empty, lane_contiguous, parallel_launch, view
from . import rows as cpu_values
from . import scalars as cuda_values
from .lanes import WARP_DTYPES

TAPS = 4
STRIP = 16  # tokens of a forward task: few rows at once, for each is of another page
CHUNK = 64  # of a backward one; the gradient of the weight is summed in these, then over them
DTYPES = (torch.float32, torch.bfloat16, torch.float16)
ACTIVATIONS = (None, "silu", "swish")

_S = wp.constant(STRIP)
_K = wp.constant(CHUNK)
_HISTORY = wp.constant(TAPS - 1)


def _values(device_type: str, io: torch.dtype):
    """Value type, its channels, load, store and the arithmetic of one device."""
    m = cpu_values if device_type == "cpu" else cuda_values
    load, store = m.ACCESSORS[io]
    return m.VALUE, m.WIDTH, load, store, m.times, m.fma, m.sigmoid


@functools.cache
def _forward_kernel(device_type: str, io: torch.dtype):
    value, channels_of_value, load, store, times, fma, sigmoid = _values(device_type, io)
    scalar = WARP_DTYPES[io]

    @wp.kernel(enable_backward=False, module="unique")
    def conv_forward(
        offset: int,
        # in
        strips: int,
        use_silu: int,
        x_in: wp.array3d(dtype=scalar),
        weight_in: wp.array2d(dtype=value),
        bias_in: wp.array(dtype=value),
        state_in: wp.array3d(dtype=scalar),
        # out
        y_out: wp.array3d(dtype=scalar),
    ):
        task, k = wp.tid()
        task = task + offset
        b = task / strips
        t0 = (task % strips) * _S
        d = k * wp.static(channels_of_value)
        width = wp.min(wp.static(channels_of_value), x_in.shape[2] - d)
        w0, w1, w2, w3 = weight_in[0, k], weight_in[1, k], weight_in[2, k], weight_in[3, k]
        x0, x1, x2 = value(0.0), value(0.0), value(0.0)
        for i in range(_HISTORY):
            x0 = x1
            x1 = x2
            t = t0 - _HISTORY + i
            if t >= 0:
                x2 = load(x_in, b, t, d, width)
            elif state_in.shape[1] > 0:
                x2 = load(state_in, b, t + _HISTORY, d, width)
        for t in range(t0, wp.min(t0 + _S, x_in.shape[1])):
            x3 = load(x_in, b, t, d, width)
            y = fma(w0, x0, fma(w1, x1, fma(w2, x2, fma(w3, x3, bias_in[k]))))
            if use_silu != 0:
                y = times(y, sigmoid(y))
            store(y_out, b, t, d, width, y)
            x0 = x1
            x1 = x2
            x2 = x3

    return conv_forward


@functools.cache
def _backward_kernel(device_type: str, io: torch.dtype):
    value, channels_of_value, load, store, times, fma, sigmoid = _values(device_type, io)
    scalar = WARP_DTYPES[io]

    @wp.kernel(enable_backward=False, module="unique")
    def conv_backward(
        offset: int,
        # in
        chunks: int,
        use_silu: int,
        x_in: wp.array3d(dtype=scalar),
        weight_in: wp.array2d(dtype=value),
        bias_in: wp.array(dtype=value),
        state_in: wp.array3d(dtype=scalar),
        dout_in: wp.array3d(dtype=scalar),
        # out
        dx_out: wp.array3d(dtype=scalar),
        dstate_out: wp.array3d(dtype=scalar),
        dweight_out: wp.array3d(dtype=value),
    ):
        task, k = wp.tid()
        task = task + offset
        b = task / chunks
        t0 = (task % chunks) * _K
        length = x_in.shape[1]
        end = wp.min(t0 + _K, length)
        d = k * wp.static(channels_of_value)
        width = wp.min(wp.static(channels_of_value), x_in.shape[2] - d)
        w0, w1, w2, w3 = weight_in[0, k], weight_in[1, k], weight_in[2, k], weight_in[3, k]
        x0, x1, x2, x3 = value(0.0), value(0.0), value(0.0), value(0.0)
        for i in range(_HISTORY):
            x0 = x1
            x1 = x2
            t = t0 - _HISTORY + i
            if t >= 0:
                x2 = load(x_in, b, t, d, width)
            elif state_in.shape[1] > 0:
                x2 = load(state_in, b, t + _HISTORY, d, width)
        g0, g1, g2, g3 = value(0.0), value(0.0), value(0.0), value(0.0)
        v0, v1, v2, v3, vb = value(0.0), value(0.0), value(0.0), value(0.0), value(0.0)
        # dx of token t needs the gradients g of t to t + 3: the loop runs three tokens behind
        for t in range(t0, end + _HISTORY):
            g3 = value(0.0)
            if t < length:
                x3 = load(x_in, b, t, d, width)
                g3 = load(dout_in, b, t, d, width)
                if use_silu != 0:
                    y = fma(w0, x0, fma(w1, x1, fma(w2, x2, fma(w3, x3, bias_in[k]))))
                    s = sigmoid(y)
                    g3 = times(g3, fma(times(y, s), value(1.0) - s, s))
                if t < end:
                    v0 = fma(g3, x0, v0)
                    v1 = fma(g3, x1, v1)
                    v2 = fma(g3, x2, v2)
                    v3 = fma(g3, x3, v3)
                    vb = vb + g3
            dx = fma(w3, g0, fma(w2, g1, fma(w1, g2, times(w0, g3))))
            at = t - _HISTORY
            if at >= t0:
                if dx_out.shape[1] > 0:
                    store(dx_out, b, at, d, width, dx)
            elif at < 0 and dstate_out.shape[1] > 0:
                store(dstate_out, b, t, d, width, dx)
            x0 = x1
            x1 = x2
            x2 = x3
            g0 = g1
            g1 = g2
            g2 = g3
        if dweight_out.shape[1] > 0:
            dweight_out[task, 0, k] = v0
            dweight_out[task, 1, k] = v1
            dweight_out[task, 2, k] = v2
            dweight_out[task, 3, k] = v3
            dweight_out[task, 4, k] = vb

    return conv_backward


def _empty(like: Tensor, shape: tuple[int, ...]) -> Tensor:
    return empty(shape, like.dtype) if like.device.type == "cpu" else like.new_empty(shape)


def _pack(x: Tensor | None, rows: int, channels: int, like: Tensor) -> Tensor:
    """``[D, rows]`` to float32 ``[rows, channels]``, zeros in front of too few rows."""
    packed = torch.zeros(rows, channels, device=like.device)
    if x is not None:
        x = x.reshape(like.shape[2], -1)
        packed[rows - x.shape[1] :, : like.shape[2]] = x.T
    return packed


def _operands(x: Tensor, weight: Tensor, bias: Tensor | None, state: Tensor | None):
    """Channels padded to whole values, views of the parameters, and the state's three rows."""
    m = cpu_values if x.device.type == "cpu" else cuda_values
    blocks = -(-x.shape[2] // m.WIDTH)
    shape = (m.WIDTH,) if m.WIDTH > 1 else ()
    w = _pack(weight, TAPS, blocks * m.WIDTH, x).view(TAPS, blocks, *shape)
    v = _pack(bias, 1, blocks * m.WIDTH, x).view(blocks, *shape)
    rows = x.new_zeros(x.shape[0], 0 if state is None else TAPS - 1, x.shape[2])
    if state is not None:
        rows[:, TAPS - 1 - state.shape[1] :] = state
    return blocks, view(w, m.VALUE), view(v, m.VALUE), rows


def _launch(x: Tensor, kernel, dim: tuple[int, int], inputs: list, outputs: list) -> None:
    if x.device.type == "cpu":
        parallel_launch(kernel, dim, inputs, outputs)
    else:
        cuda_launch(kernel, dim, [0, *inputs], outputs, device=x.device, block_dim=128)


@torch.library.custom_op("gamba_warp::causal_conv1d", mutates_args=())
def _conv(
    x: Tensor, weight: Tensor, bias: Tensor | None, state: Tensor | None, silu: bool
) -> Tensor:
    strips = -(-x.shape[1] // STRIP)
    x = lane_contiguous(x)
    blocks, w, v, rows = _operands(x, weight, bias, state)
    out = torch.empty(x.shape, dtype=x.dtype, device=x.device)
    kernel = _forward_kernel(x.device.type, x.dtype)
    _launch(x, kernel, (x.shape[0] * strips, blocks), [strips, int(silu), x, w, v, rows], [out])
    return out


@_conv.register_fake
def _(x, weight, bias, state, silu):
    return torch.empty_like(x, memory_format=torch.contiguous_format)


@torch.library.custom_op("gamba_warp::causal_conv1d_backward", mutates_args=())
def _conv_backward(
    dout: Tensor,
    x: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    state: Tensor | None,
    silu: bool,
    needs: list[bool],
) -> list[Tensor]:
    need_x, need_weight, need_bias, need_state = needs
    batch, length, channels = x.shape
    chunks = -(-length // CHUNK)
    x = lane_contiguous(x)
    m = cpu_values if x.device.type == "cpu" else cuda_values
    blocks, w, v, rows = _operands(x, weight, bias, state)
    dx = _empty(x, (batch, length if need_x else 0, channels))
    dstate = x.new_zeros(batch, TAPS - 1 if need_state else 0, channels)
    dweight = torch.empty(
        batch * chunks, 5 if need_weight or need_bias else 0, blocks * m.WIDTH, device=x.device
    )
    shaped = dweight.view(*dweight.shape[:2], blocks, m.WIDTH) if m.WIDTH > 1 else dweight
    _launch(
        x,
        _backward_kernel(x.device.type, x.dtype),
        (batch * chunks, blocks),
        [chunks, int(silu), x, w, v, rows, lane_contiguous(dout)],
        [dx, dstate, view(shaped, m.VALUE)],
    )
    grads = [dx] if need_x else []
    total = dweight.sum(0)[:, :channels] if need_weight or need_bias else None
    if need_weight:
        grads.append(total[TAPS - weight.shape[1] : TAPS].T.to(weight.dtype).contiguous())
    if need_bias:
        grads.append(total[TAPS].to(bias.dtype).clone())
    if need_state:
        grads.append(dstate[:, TAPS - 1 - state.shape[1] :].clone())
    return grads


@_conv_backward.register_fake
def _(dout, x, weight, bias, state, silu, needs):
    return [
        torch.empty_like(a, memory_format=torch.contiguous_format)
        for a, needed in zip((x, weight, bias, state), needs)
        if needed
    ]


def _setup_context(ctx, inputs, output):
    x, weight, bias, state, ctx.silu = inputs
    ctx.save_for_backward(x, weight, bias, state)


def _gradient(ctx, dout):
    needs = list(ctx.needs_input_grad[:4])
    grads = iter(_conv_backward(dout, *ctx.saved_tensors, ctx.silu, needs))
    return (*(next(grads) if needed else None for needed in needs), None)


def _no_second_gradient(ctx, *grads):
    raise RuntimeError("causal_conv1d: second derivatives are not supported")


_conv.register_autograd(_gradient, setup_context=_setup_context)
_conv_backward.register_autograd(_no_second_gradient)


def causal_conv1d(
    x: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    *,
    activation: str | None = None,
    initial_state: Tensor | None = None,
    return_final_state: bool = False,
) -> Tensor | tuple[Tensor, Tensor]:
    """Depthwise causal convolution along tokens, channels last (README, equation 13).

    Args:
        x: ``[B, L, D]`` float32, bfloat16 or float16.
        weight: ``[D, W]`` float dtype, W from 2 to 4; the last tap meets the present token.
        bias: ``[D]`` float dtype, or None for 0.
        activation: None, "silu" or "swish" (the same).
        initial_state: ``[B, W-1, D]`` in x's dtype, the tokens before the first; None for 0.
        return_final_state: also return the last W-1 tokens, ``[B, W-1, D]``.

    Returns:
        ``[B, L, D]`` in x's dtype, and the final state if asked for.

    Raises:
        TypeError: an argument is not a tensor or has another dtype.
        ValueError: a shape, a device or ``activation`` is not one of the above.
    """
    _check(x, weight, bias, activation, initial_state)
    out = _conv(x, weight, bias, initial_state, activation is not None)
    if not return_final_state:
        return out
    history = weight.shape[1] - 1
    if initial_state is None:
        initial_state = x.new_zeros(x.shape[0], history, x.shape[2])
    recent = torch.cat([initial_state, x[:, max(0, x.shape[1] - history) :]], 1)
    return out, recent[:, recent.shape[1] - history :]


def _check(x, weight, bias, activation, initial_state) -> None:
    tensors = {"x": x, "weight": weight, "bias": bias, "initial_state": initial_state}
    for name, value in tensors.items():
        if value is None and name in ("bias", "initial_state"):
            continue
        if not isinstance(value, Tensor):
            raise TypeError(f"{name} is {type(value).__name__}, must be a tensor")
        if value.dtype not in DTYPES:
            raise TypeError(f"{name} has dtype {value.dtype}, allowed: {DTYPES}")
        if value.device != x.device or x.device.type not in ("cpu", "cuda"):
            raise ValueError(f"{name} is on {value.device}, x is on {x.device}; cpu or cuda")
    if x.dim() != 3 or x.shape[2] == 0:
        raise ValueError(f"x has shape {tuple(x.shape)}, must be [B, L, D] with D >= 1")
    batch, _, channels = x.shape
    if weight.dim() != 2 or weight.shape[0] != channels or not 2 <= weight.shape[1] <= TAPS:
        raise ValueError(f"weight has shape {tuple(weight.shape)}, must be ({channels}, 2 to 4)")
    if bias is not None and tuple(bias.shape) != (channels,):
        raise ValueError(f"bias has shape {tuple(bias.shape)}, must be ({channels},)")
    want = (batch, weight.shape[1] - 1, channels)
    if initial_state is not None and tuple(initial_state.shape) != want:
        raise ValueError(f"initial_state has shape {tuple(initial_state.shape)}, must be {want}")
    if initial_state is not None and initial_state.dtype != x.dtype:
        raise TypeError(f"initial_state has dtype {initial_state.dtype}, x has {x.dtype}")
    if activation not in ACTIVATIONS:
        raise ValueError(f"activation is {activation!r}, allowed: {ACTIVATIONS}")
