"""Colours from three planes of features: the decoder ``triplane`` (paper, question Q3, answer A3).

The blocks and tokens of the other decoders give positions, sizes and opacities of the Gaussians. A
second branch of blocks of the same depth and width, after the same prefix, turns learned tokens
into three square planes of features in x and y, x and z, y and z, which span ±``position_range``.
All three are sampled at each Gaussian's centre, and an MLP turns the features into its colour.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ...gaussians import Gaussians
from ..config import GambaConfig
from .block import make_norm, run_blocks
from .decoder import GaussianDecoder
from .weights import init_normal

AXES = ((0, 1), (0, 2), (1, 2))  # of the planes: the first along a row, the second down a column


class PlaneBranch(nn.Module):
    """Branch that makes the planes: 3n² learned tokens, its own blocks, norm and projection."""

    def __init__(self, config: GambaConfig, blocks: nn.ModuleList) -> None:
        """Build the branch around blocks, whose states ``prefix_states`` computes separately."""
        super().__init__()
        side, features = config.triplane_size, config.triplane_features
        self.sides = 3, side, side
        self.embedding = nn.Parameter(torch.empty(3 * side**2, config.width))
        init_normal(self.embedding, std=config.embedding_init)
        vars(self.embedding)["_no_weight_decay"] = True
        self.blocks = blocks
        self.norm = make_norm(config, final=True)
        self.features = nn.Linear(config.width, features)
        init_normal(self.features.weight, std=config.width**-0.5)
        nn.init.zeros_(self.features.bias)

    def forward(self, batch: int, states: Sequence[Any], checkpointing: bool = False) -> Tensor:
        """Make the planes of ``batch`` images: ``[B, 3, features, n, n]``.

        Args:
            batch: B.
            states: of ``blocks``, after the prefix of these images.
            checkpointing: as for ``run_blocks``.
        """
        tokens = self.embedding.expand(batch, -1, -1)
        tokens = run_blocks(self.blocks, tokens, states, checkpointing)
        return self.features(self.norm(tokens)).unflatten(1, self.sides).permute(0, 1, 4, 2, 3)


def query_planes(planes: Tensor, points: Tensor) -> Tensor:
    """Sample three planes at points, bilinearly between the four nearest cells' centres.

    Args:
        planes: ``[B, 3, C, n, n]``, in the order of ``AXES``.
        points: ``[B, N, 3]``, where -1 and 1 are the outer edges of the planes. Beyond the centres
            of the outermost cells a plane is constant.

    Returns:
        ``[B, N, 3C]``, the planes one after the other.
    """
    coordinates = torch.stack([points[..., list(axes)] for axes in AXES], 1)
    sampled = F.grid_sample(
        planes.flatten(0, 1),
        coordinates.flatten(0, 1)[:, None],
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )
    return sampled[:, :, 0].unflatten(0, (-1, 3)).permute(0, 3, 1, 2).flatten(2)


class TriplaneDecoder(GaussianDecoder):
    """``GaussianDecoder`` with an MLP of the planes' features instead of a head for colours."""

    colored = False

    def __init__(self, config: GambaConfig) -> None:
        super().__init__(config)
        width, features = config.decoder_width or config.width, 3 * config.triplane_features
        first, second = nn.Linear(features, width), nn.Linear(width, width)
        self.plane_mlp = nn.Sequential(first, nn.SiLU(), second, nn.SiLU())
        self.init_mlp(first, second)
        self.plane_color = nn.Linear(width, 3)
        self.init_head(self.plane_color)

    def forward(self, tokens: Tensor, planes: Tensor) -> Gaussians:
        """Decode tokens and planes to Gaussians in float32.

        Args:
            tokens: ``[B, L, width]``.
            planes: the result of ``PlaneBranch``.

        Returns:
            ``[B, L]``; the ranges are as in ``GaussianDecoder``. Positions get no gradient
            through the sampling of the planes (nor do they in the authors' public code).
        """
        parts = self.shapes(self.mlp(tokens))
        points = parts["means"].detach() / self.config.position_range
        hidden = self.plane_mlp(query_planes(planes.float(), points))
        with torch.autocast(tokens.device.type, enabled=False):
            return Gaussians(**parts, colors=self.plane_color(hidden.float()).sigmoid())
