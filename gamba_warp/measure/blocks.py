"""Benchmark cases of the model's blocks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..kernels.bench.core.case import (
    BOTH,
    Case,
    Error,
    Settings,
    Variant,
    compare,
    make_cases,
)
from ..kernels.bench.core.problem import Problem
from ..kernels.causal_conv1d.reference import causal_conv1d_reference
from ..kernels.selective_scan.reference import selective_scan_reference
from ..model.config import PRESETS, GambaConfig
from ..model.parts.block import GambaBlock, prefix_states, run_blocks

LIMIT, BACKWARD_LIMIT = 1e-5, 1e-4  # allowed relative rms error to float64
_IMAGE_CHANNELS, _IMAGE_TOKENS = 768, 576  # as of DINOv2 ViT-B/14 at 336 pixels
TOKENS = 128  # number of first tokens compared with the oracle


def cases(settings: Settings) -> list[Case]:
    """Return all cases of blocks at the level's sizes."""
    blocks = [("one block", one_block, "error"), ("backbone", whole_backbone, "error")]
    return make_cases("block", settings, blocks)


class Backbone(Problem):
    """Blocks of the paper's size with the condition of one image."""

    def __init__(self, settings: Settings, depth: int) -> None:
        quick = settings.level == "quick"
        config = GambaConfig(dt_rank=8, width=128) if quick else PRESETS["paper"]
        torch.manual_seed(0)
        channels = _IMAGE_CHANNELS
        blocks = (GambaBlock(config, channels, channels) for _ in range(depth))
        self.blocks = [block.to(settings.device) for block in blocks]
        self.depth, self.device = depth, settings.device
        self.length = 1024 if quick else config.num_gaussians
        tokens = torch.randn(1, self.length, config.width)
        camera, image = torch.randn(1, 1, channels), torch.randn(1, _IMAGE_TOKENS, channels)
        self.tokens, self.camera, self.image = (x.to(self.device) for x in (tokens, camera, image))
        self.sizes = {"L": self.length, "D": config.width, "depth": depth}

    def run(self, tokens: Tensor) -> Tensor:
        """Run the blocks like ``Gamba.forward``: the prefix states, then the tokens."""
        states = prefix_states(self.blocks, self.camera, self.image)
        return run_blocks(self.blocks, tokens, states)

    @torch.no_grad()
    def forward(self) -> Tensor:
        """Run the blocks without gradients (timed)."""
        return self.run(self.tokens)

    @torch.no_grad()
    def prepended(self) -> Tensor:
        """Run the paper's eq. 2 literally, prepending and dropping (timed)."""
        tokens = self.tokens
        for block in self.blocks:
            assert block.project_camera is not None and block.project_image is not None
            prefix = [block.project_camera(self.camera), block.project_image(self.image)]
            hidden, _ = block.mamba(block.norm(torch.cat([*prefix, tokens], dim=1)))
            tokens = tokens + hidden[:, -self.length :]
        return tokens

    def backward(self) -> tuple[Tensor, ...]:
        """Run forward and backward, with the tokens as cotangent (timed).

        Returns the gradients of the tokens and of all weights.
        """
        tokens = self.tokens.detach().requires_grad_()
        leaves = [tokens, *(p for block in self.blocks for p in block.parameters())]
        return torch.autograd.grad(self.run(tokens), leaves, self.tokens)

    def oracle(self, direction: str) -> str:
        """Return a description of the check's reference."""
        text = f"float64 with the condition prepended, first {TOKENS} of {self.length} tokens"
        return text + (", gradient of these tokens" if direction == BOTH else "")

    def limit(self, direction: str, dtype: torch.dtype = torch.float32) -> float:
        """Return the largest allowed error."""
        return BACKWARD_LIMIT if direction == BOTH else LIMIT

    def forward_variant(self, name: str, run: Callable[[], Tensor], **changes) -> Variant:
        """Return a variant that runs the blocks forward by another function."""
        return self.variant(name, run=run, check=partial(self.check, "forward", run), **changes)

    def check(self, direction: str, run: Callable[[], Tensor] | None = None) -> Error:
        """Measure the error of the update of the first tokens, which depend on no later one.

        Or of their gradient, with a cotangent of 0 after them.
        """
        first = self.tokens[:, :TOKENS].double().cpu().requires_grad_(direction == BOTH)
        with torch.set_grad_enabled(direction == BOTH):
            tokens = first
            for block in self.blocks:
                tokens = reference_block(block, tokens, self.camera, self.image)
        if direction != BOTH:
            got = (run or self.forward)()[:, :TOKENS].double().cpu()
            return compare({"update": got - first}, {"update": tokens - first})
        leaf = self.tokens.detach().requires_grad_()
        cotangent = self.tokens.clone()
        cotangent[:, TOKENS:] = 0
        (got,) = torch.autograd.grad(self.run(leaf), [leaf], cotangent)
        (want,) = torch.autograd.grad(tokens, [first], first.detach())
        name = "gradient of the tokens"
        return compare({name: got[:, :TOKENS]}, {name: want})


