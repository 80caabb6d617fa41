"""Gamba block: prepend the condition, run a Mamba block, drop the condition (paper eq. 2).

In a Mamba block a token depends on the tokens before it only through two small states. A block
prepends the condition, drops its outputs, and the next block prepends it again. The condition thus
contributes only the pair of states after it, which does not depend on the 3DGS tokens.
``prefix_states`` computes the states of all blocks at once, and ``run_blocks`` then runs the blocks
over the 3DGS tokens only. The result equals prepending and dropping.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import partial
from operator import attrgetter
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

from ...kernels.causal_conv1d import causal_conv1d
from ...kernels.runtime.packed import Packed
from ...kernels.selective_scan import selective_scan, selective_scan_state
from ..config import GambaConfig

STEP_RANGE = (1e-3, 1e-1)  # of the step size δ at the start, log-uniform (Mamba, §3.6)
# Tokens that pass through all blocks at a time on a CPU without gradients. Temporaries of this size
# are reused instead of being mapped each time.
SEGMENT = 4096
Blocks = Sequence["Block"] | nn.ModuleList


def make_norm(config: GambaConfig, final: bool = False) -> nn.LayerNorm | nn.RMSNorm:
    """Make a LayerNorm or RMSNorm over a token's channels, eps 1e-5; optionally ``final_norm``."""
    kinds = {"layer": nn.LayerNorm, "rms": nn.RMSNorm}
    other = final and config.final_norm != "same"
    kind = kinds[config.final_norm if other else config.norm]
    norm = kind(config.width, eps=1e-5)
    for parameter in norm.parameters():
        vars(parameter)["_no_weight_decay"] = True
    return norm


class State(NamedTuple):
    """State of a Mamba block after some tokens.

    Attributes:
        conv: ``[B, conv_size - 1, inner_width]``, the convolution's last inputs.
        scan: ``[B, inner_width, state_size]`` float32, the SSM's state.
        A: ``[inner_width, state_size]`` float32, -exp(A_log), if made for all blocks together.
    """

    conv: Tensor
    scan: Tensor
    A: Tensor | None = None


