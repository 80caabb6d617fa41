"""causal-conv1d's functions: whole sequences by our kernel, and the next tokens of a sequence."""

from __future__ import annotations

from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor

from ...kernels.causal_conv1d import causal_conv1d_fn
from ...kernels.causal_conv1d.reference import causal_conv1d_reference
from ...kernels.selective_scan.cpu.step import conv_step
from ..states import (
    check_dtype,
    check_indices,
    check_tensors,
    put_rows,
    take_rows,
    without_gradient,
)

__all__ = [
    "causal_conv1d_fn",
    "causal_conv1d_ref",
    "causal_conv1d_update",
    "causal_conv1d_update_ref",
]

ACTIVATIONS = (None, "silu", "swish")


@without_gradient
def causal_conv1d_update(
    x: Tensor,
    conv_state: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    activation: str | None = None,
    cache_seqlens: Tensor | None = None,
    conv_state_indices: Tensor | None = None,
) -> Tensor:
    """Convolves the next tokens, and updates the state in place; no gradient flows through it.

    Args:
        x: ``[B, D]`` or ``[B, D, L]`` float32, bfloat16 or float16.
        conv_state: ``[B, D, S]``, the last S tokens, S at least W - 1; with ``conv_state_indices``
            ``[rows, D, S]``.
        weight: ``[D, W]``; the last tap meets the present token.
        bias: ``[D]``, or None for 0.
        activation: None, "silu" or "swish" (the same).
        cache_seqlens: ``[B]`` int32 or int64, tokens seen so far. With it the state is a ring:
            token t lies in column t mod S.
        conv_state_indices: ``[B]`` int32 or int64, the state's row for each element of the batch;
            below 0 the output is 0 and no state is touched.

    Returns:
        The shape and dtype of x.

    Raises:
        TypeError: an argument is not a tensor or has another dtype.
        ValueError: a shape or ``activation`` is not one of the above.
    """
    if cache_seqlens is None and conv_state_indices is None and activation in ACTIVATIONS:
        out = conv_step(x, weight, bias, conv_state, activation is not None)
        if out is not None:  # None, and nothing done, also where an argument is wrong
            return out
    state = _check(x, conv_state, weight, bias, activation, cache_seqlens, conv_state_indices)
    tokens = x[..., None] if x.dim() == 2 else x
    if cache_seqlens is None:
        recent = _shift(state, tokens, weight.shape[1])
    else:
        recent = _turn(state, tokens, weight.shape[1], cache_seqlens)
    width = weight.shape[1]
    window = recent[..., recent.shape[2] - (width - 1 + tokens.shape[2]) :].float()
    if x.dim() == 2:  # the window is that of the one token
        out = (window * weight).sum(-1)
    else:
        out = (window.unfold(-1, width, 1) * weight[:, None]).sum(-1)
    if bias is not None:
        out += bias if x.dim() == 2 else bias[:, None]
    if activation is not None:
        out = F.silu(out, inplace=True)
    if conv_state_indices is not None:
        out = put_rows(conv_state, conv_state_indices, state, out)
    return out.to(x.dtype)


def causal_conv1d_ref(
    x: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    initial_states: Tensor | None = None,
    return_final_states: bool = False,
    final_states_out: Tensor | None = None,
    activation: str | None = None,
    seq_idx: None = None,
) -> Tensor | tuple[Tensor, Tensor]:
    """The convolution in plain torch and the dtype of ``weight``, to compare with.

    Args:
        x: ``[B, D, L]``, any real float dtype, as ``causal_conv1d_fn``; likewise the others.
        weight: ``[D, W]``, any W.
        bias: ``[D]``, or None for 0.
        initial_states: ``[B, D, W-1]``, or None for 0.
        return_final_states: also return the last W - 1 tokens, ``[B, D, W-1]``.
        final_states_out: where to write them, or None.
        activation: None, "silu" or "swish" (the same).
        seq_idx: must be None.

    Returns:
        The shape and dtype of x, and the final states if asked for.

    Raises:
        ValueError: another ``activation``, or a ``seq_idx``.
    """
    if seq_idx is not None:
        raise ValueError("seq_idx is given; packed sequences are not supported")
    if activation not in ACTIVATIONS:
        raise ValueError(f"activation is {activation!r}, allowed: {ACTIVATIONS}")
    first = None if initial_states is None else initial_states.mT.to(weight.dtype)
    out, final = causal_conv1d_reference(x.mT.to(weight.dtype), weight, bias, first, activation)
    out, final = out.mT.to(x.dtype), final.mT.to(x.dtype)
    if final_states_out is not None:
        final = final_states_out.copy_(final)
    return (out, final) if return_final_states else out


