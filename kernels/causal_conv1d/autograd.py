"""The convolution as torch operators: launches, fake results and gradients."""

import torch
from torch import Tensor

from ..runtime import gpu
from ..runtime.launch import launch
from ..runtime.memory import empty_like
from ..runtime.native import streams
from ..runtime.operator import operator
from ..runtime.packed import count_slots, pieces
from ..runtime.views import dense, is_transposed, laid_as, lane_contiguous, view
from .kernels import CHUNK, STRIP, TAPS, TRANSPOSED_STRIP, VALUES, backward_kernel, forward_kernel

_ARGUMENTS = "Tensor x, Tensor weight, Tensor? bias, Tensor? state, Tensor? packed, bool silu"
_FEW = 1 << 15  # elements that one thread has done before it could wake another


def _like(x: Tensor) -> Tensor:
    return empty_like(x) if x.device.type == "cpu" else x.new_empty(x.shape)


def _pack(x: Tensor | None, rows: int, channels: int, like: Tensor) -> Tensor:
    """``[D, rows]`` to float32 ``[rows, channels]``, zeros in front of too few rows.

    The result may share the memory of ``x``.
    """
    if x is None:
        return torch.zeros(rows, channels, dtype=torch.float32, device=like.device)
    x = x.reshape(like.shape[2], -1).T.float()
    if x.shape != (rows, channels):
        x = torch.constant_pad_nd(x, (0, channels - x.shape[1], rows - x.shape[0], 0))
    return x.contiguous()


def _operands(x: Tensor, weight: Tensor, bias: Tensor | None, state: Tensor | None):
    """Channels padded to whole values, views of the parameters, and the state's three rows."""
    value, width = VALUES[gpu.kind_of(x.device)]
    blocks = -(-x.shape[2] // width)
    shape = (width,) if width > 1 else ()
    w = _pack(weight, TAPS, blocks * width, x).view(TAPS, blocks, *shape)
    v = _pack(bias, 1, blocks * width, x).view(blocks, *shape)
    rows = x.narrow(1, 0, 0) if state is None else lane_contiguous(state)
    if state is not None and (short := TAPS - 1 - state.shape[1]):
        rows = torch.constant_pad_nd(state, (0, 0, short, 0))
    return blocks, view(w, value), view(v, value), rows


def _launch(x: Tensor, kernel, dim: tuple[int, int], inputs: list, outputs: list) -> None:
    threads = 1 if x.numel() < _FEW else None
    launch(kernel, dim, inputs, outputs, x.device, threads)


def _pieces(x: Tensor, rows: Tensor | None, tokens: int) -> tuple[int, Tensor]:
    """Return the number of pieces of that many tokens, and the pieces of packed rows."""
    batch, length, _ = x.shape
    if rows is None:
        return batch * -(-length // tokens), torch.empty(0, 5, dtype=torch.int32, device=x.device)
    return count_slots(rows, batch, length, tokens), pieces(rows, batch, length, tokens)


@torch.library.custom_op(
    "gamba_warp::causal_conv1d", mutates_args=(), schema=f"({_ARGUMENTS}) -> Tensor"
)
def conv(x, weight, bias, state, packed, silu):
    """``causal_conv1d`` after its checks: ``x [B, L, D]`` to ``[B, L, D]``.

    ``packed`` are the sequences (``runtime.packed``), or None.
    """
    kind = gpu.kind_of(x.device)
    x = dense(x)
    transposed = is_transposed(x)
    strips, where = _pieces(x, packed, TRANSPOSED_STRIP if transposed else STRIP[kind])
    blocks, w, v, rows = _operands(x, weight, bias, state)
    out = _like(x)
    kernel = forward_kernel(kind, x.dtype, transposed)
    stream = int(kind == "cpu" and streams([out]) and not (transposed and packed is not None))
    inputs = [int(silu), where, x, w, v, rows, stream]
    _launch(x, kernel, (blocks, strips) if transposed else (strips, blocks), inputs, [out])
    return out


@conv.register_fake
def _(x, weight, bias, state, packed, silu):
    return laid_as(x, x.new_empty)


@torch.library.custom_op(
    "gamba_warp::causal_conv1d_backward",
    mutates_args=(),
    schema=f"(Tensor dout, {_ARGUMENTS}, bool[] needs) -> Tensor[]",
)
def _conv_backward(dout, x, weight, bias, state, packed, silu, needs):
    need_x, need_weight, need_bias, need_state = needs
    batch, length, channels = x.shape
    kind = gpu.kind_of(x.device)
    chunks, where = _pieces(x, packed, CHUNK[kind])
    x, dout = dense(x), dense(dout)
    transposed = is_transposed(x) or is_transposed(dout)
    value, width = VALUES[kind]
    blocks, w, v, rows = _operands(x, weight, bias, state)
    dx = _like(x) if need_x else x.new_empty(batch, 0, channels)
    dstate = x.new_zeros(len(rows), TAPS - 1 if need_state else 0, channels)
    make = torch.empty if packed is None else torch.zeros  # a piece may have no token
    shape = chunks, 5 if need_weight or need_bias else 0, blocks * width
    dweight = make(shape, dtype=torch.float32, device=x.device)
    shaped = dweight.view(*dweight.shape[:2], blocks, width) if width > 1 else dweight
    _launch(
        x,
        backward_kernel(kind, x.dtype, transposed),
        (blocks, chunks) if transposed else (chunks, blocks),
        [int(silu), where, x, w, v, rows, dout],
        [dx, dstate, view(shaped, value)],
    )
    grads = [dx] if need_x else []
    total = dweight.sum(0)[:, :channels]  # without rows if neither gradient is needed
    if need_weight:
        grads.append(total[TAPS - weight.shape[1] : TAPS].T.to(weight.dtype).contiguous())
    if need_bias and bias is not None:
        grads.append(total[TAPS].to(bias.dtype).clone())
    if need_state and state is not None:
        grads.append(dstate[:, TAPS - 1 - state.shape[1] :].clone())
    return grads


@_conv_backward.register_fake
def _(dout, x, weight, bias, state, packed, silu, needs):
    grads = [
        torch.empty_like(a, memory_format=torch.contiguous_format)
        for a, needed in zip((x, weight, bias, state), needs)
        if needed
    ]
    return [laid_as(x, x.new_empty), *grads[1:]] if needs[0] else grads


def _setup_context(ctx, inputs, output):
    *tensors, ctx.silu = inputs
    ctx.save_for_backward(*tensors)


def _gradient(ctx, dout):
    needs = list(ctx.needs_input_grad[:4])
    grads = iter(_conv_backward(dout, *ctx.saved_tensors, ctx.silu, needs))
    return (*(next(grads) if needed else None for needed in needs), None, None)


def _no_second_gradient(ctx, *grads):
    raise RuntimeError("causal_conv1d: second derivatives are not supported")


conv = operator(conv, "causal_conv1d", _setup_context, _gradient)
_conv_backward.register_autograd(_no_second_gradient)
_conv_backward = operator(_conv_backward, "causal_conv1d")
