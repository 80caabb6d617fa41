"""Loading of models from files, including the shipped one."""

from __future__ import annotations

from pathlib import Path

import torch

from ..files import STARTER
from .encoders import Weights
from .gamba import Gamba
from .pretrained import FILE_NAME, read_config, read_model, read_weights, save_model

__all__ = (
    "DEFAULT_CHECKPOINT",
    "FILE_NAME",
    "load_model",
    "read_config",
    "read_weights",
    "save_model",
)
DEFAULT_CHECKPOINT = STARTER / "rays.safetensors"


def load_model(
    path: str | Path | None = None,
    device: str | torch.device = "cpu",
    encoder_weights: Weights | None = None,
) -> Gamba:
    """Load a model saved by ``save_model``.

    Args:
        path: the file, or a folder with a ``model.safetensors``; None loads the shipped model.
        device: the model's device.
        encoder_weights: as for ``build_encoder``; required by a frozen timm encoder. The default is
            the ``encoder.safetensors`` beside the model, if there is one.

    Returns:
        The model in eval mode.

    Raises:
        UserError: the file is missing, damaged or of another format, its numbers are not finite, or
            the encoder differs from that of the training.
    """
    return read_model(Gamba, Path(path or DEFAULT_CHECKPOINT), device, encoder_weights)
