"""Blocks of mamba-ssm's language models and their initial weights."""

from __future__ import annotations

import math
from functools import partial

import torch
from torch import nn

from ...shared import one_of
from ..modules.block import Block
from ..modules.mamba_simple import Mamba
from ..ops.triton.layer_norm import RMSNorm


def create_block(
    d_model: int, d_intermediate: int = 0, ssm_cfg: dict | None = None,
    attn_layer_idx: list | None = None, attn_cfg: dict | None = None, norm_epsilon: float = 1e-5,
    rms_norm=False, residual_in_fp32=False, fused_add_norm=False, layer_idx: int | None = None,
    device=None, dtype=None,
) -> Block:  # fmt: skip
    """Make a block around a Mamba layer with the arguments ``ssm_cfg``.

    Raises:
        ValueError: an MLP, attention or another layer than Mamba-1 is asked for.
    """
    one_of("d_intermediate", d_intermediate, 0)
    one_of("attn_layer_idx", attn_layer_idx or [], [])
    options, at = {"layer": "Mamba1", **(ssm_cfg or {})}, {"device": device, "dtype": dtype}
    one_of("ssm_cfg['layer']", options.pop("layer"), "Mamba1")
    mixer = partial(Mamba, layer_idx=layer_idx, **options, **at)
    norm = partial(RMSNorm if rms_norm else nn.LayerNorm, eps=norm_epsilon, **at)
    block = Block(d_model, mixer, nn.Identity, norm, fused_add_norm, residual_in_fp32)
    block.layer_idx = layer_idx
    return block


def _init_weights(
    module: nn.Module, n_layer: int, initializer_range: float = 0.02,
    rescale_prenorm_residual: bool = True, n_residuals_per_layer: int = 1,
) -> None:  # fmt: skip
    """Initialize a module as GPT-2's: small embeddings, residual branches over the root of all."""
    if isinstance(module, nn.Embedding):
        nn.init.normal_(module.weight, std=initializer_range)
    elif isinstance(module, nn.Linear) and not getattr(module.bias, "_no_reinit", False):
        if module.bias is not None:
            nn.init.zeros_(module.bias)
    for name, weight in module.named_parameters() if rescale_prenorm_residual else ():
        if name in ("out_proj.weight", "fc2.weight"):
            nn.init.kaiming_uniform_(weight, a=math.sqrt(5))  # again, as it is called repeatedly
            with torch.no_grad():
                weight /= math.sqrt(n_residuals_per_layer * n_layer)
