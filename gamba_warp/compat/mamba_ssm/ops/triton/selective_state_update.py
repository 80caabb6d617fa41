"""One step of the selective scan, with an update of the state in place."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from ....shared import DTYPES, INDEX_DTYPES, check_tensor, of_rows


def selective_state_update(
    state: Tensor, x: Tensor, dt: Tensor, A: Tensor, B: Tensor, C: Tensor, D: Tensor | None = None,
    z: Tensor | None = None, dt_bias: Tensor | None = None, dt_softplus: bool = False,
    state_batch_indices: Tensor | None = None,
) -> Tensor:  # fmt: skip
    """Advance the state by one token, in place, and return that token's output.

    Computed in float32 for all dtypes; only the stored ``state`` is rounded. No gradient flows
    through it. Tensors are float32, bfloat16 or float16, independently.

    Args:
        state: ``[B, D, N]``, or with heads ``[B, H, D, N]``; with ``state_batch_indices`` its first
            axis is the rows that they choose from.
        x: ``[B, D]`` or ``[B, H, D]``, the token.
        dt: as x, its step, before the bias and the softplus.
        A: ``[D, N]`` or ``[H, D, N]``, real.
        B: ``[B, N]``, or with heads also ``[B, G, N]``: group h // (H / G) serves head h.
        C: as B.
        D: ``[D]`` or ``[H, D]``, or None for 0.
        z: as x, or None for no gate.
        dt_bias: as D, or None for 0.
        dt_softplus: apply softplus to the step.
        state_batch_indices: ``[B]`` int32 or int64, the state's row for each element of the batch;
            for negative ones the output is 0 and no state changes. They must not repeat.

    Returns:
        The shape and dtype of x.

    Raises:
        TypeError: an argument is not a tensor or has another dtype (complex and float64 too).
        ValueError: a shape is not one of the above.
    """
    check_tensor("state", state, ("B", "D", "N"), ("B", "H", "D", "N"), dtypes=DTYPES)
    rows, *heads, channels, states = state.shape
    parameter = (*heads, channels)
    check_tensor("x", x, (rows if state_batch_indices is None else "B", *parameter), dtypes=DTYPES)
    batch = x.shape[0]
    token = (batch, *parameter)
    groups = [g for g in range(1, heads[0] + 1) if heads[0] % g == 0] if heads else [1]
    matrix = ((batch, states), *((batch, g, states) for g in groups))
    needed = {
        "dt": (dt, token), "A": (A, (*parameter, states)), "B": (B, *matrix), "C": (C, *matrix)
    }  # fmt: skip
    optional = {"D": (D, parameter), "z": (z, token), "dt_bias": (dt_bias, parameter)}
    for name, (value, *shapes) in (needed | optional).items():
        check_tensor(name, value, *shapes, dtypes=DTYPES, optional=name in optional)
    indices = state_batch_indices
    check_tensor("state_batch_indices", indices, (batch,), dtypes=INDEX_DTYPES, optional=True)

    def update(state: Tensor) -> Tensor:
        return selective_state_update_ref(state, x, dt, A, B, C, D, z, dt_bias, dt_softplus)

    return of_rows(update, state, indices)


def selective_state_update_ref(
    state: Tensor, x: Tensor, dt: Tensor, A: Tensor, B: Tensor, C: Tensor, D: Tensor | None = None,
    z: Tensor | None = None, dt_bias: Tensor | None = None, dt_softplus: bool = False,
) -> Tensor:  # fmt: skip
    """Compute the same in plain torch, as a reference; in float64 if x is, else float32."""
    dtype = torch.promote_types(x.dtype, torch.float32)
    token = (x.shape[0], state.shape[1] if state.dim() == 4 else 1, x.shape[-1])

    def per_head(matrix: Tensor) -> Tensor:
        matrix = matrix.to(dtype).view(token[0], -1, 1, matrix.shape[-1])
        repeats = token[1] // matrix.shape[1]
        return matrix if repeats == 1 else matrix.repeat_interleave(repeats, dim=1)

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
