"""Checkpoints: folders ``RUN/checkpoints/step_000123/``, each of which is whole or does not exist.

A checkpoint holds ``model.safetensors`` and ``ema.safetensors``, models that every command can
load, and ``state.pt``, the tensors and plain values that a bit-identical continuation needs too.
"""

from __future__ import annotations

import os
import pickle
import re
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open

from gamba_warp.errors import UserError
from gamba_warp.files import write_json
from gamba_warp.model.checkpoint import save_model
from gamba_warp.model.config import GambaConfig
from gamba_warp.model.gamba import Gamba

_NAME = re.compile(r"step_(\d+)")
_TEMPORARY = ".partial-"


def list_checkpoints(run: Path) -> list[Path]:
    """Lists the run's checkpoints, oldest first."""
    folder = run / "checkpoints"
    found = [p for p in folder.iterdir() if _NAME.fullmatch(p.name)] if folder.is_dir() else []
    return sorted(found, key=lambda p: int(p.name.split("_")[1]))


def save_checkpoint(run: Path, step: int, models: dict[str, Gamba], state: dict, keep: int) -> Path:
    """Writes a checkpoint to a temporary folder, renames it, and removes the oldest checkpoints.

    Args:
        run: the run folder.
        step: optimizer steps done.
        models: models by file stem, which ``save_model`` writes.
        state: content of ``state.pt``, nested tensors and plain values.
        keep: number of checkpoints left afterwards.

    Returns:
        The checkpoint's folder, ``RUN/checkpoints/step_<step>``.

    Raises:
        UserError: it cannot be written; older checkpoints are untouched.
    """
    folder = run / "checkpoints"
    target = folder / f"step_{step:06d}"

    def write(temporary: Path) -> None:
        for name, model in models.items():
            save_model(temporary / f"{name}.safetensors", model)
        torch.save(state, temporary / "state.pt")

    _write_folder(target, write)
    write_json(run / "latest.json", {"checkpoint": f"checkpoints/{target.name}", "step": step})
    for old in list_checkpoints(run)[:-keep]:
        _remove(old)
    return target


def _write_folder(target: Path, write: Callable[[Path], None]) -> None:
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        for stale in target.parent.glob(f"{_TEMPORARY}*"):  # left by a killed process
            shutil.rmtree(stale, ignore_errors=True)
        temporary = Path(tempfile.mkdtemp(prefix=_TEMPORARY, dir=target.parent))
    except OSError as error:
        raise UserError(f"cannot write {target}: {error.strerror}") from error
    try:
        write(temporary)
        for path in [*temporary.iterdir(), temporary]:
            _sync(path)
        temporary.chmod(0o755)
        if target.exists():
            _remove(target)
        temporary.rename(target)
        _sync(target.parent)
    # torch.save reports a full disk as a RuntimeError of its zip writer.
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise UserError(f"cannot write {target}: {reason}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _remove(folder: Path) -> None:
    """Renames the folder before it deletes it: half of one must not look like a checkpoint."""
    doomed = folder.with_name(f"{_TEMPORARY}{folder.name}")
    shutil.rmtree(doomed, ignore_errors=True)
    folder.rename(doomed)
    shutil.rmtree(doomed, ignore_errors=True)


def find_checkpoint(run: Path, resume: str) -> Path | None:
    """Finds the checkpoint that ``--resume`` means, or None for a fresh start.

    Args:
        run: the run folder.
        resume: "auto" (the newest of the run folder, if any), "never", or the path of a
            checkpoint or of another run folder.

    Raises:
        UserError: the run folder holds checkpoints in spite of "never", or the path holds none.
    """
    if resume in ("auto", "never"):
        found = list_checkpoints(run)
        if found and resume == "never":
            raise UserError(f"{run}: holds a run already; give another --out or --resume auto")
        return found[-1] if found else None
    path = Path(resume)
    if (path / "state.pt").is_file():
        return path
    found = list_checkpoints(path)
    if not found:
        raise UserError(f"--resume {path}: no checkpoint there")
    return found[-1]


def read_state(checkpoint: Path) -> dict:
    """Reads ``state.pt`` onto the CPU.

    Raises:
        UserError: the file is missing, truncated or of another kind.
    """
    path = checkpoint / "state.pt"
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise UserError(f"{path}: no such file") from error
    except (OSError, EOFError, RuntimeError, ValueError, pickle.UnpicklingError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"{path}: damaged, take an older checkpoint ({reason})") from error


def load_weights(path: Path, model: Gamba) -> None:
    """Loads a model file into a model of the same configuration.

    Raises:
        UserError: the file is missing or truncated, or its configuration differs; the message names
            the differing fields.
    """
    try:
        with safe_open(path, framework="pt") as file:
            config = GambaConfig.from_json((file.metadata() or {}).get("config", ""), str(path))
            state = {name: file.get_tensor(name) for name in file.keys()}
    except FileNotFoundError as error:
        raise UserError(f"{path}: no such file") from error
    except (SafetensorError, OSError) as error:
        raise UserError(f"{path}: not a whole safetensors file ({error})") from error
    stored, wanted = asdict(config), asdict(model.config)
    differing = [name for name in wanted if stored[name] != wanted[name]]
    if differing:
        raise UserError(f"{path}: is a model of another {', '.join(differing)}")
    model.load_stored_state(state)
