"""Mamba layer (Gu & Dao 2023) with states before and after its tokens."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ...kernels.causal_conv1d import causal_conv1d
from ...kernels.runtime.packed import Packed
from ...kernels.selective_scan import selective_scan
from ..config import GambaConfig

STEP_RANGE = (1e-3, 1e-1)  # of the step size δ at the start, log-uniform (Mamba, §3.6)


class State(NamedTuple):
    """State of a Mamba layer after some tokens.

    Attributes:
        conv: ``[B, conv_size - 1, inner_width]``, the convolution's last inputs.
        scan: ``[B, inner_width, state_size]`` float32, the SSM's state.
        A: ``[inner_width, state_size]`` float32, -exp(A_log), if made for all blocks together.
    """

    conv: Tensor
    scan: Tensor
    A: Tensor | None = None


class Mamba(nn.Module):
    """Mamba layer, channels last.

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
