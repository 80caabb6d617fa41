"""Residual blocks of mamba-ssm: the sum with the residual, a norm, then the mixer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from ..ops.triton.layer_norm import RMSNorm, layer_norm_fn


class Block(nn.Module):
    """Block of mamba-ssm 2; version 1 is in ``mamba_simple``. Weights: ``norm``, ``mixer``; with
    an MLP also ``norm2``, ``mlp``.
    """

    layer_idx: int | None = None

    def __init__(
        self, dim: int, mixer_cls: Callable, mlp_cls: Callable = nn.Identity,
        norm_cls: Callable = nn.LayerNorm, fused_add_norm=False, residual_in_fp32=False,
    ) -> None:  # fmt: skip
        super().__init__()
        self.fused_add_norm, self.residual_in_fp32 = fused_add_norm, residual_in_fp32
        self.norm, self.mixer = norm_cls(dim), mixer_cls(dim)
        self.norm2 = self.mlp = None
        if mlp_cls is not nn.Identity:
            self.norm2, self.mlp = norm_cls(dim), mlp_cls(dim)

    def forward(
        self, hidden_states: Tensor, residual: Tensor | None = None, inference_params=None, **kwargs
    ) -> tuple[Tensor, Tensor]:
        """Return the output of the mixer or MLP, ``[B, L, dim]``, and the residual for the next."""
        hidden_states, residual = add_norm(self, self.norm, hidden_states, residual)
        hidden_states = self.mixer(hidden_states, inference_params=inference_params, **kwargs)
        if self.mlp is not None:
            hidden_states, residual = add_norm(self, self.norm2, hidden_states, residual)
            hidden_states = self.mlp(hidden_states)
        return hidden_states, residual

    def allocate_inference_cache(self, batch_size: int, max_seqlen: int, dtype=None, **kwargs):
        """Make the mixer's states before the first token."""
        return self.mixer.allocate_inference_cache(batch_size, max_seqlen, dtype=dtype, **kwargs)


def add_norm(owner: Any, norm: Any, x: Tensor, residual: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the norm of the sum and the sum, with the two switches of the owner."""
    if owner.fused_add_norm:
        options = {"prenorm": True, "residual_in_fp32": owner.residual_in_fp32, "eps": norm.eps}
        rms = isinstance(norm, RMSNorm)
        return layer_norm_fn(x, norm.weight, norm.bias, residual, is_rms_norm=rms, **options)
    total = x if residual is None else x + residual
    out = norm(total.to(norm.weight.dtype))
    return out, total.to(torch.float32) if owner.residual_in_fp32 else total
