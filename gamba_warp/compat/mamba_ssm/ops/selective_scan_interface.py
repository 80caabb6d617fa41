"""Selective scan, and a Mamba block after its first projection, in mamba-ssm's layout."""

from __future__ import annotations

from typing import Any, cast

import torch.nn.functional as F
from torch import Tensor

from ....kernels.causal_conv1d import causal_conv1d_fn
from ....kernels.selective_scan import selective_scan_fn as selective_scan_fn
from ....kernels.selective_scan.api import input_matrix
from ....kernels.selective_scan.reference import selective_scan_reference
from ...shared import check_tensor, one_of


def selective_scan_ref(
    u: Tensor, delta: Tensor, A: Tensor, B: Tensor, C: Tensor, D: Tensor | None = None,
    z: Tensor | None = None, delta_bias: Tensor | None = None, delta_softplus: bool = False,
    return_last_state: bool = False,
) -> Tensor | tuple[Tensor, Tensor]:  # fmt: skip
    """Compute ``selective_scan_fn`` by a loop over tokens in float32 torch, as a reference.

    The arguments and results are the same, in any real float dtype; complex A, B or C is a
    ``TypeError``.
    """
    if A.is_complex():
        raise TypeError(f"A has dtype {A.dtype}; complex states are not supported")
    B, C = (input_matrix(x, u, name).float() for x, name in ((B, "B"), (C, "C")))
    D, delta_bias = (None if x is None else x.float() for x in (D, delta_bias))
    z = None if z is None else z.mT.float()
    arguments = u.mT.float(), delta.mT.float(), A.float(), B, C, D, z, delta_bias
    out, last = selective_scan_reference(*arguments, delta_softplus=delta_softplus)
    out = out.mT.to(u.dtype)
    return (out, last) if return_last_state else out


def mamba_inner_fn_no_out_proj(
    xz: Tensor, conv1d_weight: Tensor, conv1d_bias: Tensor | None, x_proj_weight: Tensor,
    delta_proj_weight: Tensor, A: Tensor, B: Tensor | None = None, C: Tensor | None = None,
    D: Tensor | None = None, delta_bias: Tensor | None = None, B_proj_bias: Tensor | None = None,
    C_proj_bias: Tensor | None = None, delta_softplus: bool = True, checkpoint_lvl: int = 1,
    b_rms_weight: Tensor | None = None, c_rms_weight: Tensor | None = None,
    dt_rms_weight: Tensor | None = None, b_c_dt_rms_eps: float = 1e-6, *, A_b: Tensor | None = None,
) -> Tensor:  # fmt: skip
    """Run a Mamba block between its first and its last projection, as the forks Vim and SegMamba.

    Args:
        xz: ``[B, 2 D, L]``: the input of the convolution, then the gate.
        conv1d_weight: ``[D, 1, W]``, W from 2 to 4; ``conv1d_bias`` is ``[D]``, or None.
        x_proj_weight: ``[R + N + N, D]``: rows for the step, B and C; none for a given B or C.
        delta_proj_weight: ``[D, R]``; D and ``delta_bias`` are ``[D]``, or None for 0.
        A: ``[D, N]`` float32, real. ``A_b`` belongs to a second scan, added, from the last token
            to the first, or None.
        B: ``[D, N]`` constant, or None: from the tokens, with ``B_proj_bias [N]`` added and an RMS
            norm with ``b_rms_weight [N]``, where these are given. C is as B; ``dt_rms_weight [D]``
            is that of the step before its bias.
        checkpoint_lvl: 0 or 1; without effect.

    Returns:
        ``[B, D, L]``.

    Raises:
        TypeError: as ``selective_scan_fn``, also for complex A.
        ValueError: as ``selective_scan_fn``; also for rows of x_proj_weight that fit no B and C,
            and for a bias or norm of a B or C that is given.
    """
    one_of("checkpoint_lvl", checkpoint_lvl, 0, 1)
    rank, states = delta_proj_weight.shape[1], A.shape[1]
    check_tensor("conv1d_weight", conv1d_weight, ("D", 1, "W"))
    unused = {} if B is None else {"B_proj_bias": B_proj_bias, "b_rms_weight": b_rms_weight}
    if C is not None:
        unused |= {"C_proj_bias": C_proj_bias, "c_rms_weight": c_rms_weight}
    for name, value in unused.items():
        if value is not None:
            raise ValueError(f"{name} is given, must be None with a constant {name[0].upper()}")
    rows = rank + states * ((B is None) + (C is None))
    if x_proj_weight.shape[0] != rows:
        raise ValueError(f"x_proj_weight has {x_proj_weight.shape[0]} rows, must have {rows}")

    def normalized(x: Tensor, bias: Tensor | None, weight: Tensor | None) -> Tensor:
        """Return a part of the small projection as ``[B, .., L]``, after its bias and RMS norm."""
        if bias is not None:
            x = x + bias.to(x.dtype)
        if weight is not None:
            x = F.rms_norm(x.float(), x.shape[-1:], weight.float(), b_c_dt_rms_eps).to(x.dtype)
        return x.transpose(1, 2)

    x, z = xz.chunk(2, dim=1)
    x = cast(Tensor, causal_conv1d_fn(x, conv1d_weight[:, 0], conv1d_bias, activation="silu"))
    low = F.linear(x.transpose(1, 2), x_proj_weight)
    delta = normalized(F.linear(low[..., :rank], delta_proj_weight), None, dt_rms_weight)
    if B is None:
        B = normalized(low[..., rank : rank + states], B_proj_bias, b_rms_weight)
    if C is None:
        C = normalized(low[..., -states:], C_proj_bias, c_rms_weight)
    y = cast(Tensor, selective_scan_fn(x, delta, A, B, C, D, z, delta_bias, delta_softplus))
    if A_b is not None:
        x, delta, z = (part.flip(-1) for part in (x, delta, z))
        B, C = (part if part.dim() == 2 else part.flip(-1) for part in (B, C))
        back = selective_scan_fn(x, delta, A_b, B, C, D, z, delta_bias, delta_softplus)
        y = y + cast(Tensor, back).flip(-1)
    return y


