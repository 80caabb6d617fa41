"""The scan, and all of a Mamba block behind its first projection, in mamba-ssm's layout."""

from __future__ import annotations

from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from ....kernels.causal_conv1d import causal_conv1d_fn
from ....kernels.selective_scan import selective_scan_fn

__all__ = ["mamba_inner_fn", "mamba_inner_ref", "selective_scan_fn", "selective_scan_ref"]


def selective_scan_ref(
    u: Tensor,
    delta: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor | None = None,
    z: Tensor | None = None,
    delta_bias: Tensor | None = None,
    delta_softplus: bool = False,
    return_last_state: bool = False,
) -> Tensor | tuple[Tensor, Tensor]:
    """The scan as a loop over tokens in float32 torch, to compare with.

    Args:
        u: ``[B, D, L]``, any real float dtype, as ``selective_scan_fn``; likewise the others.
        delta: a step for each token and channel.
        A: ``[D, N]``.
        B: (D, N) constant, (B, N, L), or (B, G, N, L).
        C: as B, on its own.
        D: ``[D]``, or None.
        z: as u, or None.
        delta_bias: ``[D]``, or None.
        delta_softplus: whether softplus is applied to delta.
        return_last_state: also return ``[B, D, N]`` float32.

    Returns:
        ``[B, D, L]`` in u's dtype.

    Raises:
        TypeError: A, B or C is complex.
    """
    B, C = _per_channel(B, u, "B"), _per_channel(C, u, "C")
    if A.is_complex():
        raise TypeError(f"A has dtype {A.dtype}; complex states are not supported")
    inputs, steps, rates = u.float(), delta.float(), A.float()
    if delta_bias is not None:
        steps = steps + delta_bias.float()[:, None]
    if delta_softplus:
        steps = F.softplus(steps)
    h = inputs.new_zeros(*u.shape[:2], A.shape[1])
    rows = []
    tokens = (inputs.unbind(2), steps.unbind(2), B.unbind(2), C.unbind(2))
    for u_t, delta_t, B_t, C_t in zip(*tokens):
        h = torch.exp(delta_t[..., None] * rates) * h + (delta_t * u_t)[..., None] * B_t
        rows.append((h * C_t).sum(-1))
    out = torch.stack(rows, 2) if rows else torch.zeros_like(inputs)
    if D is not None:
        out = out + D.float()[:, None] * inputs
    if z is not None:
        out = out * F.silu(z.float())
    out = out.to(u.dtype)
    return (out, h) if return_last_state else out


