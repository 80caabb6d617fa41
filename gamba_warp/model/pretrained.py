"""Models as folders: ``model.safetensors``, ``config.json``, a card, a frozen encoder's weights.

``Gamba.from_pretrained``, ``save_pretrained`` and ``push_to_hub`` are these functions. A folder is
read and written without huggingface_hub and without a network.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from ..errors import UserError, first_line
from ..files import atomic_path, output_folder, write_text
from ..versions import __version__, advice
from .checkpoint import ENCODER_NAME, FILE_NAME, load_model, read_config, save_model
from .config import GambaConfig

if TYPE_CHECKING:
    from .encoders import Weights
    from .gamba import Gamba

CONFIG_NAME, CARD_NAME = "config.json", "README.md"
WRITTEN = (FILE_NAME, ENCODER_NAME, CONFIG_NAME, CARD_NAME)  # what ``save_pretrained`` writes
_MAX_CONFIG = 1 << 20  # bytes of a config.json; ours have 1,500


def save_pretrained(model: Gamba, folder: str | Path, card: str = "") -> Path:
    """Writes a model as a folder that ``from_pretrained`` and ``load_model`` read.

    Args:
        model: with a frozen timm encoder, that is written too, as ``encoder.safetensors``.
        folder: is made; files of the same names are replaced, each when it is whole, but a
            README.md that is there stays as it is.
        card: Markdown that follows what the model card says by itself.

    Returns:
        The folder.

    Raises:
        UserError: a file cannot be written.
    """
    from safetensors.torch import save_file

    folder = output_folder(folder)
    encoder = model.encoder
    if encoder and encoder.frozen and model.config.encoder != "vgg16":
        with atomic_path(folder / ENCODER_NAME) as temporary:
            save_file(encoder.weights(), temporary)
    save_model(folder / FILE_NAME, model)
    values = json.loads(model.config.to_json())
    write_text(folder / CONFIG_NAME, json.dumps(values, indent=2, sort_keys=True) + "\n")
    if not (folder / CARD_NAME).exists():
        write_text(folder / CARD_NAME, model_card(model, folder.name, card))
    return folder


def from_pretrained(
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
    """Reads a model from a folder, a file or a repository of the Hugging Face Hub.

    A repository that is in the cache is not asked for again; ``force_download`` does that.

    Args:
        name: a folder of ``save_pretrained``, a model file, or ``owner/repository``.
        device: as for ``load_model``, like ``encoder_weights``.
        revision: of the repository: a branch, tag or commit.
        cache_dir: of huggingface_hub, like the arguments that follow.

    Returns:
        The model in eval mode.

    Raises:
        UserError: it cannot be had, is no model of ours, or its config.json is of another one.
    """
    path = Path(name)
    if not path.exists():
        path = _fetched(
            str(name),
            force_download,
            revision=revision,
            cache_dir=cache_dir,
            local_files_only=local_files_only,
            token=token,
        )
    _check_config(path / CONFIG_NAME, path / FILE_NAME)
    return load_model(path, device, encoder_weights)


def push_to_hub(model: Gamba, repo_id: str, card: str = "", **options: Any) -> str:
    """Writes a model into a repository of the Hugging Face Hub, as ``save_pretrained`` does.

    Args:
        model: what is written.
        repo_id: ``owner/repository``; it is made if it is not there.
        card: as for ``save_pretrained``.
        options: of ``huggingface_hub.ModelHubMixin.push_to_hub``: token, private, branch,
            commit_message and others.

    Returns:
        The address of the commit.

    Raises:
        UserError: huggingface_hub is missing, or the Hub refuses.
    """
    hub = _hub("Gamba.push_to_hub")

    class Pushed(hub.ModelHubMixin):
        def _save_pretrained(self, save_directory: Path) -> None:
            save_pretrained(model, save_directory, card)

    try:
        return str(Pushed().push_to_hub(repo_id, **options))
    except UserError:
        raise
    except Exception as error:  # of the library, of its network and of its checks
        raise UserError(f"{repo_id}: cannot be written to the Hub ({first_line(error)})") from error


def model_card(model: Gamba, name: str, card: str = "") -> str:
    """The model card of ``save_pretrained``: Markdown that begins with the Hub's fields."""
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


def _check_config(config: Path, model: Path) -> None:
    """Compares config.json with what the model's own file says, which decides."""
    if not (config.is_file() and model.is_file()):
        return
    if config.stat().st_size > _MAX_CONFIG:
        raise UserError(f"{config}: has more than {_MAX_CONFIG:,} bytes")
    try:
        text = config.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{config}: cannot be read ({first_line(error)})") from error
    if GambaConfig.from_json(text, str(config)) != read_config(model)[0]:
        raise UserError(f"{config}: is not the configuration in {model}")


def _hub(what: str) -> Any:
    try:
        import huggingface_hub
    except ModuleNotFoundError as error:
        raise UserError(advice("huggingface_hub", what) or str(error)) from error
    return huggingface_hub


def _fetched(name: str, force: bool, **options: Any) -> Path:
    """The folder that a repository's files are cached in."""
    hub = _hub("Gamba.from_pretrained")
    wanted = [CONFIG_NAME, FILE_NAME, ENCODER_NAME]
    options = {"allow_patterns": wanted} | options
    tries = [{"force_download": force}] if force else [{"local_files_only": True}, {}]
    for change in tries:
        try:
            folder = Path(hub.snapshot_download(name, **{**options, **change}))
        except Exception as error:  # of the library, of its network and of its checks
            failure = error
            continue
        if (folder / FILE_NAME).is_file():
            return folder
        failure = FileNotFoundError(f"it has no {FILE_NAME}")
    reason = first_line(failure)[:200]
    raise UserError(f"{name}: neither a folder here nor to be had from the Hub ({reason})")
