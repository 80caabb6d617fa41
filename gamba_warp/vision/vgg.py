"""VGG16's convolutions, the trunk of LPIPS and an encoder of image tokens."""

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

# Blocks of five in float32 in ``VGG16Trunk.lower``: with a gradient, and without one.
FULL_BLOCKS, FULL_BLOCKS_OF_TARGET = 4, 1
_LAYERS = sum(map(len, CONVS))


class _Lower(torch.autograd.Function):
    """``VGG16Trunk.lower``, with its gradient.

    The gradient of a layer's input is the convolution with the flipped kernel, in bfloat16
    throughout. It uses the ReLU masks of the forward pass; rounding the first blocks there would
    change these masks and so the gradient.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, trunk: VGG16Trunk) -> tuple[Tensor, ...]:
        outputs, activations, places = [], [], []
        for block, layers in enumerate(CONVS):
            if block:
                x, place = F.max_pool2d(x, 2, return_indices=True)
                places.append(place)
            x = x if block < FULL_BLOCKS else x.bfloat16()
            for number in map(str, layers):
                layer = trunk.features[number] if block < FULL_BLOCKS else trunk.rounded[number]
                x = F.relu_(layer(x))
                activations.append(x)
            outputs.append(x)
        ctx.save_for_backward(*activations, *places)
        ctx.turned = trunk.turned
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor, None]:
        activations, places = list(ctx.saved_tensors[:_LAYERS]), list(ctx.saved_tensors[_LAYERS:])
        passed = None
        for block, layers in reversed(list(enumerate(CONVS))):
            cotangent = cotangents[block].bfloat16()
            passed = cotangent if passed is None else passed.add_(cotangent)
            for number in reversed(layers):
                passed = torch.where(activations.pop() > 0, passed, 0.0)
                passed = F.conv2d(passed, ctx.turned[str(number)], padding=1)
            if block:
                before = activations[-1].to(passed.dtype)
                square = ([2, 2], [2, 2], [0, 0], [1, 1], False)
                pool = torch.ops.aten.max_pool2d_with_indices_backward
                passed = pool(passed, before, *square, places.pop())
        assert passed is not None
        return passed.float(), None


def _check_size(x: Tensor) -> None:
    if min(x.shape[-2:]) < 16:
        raise ValueError(f"images are {x.shape[-1]}x{x.shape[-2]}; VGG16 needs 16x16 or more")


class VGG16Trunk(nn.Module):
    """VGG16's 13 convolutions, frozen, with torchvision's names."""

    def __init__(self) -> None:
        super().__init__()
        # bfloat16 weights by layer, created on first use: flipped ones for the gradient, and
        # unchanged ones for the rounded blocks.
        self.turned: dict[str, Tensor] = {}
        self.rounded: dict[str, nn.Conv2d] = {}
        self.features = nn.ModuleDict()
        channels = 3
        for layers, width in zip(CONVS, WIDTHS, strict=True):
            for number in layers:
                self.features[str(number)] = nn.Conv2d(channels, width, 3, padding=1)
                channels = width
        self.requires_grad_(False)

    def forward(self, x: Tensor) -> list[Tensor]:
        """Map normalised ``[B, 3, H, W]`` to the features relu1_2, 2_2, 3_3, 4_3 and 5_3.

        Raises:
            ValueError: the images are smaller than 16 pixels.
        """
        return self._features(x, len(CONVS))

    def _features(self, x: Tensor, full: int) -> list[Tensor]:
        """Compute the features, the blocks from ``full`` on in bfloat16."""
        _check_size(x)
        outputs = []
        for block, layers in enumerate(CONVS):
            x = F.max_pool2d(x, 2) if block else x
            x = x.bfloat16() if block >= full else x
            for number in map(str, layers):
                x = F.relu((self.features if block < full else self.rounded)[number](x))
            outputs.append(x)
        return outputs

    def lower(self, x: Tensor) -> list[Tensor]:
        """Run ``forward``, partly in bfloat16 where that hardly matters.

        bfloat16 are the whole gradient and block 5 of a batch with a gradient, and blocks 2 to 5 of
        one without; the rest is float32 (docs/lab/step.md has the effect of each choice).

        Raises:
            ValueError: the images are smaller than 16 pixels.
        """
        _check_size(x)
        if not self.turned or next(iter(self.turned.values())).device != x.device:
            self._lower_weights()
        if x.requires_grad:
            return list(_Lower.apply(x, self))
        return self._features(x, FULL_BLOCKS_OF_TARGET)

    @torch.no_grad()
    def _lower_weights(self) -> None:
        for block, layers in enumerate(CONVS):
            for number in map(str, layers):
                layer = self.features[number]
                assert isinstance(layer, nn.Conv2d)
                if block >= FULL_BLOCKS_OF_TARGET:
                    self.rounded[number] = copy.deepcopy(layer).bfloat16()
                turned = layer.weight.flip(2, 3).transpose(0, 1).bfloat16()
                self.turned[number] = turned.contiguous(memory_format=torch.channels_last)


class VGG16Features(nn.Module):
    """VGG16's last features as image tokens, frozen; created by ``vgg16_features``.

    Attributes:
        dim: size of a token, 512.
        stride: side of a token's square, 16 pixels.
    """

    dim = 512
    stride = 16
    mean: Tensor
    std: Tensor

    def __init__(self, state: dict[str, Tensor]) -> None:
        """Take torchvision's ``features.N.weight`` and ``.bias`` of ``state``; ignore the rest."""
        super().__init__()
        self.trunk = VGG16Trunk()
        self.trunk.load_state_dict({n: v for n, v in state.items() if n.startswith("features.")})
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD), persistent=False)
        self.eval()

    def forward(self, images: Tensor) -> Tensor:
        """Map ``[B, H, W, 3]`` RGB in [0, 1] to relu5_3 tokens ``[B, (H // 16)·(W // 16), 512]``.

        Tokens are in row-major order.

        Raises:
            ValueError: the images are smaller than 16 pixels.
        """
        x = ((images - self.mean) / self.std).permute(0, 3, 1, 2)
        return self.trunk(x)[-1].flatten(2).mT


def vgg16_features(path: str | Path | None = None) -> VGG16Features:
    """Create VGG16's ImageNet features as image tokens, on the CPU.

    Args:
        path: torchvision's ``vgg16-397923af.pth``; None takes the weights in the cache.

    Raises:
        UserError: the file is missing or has other weights, or the cache has none.
    """
    return VGG16Features(read_cached() if path is None else read_torchvision(Path(path)))
