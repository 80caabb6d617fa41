"""Measures of how far two pictures are apart: PSNR, SSIM, and the IoU of masks."""

from __future__ import annotations

import torch
from torch import Tensor

MAX_PSNR = 100.0  # dB; given for equal pictures, whose PSNR has no bound
SSIM_WINDOW = 11  # pixels
SSIM_SIGMA = 1.5  # pixels; kornia has it fixed


def psnr(a: Tensor, b: Tensor) -> Tensor:
    """Computes the peak signal-to-noise ratio of the whole picture, in dB, at most ``MAX_PSNR``.

    Args:
        a: ``[.., H, W, C]`` in [0, 1].
        b: the same shape.

    Returns:
        ``[..]`` float64.
    """
    _same_shape(a, b)
    error = (a.double() - b.double()).square().mean((-3, -2, -1))
    return -10 * torch.log10(error.clamp(min=10 ** (-MAX_PSNR / 10)))


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Computes the structural similarity (Wang et al. 2004), mean over channels and whole windows.

    The window is Gaussian, 11x11, with sigma 1.5; the range is 1 and nothing is padded. The result
    equals scikit-image's with ``gaussian_weights=True, use_sample_covariance=False``.

    Args:
        a: ``[.., H, W, C]`` in [0, 1], H and W at least 11.
        b: the same shape.

    Returns:
        ``[..]`` float64, 1 for equal pictures.

    Raises:
        ValueError: the shapes differ, or the pictures are smaller than the window.
    """
    from kornia.metrics import ssim as ssim_map

    _same_shape(a, b)
    if min(a.shape[-3:-1]) < SSIM_WINDOW:
        raise ValueError(f"pictures of {a.shape[-2]}x{a.shape[-3]}; SSIM needs 11x11 or more")
    # This needs float64: in flat regions the variances are differences of nearly equal numbers.
    x, y = (v.double().reshape(-1, *v.shape[-3:]).permute(0, 3, 1, 2) for v in (a, b))
    values = ssim_map(x, y, SSIM_WINDOW, max_val=1.0, eps=0.0, padding="valid")
    return values.mean((1, 2, 3)).reshape(a.shape[:-3])


def mask_iou(a: Tensor, b: Tensor) -> Tensor:
    """Computes the intersection over union of two masks.

    Args:
        a: ``[.., H, W]`` bool.
        b: the same shape.

    Returns:
        ``[..]`` float64; 1 where both are empty.
    """
    _same_shape(a, b)
    both, either = (a & b).sum((-2, -1)), (a | b).sum((-2, -1))
    return torch.where(either > 0, both.double() / either.clamp(min=1), 1.0)


def _same_shape(a: Tensor, b: Tensor) -> None:
    if a.shape != b.shape:
        raise ValueError(f"shapes differ: {tuple(a.shape)} and {tuple(b.shape)}")
