"""Prediction of a model for one image."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from ..conventions import Detail, Precision
from ..data.preprocess import composite, resize_rgba
from ..devices import network_precision, pick_precision
from ..gaussians import Gaussians
from .config import GambaConfig
from .detail import checked_detail, fill_gaps, split_front
from .posing import reference_cameras

if TYPE_CHECKING:
    from .gamba import Gamba


@torch.inference_mode()
def reconstruct(
    model: Gamba,
    image: str | Path | np.ndarray,
    precision: Precision = "float32",
    detail: Detail | None = None,
) -> Gaussians:
    """Reconstruct one image, taken as seen by the reference camera.

    Args:
        model: on any device, in evaluation mode.
        image: a file, whose object ``photo.cutout.cut_out`` cuts out and centres without
            downloads; or the ``rgba`` of its result, ``[S, S, 4]`` in [0, 1] with the object in the
            middle.
        precision: of the network's products, see ``devices.pick_precision``.
        detail: largest number of Gaussians a side into which each front one splits, see
            ``detail.split_front``; 1 for the network's output. None is the largest that the
            image's pixels allow; an image with too few has no gaps, see ``detail.fill_gaps``.

    Returns:
        Gaussians ``[N]``, float32, on the model's device, in the reference camera's frame.

    Raises:
        UserError: the file cannot be read, its object cannot be separated from the background, or
            the model cannot split its front.
        ValueError: the array has another shape.
    """
    rgba = image
    if not isinstance(rgba, np.ndarray):
        from ..photo.cutout import CutoutOptions, cut_out

        rgba = cut_out(rgba, CutoutOptions(fetch=False)).rgba
    if rgba.ndim != 3 or rgba.shape[0] != rgba.shape[1] or rgba.shape[2] != 4:
        raise ValueError(f"image has shape {rgba.shape}, expected [S, S, 4]")
    config = model.config
    chosen = checked_detail(detail, config, len(rgba))
    device = next(model.parameters()).device
    images = model_input(rgba, config).to(device)
    dtype = pick_precision(precision, device, config.width)
    camera = reference_cameras(config, 1).to(device)
    with network_precision(device, dtype):
        gaussians = model(images, camera)[0]
    if detail is None and chosen == 1 and config.decoder == "rays":
        return fill_gaps(gaussians, config, camera)
    return split_front(gaussians, images[0], rgba, config, chosen, camera)


def model_input(rgba: np.ndarray, config: GambaConfig) -> Tensor:
    """Convert an image to a model's input.

    Args:
        rgba: ``[S, S, 4]`` in [0, 1], straight alpha.
        config: of the model.

    Returns:
        ``[1, s, s, 3]`` RGB on the model's background, or RGBA if the model takes alpha, on the
        CPU; s is ``config.image_size``.
    """
    size = config.image_size
    if config.input_channels == 3:
        return composite(rgba, size, config.background_color)[None]
    return torch.from_numpy(resize_rgba(rgba, size, size))[None]
