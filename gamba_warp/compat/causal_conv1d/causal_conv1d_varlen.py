"""The states of packed sequences, under causal-conv1d's path."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["causal_conv1d_varlen_states", "causal_conv1d_varlen_states_ref"]


@torch.no_grad()
def causal_conv1d_varlen_states(x: Tensor, cu_seqlens: Tensor, state_len: int) -> Tensor:
    """The last tokens of each of several sequences in one row; no gradient flows through it.

    Args:
        x: ``[tokens, D]``, the sequences behind one another.
        cu_seqlens: ``[S + 1]`` integers, ascending: where each begins, and where the last ends.
        state_len: how many tokens are taken.

    Returns:
        ``[S, D, state_len]`` in x's dtype, 0 where a sequence is shorter. Channels are adjacent.

    Raises:
        ValueError: a shape is not one of the above.
    """
    if x.dim() != 2 or cu_seqlens.dim() != 1 or len(cu_seqlens) == 0:
        raise ValueError(
            f"x has shape {tuple(x.shape)}, must be [tokens, D]; "
            f"cu_seqlens {tuple(cu_seqlens.shape)}, must be [S + 1]"
        )
    places = cu_seqlens[1:, None] + torch.arange(-state_len, 0, device=x.device)
    outside = places < cu_seqlens[:-1, None]
    padded = torch.cat([x, x.new_zeros(1, x.shape[1])])
    return padded[places.masked_fill(outside, len(x)).long()].mT


causal_conv1d_varlen_states_ref = causal_conv1d_varlen_states
