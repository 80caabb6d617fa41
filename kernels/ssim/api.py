"""1 - SSIM and its slope: the checks, and the choice of how it is computed."""

from __future__ import annotations

import torch
from torch import Tensor

from .lanes import dissimilarity_on_lanes
from .products import dissimilarity_by_products
from .reference import WINDOW


def dissimilarity(got: Tensor, want: Tensor, slope: bool) -> tuple[Tensor, Tensor | None]:
    """Computes 1 - SSIM of images, and its derivative by ``got`` (README).

    An image's value depends on no other image. Windows in which two images are equal, as they
    are on the background, add 0 and have no slope; a CPU skips pixels of no other window.
    float32 on a CPU has kernels; other dtypes and devices take matrix products, which have to keep
    all digits: where the process allows rounding, the caller has to switch it off.

    Args:
        got: ``[P, H, W, C]`` of a floating dtype, H and W at least 11.
        want: the same shape, dtype and device, values in [0, 1].
        slope: True to compute the derivative.

    Returns:
        Values ``[P]``, means over channels and whole windows, and the slope ``[P, H, W, C]``, both
        in the dtype of the images.

    Raises:
        TypeError: the dtypes differ or are not floating, or the devices differ.
        ValueError: the shapes differ or are too small.
    """
    for name, x in (("got", got), ("want", want)):
        if not x.is_floating_point() or x.dtype != got.dtype or x.device != got.device:
            raise TypeError(
                f"{name} is {x.dtype} on {x.device}, must have the floating dtype "
                "and the device of got"
            )
        if x.ndim != 4 or x.shape != got.shape or min(x.shape[1:3]) < WINDOW:
            raise ValueError(
                f"{name} must have shape got's, [P, H, W, C] with H and W >= {WINDOW}, "
                f"got {tuple(x.shape)}"
            )
    on_lanes = got.device.type == "cpu" and got.dtype == torch.float32
    compute = dissimilarity_on_lanes if on_lanes else dissimilarity_by_products
    return compute(got.detach(), want.detach(), slope)