def causal_conv1d_update_ref(
    x: Tensor,
    conv_state: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    activation: str | None = None,
    cache_seqlens: Tensor | None = None,
) -> Tensor:
    """``causal_conv1d_update`` in plain torch and the dtype of ``weight``, to compare with.

    Args:
        x: ``[B, D]`` or ``[B, D, L]``, any real float dtype.
        conv_state: ``[B, D, S]``, S at least W - 1; the tokens are written into it.
        weight: ``[D, W]``, any W.
        bias: ``[D]``, or None for 0.
        activation: None, "silu" or "swish" (the same).
        cache_seqlens: ``[B]`` integers; with it the state is a ring, as in
            ``causal_conv1d_update``.

    Returns:
        The shape and dtype of x.

    Raises:
        ValueError: another ``activation``.
    """
    tokens = x[..., None] if x.dim() == 2 else x
    size, before = conv_state.shape[2], weight.shape[1] - 1
    if cache_seqlens is None:
        every = torch.cat([conv_state, tokens.to(conv_state.dtype)], -1)
        seen = conv_state[..., size - before :].clone()
        conv_state.copy_(every[..., every.shape[2] - size :])
    else:
        places = cache_seqlens.long()[:, None] + torch.arange(-before, 0, device=x.device)
        columns = places.remainder(size)[:, None].expand(-1, conv_state.shape[1], -1)
        seen = conv_state.gather(2, columns)
        for t in range(tokens.shape[2]):
            at = (cache_seqlens.long() + t).remainder(size)[:, None, None]
            token = tokens[..., t : t + 1].to(conv_state.dtype)
            conv_state.scatter_(2, at.expand_as(token), token)
    out = cast(Tensor, causal_conv1d_ref(tokens, weight, bias, seen, activation=activation))
    return out[..., 0] if x.dim() == 2 else out


def _check(x, conv_state, weight, bias, activation, cache_seqlens, indices) -> Tensor:
    """Checks the arguments; returns the states of the batch, copied if there are indices."""
    for name, value in {"x": x, "conv_state": conv_state, "weight": weight}.items():
        check_dtype(name, value)
    if x.dim() not in (2, 3):
        raise ValueError(f"x has shape {tuple(x.shape)}, must be [B, D] or [B, D, L]")
    if weight.dim() != 2 or weight.shape[0] != x.shape[1] or weight.shape[1] == 0:
        raise ValueError(f"weight has shape {tuple(weight.shape)}, must be ({x.shape[1]}, W)")
    (batch, channels), width = x.shape[:2], weight.shape[1]
    if bias is not None:
        check_tensors({"bias": (bias, (channels,))})
    rows = batch if indices is None else conv_state.shape[0]
    shape = tuple(conv_state.shape)
    if len(shape) != 3 or shape[:2] != (rows, channels) or shape[2] < max(1, width - 1):
        raise ValueError(
            f"conv_state has shape {shape}, must be [{'rows' if indices is not None else batch}, "
            f"{channels}, S] with S >= {max(1, width - 1)}"
        )
    if activation not in ACTIVATIONS:
        raise ValueError(f"activation is {activation!r}, allowed: {ACTIVATIONS}")
    if cache_seqlens is not None:
        check_indices("cache_seqlens", cache_seqlens, batch)
    if indices is None:
        return conv_state
    check_indices("conv_state_indices", indices, batch)
    return take_rows(conv_state, indices)


def _shift(state: Tensor, tokens: Tensor, width: int) -> Tensor:
    """Moves the tokens into the state from behind; returns at least the last W - 1 + L of both."""
    size, length = state.shape[2], tokens.shape[2]
    # What neither the state nor the taps need any more is not copied.
    recent = torch.cat((state[..., min(length, size - width + 1) :], tokens), -1)
    state.copy_(recent[..., recent.shape[2] - size :])
    return recent


def _turn(state: Tensor, tokens: Tensor, width: int, seen: Tensor) -> Tensor:
    """Writes the tokens into the ring; returns the last W - 1 + L."""
    size, (_, channels, length) = state.shape[2], tokens.shape

    def columns(first: int, last: int) -> Tensor:
        steps = torch.arange(first, last, device=state.device)
        at = torch.remainder(seen.long()[:, None] + steps, size)
        return at[:, None].expand(-1, channels, -1)

    recent = torch.cat((state.gather(2, columns(1 - width, 0)), tokens), -1)
    kept = min(length, size)  # of more tokens than columns, two would meet in a column
    state.scatter_(2, columns(length - kept, length), tokens[..., length - kept :].to(state.dtype))
    return recent
