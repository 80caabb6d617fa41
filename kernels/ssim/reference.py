"""SSIM by its definition (Wang et al. 2004), with windows unfolded: the oracle."""

from __future__ import annotations

import torch
from torch import Tensor

WINDOW = 11  # pixels, side of the Gaussian window
SIGMA = 1.5  # pixels
C1, C2 = 0.01**2, 0.03**2  # for images in [0, 1]
EDGE = WINDOW - 1  # pixels minus windows of an image, in each direction


def dissimilarity_reference(got: Tensor, want: Tensor) -> Tensor:
    """Computes 1 - SSIM of images, differentiable; windows are unfolded, so it is for small ones.

    Args:
        got: ``[P, H, W, C]``.
        want: the same shape.

    Returns:
        ``[P]``.
    """
    offsets = torch.arange(WINDOW, dtype=torch.float64, device=got.device) - WINDOW // 2
    line = torch.exp(-offsets.square() / (2 * SIGMA**2))
    weights = (line[:, None] * line / line.sum() ** 2).to(got)
    a, b = (x.unfold(1, WINDOW, 1).unfold(2, WINDOW, 1) for x in (got, want))

    def mean(x: Tensor) -> Tensor:
        return (x * weights).sum((-2, -1))

    mu_a, mu_b = mean(a), mean(b)
    var_a = mean((a - mu_a[..., None, None]).square())
    var_b = mean((b - mu_b[..., None, None]).square())
    both = mean((a - mu_a[..., None, None]) * (b - mu_b[..., None, None]))
    light = (2 * mu_a * mu_b + C1) / (mu_a.square() + mu_b.square() + C1)
    shape = (2 * both + C2) / (var_a + var_b + C2)
    return 1 - (light * shape).mean((1, 2, 3))
