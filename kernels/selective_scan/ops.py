"""The scan as torch operators: fake results, gradients, and a kernel by device."""

from typing import List

import torch
from torch import Tensor

from ..runtime.start import without_compiler
from .cpu import launch as cpu
from .cpu import tuning as cpu_tuning
from .cuda import tuning as cuda_tuning


def _implementation(tensor: Tensor):
    if tensor.device.type == "cpu":
        return cpu
    from .cuda import launch as cuda

    return cuda


def tuning_now(tensor: Tensor) -> list[int]:
    """The tuning that ``use_tuning`` asks for on the tensor's device, as the operators take it.

    It is read once, when a scan begins, and goes with the saved tensors to the gradient. It is
    empty where the operators choose by the shape alone, which is the same in both directions.
    """
    tuning = (cpu_tuning if tensor.device.type == "cpu" else cuda_tuning).current()
    return [] if tuning is None else tuning.numbers()


def _wanted(like: tuple, needs: list[bool]) -> list[Tensor]:
    return [
        torch.empty_like(x, memory_format=torch.contiguous_format)
        for x, needed in zip(like, needs)
        if needed
    ]


def _placed(grads: list[Tensor], needs: list[bool]) -> tuple[Tensor | None, ...]:
    found = iter(grads)
    return tuple(next(found) if needed else None for needed in needs)


def _need_saved(ctx) -> None:
    if not ctx.saved:
        raise RuntimeError("selective_scan: this call kept nothing for a gradient")


@without_compiler
@torch.library.custom_op("gamba_warp::selective_scan", mutates_args=())
def scan(
    u: Tensor,
    delta: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor | None,
    z: Tensor | None,
    delta_bias: Tensor | None,
    initial_state: Tensor | None,
    softplus: bool,
    discretization: str,
    save: bool,
    tuning: List[int],
) -> tuple[Tensor, Tensor, Tensor]:
    """``(out, last state, saved states)`` of checked tensors; B and C are ``[B, L, G, N]``.

    ``tuning`` is that of ``tuning_now``.
    """
    run = _implementation(u).forward
    return run(
        u, delta, A, B, C, D, z, delta_bias, initial_state, softplus, discretization, save, tuning
    )


@scan.register_fake
def _(u, delta, A, B, C, D, z, delta_bias, initial_state, softplus, discretization, save, tuning):
    out = torch.empty_like(u, memory_format=torch.contiguous_format)
    last = A.new_empty(u.shape[0], *A.shape)
    return out, last, A.new_empty(_implementation(u).saved_shape(u, A, B, save, tuning))


@without_compiler
@torch.library.custom_op("gamba_warp::selective_scan_backward", mutates_args=())
def _scan_backward(
    dout: Tensor,
    dlast: Tensor | None,
    u: Tensor,
    delta: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor | None,
    z: Tensor | None,
    delta_bias: Tensor | None,
    saved: Tensor,
    softplus: bool,
    discretization: str,
    needs: List[bool],
    tuning: List[int],
) -> List[Tensor]:
    run = _implementation(u).backward
    grads = run(
        dout, dlast, u, delta, A, B, C, D, z, delta_bias, saved, softplus, discretization, needs,
        tuning,
    )  # fmt: skip
    return [grad for grad in grads if grad is not None]


@_scan_backward.register_fake
def _(
    dout, dlast, u, delta, A, B, C, D, z, delta_bias, saved, softplus, discretization, needs, tuning
):
    state = A.new_empty(u.shape[0], *A.shape)
    return _wanted((u, delta, A, B, C, D, z, delta_bias, state), needs)


def _setup_context(ctx, inputs, output):
    u, delta, A, B, C, D, z, delta_bias, _, softplus, discretization, save, tuning = inputs
    _, _, saved = output
    ctx.mark_non_differentiable(saved)
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(u, delta, A, B, C, D, z, delta_bias, saved)
    ctx.softplus, ctx.discretization, ctx.saved, ctx.tuning = softplus, discretization, save, tuning


def _gradient(ctx, dout, dlast, _):
    _need_saved(ctx)
    u, delta, A, B, C, D, z, delta_bias, saved = ctx.saved_tensors
    needs = list(ctx.needs_input_grad[:9])
    if dout is None:
        dout = u.new_zeros(1, 1, u.shape[2]).expand_as(u)
    grads = _scan_backward(
        dout, dlast, u, delta, A, B, C, D, z, delta_bias, saved,
        ctx.softplus, ctx.discretization, needs, ctx.tuning,
    )  # fmt: skip
    return (*_placed(grads, needs), None, None, None, None)


def _no_second_gradient(ctx, *grads):
    raise RuntimeError("selective_scan: second derivatives are not supported")


scan.register_autograd(_gradient, setup_context=_setup_context)
_scan_backward.register_autograd(_no_second_gradient)


@without_compiler
@torch.library.custom_op("gamba_warp::selective_scan_state", mutates_args=())
def state(
    u: Tensor,
    delta: Tensor,
    A: Tensor,
    B: Tensor,
    delta_bias: Tensor | None,
    initial_state: Tensor | None,
    softplus: bool,
    discretization: str,
    save: bool,
    tuning: List[int],
) -> tuple[Tensor, Tensor]:
    """``(last state, saved states)`` of checked tensors; B is ``[B, L, G, N]``."""
    run = _implementation(u).final_state
    return run(u, delta, A, B, delta_bias, initial_state, softplus, discretization, save, tuning)


@state.register_fake
def _(u, delta, A, B, delta_bias, initial_state, softplus, discretization, save, tuning):
    saved = _implementation(u).saved_shape(u, A, B, save, tuning)
    return A.new_empty(u.shape[0], *A.shape), A.new_empty(saved)


@without_compiler
@torch.library.custom_op("gamba_warp::selective_scan_state_backward", mutates_args=())
def _state_backward(
    dlast: Tensor,
    u: Tensor,
    delta: Tensor,
    A: Tensor,
    B: Tensor,
    delta_bias: Tensor | None,
    saved: Tensor,
    softplus: bool,
    discretization: str,
    needs: List[bool],
    tuning: List[int],
) -> List[Tensor]:
    run = _implementation(u).final_state_backward
    grads = run(dlast, u, delta, A, B, delta_bias, saved, softplus, discretization, needs, tuning)
    return [grad for grad in grads if grad is not None]


@_state_backward.register_fake
def _(dlast, u, delta, A, B, delta_bias, saved, softplus, discretization, needs, tuning):
    return _wanted((u, delta, A, B, delta_bias, dlast), needs)


def _state_setup_context(ctx, inputs, output):
    u, delta, A, B, delta_bias, _, softplus, discretization, save, tuning = inputs
    _, saved = output
    ctx.mark_non_differentiable(saved)
    ctx.save_for_backward(u, delta, A, B, delta_bias, saved)
    ctx.softplus, ctx.discretization, ctx.saved, ctx.tuning = softplus, discretization, save, tuning


def _state_gradient(ctx, dlast, _):
    _need_saved(ctx)
    needs = list(ctx.needs_input_grad[:6])
    grads = _state_backward(
        dlast, *ctx.saved_tensors, ctx.softplus, ctx.discretization, needs, ctx.tuning
    )
    return (*_placed(grads, needs), None, None, None, None)


state.register_autograd(_state_gradient, setup_context=_state_setup_context)
_state_backward.register_autograd(_no_second_gradient)
