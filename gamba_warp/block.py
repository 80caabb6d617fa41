"""The Gamba block: prepend the condition, run a Mamba block, drop the condition (paper eq. 2)."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from .config import GambaConfig
from .kernels.selective_scan import causal_conv1d, selective_scan

STEP_RANGE = (1e-3, 1e-1)  # of the step size δ at the start, log-uniform (Mamba, §3.6)


def make_norm(config: GambaConfig) -> nn.Module:
    """LayerNorm or RMSNorm over a token's channels, with eps 1e-5."""
    kind = nn.LayerNorm if config.norm == "layer" else nn.RMSNorm
    norm = kind(config.width, eps=1e-5)
    for parameter in norm.parameters():
        parameter._no_weight_decay = True
    return norm


class Mamba(nn.Module):
    """The vanilla Mamba block (Gu & Dao 2023), channels last.

    Parameters have mamba-ssm's names, shapes and row order (``x_proj``: step rank, B, C), so its
    weights load unchanged, but for the convolution's, which lack its middle axis of length 1.
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
        """As mamba-ssm's defaults (version 2.2)."""
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
        # One residual branch per block: the sum over the depth keeps the variance of one branch.
        self.out_proj.weight.div_(math.sqrt(config.depth))
        for parameter in (self.A_log, self.D, self.conv_bias, self.dt_proj.bias):
            parameter._no_weight_decay = True

    def forward(self, tokens: Tensor) -> Tensor:
        """``[B, L, width]`` to ``[B, L, width]``; a token sees itself and those before it."""
        x, z = self.in_proj(tokens).chunk(2, dim=-1)
        x = causal_conv1d(x, self.conv_weight, self.conv_bias, activation="silu")
        low_rank, B, C = self.x_proj(x).split(self.split, dim=-1)
        # The bias is added inside the scan, in float32: δ of 1e-3 does not survive bfloat16.
        delta = nn.functional.linear(low_rank, self.dt_proj.weight)
        y = selective_scan(
            x,
            delta,
            -torch.exp(self.A_log.float()),
            B,
            C,
            D=self.D.float(),
            z=z,
            delta_bias=self.dt_proj.bias.float(),
            delta_softplus=True,
            discretization=self.discretization,
        )
        return self.out_proj(y)


class GambaBlock(nn.Module):
    """One Gamba block: G_n = G_{n-1} + Drop(Mamba(Norm(Prepend(P_c T, P_x X, G_{n-1})))).

    The prefix has no residual of its own, since it is dropped and made afresh in each block.
    """

    def __init__(self, config: GambaConfig, camera_channels: int, image_channels: int) -> None:
        """Zero channels mean that there is no such condition."""
        super().__init__()
        width = config.width
        self.project_camera = nn.Linear(camera_channels, width) if camera_channels else None
        self.project_image = nn.Linear(image_channels, width) if image_channels else None
        self.norm = make_norm(config)
        self.mamba = Mamba(config)

    def prefix(self, camera: Tensor | None, image: Tensor | None) -> list[Tensor]:
        """The projected condition, each ``[B, ·, width]``: camera first, as the paper has it."""
        parts = [(self.project_camera, camera), (self.project_image, image)]
        return [project(tokens) for project, tokens in parts if project is not None]

    def forward(self, tokens: Tensor, camera: Tensor | None, image: Tensor | None) -> Tensor:
        """Refines the 3DGS tokens.

        Args:
            tokens: ``[B, L, width]``.
            camera: ``[B, 1, camera_channels]``, or None where the block has no such condition.
            image: ``[B, K, image_channels]``, likewise.

        Returns:
            ``[B, L, width]``.
        """
        prepended = torch.cat([*self.prefix(camera, image), tokens], dim=1)
        dropped = prepended.shape[1] - tokens.shape[1]
        hidden = self.mamba(self.norm(prepended))
        return tokens + hidden[:, dropped:]
