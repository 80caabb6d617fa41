"""Gamba block: prepend the condition, run a Mamba layer, drop the condition (paper eq. 2)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from ...kernels.runtime.packed import Packed
from ..config import GambaConfig
from .mamba import Mamba, State
from .mixed import Mixed, run_mixed
from .prefix import Blocks, mamba_states

# Tokens that pass through all blocks at a time on a CPU without gradients. Temporaries of this size
# are reused instead of being mapped each time.
SEGMENT = 4096


def make_norm(config: GambaConfig, final: bool = False) -> nn.LayerNorm | nn.RMSNorm:
    """Make a LayerNorm or RMSNorm over a token's channels, eps 1e-5; optionally ``final_norm``."""
    kinds = {"layer": nn.LayerNorm, "rms": nn.RMSNorm}
    other = final and config.final_norm != "same"
    kind = kinds[config.final_norm if other else config.norm]
    norm = kind(config.width, eps=1e-5)
    for parameter in norm.parameters():
        vars(parameter)["_no_weight_decay"] = True
    return norm


class Block(nn.Module):
    """Base of blocks with any mixer: the projections of the condition, and the norm.

    Attributes:
        in_segments: True if one part of the tokens may pass through all blocks before the next.
    """

    in_segments = True

    def __init__(self, config: GambaConfig, camera_channels: int, image_channels: int) -> None:
        """Build the layers; zero channels mean no such condition."""
        super().__init__()
        width = config.width
        self.project_camera = nn.Linear(camera_channels, width) if camera_channels else None
        self.project_image = nn.Linear(image_channels, width) if image_channels else None
        self.norm = make_norm(config)

    def forward(
        self, tokens: Tensor, state: Any, packed: Packed | None = None, keep: bool = False
    ) -> tuple[Tensor, Any]:
        """Refine the 3DGS tokens, all of them or the next segment.

        Args:
            tokens: ``[B, L, width]``, or the tokens of all images in one row.
            state: this block's entry of ``prefix_states``, or its state after the previous segment.
            packed: the B images' tokens in such a row.
            keep: return the state after the last token, for a further segment.

        Returns:
            ``[B, L, width]``, and this state, or None.
        """
        raise NotImplementedError

    @staticmethod
    def states_after(blocks: Blocks, prefix: Tensor) -> list[Any]:
        """Compute the state of each block after its prefix.

        Args:
            blocks: all of one configuration.
            prefix: ``[B, K, depth, width]``, K > 0, the normalised prefix of each.
        """
        raise NotImplementedError


class GambaBlock(Block):
    """Gamba block: G_n = G_{n-1} + Drop(Mamba(Norm(Prepend(P_c T, P_x X, G_{n-1})))).

    The prefix has no residual branch, since each block drops it and the next one makes it again. It
    enters as the state after it, computed by ``prefix_states``. With ``image_tokens`` "mixed" these
    tokens are among the 3DGS tokens, and the block runs over the whole sequence.
    """

    def __init__(self, config: GambaConfig, camera_channels: int, image_channels: int) -> None:
        """Build the block; zero channels mean no such condition."""
        super().__init__(config, camera_channels, image_channels)
        self.mixed = config.image_tokens == "mixed"
        self.in_segments = not self.mixed
        self.mamba = Mamba(config)

    def forward(
        self,
        tokens: Tensor,
        state: State | Mixed | None,
        packed: Packed | None = None,
        keep: bool = False,
    ) -> tuple[Tensor, State | None]:
        """Refine the 3DGS tokens: ``Block.forward``."""
        if isinstance(state, Mixed):
            return tokens + run_mixed(self.mamba, self.norm(tokens), state.tokens, packed), None
        hidden, after = self.mamba(self.norm(tokens), state, packed, keep)
        return tokens + hidden, after

    @staticmethod
    def states_after(blocks: Blocks, prefix: Tensor) -> list[State] | list[Mixed]:
        """Compute the states after the prefix, or the tokens to mix: ``Block.states_after``."""
        first = blocks[0]
        assert isinstance(first, GambaBlock)
        if first.mixed:
            return [Mixed(tokens) for tokens in prefix.unbind(2)]
        return mamba_states(blocks, prefix)


def run_blocks(
    blocks: Iterable[nn.Module],
    tokens: Tensor,
    states: Sequence[Any],
    checkpointing: bool = False,
    packed: Packed | None = None,
) -> Tensor:
    """Run all blocks over the 3DGS tokens.

    On a CPU without gradients, one segment of ``SEGMENT`` tokens after the other passes through all
    blocks, and each block passes its state from one segment to the next. Blocks that see tokens in
    both directions take all tokens at once.

    Args:
        blocks: the network's blocks, all of one kind, in their order.
        tokens: ``[B, L, width]``; with ``packed`` ``[1, T, width]``, all images' tokens.
        states: the result of ``prefix_states``, one entry per block.
        checkpointing: with gradients, keep only each block's input and recompute the block in the
            backward pass.
        packed: each image's tokens in one row.

    Returns:
        The shape of ``tokens``.
    """
    blocks, states, gradients = list(blocks), list(states), torch.is_grad_enabled()
    first: Any = blocks[0]
    segments, start = [tokens], 0
    if tokens.device.type == "cpu" and not gradients and first.in_segments:
        segments = list(tokens.split(SEGMENT, dim=1))
    for s, segment in enumerate(segments):
        in_segment, keep = packed, s + 1 < len(segments)
        if packed is not None and len(segments) > 1:
            # The state of an image without tokens in this segment is unchanged.
            in_segment = Packed.of((packed.cu_seqlens - start).clamp(0, segment.shape[1]))
        start += segment.shape[1]
        for i, block in enumerate(blocks):
            run = block
            if checkpointing and gradients:
                run = partial(checkpoint, block, use_reentrant=False)
            segment, states[i] = run(segment, states[i], in_segment, keep)
        segments[s] = segment
    return torch.cat(segments, dim=1) if len(segments) > 1 else segments[0]
