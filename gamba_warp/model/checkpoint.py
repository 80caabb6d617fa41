"""Models as files: one safetensors file holds the weights and, in its header, the configuration.

What a file says is compared with the model that its configuration means before that model, or any
of the file's tensors, takes memory.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..errors import UserError, first_line
from ..files import STARTER, atomic_path
from .config import GambaConfig
from .encoders import Weights, outline_encoder
from .gamba import Gamba

if TYPE_CHECKING:
    from safetensors import safe_open

FORMAT = "gamba_warp.model.1"
FILE_NAME = "model.safetensors"
ENCODER_NAME = "encoder.safetensors"  # a frozen encoder's weights, in the same folder
DEFAULT_CHECKPOINT = STARTER / "rays.safetensors"

MAX_HEADER = 16 << 20  # bytes; that of a model of 256 blocks takes 1 MB
_SMALL = 10_000_000  # parameters of a model that is built at once: torch's meta device is slow
_STORED = ("F32", "BF16", "F16")  # numbers that a file may have; all become float32

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
        _sort_metadata(temporary)


def _sort_metadata(path: Path) -> None:
    """Sorts the header's entries, which the library writes in another order each time.

    So equal weights are equal bytes. The header keeps its length, and the tensors their places.
    """
    with open(path, "r+b") as file:
        size = int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(size))
        header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
        text = json.dumps(header, ensure_ascii=False, separators=(",", ":"))
        file.seek(8)
        file.write(text.encode().ljust(size))


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
    path = DEFAULT_CHECKPOINT if path is None else Path(path)
    if path.is_dir():
        path = path / FILE_NAME
    if not path.exists():
        raise UserError(f"{path}: no such checkpoint")
    config, encoder_sha256 = read_config(path)
    if not config.encoder_frozen and config.encoder != "none":
        encoder_weights = "random"  # the file holds the trained ones
    beside = path.parent / ENCODER_NAME
    if encoder_weights is None and config.encoder not in ("none", "vgg16") and beside.is_file():
        encoder_weights = beside
    model = None
    if config.num_parameters <= _SMALL and (not config.prepend or config.encoder == "none"):
        model = Gamba(config)
    try:
        state = read_weights(path, model or _outline(config, path))
    except ValueError as error:
        raise UserError(f"{path}: does not fit its own configuration: {error}") from error
    model = model or Gamba(config, encoder_weights)
    model.load_stored_state(state)
    if model.encoder and model.encoder.frozen:
        if model.encoder.fingerprint != encoder_sha256:
            raise UserError(
                f"{path}: was trained with other weights of {config.encoder} than those given"
            )
    return model.to(device).eval()


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


def _outline(config: GambaConfig, path: Path) -> Gamba:
    """The model that a file's configuration means, as shapes without memory."""
    try:
        with torch.device("meta"):
            return Gamba(config, encoder=outline_encoder(config))
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def read_config(path: Path) -> tuple[GambaConfig, str | None]:
    """Reads what a model file says of itself, and no tensor.

    Args:
        path: a file of ``save_model``.

    Returns:
        The configuration, and the SHA-256 of a frozen encoder's weights or None.

    Raises:
        UserError: the file is missing, damaged or not of our format.
    """
    with _opened(path) as file:
        metadata = file.metadata() or {}
    if metadata.get("format") != FORMAT or "config" not in metadata:
        found = "".join(filter(str.isprintable, metadata.get("format", "none")[:40]))
        raise UserError(f"{path}: not a Gamba checkpoint (format {found}, not {FORMAT})")
    return GambaConfig.from_json(metadata["config"], str(path)), metadata.get("encoder_sha256")


def read_weights(path: Path, model: Gamba) -> dict[str, Tensor]:
    """Reads a model file's tensors, after their names, shapes and kinds are those of a model.

    Args:
        path: a file of ``save_model``.
        model: of the file's configuration; it may be on the meta device.

    Returns:
        What ``Gamba.load_stored_state`` takes: float32, finite, on the CPU.

    Raises:
        UserError: the file is missing or damaged, or a number in it is not finite.
        ValueError: a tensor is missing, unknown, or of another shape or kind; it names the tensor.
    """
    state = {}
    with _opened(path) as file:
        model.check_stored_state({name: file.get_slice(name).get_shape() for name in file.keys()})
        for name in file.keys():
            kind = file.get_slice(name).get_dtype()
            if kind not in _STORED:
                raise ValueError(f"tensor '{name}' is of {kind}, not {', '.join(_STORED)}")
        for name in file.keys():
            state[name] = file.get_tensor(name).float()
            bad = int((~state[name].isfinite()).sum())
            if bad:
                count = state[name].numel()
                raise UserError(f"{path}: {bad} of {count} numbers of '{name}' are not finite")
    return state


@contextmanager
def _opened(path: Path) -> Iterator[safe_open]:
    """An open safetensors file. Raises UserError for all that is wrong with the file itself."""
    from safetensors import SafetensorError, safe_open

    try:
        if not path.is_file():
            raise UserError(f"{path}: {'not a plain file' if path.exists() else 'no such file'}")
        with open(path, "rb") as raw:
            length = int.from_bytes(raw.read(8), "little")
        # The library's own limit is 100 MB, which it would parse.
        if length > min(MAX_HEADER, path.stat().st_size):
            raise UserError(f"{path}: not a whole safetensors file (its header is too large)")
        with safe_open(path, framework="pt") as file:
            yield file
    except (SafetensorError, OSError) as error:
        reason = first_line(error)[:200]
        raise UserError(f"{path}: not a whole safetensors file ({reason})") from error
