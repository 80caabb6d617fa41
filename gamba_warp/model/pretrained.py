"""Reading and writing of models as files, folders and repositories of a hub.

A safetensors file holds the weights and, in its header, the configuration. The header is checked
against the model of its configuration before that model, or any tensor, takes memory. A folder has
that file, ``config.json``, a card, and a frozen encoder's weights; reading and writing it needs
neither huggingface_hub nor a network.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from ..errors import UserError, first_line
from ..files import atomic_path, output_folder, write_text
from ..versions import __version__, advice
from .config import GambaConfig
from .encoders import Weights, outline_encoder

if TYPE_CHECKING:
    from safetensors import safe_open

    from .gamba import Gamba

FORMAT = "gamba_warp.model.1"
FILE_NAME = "model.safetensors"
ENCODER_NAME = "encoder.safetensors"  # a frozen encoder's weights, in the same folder
MAX_HEADER = 16 << 20  # bytes; that of a model of 256 blocks takes 1 MB
_DTYPES = ("F32", "BF16", "F16")  # allowed in a file; all become float32

CONFIG_NAME, CARD_NAME = "config.json", "README.md"
WRITTEN = (FILE_NAME, ENCODER_NAME, CONFIG_NAME, CARD_NAME)  # files of ``save_pretrained``
_MAX_CONFIG = 1 << 20  # bytes of a config.json; ours have 1,500
# Reserved keys of the header; extra_metadata may use any other key.
_RESERVED_KEYS = ("format", "config", "encoder_sha256")


class Pretrained:
    """Methods of ``Gamba`` to read and write folders and repositories of a hub."""

    def save_pretrained(self: Gamba, folder: str | Path, card: str = "") -> Path:  # type: ignore[misc]
        """Write a model as a folder for ``from_pretrained`` and ``load_model``.

        A frozen timm encoder is written too, as ``encoder.safetensors``.

        Args:
            folder: the folder, created if missing; existing files are replaced atomically, except
                README.md, which stays.
            card: Markdown to append to the generated model card.

        Returns:
            The folder.

        Raises:
            UserError: a file cannot be written.
        """
        from safetensors.torch import save_file

        folder = output_folder(folder)
        encoder = self.encoder
        if encoder and encoder.frozen and self.config.encoder != "vgg16":
            with atomic_path(folder / ENCODER_NAME) as temporary:
                save_file(encoder.weights(), temporary)
        save_model(folder / FILE_NAME, self)
        values = json.loads(self.config.to_json())
        write_text(folder / CONFIG_NAME, json.dumps(values, indent=2, sort_keys=True) + "\n")
        if not (folder / CARD_NAME).exists():
            write_text(folder / CARD_NAME, model_card(self, folder.name, card))
        return folder

    @classmethod
    def from_pretrained(
        cls: type[Gamba],  # type: ignore[misc]
        name: str | Path,
        device: str | torch.device = "cpu",
        encoder_weights: Weights | None = None,
        *,
        revision: str | None = None,
        cache_dir: str | Path | None = None,
        force_download: bool = False,
        local_files_only: bool = False,
        token: str | bool | None = None,
    ) -> Gamba:
        """Load a model from a folder, a file or a repository of the Hugging Face Hub.

        A cached repository is used without a request; ``force_download`` requests it again.

        Args:
            name: a folder of ``save_pretrained``, a model file, or ``owner/repository``.
            device: as for ``load_model``, like ``encoder_weights``.
            revision: of the repository: a branch, tag or commit.
            cache_dir: of huggingface_hub, like the following arguments.

        Returns:
            The model in eval mode.

        Raises:
            UserError: the model cannot be found, is of another format, or its config.json differs.
        """
        path = Path(name)
        if not path.exists():
            path = _download(
                str(name),
                force_download,
                revision=revision,
                cache_dir=cache_dir,
                local_files_only=local_files_only,
                token=token,
            )
        config, model = path / CONFIG_NAME, path / FILE_NAME  # the model's header is decisive
        if config.is_file() and model.is_file():
            from ..untrusted.documents import read_bytes  # not at the top: msgspec is optional

            text = read_bytes(config, _MAX_CONFIG)
            if GambaConfig.from_json(text, str(config)) != read_config(model)[0]:
                raise UserError(f"{config}: is not the configuration in {model}")
        return read_model(cls, path, device, encoder_weights)

    def push_to_hub(self: Gamba, repo_id: str, card: str = "", **options: Any) -> str:  # type: ignore[misc]
        """Write a model into a repository of the Hugging Face Hub, like ``save_pretrained``.

        Args:
            repo_id: ``owner/repository``, created if missing.
            card: as for ``save_pretrained``.
            options: of ``huggingface_hub.ModelHubMixin.push_to_hub``: token, private, branch,
                commit_message and others.

        Returns:
            URL of the commit.

        Raises:
            UserError: huggingface_hub is missing, or the upload fails.
        """
        model, hub = self, _hub("Gamba.push_to_hub")

        class Upload(hub.ModelHubMixin):
            def _save_pretrained(self, save_directory: Path) -> None:
                model.save_pretrained(save_directory, card)

        try:
            return str(Upload().push_to_hub(repo_id, **options))
        except UserError:
            raise
        except Exception as error:  # of the library, the network or its checks
            reason = first_line(error)
            raise UserError(f"{repo_id}: cannot be written to the Hub ({reason})") from error


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


def read_model(
    kind: type[Gamba],
    path: Path,
    device: str | torch.device,
    encoder_weights: Weights | None,
) -> Gamba:
    """Implement ``load_model``; ``kind`` is ``Gamba``, which imports this module."""
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
        expected = outline(kind, config)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    try:
        state = read_weights(path, expected)
    except ValueError as error:
        raise UserError(f"{path}: does not fit its own configuration: {error}") from error
    model = kind(config, encoder_weights)
    model.load_stored_state(state)
    if model.encoder and model.encoder.frozen:
        if model.encoder.fingerprint != encoder_sha256:
            raise UserError(
                f"{path}: was trained with other weights of {config.encoder} than those given"
            )
    return model.to(device).eval()


class _Outline(TorchFunctionMode):
    """Skip random initialization, whose first use on the meta device takes seconds."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return None if func is nn.init.normal_ else func(*args, **(kwargs or {}))


