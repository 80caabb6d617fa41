"""The scan as torch operators: fake results, gradients, and a kernel by device."""

from __future__ import annotations

import torch
from torch import Tensor

from ..runtime.operator import operator
from ..runtime.stand_in import kind_of
from .cpu import launch as cpu
from .problem import Scan

_SCAN = (
    "Tensor u, Tensor delta, Tensor A, Tensor B, Tensor? C, Tensor? D, Tensor? z, "
    "Tensor? delta_bias, Tensor? initial_state, Tensor? packed, bool softplus, "
    "str discretization, bool save"
)


def _implementation(x: Scan):
    if kind_of(x.u.device) == "cpu":
        return cpu
    from .cuda import launch as cuda

    return cuda


@torch.library.custom_op(
    "gamba_warp::selective_scan",
    mutates_args=(),
    schema=f"({_SCAN}) -> (Tensor, Tensor, Tensor)",
)
def scan(*args) -> tuple[Tensor, Tensor, Tensor]:
    """``(out, last state, saved states)`` of the fields of a ``Scan``; without C, out is empty."""
    x = Scan(*args)
    return _implementation(x).forward(x)


@scan.register_fake
def _(*args):
    x = Scan(*args)
    out = torch.empty_like(x.u, memory_format=torch.contiguous_format)
    last = x.A.new_empty(x.sequences, *x.A.shape)
    saved = x.A.new_empty(_implementation(x).saved_shape(x))
    return out if x.C is not None else out.new_empty(x.u.shape[0], 0, x.u.shape[2]), last, saved


@torch.library.custom_op(
    "gamba_warp::selective_scan_backward",
    mutates_args=(),
    schema=f"(Tensor? dout, Tensor? dlast, Tensor saved, bool[] needs, {_SCAN}) -> Tensor[]",
)
def _scan_backward(dout, dlast, saved, needs, *args) -> list[Tensor]:
    x = Scan(*args)
    grads = _implementation(x).backward(dout, dlast, x, saved, needs)
    return [grad for grad in grads if grad is not None]


@_scan_backward.register_fake
def _(dout, dlast, saved, needs, *args):
    x = Scan(*args)
    state = x.A.new_empty(x.sequences, *x.A.shape)
    return [
        torch.empty_like(tensor, memory_format=torch.contiguous_format)
        for tensor, needed in zip((*x[:8], state), needs)
        if needed and tensor is not None
    ]


def _setup_context(ctx, inputs, output):
    x = Scan(*inputs)
    _, _, saved = output
    ctx.mark_non_differentiable(saved)
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*x[:8], x.packed, saved)
    ctx.options = x[10:]


def _gradient(ctx, dout, dlast, _):
    *tensors, packed, saved = ctx.saved_tensors
    x = Scan._make((*tensors, None, packed, *ctx.options))
    if not x.save:
        raise RuntimeError("selective_scan: this call kept nothing for a gradient")
    needs = list(ctx.needs_input_grad[:9])
    if x.C is None:
        dout = None
    elif dout is None:
        dout = x.u.new_zeros(1, 1, x.u.shape[2]).expand_as(x.u)
    grads = iter(_scan_backward(dout, dlast, saved, needs, *x))
    return (*(next(grads) if needed else None for needed in needs), *[None] * 4)


def _no_second_gradient(ctx, *grads):
    raise RuntimeError("selective_scan: second derivatives are not supported")


scan = operator(scan, "selective_scan", _setup_context, _gradient)
_scan_backward.register_autograd(_no_second_gradient)
_scan_backward = operator(_scan_backward, "selective_scan")
