"""States of packed sequences, under causal-conv1d's path."""

from __future__ import annotations

import torch
from torch import Tensor

from ...kernels.causal_conv1d.api import last_tokens
from ...kernels.runtime.packed import sequences


@torch.no_grad()
def causal_conv1d_varlen_states(x: Tensor, cu_seqlens: Tensor, state_len: int) -> Tensor:
    """Return the last tokens of each packed sequence, without gradients.

    Args:
        x: ``[tokens, D]``, the sequences concatenated.
        cu_seqlens: ``[S + 1]`` integers, ascending: the start of each, and the end of the last.
        state_len: number of tokens.

    Returns:
        ``[S, D, state_len]`` in x's dtype, 0 where a sequence is shorter. Channels are adjacent.

    Raises:
        TypeError: ``cu_seqlens`` has another dtype than int32 and int64.
        ValueError: ``x`` has another shape, or ``cu_seqlens`` is not as above.
    """
    if x.dim() != 2:
        raise ValueError(f"x must have shape [tokens, D] as of cu_seqlens, got {tuple(x.shape)}")
    packed = sequences(x[None], cu_seqlens, None)
    assert packed is not None
    return last_tokens(x[None], x.new_zeros(len(packed), state_len, x.shape[1]), packed).mT


causal_conv1d_varlen_states_ref = causal_conv1d_varlen_states
