"""VGG16's convolutions, which serve as the trunk of LPIPS and as an encoder of image tokens."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ..conventions import IMAGENET_MEAN, IMAGENET_STD
from .weights import CONVS, WIDTHS, read_cached, read_torchvision


class VGG16Trunk(nn.Module):
    """VGG16's 13 convolutions, frozen, with torchvision's names."""

    def __init__(self) -> None:
        super().__init__()
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
