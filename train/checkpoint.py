"""State of a run, and its checkpoints: folders ``RUN/checkpoints/step_000123/``.

A checkpoint is written atomically. It holds ``model.safetensors`` and ``ema.safetensors``, models
that every command can load; ``state.pt``, the further tensors and plain values of a bit-identical
continuation; and ``checksums.json``, the SHA-256 of each of these files.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import torch

from gamba_warp.errors import UserError, first_line
from gamba_warp.files import atomic_folder, reason_of, remove_folder, sha256, sweep, write_json
from gamba_warp.model.checkpoint import read_config, read_weights, save_model
from gamba_warp.model.gamba import Gamba
from gamba_warp.untrusted.documents import read_document
from gamba_warp.untrusted.names import plain_name
from gamba_warp.untrusted.torch_files import read_torch

from .batches import TrainingData
from .config import (
    STEP_SIZE,
    DataConfig,
    LengthConfig,
    TrainConfig,
    config_differences,
    renamed,
)
from .ddp import World
from .optim import Ema, NewLength, Schedule, build_optimizer, checked_moments

KEPT = 2  # checkpoints that remain
CHECKSUMS = "checksums.json"
_NAME = re.compile(r"step_(\d+)")
_NEEDED = {"model.safetensors": "", "state.pt": ""}  # required even if not in the checksums
_Digest = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
_Count = Annotated[int, msgspec.Meta(ge=0, le=10**12)]


class Setup(NamedTuple):
    """Setup of a run, which stays the same throughout.

    Attributes:
        config: the options.
        data: training and validation data.
        world: this process among all.
    """

    config: TrainConfig
    data: TrainingData
    world: World

    @property
    def step_size(self) -> int:
        """Objects of a step, over all processes."""
        views = self.config.views
        return views.batch_size * views.accumulate * self.world.size

    @property
    def steps_per_epoch(self) -> float:
        """Steps of a pass over the objects."""
        return len(self.data.objects) / self.step_size

    def schedule(self, length: LengthConfig) -> Schedule:
        """Return the schedule of a run of some length."""
        total = length.steps
        if total is None and (length.epochs or not length.minutes):
            total = math.ceil((length.epochs or 400) * self.steps_per_epoch)
        return Schedule(self.config.optim, total, length.minutes)


class Score(NamedTuple):
    """Result of a validation.

    Attributes:
        step: optimizer steps done.
        psnr: of novel views (of inputs without novel ones), dB, the mean over the objects.
    """

    step: int
    psnr: float

    def __str__(self) -> str:
        return f"{self.psnr:.4g} dB at step {self.step}"


@dataclass(kw_only=True)
class RunState:
    """State of a run: everything that its steps and validations change.

    Attributes:
        model: the model, on the world's device.
        ema: running average of its weights, or None.
        optimizer: of the model.
        schedule: of the learning rate.
        step: optimizer steps done.
        skipped: steps that were not finite.
        skipped_in_row: the last ones of them.
        elapsed: seconds of training.
        scores: of the ``first``, ``best`` and ``last`` validation.
        saved: step of the last checkpoint in the run folder; -1 without one.
    """

    model: Gamba
    ema: Ema | None
    optimizer: torch.optim.Optimizer
    schedule: Schedule
    step: int = 0
    skipped: int = 0
    skipped_in_row: int = 0
    elapsed: float = 0.0
    scores: dict[str, Score] = field(default_factory=dict)
    saved: int = -1

    @classmethod
    def begin(cls, model: Gamba, setup: Setup) -> RunState:
        """Return the state before the first step."""
        decay = setup.config.optim.ema
        return cls(
            model=model,
            optimizer=build_optimizer(model),
            ema=Ema(model, decay) if decay else None,
            schedule=setup.schedule(setup.config.length),
        )

    @property
    def models(self) -> dict[str, Gamba]:
        """Models of a checkpoint by file stem; the last one is the result."""
        return {"model": self.model} | ({"ema": self.ema.model} if self.ema else {})

    @property
    def result(self) -> Gamba:
        """Model that is validated and written at the end."""
        return self.ema.model if self.ema else self.model

    def save(self, setup: Setup) -> None:
        """Write a checkpoint, unless this step has one.

        Raises:
            UserError: as ``save_checkpoint``.
        """
        if self.saved == self.step:
            return
        values = {
            "version": 2,
            "config": setup.config.to_dict(),
            "objects": setup.data.fingerprint,
            "content": setup.data.content,
            "step": self.step,
            "skipped": self.skipped,
            "skipped_in_row": self.skipped_in_row,
            "elapsed": self.elapsed,
            "world_size": setup.world.size,
            "ema_updates": self.ema.updates if self.ema else 0,
            "scores": {name: tuple(score) for name, score in self.scores.items()},
            "new_length": asdict(self.schedule.since),
            "optimizer": self.optimizer.state_dict(),
            "rng": torch.get_rng_state(),
            "rng_cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        }
        save_checkpoint(setup.config.run.out, self.step, self.models, values, KEPT)
        self.saved = self.step

    def restore(self, checkpoint: Path, setup: Setup) -> str | None:
        """Continue from a checkpoint, bit-identically on one device.

        Everything is read and checked before anything is loaded. Only the main process reads, so no
        shared disk is needed.

        Returns:
            A line about the learning rate if the run has another length.

        Raises:
            UserError: the checkpoint is damaged, or belongs to a run with other options, data or
                number of objects a step; the message names the differences.
        """

        def read() -> tuple[Stored, LengthConfig, dict[str, Any], dict[str, Any]]:
            stored, length = read_run(checkpoint, setup)
            moments = checked_moments(self.optimizer, stored.optimizer, checkpoint / "state.pt")
            files = {name: checkpoint / f"{name}.safetensors" for name in self.models}
            weights = {n: read_weights_of(files[n], model) for n, model in self.models.items()}
            return stored, length, moments, weights

        stored, length, moments, weights = setup.world.broadcast_from_main(read)
        for name, model in self.models.items():
            model.load_stored_state(weights[name])
        if self.ema is not None:
            self.ema.updates = stored.ema_updates
        self.optimizer.load_state_dict(moments)
        self.step, self.elapsed = stored.step, stored.elapsed
        self.skipped, self.skipped_in_row = stored.skipped, stored.skipped_in_row
        self.scores = {name: Score(*score) for name, score in stored.scores.items()}
        old = replace(setup.schedule(length), since=stored.new_length)
        self.schedule, note = self.schedule.after(old, self.step, self.elapsed)
        self.saved = self.step if checkpoint.parent.parent == setup.config.run.out else -1
        torch.set_rng_state(stored.rng)
        if len(stored.rng_cuda) == torch.cuda.device_count():
            torch.cuda.set_rng_state_all(stored.rng_cuda)
        return note


class Stored(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """Fields of ``state.pt``: everything that a resumed run needs besides the weights."""

    version: Literal[2]
    config: dict[str, Any]
    objects: str
    content: str = ""  # unknown
    step: _Count
    skipped: _Count
    skipped_in_row: _Count
    elapsed: Annotated[float, msgspec.Meta(ge=0, le=1e12)]
    world_size: Annotated[int, msgspec.Meta(ge=1)]
    ema_updates: _Count
    optimizer: dict[str, Any]
    rng: Any
    rng_cuda: list[Any]
    new_length: NewLength
    scores: dict[str, tuple[_Count, float]]  # values of RunState.scores, by name


class _Plan(msgspec.Struct):
    """Part of the stored options that a resumed run is compared with by itself."""

    length: LengthConfig
    views: DataConfig


def step_of(checkpoint: Path) -> int:
    """Return the step of a checkpoint from its folder name."""
    return int(checkpoint.name.split("_")[1])


def list_checkpoints(run: Path) -> list[Path]:
    """List the run's checkpoints, oldest first."""
    folder = run / "checkpoints"
    paths = [p for p in folder.iterdir() if _NAME.fullmatch(p.name)] if folder.is_dir() else []
    return sorted(paths, key=step_of)


