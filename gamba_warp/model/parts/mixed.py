"""Condition tokens that stand among the 3DGS tokens, in place of a prefix."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ...kernels.runtime.packed import Packed
from .mamba import Mamba


class Mixed(NamedTuple):
    """Condition tokens that a block mixes into the 3DGS tokens.

    Attributes:
        tokens: ``[B, K, width]``, projected and normalised, camera first.
    """

    tokens: Tensor


def run_mixed(mamba: Mamba, tokens: Tensor, mixed: Tensor, packed: Packed | None) -> Tensor:
    """Run a layer over ``mixed [B, K, width]`` and 3DGS tokens; return those of the latter.

    Args:
        mamba: the layer.
        tokens: ``[B, L, width]``, or all tokens in one row.
        mixed: of ``Mixed``.
        packed: the images' tokens in such a row.
    """
    count, length = mixed.shape[1], tokens.shape[1]
    if packed is None:
        cu_seqlens = length * torch.arange(len(tokens) + 1, device=tokens.device)
    else:
        cu_seqlens = packed.cu_seqlens
    positions = mixed_positions(count, cu_seqlens)
    both = torch.cat([mixed.to(tokens.dtype).flatten(0, 1), tokens.flatten(0, 1)])
    row = torch.empty_like(both).index_copy(0, positions, both)[None]
    borders = cu_seqlens + count * torch.arange(len(cu_seqlens), device=tokens.device)
    hidden, _ = mamba(row, packed=Packed.of(borders))
    return hidden[0, positions[mixed.shape[:2].numel() :]].view_as(tokens)


def mixed_positions(count: int, cu_seqlens: Tensor) -> Tensor:
    """Position of each token in the common row, if condition tokens are mixed in.

    Of K such tokens and an image's L 3DGS tokens, token k = 0 .. K-1 comes before the 3DGS token
    number floor((k + 1) L / (K + 1)), so that they cut the 3DGS tokens into K + 1 pieces of nearly
    equal length. A Mamba block then runs over all K + L tokens, and the outputs of the K are
    dropped.

    Args:
        count: K.
        cu_seqlens: ``[B + 1]`` int64, borders of each image's 3DGS tokens.

    Returns:
        ``[B K + T]`` int64, a permutation: the positions of each image's K tokens, then those of
        all 3DGS tokens.
    """
    steps = torch.arange(1, count + 1, device=cu_seqlens.device)
    before = cu_seqlens[:-1, None] + steps * cu_seqlens.diff()[:, None] // (count + 1)
    before = before.flatten()
    tokens = torch.arange(int(cu_seqlens[-1]), device=cu_seqlens.device)
    passed = torch.searchsorted(before, tokens, right=True)
    return torch.cat([before + torch.arange(len(before), device=tokens.device), tokens + passed])