def outline(kind: type[Gamba], config: GambaConfig) -> Gamba:
    """Build the model of a configuration on the meta device, without memory.

    Raises:
        UserError: the encoder is unknown or too large.
    """
    with torch.device("meta"), _Outline():
        return kind(config, encoder=outline_encoder(config))


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
        found = "".join(filter(str.isprintable, metadata.get("format", "none")[:40]))
        raise UserError(f"{path}: not a Gamba checkpoint (format {found}, not {FORMAT})")
    from ..untrusted.documents import check_no_code  # not at the top: msgspec is optional

    check_no_code(metadata, str(path))
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
            raise UserError(f"{path}: not a whole safetensors file (its header is too large)")
        with safe_open(path, framework="pt") as file:
            yield file
    except (SafetensorError, OSError) as error:
        reason = first_line(error)[:200]
        raise UserError(f"{path}: not a whole safetensors file ({reason})") from error


def model_card(model: Gamba, name: str, card: str = "") -> str:
    """Model card of ``save_pretrained``: Markdown with the Hub's metadata."""
    config = model.config
    count = sum(value.numel() for value in model.stored_state().values())
    encoder = f", over `{config.encoder}`" if model.encoder else ""
    lines = [
        "---",
        "library_name: gamba-warp",
        "pipeline_tag: image-to-3d",
        "tags: [3d-gaussian-splatting, mamba]",
        "---",
        f"# {name}",
        "",
        "One picture to 3D Gaussians: a Gamba network, read and written by "
        f"gamba_warp {__version__}.",
        "",
        f"- {config.depth} blocks of {config.width} channels, {count:,} parameters{encoder}",
        f"- pictures of {config.image_size}² pixels; at most {config.num_gaussians:,} Gaussians by "
        f"the decoder `{config.decoder}`",
        f"- seen from {config.distance:g} object units, with a vertical field of view of "
        f"{config.fov:g}°",
        "",
        "```python",
        "from gamba_warp import Gamba, reconstruct",
        "",
        f'model = Gamba.from_pretrained("{name}")',
        'gaussians = reconstruct(model, "picture.png")',
        "```",
        "",
    ]
    return "\n".join(lines + ([card.strip(), ""] if card else []))


def _hub(what: str) -> Any:
    try:
        import huggingface_hub
    except ModuleNotFoundError as error:
        raise UserError(advice("huggingface_hub", what) or str(error)) from error
    return huggingface_hub


def _download(name: str, force: bool, **options: Any) -> Path:
    """Return the cache folder of a repository, downloading it if needed."""
    hub = _hub("Gamba.from_pretrained")
    wanted = [CONFIG_NAME, FILE_NAME, ENCODER_NAME]
    options = {"allow_patterns": wanted} | options
    tries = [{"force_download": force}] if force else [{"local_files_only": True}, {}]
    for change in tries:
        try:
            folder = Path(hub.snapshot_download(name, **{**options, **change}))
        except Exception as error:  # of the library, the network or its checks
            failure = error
            continue
        if (folder / FILE_NAME).is_file():
            return folder
        failure = FileNotFoundError(f"it has no {FILE_NAME}")
    reason = first_line(failure)[:200]
    raise UserError(f"{name}: neither a local folder nor available from the Hub ({reason})")
