"""Transformer block in place of the Mamba block, for the paper's question Q2.

The 3DGS tokens attend to the prefix P_c T, P_x X, whose own outputs are dropped. The prefix
therefore only has keys and values, independent of the 3DGS tokens: ``prefix_states`` computes them
once for all blocks, like the states of Mamba blocks. Attention is not causal; only the embedding E
encodes the order of the tokens.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ...kernels.runtime.packed import Packed
from ..config import GambaConfig
from .block import Block, make_norm
from .prefix import Blocks, product, stacked


class Memory(NamedTuple):
    """Keys and values of the prefix.

    Attributes:
        keys: ``[B, heads, K, width / heads]``.
        values: the same.
    """

    keys: Tensor
    values: Tensor


class AttentionBlock(Block):
    """G' = G + Attention(Norm(Prepend(..))), G = G' + MLP(Norm(G')), with biases and a GELU."""

    in_segments = False

    def __init__(self, config: GambaConfig, camera_channels: int, image_channels: int) -> None:
        """Build the block; zero channels mean no such condition."""
        super().__init__(config, camera_channels, image_channels)
        width, inner = config.width, config.mlp_width
        self.heads = config.num_heads
        self.kvq_proj = nn.Linear(width, 3 * width)  # rows of keys, of values, of queries
        self.out_proj = nn.Linear(width, width)
        self.mlp_norm = make_norm(config)
        first, second = nn.Linear(width, inner), nn.Linear(inner, width)
        self.mlp = nn.Sequential(first, nn.GELU(), second)
        for layer in (self.kvq_proj, self.out_proj, first, second):
            nn.init.zeros_(layer.bias)
        # Two residual branches per block; their sum over all blocks keeps the variance of one.
        for layer in (self.out_proj, second):
            with torch.no_grad():
                layer.weight.div_(math.sqrt(2 * config.depth))

    def forward(
        self,
        tokens: Tensor,
        state: Memory | None,
        packed: Packed | None = None,
        keep: bool = False,
    ) -> tuple[Tensor, None]:
        """Refine all 3DGS tokens: ``Block.forward``."""
        parts = self.kvq_proj(self.norm(tokens)).chunk(3, dim=-1)
        keys, values, queries = (_by_head(part, self.heads) for part in parts)
        if packed is None:
            hidden = _attention(keys, values, queries, state)
        else:  # one image after the other, each over its own tokens
            counts = packed.cu_seqlens.diff().tolist()
            images = zip(*(part.split(counts, 2) for part in (keys, values, queries)))
            hidden = torch.cat([
                _attention(k, v, q, state and Memory(*(x[i : i + 1] for x in state)))
                for i, (k, v, q) in enumerate(images)
            ], 2)  # fmt: skip
        tokens = tokens + self.out_proj(hidden.transpose(1, 2).flatten(2))
        return tokens + self.mlp(self.mlp_norm(tokens)), None

    @staticmethod
    def states_after(blocks: Blocks, prefix: Tensor) -> list[Memory]:
        """Compute keys and values of each block's prefix: ``Block.states_after``."""
        first = blocks[0]
        assert isinstance(first, AttentionBlock)
        rows = 2 * prefix.shape[-1]
        pairs = product(prefix, stacked(blocks, "kvq_proj.weight", rows))
        pairs = pairs + stacked(blocks, "kvq_proj.bias", rows)
        return [
            Memory(*(_by_head(half, first.heads) for half in both.chunk(2, dim=-1)))
            for both in pairs.unbind(2)
        ]


def _by_head(tokens: Tensor, heads: int) -> Tensor:
    """Reshape ``[B, L, width]`` to ``[B, heads, L, width / heads]``."""
    return tokens.unflatten(2, (heads, -1)).transpose(1, 2)


def _attention(keys: Tensor, values: Tensor, queries: Tensor, memory: Memory | None) -> Tensor:
    """Attend from each token to the prefix and to all tokens of its image."""
    if memory is not None:
        keys = torch.cat([memory.keys.to(keys.dtype), keys], dim=2)
        values = torch.cat([memory.values.to(values.dtype), values], dim=2)
    return F.scaled_dot_product_attention(queries, keys, values)