def save_checkpoint(run: Path, step: int, models: dict[str, Gamba], state: dict, keep: int) -> Path:
    """Write a checkpoint atomically, and remove the oldest ones.

    Args:
        run: the run folder.
        step: optimizer steps done.
        models: models by file stem, written by ``save_model``.
        state: content of ``state.pt``, nested tensors and plain values.
        keep: number of checkpoints up to this step that remain; later ones stay.

    Returns:
        The checkpoint's folder, ``RUN/checkpoints/step_<step>``.

    Raises:
        UserError: the checkpoint cannot be written; older checkpoints are untouched.
    """
    folder = run / "checkpoints"
    target = folder / f"step_{step:06d}"

    sweep(folder, age=0)  # left by killed processes: a run folder has one writer
    with atomic_folder(target, replace=True) as temporary:
        for name, model in models.items():
            save_model(temporary / f"{name}.safetensors", model)
        try:
            torch.save(state, temporary / "state.pt")
        except RuntimeError as error:  # raised by torch's zip writer
            reason = f"state.pt cannot be written; is the disk full? ({reason_of(error)})"
            raise OSError(reason) from error
        write_json(temporary / CHECKSUMS, {p.name: sha256(p) for p in sorted(temporary.iterdir())})
    write_json(run / "latest.json", {"checkpoint": f"checkpoints/{target.name}", "step": step})
    done = list_checkpoints(run)
    # Later steps are another branch, or damaged: they must not displace this one.
    older = done[: done.index(target)]
    for old in older[: max(0, len(older) + 1 - keep)]:
        try:
            remove_folder(old)
        except OSError as error:
            raise UserError(f"cannot remove {old}: {error.strerror or error}") from error
    return target


