"""The condition as a state: the paper's eq. 2 without the prefix's outputs.

In a Mamba block a token depends on the tokens before it only through two small states. A block
prepends the condition, drops its outputs, and the next block prepends it again. The condition thus
contributes only the pair of states after it, which does not depend on the 3DGS tokens. So the
states of all blocks are computed at once, and the blocks then run over the 3DGS tokens only. The
result equals prepending and dropping.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ...kernels.causal_conv1d import causal_conv1d
from ...kernels.selective_scan import selective_scan_state
from .mamba import State

Blocks = Sequence[nn.Module] | nn.ModuleList


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
    first: Any = blocks[0]
    return first.states_after(blocks, _normalized(blocks, first.norm, torch.cat(prefix, dim=1)))


def mamba_states(blocks: Blocks, prefix: Tensor) -> list[State]:
    """Compute the state of each block's Mamba layer after its prefix, all blocks together.

    One batched product per kind of matrix, one convolution and one scan in which each block is a
    group of channels. The gate z, C, D and the output projection, needed only for the dropped
    outputs, are left out.

    Args:
        blocks: blocks with a layer ``mamba``, all of one configuration.
        prefix: ``[B, K, depth, width]``, K > 0, the normalised prefix of each.
    """
    first: Any = blocks[0]
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
