"""The public convolution, and causal-conv1d's own: checks of arguments, and ``autograd.py``."""

from typing import Literal, overload

import torch
from torch import Tensor

from ..runtime.packed import Packed, sequences
from ..runtime.views import tokens_first
from .autograd import conv
from .kernels import TAPS

DTYPES = (torch.float32, torch.bfloat16, torch.float16)
ACTIVATIONS = (None, "silu", "swish")


@overload
def causal_conv1d(
    x: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    *,
    activation: str | None = None,
    initial_state: Tensor | None = None,
    return_final_state: Literal[False] = False,
    cu_seqlens: Tensor | Packed | None = None,
    seq_idx: Tensor | None = None,
) -> Tensor: ...
@overload
def causal_conv1d(
    x: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    *,
    activation: str | None = None,
    initial_state: Tensor | None = None,
    return_final_state: Literal[True],
    cu_seqlens: Tensor | Packed | None = None,
    seq_idx: Tensor | None = None,
) -> tuple[Tensor, Tensor]: ...
@overload
def causal_conv1d(
    x: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    *,
    activation: str | None = None,
    initial_state: Tensor | None = None,
    return_final_state: bool,
    cu_seqlens: Tensor | Packed | None = None,
    seq_idx: Tensor | None = None,
) -> Tensor | tuple[Tensor, Tensor]: ...
def causal_conv1d(
    x: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    *,
    activation: str | None = None,
    initial_state: Tensor | None = None,
    return_final_state: bool = False,
    cu_seqlens: Tensor | Packed | None = None,
    seq_idx: Tensor | None = None,
) -> Tensor | tuple[Tensor, Tensor]:
    """Depthwise causal convolution along tokens, channels last (README, equation 1).

    Args:
        x: ``[B, L, D]`` float32, bfloat16 or float16.
        weight: ``[D, W]`` float dtype, W from 2 to 4; the last tap meets the present token.
        bias: ``[D]`` float dtype, or None for 0.
        activation: None, "silu" or "swish" (the same).
        initial_state: ``[B, W-1, D]`` in x's dtype, the tokens before the first; None for 0. Of
            packed rows ``[S, W-1, D]``, one for each sequence.
        return_final_state: also return the last W-1 tokens, ``[B, W-1, D]`` or ``[S, W-1, D]``.
        cu_seqlens: ``[S + 1]`` int32 or int64, where the S sequences of one packed row begin and
            end; no token sees another sequence. None: each row is a sequence.
        seq_idx: ``[B, L]`` likewise, in its place: a sequence is a run of equal numbers in a row.

    Returns:
        ``[B, L, D]`` in x's dtype, and the final state if asked for.

    Raises:
        TypeError: an argument is not a tensor or has another dtype.
        ValueError: a shape, a device or ``activation`` is not one of the above, or
            ``cu_seqlens`` or ``seq_idx`` is invalid (``runtime.packed.sequences``).
    """
    tensors = {"x": x, "weight": weight, "bias": bias, "initial_state": initial_state}
    for name, value in tensors.items():
        if value is None and name in ("bias", "initial_state"):
            continue
        if not isinstance(value, Tensor):
            raise TypeError(f"{name} must be a tensor, got {type(value).__name__}")
        if value.dtype not in DTYPES:
            raise TypeError(f"{name} must have a dtype of {DTYPES}, got {value.dtype}")
        if value.device != x.device:
            raise ValueError(f"{name} must be on {x.device}, as x, got {value.device}")
    if x.device.type not in ("cpu", "cuda"):
        raise ValueError(f"x must be on cpu or cuda, got {x.device}")
    if x.dim() != 3 or x.shape[2] == 0:
        raise ValueError(f"x must have shape [B, L, D] with D >= 1, got {tuple(x.shape)}")
    packed = sequences(x, cu_seqlens, seq_idx)
    # not len(x), which would fix a traced batch
    batch, channels = (x if packed is None else packed).shape[0], x.shape[2]
    if weight.dim() != 2 or weight.shape[0] != channels or not 2 <= weight.shape[1] <= TAPS:
        raise ValueError(f"weight must have shape ({channels}, 2 to 4), got {tuple(weight.shape)}")
    if bias is not None and tuple(bias.shape) != (channels,):
        raise ValueError(f"bias must have shape ({channels},), got {tuple(bias.shape)}")
    want = (batch, weight.shape[1] - 1, channels)
    if initial_state is not None and tuple(initial_state.shape) != want:
        raise ValueError(f"initial_state must have shape {want}, got {tuple(initial_state.shape)}")
    if initial_state is not None and initial_state.dtype != x.dtype:
        raise TypeError(f"initial_state has dtype {initial_state.dtype}, x has {x.dtype}")
    if activation not in ACTIVATIONS:
        raise ValueError(f"activation must be one of {ACTIVATIONS}, got {activation!r}")
    out = conv(x, weight, bias, initial_state, packed, activation is not None)
    if not return_final_state:
        return out
    history = weight.shape[1] - 1
    if initial_state is None:
        initial_state = x.new_zeros(batch, history, channels)
    if packed is not None:
        return out, last_tokens(x, initial_state, packed)
    recent = torch.cat([initial_state, x[:, max(0, x.shape[1] - history) :]], 1)
    return out, recent[:, recent.shape[1] - history :]