def _per_channel(matrix: Tensor, u: Tensor, name: str) -> Tensor:
    """Brings (D, N), (B, N, L) or (B, G, N, L) to ``[B or 1, D or 1, L, N]`` in float32."""
    if matrix.is_complex():
        raise TypeError(f"{name} has dtype {matrix.dtype}; complex states are not supported")
    matrix = matrix.float()
    if matrix.dim() == 2:
        return matrix[None, :, None].expand(-1, -1, u.shape[2], -1)
    if matrix.dim() == 3:
        return matrix.transpose(1, 2)[:, None]
    return matrix.transpose(2, 3).repeat_interleave(u.shape[1] // matrix.shape[1], dim=1)


def _normalized(x: Tensor, weight: Tensor | None, eps: float) -> Tensor:
    """RMS norm over the last axis, in float32; x itself without a weight."""
    if weight is None:
        return x
    return F.rms_norm(x.float(), x.shape[-1:], weight.float(), eps).to(x.dtype)


def _matrix(
    low: Tensor, rows: slice, bias: Tensor | None, weight: Tensor | None, eps: float
) -> Tensor:
    """B or C of all tokens, ``[B, N, L]``, from its part of the small projection."""
    matrix = low[..., rows]
    if bias is not None:
        matrix = matrix + bias.to(matrix.dtype)
    return _normalized(matrix, weight, eps).transpose(1, 2)


def _check_inner(conv1d_weight, x_proj_weight, rank, A, given, level) -> None:
    if A.is_complex():
        raise TypeError(f"A has dtype {A.dtype}; complex states are not supported")
    if conv1d_weight.dim() != 3 or conv1d_weight.shape[1] != 1:
        raise ValueError(f"conv1d_weight has shape {tuple(conv1d_weight.shape)}, must be (D, 1, W)")
    for name, (value, others) in given.items():
        for other, unused in others.items():
            if value is not None and unused is not None:
                raise ValueError(f"{other} is given; it has no use beside a constant {name}")
    rows = rank + A.shape[1] * sum(value is None for value, _ in given.values())
    if x_proj_weight.shape[0] != rows:
        raise ValueError(f"x_proj_weight has {x_proj_weight.shape[0]} rows, must have {rows}")
    if level not in (0, 1):
        raise ValueError(f"checkpoint_lvl is {level!r}, allowed: (0, 1)")


def mamba_inner_fn(
    xz: Tensor,
    conv1d_weight: Tensor,
    conv1d_bias: Tensor | None,
    x_proj_weight: Tensor,
    delta_proj_weight: Tensor,
    out_proj_weight: Tensor,
    out_proj_bias: Tensor | None,
    A: Tensor,
    B: Tensor | None = None,
    C: Tensor | None = None,
    D: Tensor | None = None,
    delta_bias: Tensor | None = None,
    B_proj_bias: Tensor | None = None,
    C_proj_bias: Tensor | None = None,
    delta_softplus: bool = True,
    checkpoint_lvl: int = 1,
    b_rms_weight: Tensor | None = None,
    c_rms_weight: Tensor | None = None,
    dt_rms_weight: Tensor | None = None,
    b_c_dt_rms_eps: float = 1e-6,
) -> Tensor:
    """A Mamba block behind its first projection: convolution, small projections, scan, output.

    Args:
        xz: ``[B, 2 D, L]``, the first half goes through the convolution, the second is the gate.
        conv1d_weight: ``[D, 1, W]``, W from 2 to 4.
        conv1d_bias: ``[D]``, or None.
        x_proj_weight: ``[R + N + N, D]``: rows for the step, B and C; none for a given B or C.
        delta_proj_weight: ``[D, R]``.
        out_proj_weight: ``[M, D]``.
        out_proj_bias: ``[M]``, or None.
        A: ``[D, N]`` float32, real.
        B: ``[D, N]`` constant, or None: from the tokens.
        C: as B.
        D: ``[D]``, or None for 0.
        delta_bias: ``[D]``, or None for 0.
        B_proj_bias: ``[N]``, added to a B from the tokens, or None.
        C_proj_bias: as B_proj_bias.
        delta_softplus: whether the step is a softplus.
        checkpoint_lvl: 0 or 1; both keep the same for the gradient.
        b_rms_weight: ``[N]``, of an RMS norm of a B from the tokens, or None for no norm.
        c_rms_weight: as b_rms_weight.
        dt_rms_weight: ``[D]``, of an RMS norm of the step before its bias, or None.
        b_c_dt_rms_eps: added to the mean squares of these norms.

    Returns:
        ``[B, L, M]``.

    Raises:
        TypeError: as ``selective_scan_fn``, also for complex A.
        ValueError: as ``selective_scan_fn``; also for rows of x_proj_weight that fit no B and C,
            and for a bias or norm of a B or C that is given.
    """
    rank, states = delta_proj_weight.shape[1], A.shape[1]
    given = {
        "B": (B, {"B_proj_bias": B_proj_bias, "b_rms_weight": b_rms_weight}),
        "C": (C, {"C_proj_bias": C_proj_bias, "c_rms_weight": c_rms_weight}),
    }
    _check_inner(conv1d_weight, x_proj_weight, rank, A, given, checkpoint_lvl)
    x, z = xz.chunk(2, dim=1)
    x = causal_conv1d_fn(x, conv1d_weight[:, 0], conv1d_bias, activation="silu")
    assert isinstance(x, Tensor)
    low = F.linear(x.transpose(1, 2), x_proj_weight)
    delta = F.linear(low[..., :rank], delta_proj_weight)
    delta = _normalized(delta, dt_rms_weight, b_c_dt_rms_eps).transpose(1, 2)
    matrix = partial(_matrix, low, eps=b_c_dt_rms_eps)
    if B is None:
        B = matrix(slice(rank, rank + states), B_proj_bias, b_rms_weight)
    if C is None:
        C = matrix(slice(low.shape[-1] - states, None), C_proj_bias, c_rms_weight)
    y = selective_scan_fn(x, delta, A, B, C, D, z, delta_bias, delta_softplus)
    assert isinstance(y, Tensor)
    return F.linear(y.transpose(1, 2), out_proj_weight, out_proj_bias)


def mamba_inner_ref(
    xz: Tensor,
    conv1d_weight: Tensor,
    conv1d_bias: Tensor | None,
    x_proj_weight: Tensor,
    delta_proj_weight: Tensor,
    out_proj_weight: Tensor,
    out_proj_bias: Tensor | None,
    A: Tensor,
    B: Tensor | None = None,
    C: Tensor | None = None,
    D: Tensor | None = None,
    delta_bias: Tensor | None = None,
    B_proj_bias: Tensor | None = None,
    C_proj_bias: Tensor | None = None,
    delta_softplus: bool = True,
) -> Tensor:
    """The same, without norms: mamba-ssm's own reference runs over its two kernels as well.

    To check the kernels, compare ``selective_scan_fn`` with ``selective_scan_ref``.

    Args:
        xz: as ``mamba_inner_fn``; likewise the others.
        conv1d_weight: taps.
        conv1d_bias: added to the convolution.
        x_proj_weight: the small projection.
        delta_proj_weight: the step's projection.
        out_proj_weight: the last projection.
        out_proj_bias: its bias.
        A: rates of decay.
        B: a constant input matrix.
        C: a constant output matrix.
        D: the way past the state.
        delta_bias: added to the step.
        B_proj_bias: added to B.
        C_proj_bias: added to C.
        delta_softplus: whether the step is a softplus.

    Returns:
        ``[B, L, M]``.
    """
    return mamba_inner_fn(**locals())