class Mamba(nn.Module):
    """Vanilla Mamba block (Gu & Dao 2023), channels last.

    Parameters have mamba-ssm's names, shapes and row order (``x_proj``: step rank, B, C), so
    weights of mamba-ssm load unchanged, except the convolution's weight, which lacks mamba-ssm's
    middle axis of length 1.
    """

    def __init__(self, config: GambaConfig) -> None:
        super().__init__()
        inner, rank, states = config.inner_width, config.step_rank, config.state_size
        self.split = [rank, states, states]
        self.discretization = config.discretization
        self.in_proj = nn.Linear(config.width, 2 * inner, bias=False)
        self.conv_weight = nn.Parameter(torch.empty(inner, config.conv_size))
        self.conv_bias = nn.Parameter(torch.empty(inner))
        self.x_proj = nn.Linear(inner, rank + 2 * states, bias=False)
        self.dt_proj = nn.Linear(rank, inner)
        self.A_log = nn.Parameter(torch.empty(inner, states))
        self.D = nn.Parameter(torch.ones(inner))
        self.out_proj = nn.Linear(inner, config.width, bias=False)
        self._init_weights(config)

    @torch.no_grad()
    def _init_weights(self, config: GambaConfig) -> None:
        """Draw the weights like mamba-ssm by default (version 2.2)."""
        if self.A_log.is_meta:  # torch would load its compiler for this arithmetic, for seconds
            return
        bound = config.conv_size**-0.5
        nn.init.uniform_(self.conv_weight, -bound, bound)
        nn.init.uniform_(self.conv_bias, -bound, bound)
        bound = config.step_rank**-0.5
        nn.init.uniform_(self.dt_proj.weight, -bound, bound)
        low, high = map(math.log, STEP_RANGE)
        step = torch.empty_like(self.dt_proj.bias).uniform_(low, high).exp().clamp(min=1e-4)
        self.dt_proj.bias.copy_(step + torch.log(-torch.expm1(-step)))  # softplus's inverse
        states = torch.arange(1, config.state_size + 1, dtype=torch.float32)
        self.A_log.copy_(states.log().expand_as(self.A_log))
        # One residual branch per block; their sum keeps the variance of one branch.
        self.out_proj.weight.div_(math.sqrt(config.depth))
        for parameter in (self.A_log, self.D, self.conv_bias, self.dt_proj.bias):
            vars(parameter)["_no_weight_decay"] = True

    def forward(
        self,
        tokens: Tensor,
        state: State | None = None,
        packed: Packed | None = None,
        keep: bool = False,
    ) -> tuple[Tensor, State | None]:
        """Map ``[B, L, width]`` to ``[B, L, width]``; a token sees itself and earlier ones.

        ``state`` is the earlier tokens', None without any. With ``keep`` the state after the
        last token is returned with the tokens. ``packed`` are S sequences in one row; B of the
        states is then S.
        """
        conv_state, scan_state, A = state or (None, None, None)
        if A is None:
            A = -torch.exp(self.A_log.float())
        x, z = self.in_proj(tokens).chunk(2, dim=-1)
        if conv_state is not None:
            conv_state = conv_state.to(x.dtype)
        convolved: Any = causal_conv1d(
            x,
            self.conv_weight,
            self.conv_bias,
            activation="silu",
            initial_state=conv_state,
            return_final_state=keep,
            cu_seqlens=packed,
        )
        x, conv_state = convolved if keep else (convolved, None)
        low_rank, B, C = self.x_proj(x).split(self.split, dim=-1)
        # The bias is added inside the scan, in float32: δ of 1e-3 does not survive bfloat16.
        delta = F.linear(low_rank, self.dt_proj.weight)
        scanned: Any = selective_scan(
            x,
            delta,
            A,
            B,
            C,
            D=self.D.float(),
            z=z,
            delta_bias=self.dt_proj.bias.float(),
            delta_softplus=True,
            initial_state=scan_state,
            return_last_state=keep,
            discretization=self.discretization,
            cu_seqlens=packed,
        )
        y, scan_state = scanned if keep else (scanned, None)
        if conv_state is None or scan_state is None:
            return self.out_proj(y), None
        return self.out_proj(y), State(conv_state, scan_state, A)


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
            tokens: ``[B, L, width]``, or the tokens of all pictures in one row.
            state: this block's entry of ``prefix_states``, or its state after the previous segment.
            packed: the B pictures' tokens in such a row.
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
            return tokens + self._mixing(self.norm(tokens), state.tokens, packed), None
        hidden, after = self.mamba(self.norm(tokens), state, packed, keep)
        return tokens + hidden, after

    def _mixing(self, tokens: Tensor, mixed: Tensor, packed: Packed | None) -> Tensor:
        """Run the Mamba block over ``mixed [B, K, width]`` and 3DGS tokens; keep the latter."""
        count, length = mixed.shape[1], tokens.shape[1]
        if packed is None:
            cu_seqlens = length * torch.arange(len(tokens) + 1, device=tokens.device)
        else:
            cu_seqlens = packed.cu_seqlens
        positions = mixed_positions(count, cu_seqlens)
        both = torch.cat([mixed.to(tokens.dtype).flatten(0, 1), tokens.flatten(0, 1)])
        row = torch.empty_like(both).index_copy(0, positions, both)[None]
        borders = cu_seqlens + count * torch.arange(len(cu_seqlens), device=tokens.device)
        hidden, _ = self.mamba(row, packed=Packed.of(borders))
        return hidden[0, positions[mixed.shape[:2].numel() :]].view_as(tokens)

    @staticmethod
    def states_after(blocks: Blocks, prefix: Tensor) -> list[State] | list[Mixed]:
        """Compute the states after the prefix, or the tokens to mix: ``Block.states_after``.

        All blocks are computed together: one batched product per kind of matrix, one convolution
        and one scan in which each block is a group of channels. The gate z, C, D and the output
        projection, needed only for the dropped outputs, are left out.
        """
        first = blocks[0]
        assert isinstance(first, GambaBlock)
        if first.mixed:
            return [Mixed(tokens) for tokens in prefix.unbind(2)]
        mamba = first.mamba
        inner, (rank, states, _) = len(mamba.D), mamba.split
        x, conv_state = causal_conv1d(
            product(prefix, stacked(blocks, "mamba.in_proj.weight", inner)).flatten(2),
            joined(blocks, "mamba.conv_weight"),
            joined(blocks, "mamba.conv_bias"),
            activation="silu",
            return_final_state=True,
        )
        rows = stacked(blocks, "mamba.x_proj.weight", rank + states)
        low_rank, B = product(x.unflatten(2, (-1, inner)), rows).split([rank, states], dim=-1)
        delta = product(low_rank, stacked(blocks, "mamba.dt_proj.weight")).flatten(2)
        A = -torch.exp(joined(blocks, "mamba.A_log").float())
        scan_state = selective_scan_state(
            x,
            delta,
            A,
            B,
            delta_bias=joined(blocks, "mamba.dt_proj.bias").float(),
            delta_softplus=True,
            discretization=mamba.discretization,
        )
        parts = conv_state.split(inner, dim=2), scan_state.split(inner, dim=1), A.split(inner)
        return [State(*part) for part in zip(*parts)]


