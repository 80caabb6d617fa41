"""Decoder from tokens to Gaussians, with all activations (paper §3.2, Gaussian Decoder)."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ...gaussians import Gaussians
from ..config import GambaConfig
from .weights import init_normal

MIN_SCALE = 1e-6  # object units; keeps the logarithm stored in files finite


class GaussianDecoder(nn.Module):
    """Shared MLP with one hidden layer, then one linear head for each attribute.

    Attributes:
        colored: True if it has a head for colours.
    """

    colored = True
    points: Tensor

    def __init__(self, config: GambaConfig) -> None:
        super().__init__()
        self.config = config
        width = config.decoder_width or config.width
        # The last SiLU keeps the heads from merging with the MLP's second layer.
        first, second = nn.Linear(config.width, width), nn.Linear(width, width)
        self.mlp = nn.Sequential(first, nn.SiLU(), second, nn.SiLU())
        self.position = nn.Linear(width, 3 * config.position_bins)
        self.opacity = nn.Linear(width, 1)
        self.scale = nn.Linear(width, 3)
        self.color = nn.Linear(width, 3) if self.colored else None
        self.rotation = nn.Linear(width, 4) if config.predict_rotation else None
        limit = config.position_range
        points = torch.linspace(-limit, limit, config.position_bins)
        self.register_buffer("points", points, persistent=False)
        self._init_weights(first, second)

    def _init_weights(self, first: nn.Linear, second: nn.Linear) -> None:
        config = self.config
        self.init_mlp(first, second)
        for head in (self.opacity, self.scale, self.color, self.rotation):
            if head is not None:
                self.init_head(head)
        # A softmax over near-zero logits puts every Gaussian at the centre; opaque Gaussians at one
        # point are the collapse that the radial mask loss is to prevent. Logits of deviation 1.5
        # spread the centres by about 0.1 per axis: inside any object, and far from a saturated
        # softmax, whose gradient would vanish.
        fan_in = 0.356 * self.position.in_features
        init_normal(self.position.weight, std=config.position_init * fan_in**-0.5)
        nn.init.zeros_(self.position.bias)
        odds = config.opacity_init / (1 - config.opacity_init)
        nn.init.constant_(self.opacity.bias, math.log(odds))
        nn.init.constant_(
            self.scale.bias, math.log(math.expm1(config.scale_init / config.scale_factor))
        )
        if self.rotation is not None:
            with torch.no_grad():
                self.rotation.bias[0] = 1.0

    @staticmethod
    def init_mlp(first: nn.Linear, second: nn.Linear) -> None:
        """Give unit variance before each SiLU, whose mean square on a unit normal is 0.356."""
        for layer in (first, second):
            nn.init.zeros_(layer.bias)
        init_normal(first.weight, std=first.in_features**-0.5)
        init_normal(second.weight, std=(0.356 * second.in_features) ** -0.5)

    @staticmethod
    def init_head(head: nn.Linear) -> None:
        """Make the output of a head almost 0 at the start."""
        init_normal(head.weight, std=0.02)
        nn.init.zeros_(head.bias)

    def forward(self, tokens: Tensor) -> Gaussians:
        """Decode ``tokens [B, L, width]`` to ``[B, L]`` Gaussians in float32.

        Positions lie within ±``position_range`` (with unit weights beyond), opacities and colours
        in [0, 1], scales above 0.
        """
        hidden = self.mlp(tokens)
        assert self.color is not None
        with torch.autocast(tokens.device.type, enabled=False):
            return Gaussians(**self.shapes(hidden), colors=self.color(hidden.float()).sigmoid())

    def shapes(self, hidden: Tensor) -> dict[str, Any]:
        """Decode all but the colours, float32, from the MLP's ``[B, L, channels]``."""
        # bfloat16 would move a centre by up to 0.002, more than a pixel's width at 512².
        with torch.autocast(hidden.device.type, enabled=False):
            hidden = hidden.float()
            logits = self.position(hidden).unflatten(-1, (3, -1))
            unit = self.config.position_weights == "unit"
            weights = F.normalize(logits, dim=-1) if unit else logits.softmax(-1)
            return {
                "means": (weights * self.points).sum(-1),  # no matrix product: GPUs may round it
                "quats": None if self.rotation is None else self.rotation(hidden),
                "scales": self.config.scale_factor * F.softplus(self.scale(hidden)) + MIN_SCALE,
                "opacities": self.opacity(hidden)[..., 0].sigmoid(),
            }