def mamba_inner_fn(
    xz: Tensor, conv1d_weight: Tensor, conv1d_bias: Tensor | None, x_proj_weight: Tensor,
    delta_proj_weight: Tensor, out_proj_weight: Tensor, out_proj_bias: Tensor | None, A: Tensor,
    B: Tensor | None = None, C: Tensor | None = None, D: Tensor | None = None,
    delta_bias: Tensor | None = None, B_proj_bias: Tensor | None = None,
    C_proj_bias: Tensor | None = None, delta_softplus: bool = True, checkpoint_lvl: int = 1,
    b_rms_weight: Tensor | None = None, c_rms_weight: Tensor | None = None,
    dt_rms_weight: Tensor | None = None, b_c_dt_rms_eps: float = 1e-6, *, A_b: Tensor | None = None,
) -> Tensor:  # fmt: skip
    """Run a Mamba block after its first projection: convolution, small projections, scan, output.

    The arguments are as in ``mamba_inner_fn_no_out_proj``, with a last projection
    ``out_proj_weight [M, D]`` and ``out_proj_bias [M]`` or None. Returns ``[B, L, M]``.
    """
    weights = conv1d_weight, conv1d_bias, x_proj_weight, delta_proj_weight
    rest = B_proj_bias, C_proj_bias, delta_softplus, checkpoint_lvl
    norms = b_rms_weight, c_rms_weight, dt_rms_weight, b_c_dt_rms_eps
    arguments = xz, *weights, A, B, C, D, delta_bias, *rest, *norms
    y = mamba_inner_fn_no_out_proj(*arguments, A_b=A_b)
    return F.linear(y.transpose(1, 2), out_proj_weight, out_proj_bias)


def bimamba_inner_fn(
    xz: Tensor, conv1d_weight: Tensor, conv1d_bias: Tensor | None, x_proj_weight: Tensor,
    delta_proj_weight: Tensor, out_proj_weight: Tensor, out_proj_bias: Tensor | None, A: Tensor,
    A_b: Tensor, *args: Any, **options: Any,
) -> Tensor:  # fmt: skip
    """Add a scan from the last token to the first, with ``A_b``, to ``mamba_inner_fn``."""
    arguments = xz, conv1d_weight, conv1d_bias, x_proj_weight, delta_proj_weight
    of_output = out_proj_weight, out_proj_bias
    return mamba_inner_fn(*arguments, *of_output, A, *args, A_b=A_b, **options)


# mamba-ssm's references run on its two kernels as well. To check the kernels, compare
# ``selective_scan_fn`` with ``selective_scan_ref``.
mamba_inner_ref, bimamba_inner_ref = mamba_inner_fn, bimamba_inner_fn