def run_blocks(
    blocks: Iterable[nn.Module],
    tokens: Tensor,
    states: Sequence[Any],
    recompute: bool = False,
    packed: Packed | None = None,
) -> Tensor:
    """Run all blocks over the 3DGS tokens.

    On a CPU without gradients, one segment of ``SEGMENT`` tokens after the other passes through all
    blocks, and each block passes its state from one segment to the next. Blocks that see tokens in
    both directions take all tokens at once.

    Args:
        blocks: the network's blocks, all of one kind, in their order.
        tokens: ``[B, L, width]``; with ``packed`` ``[1, T, width]``, all pictures' tokens.
        states: the result of ``prefix_states``, one entry per block.
        recompute: with gradients, keep only each block's input and recompute the block in the
            backward pass.
        packed: each picture's tokens in one row.

    Returns:
        The shape of ``tokens``.
    """
    blocks, states, gradients = list(blocks), list(states), torch.is_grad_enabled()
    first: Any = blocks[0]
    segments, start = [tokens], 0
    if tokens.device.type == "cpu" and not gradients and first.in_segments:
        segments = list(tokens.split(SEGMENT, dim=1))
    for s, segment in enumerate(segments):
        own, keep = packed, s + 1 < len(segments)
        if packed is not None and len(segments) > 1:
            # The state of a picture without tokens in this segment is unchanged.
            own = Packed.of((packed.cu_seqlens - start).clamp(0, segment.shape[1]))
        start += segment.shape[1]
        for i, block in enumerate(blocks):
            run = block
            if recompute and gradients:
                run = partial(checkpoint, block, use_reentrant=False)
            segment, states[i] = run(segment, states[i], own, keep)
        segments[s] = segment
    return torch.cat(segments, dim=1) if len(segments) > 1 else segments[0]


def prefix_states(blocks: Blocks, camera: Tensor | None, image: Tensor | None) -> list[Any]:
    """Compute the state of each block after its prefix P_c T, P_x X, camera first.

    Args:
        blocks: blocks of one configuration.
        camera: ``[B, 1, camera_channels]``, or None if the blocks have no such condition.
        image: ``[B, K, image_channels]``, or None likewise.

    Returns:
        One state per block, a named tuple of tensors ``[B, ..]``: ``State`` of Mamba blocks,
        ``Mixed`` of tokens to mix, ``Memory`` of attention. None for each without any condition.
    """
    projections = {"project_camera": camera, "project_image": image}
    prefix = [
        F.linear(tokens, joined(blocks, f"{name}.weight"), joined(blocks, f"{name}.bias"))
        for name, tokens in projections.items()
        if tokens is not None
    ]
    if not prefix:
        return [None] * len(blocks)
    first = blocks[0]
    assert isinstance(first, Block)
    return first.states_after(blocks, _normalized(blocks, first.norm, torch.cat(prefix, dim=1)))


def joined(blocks: Blocks, name: str) -> Tensor:
    """Concatenate one parameter of all blocks along its first dimension."""
    return torch.cat([attrgetter(name)(block) for block in blocks])


def stacked(blocks: Blocks, name: str, rows: int | None = None) -> Tensor:
    """Stack the first ``rows`` of one parameter of all blocks: ``[depth, rows, ..]``."""
    return torch.stack([attrgetter(name)(block) for block in blocks])[:, :rows]


def product(tokens: Tensor, matrices: Tensor) -> Tensor:
    """Multiply each block's tokens by its matrix: ``[B, K, depth, in]`` to ``[.., out]``."""
    rows = tokens.flatten(0, 1).transpose(0, 1)
    return torch.bmm(rows, matrices.mT).transpose(0, 1).unflatten(0, tokens.shape[:2])


def _normalized(blocks: Blocks, norm: nn.LayerNorm | nn.RMSNorm, tokens: Tensor) -> Tensor:
    """Apply each block's own norm: ``[B, K, depth·width]`` to ``[B, K, depth, width]``."""
    tokens = tokens.unflatten(2, (len(blocks), -1)).float()
    if isinstance(norm, nn.RMSNorm):
        return F.rms_norm(tokens, norm.normalized_shape, None, norm.eps) * stacked(
            blocks, "norm.weight"
        )
    tokens = F.layer_norm(tokens, norm.normalized_shape, None, None, norm.eps)
    return torch.addcmul(stacked(blocks, "norm.bias"), tokens, stacked(blocks, "norm.weight"))


class Mixed(NamedTuple):
    """Condition tokens that a block mixes into the 3DGS tokens.

    Attributes:
        tokens: ``[B, K, width]``, projected and normalised, camera first.
    """

    tokens: Tensor


def mixed_positions(count: int, cu_seqlens: Tensor) -> Tensor:
    """Position of each token in the common row, if condition tokens are mixed in.

    Of K such tokens and a picture's L 3DGS tokens, token k = 0 .. K-1 comes before the 3DGS token
    number floor((k + 1) L / (K + 1)), so that they cut the 3DGS tokens into K + 1 pieces of nearly
    equal length. A Mamba block then runs over all K + L tokens, and the outputs of the K are
    dropped.

    Args:
        count: K.
        cu_seqlens: ``[B + 1]`` int64, borders of each picture's 3DGS tokens.

    Returns:
        ``[B K + T]`` int64, a permutation: the positions of each picture's K tokens, then those of
        all 3DGS tokens.
    """
    steps = torch.arange(1, count + 1, device=cu_seqlens.device)
    before = cu_seqlens[:-1, None] + steps * cu_seqlens.diff()[:, None] // (count + 1)
    before = before.flatten()
    tokens = torch.arange(int(cu_seqlens[-1]), device=cu_seqlens.device)
    passed = torch.searchsorted(before, tokens, right=True)
    return torch.cat([before + torch.arange(len(before), device=tokens.device), tokens + passed])