def find_checkpoint(
    run: Path, resume: str, warn: Callable[[str], None] = warnings.warn
) -> Path | None:
    """Find the checkpoint of ``--resume``; None for a fresh start.

    Args:
        run: the run folder.
        resume: "auto" (the newest intact checkpoint of the run folder, if any), "never", or the
            path of a checkpoint or of another run folder.
        warn: called with one line for each damaged checkpoint that "auto" skips.

    Raises:
        UserError: the run folder holds checkpoints despite "never", the path holds none, or its
            checkpoint is damaged; the message names the newest intact one.
    """
    if resume in ("auto", "never"):
        checkpoints = list_checkpoints(run)
        if checkpoints and resume == "never":
            raise UserError(f"{run}: already holds a run; give another --out or --resume auto")
        return _newest_intact(checkpoints, warn) if checkpoints else None
    path = Path(resume)
    if not (path / "state.pt").is_file():
        checkpoints = list_checkpoints(path)
        if not checkpoints:
            raise UserError(f"--resume {path}: no checkpoint found")
        path = checkpoints[-1]
    reason = damage(path)
    if reason:
        beside = [p for p in list_checkpoints(path.parent.parent) if p != path]
        intact = next((p for p in reversed(beside) if not damage(p)), None)
        advice = f"--resume {intact} is intact" if intact else "no other is intact"
        raise UserError(f"{reason}; {advice}")
    return path


def _newest_intact(checkpoints: list[Path], warn: Callable[[str], None]) -> Path:
    """Return the newest intact checkpoint. Raises UserError if all are damaged."""
    reasons = []
    for checkpoint in reversed(checkpoints):
        reason = damage(checkpoint)
        if not reason:
            for text in reasons:
                warn(f"{text}; resuming from {checkpoint}")
            return checkpoint
        reasons.append(reason)
    raise UserError(f"{reasons[0]}; no checkpoint of this run is intact")


def damage(checkpoint: Path) -> str | None:
    """Describe the damage of a checkpoint's files; None if they are intact."""
    try:
        listed = checkpoint / CHECKSUMS
        for name, wanted in {**_NEEDED, **read_document(listed, dict[str, _Digest])}.items():
            path = checkpoint / plain_name(name, str(listed))
            if path.is_symlink() or not path.is_file():  # reading a pipe would never end
                return f"{path}: damaged, not a plain file"
            if sha256(path) != wanted:
                return f"{path}: damaged, its content has changed (SHA-256)"
    except UserError as error:
        return str(error)
    return None


def read_state(checkpoint: Path) -> dict[str, Any]:
    """Read ``state.pt`` onto the CPU.

    Raises:
        UserError: the file is missing, truncated or of another format.
    """
    path = checkpoint / "state.pt"
    state = read_torch(path, "damaged, take an older checkpoint")
    if not isinstance(state, dict):
        raise UserError(f"{path}: damaged, it does not contain the state of a run")
    return state


def _renamed(state: dict[str, Any]) -> dict[str, Any]:
    """Return a state with the present names of what older checkpoints name otherwise."""
    if isinstance(config := state.get("config"), dict):
        state["config"] = renamed(config)
    length = state.get("new_length")
    if isinstance(length, dict) and "share" in length:
        length["fraction"] = length.pop("share")
    return state


