"""A model's answer to one prepared picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from ..data.preprocess import composite
from ..gaussians import Gaussians
from .posing import reference_cameras

if TYPE_CHECKING:
    from .gamba import Gamba


@torch.inference_mode()
def reconstruct(model: Gamba, rgba: np.ndarray) -> Gaussians:
    """One forward pass on one picture, seen by the reference camera.

    Args:
        model: on any device, in evaluation mode.
        rgba: ``[S, S, 4]`` in [0, 1], object centred, as ``preprocess.prepare`` returns.

    Returns:
        Gaussians ``[N]`` on the model's device, in the reference camera's frame.
    """
    config = model.config
    size = config.image_size
    device = next(model.parameters()).device
    images = composite(rgba, size, config.background_color)[None].to(device)
    cameras = reference_cameras(1, size, config.fov, config.distance)
    return model(images, cameras.to(device))[0]
