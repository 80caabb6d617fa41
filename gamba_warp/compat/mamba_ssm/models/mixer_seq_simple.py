"""Language model of Mamba-1 blocks, with mamba-ssm's names of arguments and weights."""

from __future__ import annotations

import json
import math
from collections import namedtuple
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ....files import atomic_path, write_text
from ...shared import one_of
from ..modules.block import Block, add_norm
from ..modules.mamba_simple import Mamba
from ..ops.triton.layer_norm import RMSNorm
from ..utils.generation import GenerationMixin
from ..utils.hf import load_config_hf, load_state_dict_hf
from .config_mamba import MambaConfig

CausalLMOutput = namedtuple("CausalLMOutput", ["logits"])


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
    block = Block(
        d_model,
        mixer,
        norm_cls=norm,
        fused_add_norm=fused_add_norm,
        residual_in_fp32=residual_in_fp32,
    )
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
            nn.init.kaiming_uniform_(weight, a=math.sqrt(5))  # afresh, as it is called repeatedly
            with torch.no_grad():
                weight /= math.sqrt(n_residuals_per_layer * n_layer)


class MixerModel(nn.Module):
    """Embedding, blocks and a last norm: ``embedding``, ``layers``, ``norm_f``."""

    def __init__(
        self, d_model: int, n_layer: int, d_intermediate: int = 0, vocab_size: int | None = None,
        *, norm_epsilon: float = 1e-5, rms_norm=False, initializer_cfg: dict | None = None,
        fused_add_norm=False, residual_in_fp32=False, device=None, dtype=None, **of_blocks: Any,
    ) -> None:  # fmt: skip
        super().__init__()
        if vocab_size is None:
            raise TypeError("vocab_size is None, allowed is an integer")
        self.fused_add_norm, self.residual_in_fp32 = fused_add_norm, residual_in_fp32
        self.embedding = nn.Embedding(vocab_size, d_model, device=device, dtype=dtype)
        of_blocks |= {"norm_epsilon": norm_epsilon, "rms_norm": rms_norm}
        of_blocks |= {"fused_add_norm": fused_add_norm, "residual_in_fp32": residual_in_fp32}
        block = partial(create_block, d_model, d_intermediate, device=device, dtype=dtype)
        self.layers = nn.ModuleList(block(layer_idx=i, **of_blocks) for i in range(n_layer))
        norm = RMSNorm if rms_norm else nn.LayerNorm
        self.norm_f = norm(d_model, eps=norm_epsilon, device=device, dtype=dtype)
        self.apply(partial(_init_weights, n_layer=n_layer, **(initializer_cfg or {})))

    def allocate_inference_cache(self, batch_size: int, max_seqlen: int, dtype=None, **kwargs):
        """Make the states of all layers, by their numbers."""
        layers: Any = self.layers
        made = (x.allocate_inference_cache(batch_size, max_seqlen, dtype) for x in layers)
        return dict(enumerate(made))

    def forward(self, input_ids: Tensor, inference_params=None, **kwargs) -> Tensor:
        """Return ``[B, L, d_model]`` for tokens ``[B, L]``."""
        x, residual = self.embedding(input_ids), None
        for layer in self.layers:
            x, residual = layer(x, residual, inference_params=inference_params, **kwargs)
        return add_norm(self, self.norm_f, x, residual)[0]


class MambaLMHeadModel(nn.Module, GenerationMixin):
    """``MixerModel`` as ``backbone``, and ``lm_head``, tied to the embedding or not."""

    def __init__(self, config: MambaConfig, initializer_cfg=None, device=None, dtype=None) -> None:
        super().__init__()
        self.config = config
        given: dict[str, Any] = asdict(config)
        given["vocab_size"] += -config.vocab_size % given.pop("pad_vocab_size_multiple")
        del given["tie_embeddings"]
        at: dict[str, Any] = {"device": device, "dtype": dtype}
        self.backbone = MixerModel(**given, initializer_cfg=initializer_cfg, **at)
        self.lm_head = nn.Linear(config.d_model, given["vocab_size"], bias=False, **at)
        self.apply(partial(_init_weights, n_layer=config.n_layer, **(initializer_cfg or {})))
        self.tie_weights()

    def tie_weights(self) -> None:
        """Make the head's weight that of the embedding, if the configuration says so."""
        if self.config.tie_embeddings:
            self.lm_head.weight = self.backbone.embedding.weight

    def allocate_inference_cache(self, batch_size: int, max_seqlen: int, dtype=None, **kwargs):
        """Make the states of all layers, by their numbers."""
        return self.backbone.allocate_inference_cache(batch_size, max_seqlen, dtype, **kwargs)

    def forward(
        self, input_ids: Tensor, position_ids=None, inference_params=None, num_last_tokens=0, **kw
    ) -> CausalLMOutput:
        """Return the logits ``[B, L, vocab_size]``, or those of the last tokens only."""
        x = self.backbone(input_ids, inference_params=inference_params, **kw)
        return CausalLMOutput(self.lm_head(x[:, -num_last_tokens:]))  # 0: all

    @classmethod
    def from_pretrained(cls, pretrained_model_name: str, device=None, dtype=None, **kwargs: Any):
        """Read a folder with ``config.json`` and ``pytorch_model.bin``, or a repository's."""
        config = MambaConfig(**load_config_hf(pretrained_model_name))
        model = cls(config, device=device, dtype=dtype, **kwargs)
        model.load_state_dict(load_state_dict_hf(pretrained_model_name, device=device, dtype=dtype))
        return model

    def save_pretrained(self, save_directory: str) -> None:
        """Write both files into a folder, which is made."""
        folder = Path(save_directory)
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_path(folder / "pytorch_model.bin") as path:
            torch.save(self.state_dict(), path)
        write_text(folder / "config.json", json.dumps(asdict(self.config), indent=4))