def check_state(state: dict[str, Any], source: str) -> Stored:
    """Check types and ranges of a ``state.pt``, except the optimizer's part.

    Raises:
        UserError: a field is missing, unknown, of the wrong type or out of range.
    """
    try:
        fields = msgspec.convert(state, Stored)
        msgspec.json.encode(fields.config)  # only plain values, so that they can be compared
        for rng in (fields.rng, *fields.rng_cuda):
            if not isinstance(rng, torch.Tensor) or rng.dtype != torch.uint8 or rng.ndim != 1:
                raise ValueError("rng is not the state of a generator")
        torch.Generator().set_state(fields.rng)  # raises on an invalid state
    except (ValueError, TypeError, RuntimeError, AttributeError) as error:
        # msgspec raises a ValueError, but it treats a tensor as a mapping without keys
        raise UserError(f"{source}: damaged, {first_line(error)}") from error
    return fields


def read_run(checkpoint: Path, setup: Setup) -> tuple[Stored, LengthConfig]:
    """Read and check the ``state.pt`` of a resumed run; also return its planned length.

    Raises:
        UserError: the state is damaged, or of a run with other options, data or number of objects
            a step; the message names the differences, and how to continue nevertheless.
    """
    source = str(checkpoint / "state.pt")
    stored = check_state(_renamed(read_state(checkpoint)), source)
    try:
        plan = msgspec.convert(stored.config, _Plan, dec_hook=lambda kind, value: kind(value))
    except (ValueError, TypeError) as error:
        raise UserError(f"{source}: damaged, {first_line(error)}") from error
    config, processes = setup.config, setup.world.size
    ignored = () if config.views.procedural else STEP_SIZE
    differing = config_differences(stored.config, config.to_dict(), ignored=ignored)
    if stored.objects != setup.data.fingerprint:
        names = f"{stored.objects[:80]} there, {setup.data.fingerprint} here"
        differing.append(f"objects ({names})")
    elif stored.content not in ("", setup.data.content):
        names = f"{stored.content[:80]} there, {setup.data.content} here"
        differing.append(f"images and cameras of these objects ({names})")
    if config.views.procedural and stored.world_size != processes:
        differing.append(f"world_size ({stored.world_size} there, {processes} here)")
    there = plan.views.batch_size * plan.views.accumulate * stored.world_size
    here = setup.step_size
    if here != there:
        each, remainder = divmod(there, config.views.accumulate * processes)
        way = "" if remainder else f": --batch-size {each} keeps it"
        differing.append(f"objects a step ({there} there, {here} here{way})")
    if differing:
        raise UserError(
            f"{checkpoint}: belongs to another run: {', '.join(differing[:20])}; to start from its "
            f"weights alone: --init {checkpoint}, and another --out"
        )
    return stored, plan.length


def find_initial(path: Path, warn: Callable[[str], None] = warnings.warn) -> Path:
    """Find the model file of ``--init``.

    Args:
        path: a model file, a checkpoint's folder, or a run folder, of which the newest intact
            checkpoint is taken. The averaged weights of a checkpoint are preferred.
        warn: called with one line for each damaged checkpoint that is skipped.

    Raises:
        UserError: no model is found, or a checkpoint is damaged.
    """
    if not path.is_dir():
        return path
    if (path / "state.pt").exists():
        reason = damage(path)
        if reason:
            raise UserError(f"--init {reason}")
    elif checkpoints := list_checkpoints(path):
        path = _newest_intact(checkpoints, warn)
    names = [name for name in ("ema.safetensors", "model.safetensors") if (path / name).is_file()]
    if not names:
        raise UserError(f"--init {path}: holds neither a model nor a checkpoint")
    return path / names[0]


def read_weights_of(path: Path, model: Gamba) -> dict[str, torch.Tensor]:
    """Read the tensors of a model file for a model of the same configuration.

    Raises:
        UserError: the file is missing, damaged or not finite, or its configuration differs; the
            message names the differing fields.
    """
    config, _ = read_config(path)
    stored, wanted = asdict(config), asdict(model.config)
    differing = [name for name in wanted if stored[name] != wanted[name]]
    if differing:
        raise UserError(f"{path}: is a model with a different {', '.join(differing)}")
    try:
        return read_weights(path, model)
    except ValueError as error:
        raise UserError(f"{path}: does not fit its own configuration: {error}") from error


def load_weights(path: Path, model: Gamba) -> None:
    """Load a model file into a model of the same configuration.

    Raises:
        UserError: as for ``read_weights_of``; the model is then unchanged.
    """
    model.load_stored_state(read_weights_of(path, model))
