"""Models as files: one safetensors file holds the weights and, in its header, the configuration."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from ..errors import UserError
from ..files import CHECKOUT, atomic_path
from .config import GambaConfig
from .gamba import Gamba

FORMAT = "gamba_warp.model.1"
FILE_NAME = "model.safetensors"
DEFAULT_CHECKPOINT = CHECKOUT / "starter" / "tiny.safetensors"

# These keys of the header are ours; extra_metadata may use any other key.
_OWN_KEYS = ("format", "config", "encoder_sha256")


def save_model(
    path: str | Path, model: Gamba, extra_metadata: dict[str, str] | None = None
) -> None:
    """Writes weights and configuration to one safetensors file, atomically.

    Args:
        path: the file; if it is named ``model.safetensors``, ``load_model`` finds it by its folder.
        model: the model; of a frozen encoder only the SHA-256 of its weights is stored.
        extra_metadata: further entries of the file's header; the keys "format", "config" and
            "encoder_sha256" are taken.

    Raises:
        UserError: the file cannot be written.
        ValueError: ``extra_metadata`` has a key that is taken.
    """
    from safetensors.torch import save_file

    metadata = dict(extra_metadata or {})
    taken = [key for key in _OWN_KEYS if key in metadata]
    if taken:
        raise ValueError(f"extra_metadata has {', '.join(taken)}, which save_model writes itself")
    metadata |= {"format": FORMAT, "config": model.config.to_json()}
    if model.encoder and model.encoder.frozen:
        metadata["encoder_sha256"] = model.encoder.fingerprint
    state = {name: value.contiguous() for name, value in model.stored_state().items()}
    with atomic_path(path) as temporary:
        save_file(state, temporary, metadata=metadata)


def load_model(
    path: str | Path | None = None,
    device: str | torch.device = "cpu",
    encoder_weights: str | Path | None = None,
) -> Gamba:
    """Reads a file of ``save_model``.

    Args:
        path: the file, or a folder with a ``model.safetensors``; without it the small model in
            ``starter/``, which a checkout has and an installed package does not.
        device: the model's device.
        encoder_weights: as for ``build_encoder``; a frozen timm encoder needs them.

    Returns:
        The model in eval mode.

    Raises:
        UserError: the file is missing, damaged or not of our format, or the encoder is not the one
            that the model was trained with.
    """
    path = DEFAULT_CHECKPOINT if path is None else Path(path)
    if path.is_dir():
        path = path / FILE_NAME
    metadata, state = _read(path)
    config = GambaConfig.from_json(metadata["config"], source=str(path))
    if not config.encoder_frozen and config.encoder != "none":
        encoder_weights = "random"  # the file holds the trained ones
    model = Gamba(config, encoder_weights)
    try:
        model.load_stored_state(state)
    except ValueError as error:
        raise UserError(f"{path}: does not fit its own configuration: {error}") from error
    if model.encoder and model.encoder.frozen:
        if model.encoder.fingerprint != metadata.get("encoder_sha256"):
            raise UserError(
                f"{path}: was trained with other weights of {config.encoder} than those given"
            )
    return model.to(device).eval()


def _read(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise UserError(f"{path}: no such checkpoint")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT or "config" not in metadata:
                found = metadata.get("format", "none")
                raise UserError(f"{path}: not a Gamba checkpoint (format {found}, not {FORMAT})")
            return metadata, {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, OSError) as error:
        raise UserError(f"{path}: not a whole safetensors file ({error})") from error
