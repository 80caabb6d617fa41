"""The public scan, and mamba-ssm's own: checks of their arguments, and ``autograd.py``."""

from __future__ import annotations

from typing import Literal, overload

import torch
from torch import Tensor

from ..runtime.packed import Packed, sequences
from ..runtime.views import tokens_first
from .autograd import scan
from .problem import DISCRETIZATIONS, Inputs, Options

DTYPES = (torch.float32, torch.bfloat16, torch.float16)
MAX_STATES = 256


def _check(name: str, x: Tensor, shape: tuple[int, ...], dtypes: tuple, device) -> None:
    if not isinstance(x, Tensor):
        raise TypeError(f"{name} must be a tensor, got {type(x).__name__}")
    if tuple(x.shape) != shape:
        raise ValueError(f"{name} must have shape {shape}, got {tuple(x.shape)}")
    if x.dtype not in dtypes:
        raise TypeError(f"{name} must have dtype {', '.join(map(str, dtypes))}, got {x.dtype}")
    if x.device != device:
        raise ValueError(f"{name} must be on {device}, as u, got {x.device}")


def _check_groups(name: str, x: Tensor, u: Tensor, states: int) -> Tensor:
    """Checks B or C and brings ``[B, L, N]`` to ``[B, L, G, N]``."""
    if not isinstance(x, Tensor):
        raise TypeError(f"{name} must be a tensor, got {type(x).__name__}")
    batch, length, channels = u.shape
    if x.dim() == 3:
        _check(name, x, (batch, length, states), DTYPES, u.device)
        return x[:, :, None]
    groups = x.shape[2] if x.dim() == 4 else 0
    if groups == 0 or channels % groups:
        raise ValueError(
            f"{name} must have shape {(batch, length, states)} or [{batch}, {length}, G, {states}] "
            f"with G a divisor of {channels}, got {tuple(x.shape)}"
        )
    _check(name, x, (batch, length, groups, states), DTYPES, u.device)
    return x


def _check_common(
    u, delta, A, delta_bias, initial_state, discretization, cu_seqlens, seq_idx
) -> tuple[int, Tensor | None]:
    """Check the arguments of both functions, except B and C; returns N and the packed sequences."""
    if not isinstance(u, Tensor):
        raise TypeError(f"u must be a tensor, got {type(u).__name__}")
    if u.dim() != 3 or u.shape[2] == 0:
        raise ValueError(f"u must have shape [B, L, D] with D >= 1, got {tuple(u.shape)}")
    _check("u", u, tuple(u.shape), DTYPES, u.device)
    if u.device.type not in ("cpu", "cuda"):
        raise ValueError(f"u must be on cpu or cuda, got {u.device}")
    if discretization not in DISCRETIZATIONS:
        raise ValueError(
            f"discretization must be one of {(*DISCRETIZATIONS,)}, got {discretization!r}"
        )
    batch, _, channels = u.shape
    states = A.shape[1] if isinstance(A, Tensor) and A.dim() == 2 else 0
    _check("A", A, (channels, states), (torch.float32,), u.device)
    if not 1 <= states <= MAX_STATES:
        raise ValueError(f"A must have shape [D, N] with N from 1 to 256, got {tuple(A.shape)}")
    _check("delta", delta, tuple(u.shape), DTYPES, u.device)
    if delta_bias is not None:
        _check("delta_bias", delta_bias, (channels,), DTYPES, u.device)
    packed = sequences(u, cu_seqlens, seq_idx)
    if initial_state is not None:
        shape = (batch if packed is None else len(packed), channels, states)
        _check("initial_state", initial_state, shape, (torch.float32,), u.device)
    return states, packed


def _run(x: Inputs, options: Options) -> tuple[Tensor, Tensor]:
    """Output and last state; saves the states between them if a gradient may follow."""
    save = torch.is_grad_enabled() and any(v is not None and v.requires_grad for v in x)
    out, last, _ = scan(*x, *options._replace(save=save))
    return out, last


