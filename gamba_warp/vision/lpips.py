"""LPIPS with VGG16: perceptual distance of images (Zhang et al. 2018)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ..devices import float32_weights
from .vgg import VGG16Trunk
from .weights import WIDTHS, read_cached

# LPIPS's normalisation of images in [-1, 1] (its "scaling layer").
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)


class LPIPS(nn.Module):
    """Learned perceptual distance, VGG16, version 0.1, frozen; created by ``load_lpips``."""

    shift: Tensor
    scale: Tensor

    @float32_weights()
    def __init__(self, state: dict[str, Tensor]) -> None:
        """Take torchvision's ``features.N.*`` and ``lin0`` .. ``lin4``, each ``[C]``."""
        super().__init__()
        self.trunk = VGG16Trunk()
        for k, width in enumerate(WIDTHS):
            self.register_buffer(f"lin{k}", torch.empty(width))
        self.register_buffer("shift", torch.tensor(_SHIFT)[:, None, None], persistent=False)
        self.register_buffer("scale", torch.tensor(_SCALE)[:, None, None], persistent=False)
        # Images [.., H, W, 3] are channels last, and the convolutions keep that layout.
        self.trunk.to(memory_format=torch.channels_last)
        renamed = {n if n.startswith("lin") else f"trunk.{n}": v for n, v in state.items()}
        self.load_state_dict(renamed)
        self.eval()

    def forward(self, a: Tensor, b: Tensor, precision: torch.dtype = torch.float32) -> Tensor:
        """Compute the distance of image pairs, differentiable in both inputs.

        Args:
            a: ``[.., H, W, 3]`` RGB in [0, 1], H and W at least 16.
            b: the same shape.
            precision: float32; or bfloat16, for the convolutions of ``VGG16Trunk.lower``: the value
                changes by less than a hundredth, the gradient's direction (one minus the cosine)
                by less than a thousandth.

        Returns:
            ``[..]`` float32, 0 for equal images; in bfloat16 under 2e-5 if one has a gradient.

        Raises:
            ValueError: the shapes differ, are not RGB, or are smaller than 16 pixels.
        """
        if a.shape != b.shape or a.ndim < 3 or a.shape[-1] != 3:
            raise ValueError(
                f"a is {tuple(a.shape)} and b {tuple(b.shape)}; both must be [.., H, W, 3]"
            )
        trunk = self.trunk if precision == torch.float32 else self.trunk.lower
        x, y = ([_unit(part) for part in trunk(self._normalized(image))] for image in (a, b))
        return self.distance(x, y).reshape(a.shape[:-3])

    def features(self, images: Tensor) -> list[Tensor]:
        """Compute the features for ``distance``: five maps ``[B, C, h, w]``, unit length per pixel.

        Args:
            images: ``[.., H, W, 3]`` RGB in [0, 1]; all leading dimensions become B.
        """
        return [_unit(y) for y in self.trunk(self._normalized(images))]

    def _normalized(self, images: Tensor) -> Tensor:
        x = images.reshape(-1, *images.shape[-3:]).permute(0, 3, 1, 2)
        return (2 * x - 1 - self.shift) / self.scale

    def distance(self, a: list[Tensor], b: list[Tensor]) -> Tensor:
        """Compute distances ``[B]`` from two ``features``, to compare one image with many."""
        total = a[0].new_zeros(len(a[0]))
        for k, (x, y) in enumerate(zip(a, b, strict=True)):
            weighted = torch.einsum("bchw,c->bhw", (x - y).square(), getattr(self, f"lin{k}"))
            total = total + weighted.mean((1, 2))
        return total


def _unit(x: Tensor) -> Tensor:
    # 1e-20 keeps the gradient of a pixel without features finite, and is negligible elsewhere.
    x = x.float()
    return x / (x.square().sum(1, keepdim=True) + 1e-20).sqrt()


def load_lpips() -> LPIPS:
    """Create LPIPS-VGG with the weights in the cache, on the CPU.

    Raises:
        UserError: the weights are not in the cache (the message names the command that fetches
            them), or the file is damaged.
    """
    return LPIPS(read_cached())
