"""The models of files: the shipped one, and any other."""

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
    "shipped_model",
)
DEFAULT_CHECKPOINT = STARTER / "rays.safetensors"


def load_model(
    path: str | Path | None = None,
    device: str | torch.device = "cpu",
    encoder_weights: Weights | None = None,
) -> Gamba:
    """Reads a file of ``save_model``.

    Args:
        path: the file, or a folder with a ``model.safetensors``; without it the shipped
            model.
        device: the model's device.
        encoder_weights: as for ``build_encoder``; a frozen timm encoder needs them. Without them
            the ``encoder.safetensors`` beside the model is taken, if there is one.

    Returns:
        The model in eval mode.

    Raises:
        UserError: the file is missing, damaged or not of our format, its numbers are not finite, or
            the encoder is not the one that the model was trained with.
    """
    return read_model(Gamba, Path(path or DEFAULT_CHECKPOINT), device, encoder_weights)


def shipped_model(preset: str, device: str | torch.device = "cpu") -> Gamba | None:
    """The model of a preset that comes with the package, in eval mode.

    Args:
        preset: its name.
        device: the model's device.

    Returns:
        The model; None where none of this preset comes with the package.

    Raises:
        UserError: the file cannot be read, as in ``load_model``.
    """
    path = STARTER / f"{preset}.safetensors"
    return load_model(path, device) if path.is_file() else None
