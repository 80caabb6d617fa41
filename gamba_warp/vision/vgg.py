"""VGG16's convolutions, which serve as the trunk of LPIPS and as an encoder of image tokens."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from ..conventions import IMAGENET_MEAN, IMAGENET_STD
from .weights import CONVS, WIDTHS, read_cached, read_torchvision

FULL_BLOCKS = 4  # of the five, which ``VGG16Trunk.lower`` computes in float32


class _Convolved(torch.autograd.Function):
    """A convolution and its ReLU in float32, whose gradient is a convolution in bfloat16.

    The gradient by the picture is the convolution with the turned kernel. The ReLU's mask is that
    of float32, whose changes are what spoils a gradient when the forward pass is rounded.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, layer: nn.Conv2d, turned: Tensor) -> Tensor:
        y = F.relu(layer(x))
        ctx.save_for_backward(y, turned)
        return y

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor, None, None]:
        y, turned = ctx.saved_tensors
        passed = torch.where(y > 0, cotangents[0], 0.0).to(turned.dtype)
        return F.conv2d(passed, turned, padding=1).to(y.dtype), None, None


class VGG16Trunk(nn.Module):
    """VGG16's 13 convolutions, frozen, with torchvision's names."""

    def __init__(self) -> None:
        super().__init__()
        # Weights in bfloat16 by layer, made when they are first asked for.
        self._turned: dict[str, Tensor] = {}
        self._rounded: dict[str, nn.Conv2d] = {}
        self.features = nn.ModuleDict()
        channels = 3
        for layers, width in zip(CONVS, WIDTHS, strict=True):
            for number in layers:
                self.features[str(number)] = nn.Conv2d(channels, width, 3, padding=1)
                channels = width
        self.requires_grad_(False)

    def forward(self, x: Tensor) -> list[Tensor]:
        """Maps normalised ``[B, 3, H, W]`` to the features relu1_2, 2_2, 3_3, 4_3 and 5_3.

        Raises:
            ValueError: the pictures are smaller than 16 pixels.
        """
        if min(x.shape[-2:]) < 16:
            raise ValueError(f"pictures are {x.shape[-1]}x{x.shape[-2]}; VGG16 needs 16x16 or more")
        outputs = []
        for block, layers in enumerate(CONVS):
            x = F.max_pool2d(x, 2) if block else x
            for number in layers:
                x = F.relu(self.features[str(number)](x))
            outputs.append(x)
        return outputs

    def lower(self, x: Tensor) -> list[Tensor]:
        """``forward`` with products in bfloat16 where little depends on them.

        These are all of the gradient, and those of block 5; the first four blocks are
        float32 in the forward pass. (docs/step.md has what each choice gives.)
        """
        if not self._turned or next(iter(self._turned.values())).device != x.device:
            self._lower_weights()
        outputs = []
        for block, layers in enumerate(CONVS):
            x = F.max_pool2d(x, 2) if block else x
            full = block < FULL_BLOCKS
            x = x if full else x.bfloat16()
            for number in map(str, layers):
                if full:
                    x = _Convolved.apply(x, self.features[number], self._turned[number])
                else:
                    x = F.relu(self._rounded[number](x))
            outputs.append(x)
        return outputs

    @torch.no_grad()
    def _lower_weights(self) -> None:
        for block, layers in enumerate(CONVS):
            for number in map(str, layers):
                layer = self.features[number]
                assert isinstance(layer, nn.Conv2d)
                if block >= FULL_BLOCKS:
                    self._rounded[number] = copy.deepcopy(layer).bfloat16()
                    continue
                turned = layer.weight.flip(2, 3).transpose(0, 1).bfloat16()
                self._turned[number] = turned.contiguous(memory_format=torch.channels_last)


class VGG16Features(nn.Module):
    """VGG16's last features as image tokens, frozen; ``vgg16_features`` makes one.

    Attributes:
        dim: size of a token, 512.
        stride: side of a token's square, 16 pixels.
    """

    dim = 512
    stride = 16
    mean: Tensor
    std: Tensor

    def __init__(self, state: dict[str, Tensor]) -> None:
        """Takes torchvision's ``features.N.weight`` and ``.bias`` from ``state``, nothing else."""
        super().__init__()
        self.trunk = VGG16Trunk()
        self.trunk.load_state_dict({n: v for n, v in state.items() if n.startswith("features.")})
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD), persistent=False)
        self.eval()

    def forward(self, images: Tensor) -> Tensor:
        """Maps ``[B, H, W, 3]`` RGB in [0, 1] to relu5_3 tokens ``[B, (H // 16)·(W // 16), 512]``.

        The tokens run along rows.

        Raises:
            ValueError: the pictures are smaller than 16 pixels.
        """
        x = ((images - self.mean) / self.std).permute(0, 3, 1, 2)
        return self.trunk(x)[-1].flatten(2).mT


def vgg16_features(path: str | Path | None = None) -> VGG16Features:
    """Makes VGG16's ImageNet features as image tokens, on the CPU.

    Args:
        path: torchvision's ``vgg16-397923af.pth``; None takes the weights in the cache.

    Raises:
        UserError: the file is missing or holds other weights, or the cache holds none.
    """
    return VGG16Features(read_cached() if path is None else read_torchvision(Path(path)))