def last_tokens(x: Tensor, initial_state: Tensor, packed: Tensor) -> Tensor:
    """Last tokens of each sequence; in a short one, preceded by its initial state.

    Args:
        x: ``[B, L, D]``.
        initial_state: ``[S, H, D]``, the tokens before the first of each sequence, H > 0.
        packed: the sequences (``runtime.packed``).

    Returns:
        ``[S, H, D]``.
    """
    row, begin, end = packed.long().unbind(1)
    history = initial_state.shape[1]
    t = end[:, None] + torch.arange(-history, 0, device=x.device)
    before = t - begin[:, None] + history  # index into the initial state
    old = initial_state.gather(1, before.clamp(0, history - 1)[..., None].expand_as(initial_state))
    if not x.shape[1]:
        return old
    return torch.where((t < begin[:, None])[..., None], old, x[row[:, None], t.clamp(min=0)])


def causal_conv1d_fn(
    x: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    seq_idx: Tensor | None = None,
    initial_states: Tensor | None = None,
    return_final_states: bool = False,
    final_states_out: Tensor | None = None,
    activation: str | None = None,
) -> Tensor | tuple[Tensor, Tensor]:
    """Convolve with the arguments and layout of causal-conv1d's ``causal_conv1d_fn``.

    A CPU reads x without a copy, with dense tokens or channels; the output has x's layout.

    Args:
        x: ``[B, D, L]`` float32, bfloat16 or float16.
        weight: ``[D, W]``, W from 2 to 4.
        bias: ``[D]``, or None.
        seq_idx: ``[B, L]`` int32, the sequence of each token, or None; below 0 the output is 0.
        initial_states: ``[B, D, W-1]``, or None; must be None with ``seq_idx``.
        return_final_states: also return ``[B, D, W-1]``.
        final_states_out: where to write the final states, or None.
        activation: None, "silu" or "swish".

    Returns:
        ``[B, D, L]`` in x's dtype, and the final states if asked for.

    Raises:
        TypeError: as ``causal_conv1d``.
        ValueError: as ``causal_conv1d``; also for states with a ``seq_idx``.
    """
    if seq_idx is not None and (initial_states is not None or return_final_states):
        raise ValueError("seq_idx and states are given; causal_conv1d with cu_seqlens takes both")
    result = causal_conv1d(
        tokens_first(x, "x"),
        weight,
        bias,
        activation=activation,
        initial_state=tokens_first(initial_states, "initial_states"),
        return_final_state=return_final_states or final_states_out is not None,
        seq_idx=seq_idx,
    )
    both = result if isinstance(result, tuple) else (result, None)
    out, final = (None if y is None else y.transpose(1, 2) for y in both)
    assert out is not None
    if seq_idx is not None:
        out = out.masked_fill((seq_idx < 0)[:, None], 0)
    if final is not None and final_states_out is not None:
        with torch.no_grad():
            final_states_out.copy_(final)
    return (out, final) if final is not None and return_final_states else out