@overload
def selective_scan(
    u: Tensor,
    delta: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor | None = None,
    z: Tensor | None = None,
    delta_bias: Tensor | None = None,
    delta_softplus: bool = False,
    *,
    initial_state: Tensor | None = None,
    return_last_state: Literal[False] = False,
    discretization: str = "mamba",
    cu_seqlens: Tensor | Packed | None = None,
    seq_idx: Tensor | None = None,
) -> Tensor: ...
@overload
def selective_scan(
    u: Tensor,
    delta: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor | None = None,
    z: Tensor | None = None,
    delta_bias: Tensor | None = None,
    delta_softplus: bool = False,
    *,
    initial_state: Tensor | None = None,
    return_last_state: Literal[True],
    discretization: str = "mamba",
    cu_seqlens: Tensor | Packed | None = None,
    seq_idx: Tensor | None = None,
) -> tuple[Tensor, Tensor]: ...
@overload
def selective_scan(
    u: Tensor,
    delta: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor | None = None,
    z: Tensor | None = None,
    delta_bias: Tensor | None = None,
    delta_softplus: bool = False,
    *,
    initial_state: Tensor | None = None,
    return_last_state: bool,
    discretization: str = "mamba",
    cu_seqlens: Tensor | Packed | None = None,
    seq_idx: Tensor | None = None,
) -> Tensor | tuple[Tensor, Tensor]: ...
def selective_scan(
    u: Tensor,
    delta: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor | None = None,
    z: Tensor | None = None,
    delta_bias: Tensor | None = None,
    delta_softplus: bool = False,
    *,
    initial_state: Tensor | None = None,
    return_last_state: bool = False,
    discretization: str = "mamba",
    cu_seqlens: Tensor | Packed | None = None,
    seq_idx: Tensor | None = None,
) -> Tensor | tuple[Tensor, Tensor]:
    """Mamba's selective scan, channels last (Gu and Dao 2023, algorithm 2; README for the maths).

    With δ = softplus(delta + delta_bias): h_t = f(δA) h_{t-1} + g(δA) δ B_t u_t,
    out_t = (Σ_n C_t h_t + D u_t) · silu(z_t). Interior and states are float32 whatever the inputs;
    gradients reach every tensor, the initial state included, also through the last state.

    Args:
        u: ``[B, L, D]`` float32, bfloat16 or float16.
        delta: ``[B, L, D]``, one of the same dtypes; before the softplus if there is one.
        A: ``[D, N]`` float32, N from 1 to 256; negative in a model.
        B: ``[B, L, N]`` or ``[B, L, G, N]``: group d // (D / G) serves channel d.
        C: as B, the same G.
        D: ``[D]`` float dtype, or None for 0.
        z: ``[B, L, D]`` in u's dtype, or None for no gate.
        delta_bias: ``[D]`` float dtype, or None for 0.
        delta_softplus: True to apply softplus to delta.
        initial_state: ``[B, D, N]`` float32, h before the first token; None for 0. Of packed
            rows ``[S, D, N]``, one for each sequence.
        return_last_state: also return h after the last token, of each sequence.
        discretization: "mamba" (f = e^x, g = 1), "zoh" (f = e^x, g = (e^x - 1) / x) or "bilinear"
            (f = (1 + x/2) / (1 - x/2), g = 1 / (1 - x/2)), with x = δA.
        cu_seqlens: ``[S + 1]`` int32 or int64, where the S sequences of one packed row begin and
            end: each starts from its own state, and no token sees another's. None: each row of the
            batch is a sequence.
        seq_idx: ``[B, L]`` likewise, in its place: a sequence is a run of equal numbers in a row.

    Returns:
        ``out [B, L, D]`` in u's dtype; with ``return_last_state`` also ``[B, D, N]`` float32, of
        packed rows ``[S, D, N]``.

    Raises:
        TypeError: an argument is not a tensor or has another dtype.
        ValueError: a shape, a device or ``discretization`` is not one of the above, or
            ``cu_seqlens`` or ``seq_idx`` is invalid (``runtime.packed.sequences``).
    """
    states, packed = _check_common(
        u, delta, A, delta_bias, initial_state, discretization, cu_seqlens, seq_idx
    )
    B, C = _check_groups("B", B, u, states), _check_groups("C", C, u, states)
    if B.shape != C.shape:
        raise ValueError(f"C has {C.shape[2]} groups, B has {B.shape[2]}; they must be equal")
    if D is not None:
        _check("D", D, (u.shape[2],), DTYPES, u.device)
    if z is not None:
        _check("z", z, tuple(u.shape), (u.dtype,), u.device)
    inputs = Inputs(u, delta, A, B, C, D, z, delta_bias, initial_state)
    out, last = _run(inputs, Options(packed, delta_softplus, discretization, save=False))
    return (out, last) if return_last_state else out