def reference_block(
    block: GambaBlock, tokens: Tensor, camera: Tensor | None, image: Tensor | None
) -> Tensor:
    """Run one Gamba block in float64 torch on the CPU, prepending and dropping (paper eq. 2).

    Args:
        block: with the weights.
        tokens: ``[B, L, width]`` float64.
        camera: ``[B, 1, channels]``; None for a block without this condition.
        image: ``[B, K, channels]``, or None likewise.

    Returns:
        ``[B, L, width]`` float64.
    """
    weights = {name: p.detach().double().cpu() for name, p in block.named_parameters()}

    def linear(x: Tensor, name: str) -> Tensor:
        return F.linear(x, weights[f"{name}.weight"], weights.get(f"{name}.bias"))

    mamba, width = block.mamba, tokens.shape[2]
    conditions = {"project_camera": camera, "project_image": image}
    prefix = [linear(x.double().cpu(), name) for name, x in conditions.items() if x is not None]
    x = torch.cat([*prefix, tokens], dim=1)
    if isinstance(block.norm, nn.RMSNorm):
        x = F.rms_norm(x, (width,), weights["norm.weight"], block.norm.eps)
    else:
        x = F.layer_norm(x, (width,), weights["norm.weight"], weights["norm.bias"], block.norm.eps)
    x, z = linear(x, "mamba.in_proj").chunk(2, dim=-1)
    x, _ = causal_conv1d_reference(
        x, weights["mamba.conv_weight"], weights["mamba.conv_bias"], activation="silu"
    )
    low_rank, B, C = linear(x, "mamba.x_proj").split(mamba.split, dim=-1)
    y, _ = selective_scan_reference(
        x,
        linear(low_rank, "mamba.dt_proj"),
        -torch.exp(weights["mamba.A_log"]),
        B,
        C,
        D=weights["mamba.D"],
        z=z,
        delta_softplus=True,
        discretization=mamba.discretization,
    )
    return tokens + linear(y, "mamba.out_proj")[:, -tokens.shape[1] :]


def one_block(settings: Settings) -> list[Variant]:
    """A block of the paper's size on one picture's tokens. Prefix states off: condition prepended
    and dropped, as the paper has it. For one block alone that costs the same; the states of all
    blocks are computed at once, which pays over the depth (backbone).
    """
    backbone = Backbone(settings, 1)
    return [*_forwards(backbone), backbone.variant("default", BOTH, default=True)]


def whole_backbone(settings: Settings) -> list[Variant]:
    """All blocks of the paper's size, the condition's states included, and with the condition
    prepended and dropped in each block.
    """
    rounds = 3 if settings.level == "normal" else None  # one takes seconds
    return _forwards(Backbone(settings, 2 if settings.level == "quick" else 14), rounds=rounds)


def _forwards(backbone: Backbone, **changes) -> list[Variant]:
    return [
        backbone.variant("default", default=True, **changes),
        backbone.forward_variant("prefix states off", backbone.prepended, **changes),
    ]
