"""One step of the selective scan, which updates the state in place."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from .....kernels.selective_scan.cpu.step import scan_step
from ....states import (
    check_dtype,
    check_indices,
    check_tensors,
    put_rows,
    take_rows,
    without_gradient,
)


@without_gradient
def selective_state_update(
    state: Tensor,
    x: Tensor,
    dt: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor | None = None,
    z: Tensor | None = None,
    dt_bias: Tensor | None = None,
    dt_softplus: bool = False,
    state_batch_indices: Tensor | None = None,
) -> Tensor:
    """Takes the state one token further, in place, and gives that token's output.

    Float32 inside whatever the dtypes, so only what is stored in ``state`` is rounded. No gradient
    flows through it. All tensors are float32, bfloat16 or float16, each on its own.

    Args:
        state: ``[B, D, N]``, or with heads ``[B, H, D, N]``; with ``state_batch_indices`` its first
            axis is the rows that they choose from.
        x: ``[B, D]`` or ``[B, H, D]``, the token.
        dt: as x, its step, before the bias and the softplus.
        A: ``[D, N]`` or ``[H, D, N]``, real.
        B: ``[B, N]``, or with heads also ``[B, G, N]``: group h // (H / G) serves head h.
        C: as B, the same G.
        D: ``[D]`` or ``[H, D]``, or None for 0.
        z: as x, or None for no gate.
        dt_bias: as D, or None for 0.
        dt_softplus: whether the step is a softplus.
        state_batch_indices: ``[B]`` int32 or int64, the state's row for each element of the batch;
            below 0 the output is 0 and no state is touched. They may not repeat.

    Returns:
        The shape and dtype of x.

    Raises:
        TypeError: an argument is not a tensor or has another dtype (complex and float64 too).
        ValueError: a shape is not one of the above.
    """
    if state_batch_indices is None:
        done = scan_step(state, x, dt, A, B, C, D, z, dt_bias, dt_softplus)
        if done is not None:  # None, and nothing done, also where an argument is wrong
            return done
    B, C = _matrix(B, state), _matrix(C, state)
    groups = _check(state, x, dt, A, B, C, D, z, dt_bias, state_batch_indices)
    rows = state if state_batch_indices is None else take_rows(state, state_batch_indices)
    work = rows.float()
    if groups is None:
        out = _step(work, x, dt, A, B, C, D, z, dt_bias, dt_softplus)
    else:
        heads = [None if v is None else v.unflatten(0, (groups, -1)) for v in (A, D, dt_bias)]
        tokens = [None if v is None else v.unflatten(1, (groups, -1)) for v in (work, x, dt, z)]
        (rates, straight, bias), (grouped, inputs, steps, gates) = heads, tokens
        matrices = B[:, :, None], C[:, :, None]
        out = _step(
            grouped, inputs, steps, rates, *matrices, straight, gates, bias, dt_softplus
        ).flatten(1, 2)
    if state_batch_indices is not None:
        out = put_rows(state, state_batch_indices, work, out)
    elif work is not state:
        state.copy_(work)
    return out.to(x.dtype)


def _matrix(matrix: Tensor, state: Tensor) -> Tensor:
    """Brings B or C to ``[B, G, N]`` if the state has heads, else to ``[B, N]``, if it can."""
    if isinstance(matrix, Tensor) and isinstance(state, Tensor):
        if state.dim() == 4 and matrix.dim() == 2:
            return matrix[:, None]
        if state.dim() == 3 and matrix.dim() == 3 and matrix.shape[1] == 1:
            return matrix[:, 0]
    return matrix


def _step(state, x, dt, A, B, C, D, z, dt_bias, softplus: bool) -> Tensor:
    """The step of a float32 state ``[.., D, N]``; B and C ``[.., N]`` fit its other axes."""
    x, dt = x.float(), dt.float()
    if dt_bias is not None:
        dt = dt + dt_bias
    if softplus:
        dt = F.softplus(dt)
    state *= torch.mul(dt[..., None], A).exp_()
    state.addcmul_((dt * x)[..., None], B[..., None, :].float())
    product = torch.bmm if state.dim() == 3 else torch.matmul  # the same, bmm in half the time
    out = state.new_empty(*state.shape[:-1], 1)  # autocast rounds no operands of ``out=``
    out = product(state, C[..., None].float(), out=out).squeeze(-1)
    if D is not None:
        out.addcmul_(x, D.float())
    return out if z is None else out.mul_(F.silu(z.float()))


def _check(state, x, dt, A, B, C, D, z, dt_bias, indices) -> int | None:
    """Checks the arguments; returns the number of groups, or None where there are no heads."""
    check_dtype("state", state)
    check_dtype("x", x)
    if state.dim() not in (3, 4):
        shape = tuple(state.shape)
        raise ValueError(f"state has shape {shape}, must be [B, D, N] or [B, H, D, N]")
    heads, (channels, states) = state.shape[1:-2], state.shape[-2:]
    batch = state.shape[0]
    if indices is not None:
        batch = x.shape[0] if x.dim() else 0
        check_indices("state_batch_indices", indices, batch)
    groups = B.shape[1:-1] if isinstance(B, Tensor) and heads and B.dim() == 3 else ()
    if heads and (not groups or not groups[0] or heads[0] % groups[0]):
        shape = tuple(B.shape) if isinstance(B, Tensor) else type(B).__name__
        raise ValueError(
            f"B has shape {shape}, must be [{batch}, G, {states}] with G a divisor of {heads[0]}"
        )
    token, parameter = (batch, *heads, channels), (*heads, channels)
    matrix = (batch, *groups, states)
    check_tensors(
        {
            "x": (x, token),
            "dt": (dt, token),
            "A": (A, (*parameter, states)),
            "B": (B, matrix),
            "C": (C, matrix),
            "D": (D, parameter),
            "z": (z, token),
            "dt_bias": (dt_bias, parameter),
        }
    )
    for name, value in {"dt": dt, "A": A, "B": B, "C": C}.items():
        check_dtype(name, value)  # None is none of them
    return groups[0] if groups else None


def selective_state_update_ref(
    state: Tensor,
    x: Tensor,
    dt: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor | None = None,
    z: Tensor | None = None,
    dt_bias: Tensor | None = None,
    dt_softplus: bool = False,
) -> Tensor:
    """The same as a plain sum in torch, to compare with; in float64 if x is, else in float32.

    Args:
        state: as ``selective_state_update``, updated in place; likewise the others.
        x: the token.
        dt: its step.
        A: rates of decay.
        B: input matrix.
        C: output matrix.
        D: the way past the state.
        z: the gate.
        dt_bias: added to dt.
        dt_softplus: whether the step is a softplus.

    Returns:
        The shape and dtype of x.
    """
    dtype = torch.promote_types(x.dtype, torch.float32)
    token = (x.shape[0], state.shape[1] if state.dim() == 4 else 1, x.shape[-1])

    def per_head(matrix: Tensor) -> Tensor:
        matrix = matrix.to(dtype).view(token[0], -1, 1, matrix.shape[-1])
        return matrix.repeat_interleave(token[1] // matrix.shape[1], dim=1)

    delta, u = dt.to(dtype).reshape(token), x.to(dtype).reshape(token)
    if dt_bias is not None:
        delta = delta + dt_bias.to(dtype).reshape(token[1:])
    if dt_softplus:
        delta = F.softplus(delta)
    delta, u = delta[..., None], u[..., None]
    before = state.to(dtype).reshape(*token, -1)
    rates = A.to(dtype).reshape(*token[1:], -1)
    after = torch.exp(delta * rates) * before + delta * per_head(B) * u
    state.copy_(after.reshape(state.shape))
    out = (after * per_head(C)).sum(-1)
    if D is not None:
        out = out + D.to(dtype).reshape(token[1:]) * u[..., 0]
    if z is not None:
        out = out * F.silu(z.to(dtype).reshape(token))
    return out.reshape(x.shape).to(x.dtype)