def selective_scan_state(
    u: Tensor,
    delta: Tensor,
    A: Tensor,
    B: Tensor,
    delta_bias: Tensor | None = None,
    delta_softplus: bool = False,
    *,
    initial_state: Tensor | None = None,
    discretization: str = "mamba",
    cu_seqlens: Tensor | Packed | None = None,
    seq_idx: Tensor | None = None,
) -> Tensor:
    """The state after the last token, where no output is needed: no C, D or gate is computed.

    Args:
        u: as ``selective_scan``; likewise the others.
        delta: one step per token and channel.
        A: rates of decay.
        B: input matrix.
        delta_bias: added to delta.
        delta_softplus: True to apply softplus to delta.
        initial_state: h before the first token.
        discretization: as ``selective_scan``.
        cu_seqlens: as ``selective_scan``.
        seq_idx: as ``selective_scan``.

    Returns:
        ``[B, D, N]`` float32, of packed rows ``[S, D, N]``, with gradients to every tensor.

    Raises:
        TypeError: as ``selective_scan``.
        ValueError: as ``selective_scan``.
    """
    states, packed = _check_common(
        u, delta, A, delta_bias, initial_state, discretization, cu_seqlens, seq_idx
    )
    B = _check_groups("B", B, u, states)
    inputs = Inputs(
        u, delta, A, B, C=None, D=None, z=None, delta_bias=delta_bias, initial_state=initial_state
    )
    return _run(inputs, Options(packed, delta_softplus, discretization, save=False))[1]


def input_matrix(x: Tensor, u: Tensor, name: str) -> Tensor:
    """Brings (D, N), (B, N, L) or (B, G, N, L) to ``[B, L, G, N]``."""
    if not isinstance(x, Tensor):
        raise TypeError(f"{name} must be a tensor, got {type(x).__name__}")
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
    """Run the scan with the arguments and layout of mamba-ssm's ``selective_scan_fn``.

    A CPU reads tensors without a copy, with dense tokens or channels, in any mixture, also slices.

    Args:
        u: ``[B, D, L]`` float32, bfloat16 or float16; likewise delta and z.
        delta: as u.
        A: ``[D, N]`` float32.
        B: (D, N) constant, (B, N, L), or (B, G, N, L).
        C: as B; each has its own layout.
        D: ``[D]``, or None.
        z: as u, or None.
        delta_bias: ``[D]``, or None.
        delta_softplus: True to apply softplus to delta.
        return_last_state: also return ``[B, D, N]`` float32 (its gradient flows here).

    Returns:
        ``[B, D, L]`` in u's dtype; on a CPU in u's layout, on CUDA with adjacent channels.

    Raises:
        TypeError: as ``selective_scan``; also for complex A, B or C.
        ValueError: as ``selective_scan``.
    """
    if isinstance(A, Tensor) and A.is_complex():
        raise TypeError(f"A has dtype {A.dtype}; complex states are not supported")
    u = tokens_first(u, "u")
    if not isinstance(u, Tensor):
        raise TypeError(f"u must be a tensor, got {type(u).__name__}")
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
