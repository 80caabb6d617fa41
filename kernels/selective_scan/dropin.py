"""mamba-ssm's own signature and ``[B, D, L]`` layout over our scan."""

from __future__ import annotations

from torch import Tensor

from ..runtime.views import tokens_first
from .function import selective_scan


def input_matrix(x: Tensor, u: Tensor, name: str) -> Tensor:
    """Brings (D, N), (B, N, L) or (B, G, N, L) to ``[B, L, G, N]``."""
    if not isinstance(x, Tensor):
        raise TypeError(f"{name} is {type(x).__name__}, must be a tensor")
    if x.is_complex():
        raise TypeError(f"{name} has dtype {x.dtype}; complex states are not supported")
    if x.dim() == 2:
        # in float32: the sum of its gradient over all tokens would not fit in x's few bits
        return x.float().expand(u.shape[0], u.shape[2], *x.shape)
    if x.dim() == 3:
        return x.transpose(1, 2)[:, :, None]
    if x.dim() == 4:
        return x.permute(0, 3, 1, 2)
    raise ValueError(f"{name} has shape {tuple(x.shape)}; must be (D, N), (B, N, L), (B, G, N, L)")


def _grouped(x: Tensor, groups: int) -> Tensor:
    """Brings ``[B, L, G, N]`` to more groups if they are a multiple, in float32 as their sum."""
    if x.shape[2] == groups or x.shape[2] == 0 or groups % x.shape[2]:
        return x
    if x.shape[2] == 1:  # without a copy
        return x.float().expand(-1, -1, groups, -1)
    return x.float().repeat_interleave(groups // x.shape[2], dim=2)


def selective_scan_fn(
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
    """Does what mamba-ssm's ``selective_scan_fn`` does, with the same arguments and layout.

    Args:
        u: ``[B, D, L]`` float32, bfloat16 or float16; likewise delta and z.
        delta: as u.
        A: ``[D, N]`` float32.
        B: (D, N) constant, (B, N, L), or (B, G, N, L).
        C: as B, on its own.
        D: ``[D]``, or None.
        z: as u, or None.
        delta_bias: ``[D]``, or None.
        delta_softplus: whether softplus is applied to delta.
        return_last_state: also return ``[B, D, N]`` float32 (its gradient flows here).

    Returns:
        ``[B, D, L]`` in u's dtype, with channels adjacent in memory.

    Raises:
        TypeError: as ``selective_scan``; also for complex A, B or C.
        ValueError: as ``selective_scan``.
    """
    if isinstance(A, Tensor) and A.is_complex():
        raise TypeError(f"A has dtype {A.dtype}; complex states are not supported")
    u = tokens_first(u, "u")
    if not isinstance(u, Tensor):
        raise TypeError(f"u is {type(u).__name__}, must be a tensor")
    tokens = u.transpose(1, 2)
    B, C = input_matrix(B, tokens, "B"), input_matrix(C, tokens, "C")
    groups = max(B.shape[2], C.shape[2])
    B, C = _grouped(B, groups), _grouped(C, groups)
    out, last = selective_scan(
        u,
        tokens_first(delta, "delta"),
        A,
        B,
        C,
        D,
        tokens_first(z, "z"),
        delta_bias,
        delta_softplus,
        return_last_state=True,
    )
    out = out.transpose(1, 2)
    return (out, last) if return_last_state else out
