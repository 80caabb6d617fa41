"""The scan as torch operators: fake results, gradients, and a kernel by device."""

from __future__ import annotations

import torch
from torch import Tensor

from ..runtime import gpu
from ..runtime.operator import operator
from ..runtime.views import laid_as
from .cpu import launch as cpu
from .problem import Inputs, Options, Scan

# the fields of ``Inputs``, then of ``Options``
_SCAN = (
    "Tensor u, Tensor delta, Tensor A, Tensor B, Tensor? C, Tensor? D, Tensor? z, "
    "Tensor? delta_bias, Tensor? initial_state, Tensor? packed, bool softplus, "
    "str discretization, bool save"
)


def _implementation(u: Tensor):
    if gpu.kind_of(u.device) == "cpu":
        return cpu
    from .cuda import launch as cuda

    return cuda


@torch.library.custom_op(
    "gamba_warp::selective_scan",
    mutates_args=(),
    schema=f"({_SCAN}) -> (Tensor, Tensor, Tensor)",
)
def scan(*arguments) -> tuple[Tensor, Tensor, Tensor]:
    """``(out, last state, saved states)`` of ``Scan.of(*arguments)``; without C, out is empty."""
    x = Scan.of(*arguments)
    return _implementation(x.inputs.u).forward(x)


@scan.register_fake
def _(*arguments):
    x = Scan.of(*arguments)
    u, A, C = x.inputs.u, x.inputs.A, x.inputs.C
    out = laid_as(u, u.new_empty)
    last = A.new_empty(x.sequences, *A.shape)
    saved = A.new_empty(_implementation(u).saved_shape(x))
    return out if C is not None else out.new_empty(u.shape[0], 0, u.shape[2]), last, saved


@torch.library.custom_op(
    "gamba_warp::selective_scan_backward",
    mutates_args=(),
    schema=f"(Tensor? dout, Tensor? dlast, Tensor saved, bool[] needs, {_SCAN}) -> Tensor[]",
)
def _scan_backward(dout, dlast, saved, needs, *arguments) -> list[Tensor]:
    x = Scan.of(*arguments)
    backward = _implementation(x.inputs.u).backward
    return [g for g in backward(dout, dlast, x, saved, Inputs(*needs)) if g is not None]


@_scan_backward.register_fake
def _(dout, dlast, saved, needs, *arguments):
    x = Scan.of(*arguments)
    A = x.inputs.A
    likes = x.inputs._replace(initial_state=A.new_empty(x.sequences, *A.shape))

    def fake(name: str, like: Tensor) -> Tensor:
        if name in ("u", "delta", "z"):
            return laid_as(like, like.new_empty)
        dense = torch.preserve_format if name in ("B", "C") else torch.contiguous_format
        return torch.empty_like(like, memory_format=dense)

    each = zip(Inputs._fields, likes, needs)
    return [fake(name, x) for name, x, needed in each if needed and x is not None]


def _setup_context(ctx, inputs, output):
    x = Scan.of(*inputs)
    _, _, saved = output
    ctx.mark_non_differentiable(saved)
    ctx.set_materialize_grads(False)
    # a gradient does not read the first state
    ctx.save_for_backward(*x.inputs._replace(initial_state=None), x.options.packed, saved)
    ctx.options = x.options._replace(packed=None)


def _gradient(ctx, dout, dlast, _):
    *tensors, packed, saved = ctx.saved_tensors
    x = Scan(Inputs(*tensors), ctx.options._replace(packed=packed))
    if not x.options.save:
        raise RuntimeError("selective_scan: this call saved nothing for the backward pass")
    needs = Inputs(*ctx.needs_input_grad[: len(Inputs._fields)])
    if x.inputs.C is None:
        dout = None
    elif dout is None:
        dout = x.inputs.u.new_zeros(1, 1, x.inputs.u.shape[2]).expand_as(x.inputs.u)
    grads = iter(_scan_backward(dout, dlast, saved, [*needs], *x.inputs, *x.options))
    return *(next(grads) if needed else None for needed in needs), *[None] * len(Options._fields)


def _no_second_gradient(ctx, *grads):
    raise RuntimeError("selective_scan: second derivatives are not supported")


scan = operator(scan, "selective_scan", _setup_context, _gradient)
_scan_backward.register_autograd(_no_second_gradient)
_scan_backward = operator(_scan_backward, "selective_scan")
