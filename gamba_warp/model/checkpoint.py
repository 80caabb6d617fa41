"""Reading and writing of models as safetensors files, including the shipped one.

A file holds the weights and, in its header, the configuration. The header is checked against the
model of its configuration before that model, or any tensor, takes memory.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..errors import UserError, first_line
from ..files import STARTER, atomic_path, output_folder
from ..versions import advice
from .config import GambaConfig
from .encoders import Weights, outline_encoder
from .gamba import Gamba

if TYPE_CHECKING:
    from safetensors import safe_open

DEFAULT_CHECKPOINT = STARTER / "rays.safetensors"
FORMAT = "gamba_warp.model.1"
FILE_NAME = "model.safetensors"
ENCODER_NAME = "encoder.safetensors"  # a frozen encoder's weights, in the same folder
MAX_HEADER = 16 << 20  # bytes; a model of 256 blocks needs 1 MB
_DTYPES = ("F32", "BF16", "F16")  # allowed in a file; all become float32
# Reserved keys of the header; extra_metadata may use any other key.
_RESERVED_KEYS = ("format", "config", "encoder_sha256")
_REPOSITORY = re.compile(r"hf:/{1,2}(.*)")  # a Path joins slashes


def load_model(
    path: str | Path | None = None,
    device: str | torch.device = "cpu",
    encoder_weights: Weights | None = None,
) -> Gamba:
    """Load a model saved by ``save_model``.

    Args:
        path: the file; a folder with a ``model.safetensors``; ``hf://owner/name``, a repository of
            the Hugging Face Hub with one, downloaded once; or None for the shipped model.
        device: the model's device.
        encoder_weights: as for ``build_encoder``; required by a frozen timm encoder. The default is
            the ``encoder.safetensors`` in the model's folder, if there is one.

    Returns:
        The model in eval mode.

    Raises:
        UserError: the file is missing, damaged or of another format, its numbers are not finite,
            the encoder differs from the training's, or the repository cannot be read.
    """
    repository = _REPOSITORY.fullmatch(str(path))
    path = _download(repository[1]) if repository else Path(path or DEFAULT_CHECKPOINT)
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
    try:
        expected = outline(config)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    try:
        state = read_weights(path, expected)
    except ValueError as error:
        raise UserError(f"{path}: does not fit its own configuration: {error}") from error
    model = Gamba(config, encoder_weights)
    model.load_stored_state(state)
    if model.encoder and model.encoder.frozen:
        if model.encoder.fingerprint != encoder_sha256:
            raise UserError(
                f"{path}: was trained with weights of {config.encoder} other than the given ones"
            )
    return model.to(device).eval()


def _download(name: str) -> Path:
    """Return the cache folder of a repository, downloading it if needed. Raises UserError."""
    try:
        import huggingface_hub
    except ModuleNotFoundError as error:
        raise UserError(advice("huggingface_hub", f"hf://{name}") or str(error)) from error
    try:
        wanted = [FILE_NAME, ENCODER_NAME]
        return Path(huggingface_hub.snapshot_download(name, allow_patterns=wanted))
    except Exception as error:  # of the library, the network or its checks
        raise UserError(f"hf://{name}: cannot be read ({first_line(error)[:200]})") from error


def save_folder(folder: str | Path, model: Gamba) -> Path:
    """Write a model, and a frozen timm encoder's weights, into a folder.

    Args:
        folder: created if missing; existing files are replaced atomically.
        model: the model.

    Returns:
        The folder, for ``load_model``.

    Raises:
        UserError: a file cannot be written.
    """
    from safetensors.torch import save_file

    folder, encoder = output_folder(folder), model.encoder
    if encoder and encoder.frozen and model.config.encoder != "vgg16":
        with atomic_path(folder / ENCODER_NAME) as temporary:
            save_file(encoder.weights(), temporary)
    save_model(folder / FILE_NAME, model)
    return folder


def save_model(
    path: str | Path, model: Gamba, extra_metadata: dict[str, str] | None = None
) -> None:
    """Write weights and configuration to one safetensors file, atomically.

    Args:
        path: the file; if it is named ``model.safetensors``, ``load_model`` finds it by its folder.
        model: the model; of a frozen encoder only the SHA-256 of its weights is stored.
        extra_metadata: further entries of the file's header; the keys "format", "config" and
            "encoder_sha256" are reserved.

    Raises:
        TypeError: path or model has the wrong type, for example if they are swapped.
        UserError: the file cannot be written.
        ValueError: ``extra_metadata`` has a reserved key.
    """
    from safetensors.torch import save_file

    if not isinstance(path, (str, PathLike)) or not isinstance(model, torch.nn.Module):
        kinds = f"{type(path).__name__}, {type(model).__name__}"
        raise TypeError(f"save_model takes the path, then the model, and got {kinds}")

    metadata = dict(extra_metadata or {})
    taken = [key for key in _RESERVED_KEYS if key in metadata]
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
    """Sort the header's entries, which the library writes in varying order.

    Equal weights thus give equal bytes. The length of the header does not change.
    """
    with open(path, "r+b") as file:
        size = int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(size))
        header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
        text = json.dumps(header, ensure_ascii=False, separators=(",", ":"))
        file.seek(8)
        file.write(text.encode().ljust(size))


def outline(config: GambaConfig) -> Gamba:
    """Build the model of a configuration on the meta device, without memory.

    Raises:
        UserError: the encoder is unknown or too large.
    """
    with torch.device("meta"):
        return Gamba(config, encoder=outline_encoder(config))


def read_config(path: Path) -> tuple[GambaConfig, str | None]:
    """Read the header of a model file, without its tensors.

    Args:
        path: a file of ``save_model``.

    Returns:
        The configuration, and the SHA-256 of a frozen encoder's weights or None.

    Raises:
        UserError: the file is missing, damaged or of another format.
    """
    with _opened(path) as file:
        metadata = file.metadata() or {}
    if metadata.get("format") != FORMAT or "config" not in metadata:
        stated = "".join(filter(str.isprintable, metadata.get("format", "none")[:40]))
        raise UserError(f"{path}: not a Gamba checkpoint (format {stated}, not {FORMAT})")
    return GambaConfig.from_json(metadata["config"], str(path)), metadata.get("encoder_sha256")


def read_weights(path: Path, model: Gamba) -> dict[str, Tensor]:
    """Read a model file's tensors after checking names, shapes and dtypes against a model.

    Args:
        path: a file of ``save_model``.
        model: of the file's configuration; may be on the meta device.

    Returns:
        A state for ``Gamba.load_stored_state``: float32, finite, on the CPU.

    Raises:
        UserError: the file is missing or damaged, or has non-finite numbers.
        ValueError: a tensor is missing, unknown, or of another shape or dtype; the message names
            it.
    """
    state = {}
    with _opened(path) as file:
        model.check_stored_state({name: file.get_slice(name).get_shape() for name in file.keys()})
        for name in file.keys():
            kind = file.get_slice(name).get_dtype()
            if kind not in _DTYPES:
                raise ValueError(f"tensor '{name}' is of {kind}, not {', '.join(_DTYPES)}")
        for name in file.keys():
            state[name] = file.get_tensor(name).float()
            bad = int((~state[name].isfinite()).sum())
            if bad:
                count = state[name].numel()
                raise UserError(f"{path}: {bad} of {count} numbers of '{name}' are not finite")
    return state


@contextmanager
def _opened(path: Path) -> Iterator[safe_open]:
    """Open a safetensors file. Raises UserError if the file itself is invalid."""
    from safetensors import SafetensorError, safe_open

    try:
        if not path.is_file():
            raise UserError(f"{path}: {'not a plain file' if path.exists() else 'no such file'}")
        with open(path, "rb") as raw:
            length = int.from_bytes(raw.read(8), "little")
        # The library would parse a header of up to 100 MB.
        if length > min(MAX_HEADER, path.stat().st_size):
            raise UserError(f"{path}: not a valid safetensors file (its header is too large)")
        with safe_open(path, framework="pt") as file:
            yield file
    except (SafetensorError, OSError) as error:
        reason = first_line(error)[:200]
        raise UserError(f"{path}: not a valid safetensors file ({reason})") from error
