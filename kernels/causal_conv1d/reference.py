"""The oracle: the causal convolution as plain torch, in any float dtype."""

from __future__ import annotations

from functools import reduce

import torch
import torch.nn.functional as F
from torch import Tensor


def causal_conv1d_reference(
    x: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    initial_state: Tensor | None = None,
    activation: str | None = None,
) -> tuple[Tensor, Tensor]:
    """Depthwise causal convolution, channels last. Returns (out, final state [B, W-1, D])."""
    width = weight.shape[1]
    if initial_state is None:
        initial_state = x.new_zeros(x.shape[0], width - 1, x.shape[2])
    padded = torch.cat([initial_state, x], 1)
    length = x.shape[1]
    out = reduce(torch.add, (weight[:, k] * padded[:, k : k + length] for k in range(width)))
    if bias is not None:
        out = out + bias
    if activation is not None:
        out = F.silu(out)
    return out, padded[:, padded.shape[1] - (width - 1) :]
