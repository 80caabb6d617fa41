"""causal-conv1d's functions, for whole sequences and for the next tokens of one."""

from __future__ import annotations

import functools
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import Tensor

from ...kernels.causal_conv1d import causal_conv1d_fn as _causal_conv1d_fn
from ...kernels.causal_conv1d.reference import causal_conv1d_reference
from ..shared import DTYPES, INDEX_DTYPES, check_tensor, of_rows, one_of

ACTIVATIONS = (None, "silu", "swish")


@functools.wraps(_causal_conv1d_fn)
def causal_conv1d_fn(x, weight, bias=None, seq_idx=None, *others, **named):
    """Convolve as the kernels' function; ``seq_idx`` may also be an activation."""
    if isinstance(seq_idx, str) and not others:  # version 1.0 has the activation there
        return _causal_conv1d_fn(x, weight, bias, activation=seq_idx)
    return _causal_conv1d_fn(x, weight, bias, cast(Any, seq_idx), *others, **named)


def causal_conv1d_update(
    x: Tensor, conv_state: Tensor, weight: Tensor, bias: Tensor | None = None,
    activation: str | None = None, cache_seqlens: Tensor | None = None,
    conv_state_indices: Tensor | None = None,
) -> Tensor:  # fmt: skip
    """Convolve the next tokens, and update the state in place, without gradients.

    Args:
        x: ``[B, D]`` or ``[B, D, L]`` float32, bfloat16 or float16.
        conv_state: ``[B, D, S]``, the last S tokens, S at least W - 1; with ``conv_state_indices``
            ``[rows, D, S]``.
        weight: ``[D, W]``; the last tap weights the current token.
        bias: ``[D]``, or None for 0.
        activation: None, "silu" or "swish" (the same).
        cache_seqlens: ``[B]`` int32 or int64, tokens so far. With it the state is a ring buffer:
            token t is in column t mod S.
        conv_state_indices: ``[B]`` int32 or int64, the state's row for each element of the batch;
            for negative ones the output is 0 and no state changes.

    Returns:
        The shape and dtype of x.

    Raises:
        TypeError: an argument is not a tensor or has another dtype.
        ValueError: a shape or ``activation`` is not one of the above.
    """
    check_tensor("x", x, ("B", "D"), ("B", "D", "L"), dtypes=DTYPES)
    batch, channels = x.shape[:2]
    check_tensor("weight", weight, (channels, "W >= 1"), dtypes=DTYPES)
    check_tensor("bias", bias, (channels,), dtypes=DTYPES, optional=True)
    rows, least = batch if conv_state_indices is None else "rows", max(1, weight.shape[1] - 1)
    check_tensor("conv_state", conv_state, (rows, channels, f"S >= {least}"), dtypes=DTYPES)
    indices = {"cache_seqlens": cache_seqlens, "conv_state_indices": conv_state_indices}
    for name, value in indices.items():
        check_tensor(name, value, (batch,), dtypes=INDEX_DTYPES, optional=True)

    def update(state: Tensor) -> Tensor:
        return causal_conv1d_update_ref(x, state, weight.float(), bias, activation, cache_seqlens)

    return of_rows(update, conv_state, conv_state_indices)


def causal_conv1d_ref(
    x: Tensor, weight: Tensor, bias: Tensor | None = None, initial_states: Tensor | None = None,
    return_final_states: bool = False, final_states_out: Tensor | None = None,
    activation: str | None = None, seq_idx: None = None,
) -> Tensor | tuple[Tensor, Tensor]:  # fmt: skip
    """Compute ``causal_conv1d_fn`` in plain torch and the dtype of ``weight``, as a reference.

    The arguments and results are the same, in any real float dtype and with any number of taps;
    ``seq_idx`` must be None.

    Raises:
        ValueError: another ``activation``, or a ``seq_idx``.
    """
    if seq_idx is not None:
        raise ValueError("seq_idx is given; packed sequences are not supported")
    one_of("activation", activation, *ACTIVATIONS)
    first = None if initial_states is None else initial_states.mT.to(weight.dtype)
    out, final = causal_conv1d_reference(x.mT.to(weight.dtype), weight, bias, first, activation)
    out, final = out.mT.to(x.dtype), final.mT.to(x.dtype)
    if final_states_out is not None:
        final = final_states_out.copy_(final)
    return (out, final) if return_final_states else out


def causal_conv1d_update_ref(
    x: Tensor, conv_state: Tensor, weight: Tensor, bias: Tensor | None = None,
    activation: str | None = None, cache_seqlens: Tensor | None = None,
) -> Tensor:  # fmt: skip
    """Compute ``causal_conv1d_update`` in plain torch and the dtype of ``weight``, as a reference.

    The arguments and results are the same, in any real float dtype.

    Raises:
        ValueError: another ``activation``.
    """
    one_of("activation", activation, *ACTIVATIONS)  # before the state changes
    tokens = x[..., None] if x.dim() == 2 else x
    size, before, length = conv_state.shape[2], weight.shape[1] - 1, tokens.shape[2]
    if cache_seqlens is None:
        every = torch.cat([conv_state, tokens], -1)
        window = every[..., size - before :]
        conv_state.copy_(every[..., length:])
    else:
        places = cache_seqlens.long()[:, None] + torch.arange(-before, length, device=x.device)
        columns = places.remainder(size)[:, None].expand(-1, tokens.shape[1], -1)
        window = torch.cat([conv_state.gather(2, columns[..., :before]), tokens], -1)
        new = max(0, length - size)  # with more tokens than columns, two would share a column
        conv_state.scatter_(2, columns[..., before + new :], tokens[..., new:].to(conv_state.dtype))
    out = (window.to(weight.dtype).unfold(-1, before + 1, 1) * weight[:, None]).sum(-1)
    if bias is not None:
        out = out + bias[:, None]
    if activation is not None:
        out = F.silu(out)
    return out.to(x.dtype).view(x.shape)
