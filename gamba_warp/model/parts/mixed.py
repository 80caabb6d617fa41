"""Camera and image tokens spread among the 3DGS tokens, in place of a prefix.

Of K such tokens and L 3DGS tokens, token k = 0 .. K-1 stands before the 3DGS token of the number
floor((k + 1) L / (K + 1)), so that they cut the 3DGS tokens into K + 1 pieces of nearly one length.
A Mamba block then runs over all K + L tokens, and the outputs of the K are dropped.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Mixed(NamedTuple):
    """What a block mixes into the 3DGS tokens.

    Attributes:
        tokens: ``[B, K, width]``, projected and normalised, camera first.
    """

    tokens: Tensor


def mixed_places(count: int, length: int, lengths: Tensor) -> Tensor:
    """Where each token stands in the common sequence.

    Args:
        count: K.
        length: L, what fills up the batch included; that stays behind all others.
        lengths: ``[B]`` int64, how many of the L tokens are a picture's own.

    Returns:
        ``[B, K + L]`` int64, each row a permutation: first the places of the K tokens.
    """
    steps = torch.arange(count, device=lengths.device)
    before = (steps + 1) * lengths[:, None] // (count + 1)
    own = torch.arange(length, device=lengths.device).expand(len(lengths), -1).contiguous()
    passed = torch.searchsorted(before.contiguous(), own, right=True)
    return torch.cat([before + steps, own + passed], 1)


def merged(mixed: Mixed, tokens: Tensor, places: Tensor) -> Tensor:
    """Puts both kinds of tokens, ``[B, L, width]`` the second, into one ``[B, K + L, width]``."""
    both = torch.cat([mixed.tokens.to(tokens.dtype), tokens], 1)
    return torch.zeros_like(both).scatter(1, _index(places, both), both)


def dropped(sequence: Tensor, places: Tensor, length: int) -> Tensor:
    """The 3DGS tokens of ``sequence [B, K + L, width]`` in their order: ``[B, L, width]``."""
    return sequence.gather(1, _index(places[:, places.shape[1] - length :], sequence))


def _index(places: Tensor, tokens: Tensor) -> Tensor:
    return places[..., None].expand(-1, -1, tokens.shape[-1])
