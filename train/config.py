"""Options of ``gamba train``. Defaults are the paper's (§4.1) where it states them."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from gamba_warp.conventions import DeviceChoice
from gamba_warp.errors import UserError
from gamba_warp.model.config import PRESETS, GambaConfig, Preset


@dataclass(frozen=True, kw_only=True)
class LengthConfig:
    """How long to train. The schedules end with the steps or epochs, else with the minutes."""

    steps: int | None = None
    """Number of optimizer steps."""
    epochs: float | None = None
    """Number of passes over the objects, or with --overfit over its views; 400 if no limit is
    given at all."""
    minutes: float | None = None
    """Training time, resumed parts included. If it is the only limit, the schedules follow the
    clock, and two runs are not the same to the bit."""


@dataclass(frozen=True, kw_only=True)
class DataConfig:
    """What a step sees."""

    batch_size: int | None = None
    """Objects per step and process, before accumulation; 8 if not given, or 1 with --overfit."""
    accumulate: int = 1
    """Batches per optimizer step."""
    size: int = 128
    """Side of the rendered pictures, pixels."""
    views_first: int = 2
    """Novel views per object at the start."""
    views_last: int = 6
    """Novel views per object at the end; the number grows in equal shares of the run."""
    views_per_object: int | None = None
    """A fixed number of novel views, in place of the growing one; 9 with --overfit."""
    background: Literal["white", "black", "random"] = "white"
    """Colour behind the rendered and the true pictures; "random" draws one for each object and
    step. The input picture always lies on the model's own background."""
    reference: Literal["auto", "random", "first"] = "auto"
    """The view that is the input: any, or always the first; "auto" is first with --overfit."""
    overfit: str | None = None
    """Train on this one object (uid or number) and validate on its training views: a smoke test."""
    cache: bool = False
    """Keep decoded pictures in memory."""
    workers: int = 1
    """Threads that decode pictures ahead of the training."""


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """Weights of the loss (paper eq. loss_train)."""

    mask_weight: float = 1.0
    """Weight of the alpha channel's squared error."""
    lpips: Literal["auto", "on", "off"] = "auto"
    """Use of LPIPS-VGG: "auto" uses it if its weights are there, "on" demands them."""
    lpips_weight: float = 0.5
    """Weight of LPIPS."""
    lpips_after: int = 0
    """Leave LPIPS out for this many steps; it can hold a young model in a white collapse."""
    radial_mask: bool = True
    """The radial mask constraint on the projected centres (paper Table 2)."""
    rdist_weight: float = 0.1
    """Weight of the radial mask constraint at the start."""
    rdist_epochs: float = 10.0
    """Epochs over which the weight of the radial mask constraint falls linearly to 0."""
    rdist_steps: int | None = None
    """The same in steps, in place of --rdist-epochs."""


@dataclass(frozen=True, kw_only=True)
class OptimConfig:
    """AdamW, and the running average of the weights."""

    lr: float = 1e-3
    """Peak learning rate; warm-up, then cosine to 0."""
    warmup_steps: int = 100
    """Steps of the linear warm-up, a tenth of the run at most."""
    weight_decay: float = 0.05
    """Weight decay of matrices, except those that a module flags."""
    beta2: float = 0.95
    """Second-moment decay of AdamW."""
    clip: float = 1.0
    """Largest norm of the gradient."""
    ema: float = 0.999
    """Decay of the weights' running average, shorter at the start; 0 turns it off."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Precision in the network, by autocast; parameters, losses and rendering stay float32."""
    max_skipped: int = 20
    """Give up after so many non-finite steps in a row."""


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Files, logging and the machine."""

    out: Path = Path("runs/gamba")
    """Run folder."""
    resume: str = "auto"
    """"auto" goes on where the run folder stands; else "never", or the path of a checkpoint."""
    init: Path | None = None
    """Start from the weights of this model file (same architecture), with a fresh optimizer."""
    encoder_weights: str | None = None
    """File of the image encoder's weights, or "random" to train one from scratch."""
    log_every: int = 10
    """Steps between two lines of the log."""
    val_every: int = 500
    """Steps between two validations (and sample pictures); 0 for none."""
    val_objects: int = 8
    """Held-out objects to validate on."""
    val_views: int = 4
    """Novel views of each of these, evenly spaced in the list; --overfit takes all."""
    save_every: int = 500
    """Steps between two checkpoints; one is always saved at the end."""
    keep: int = 2
    """Checkpoints kept; the oldest go first."""
    tensorboard: bool = True
    """Write TensorBoard files, if it is installed."""
    device: DeviceChoice = "auto"
    """Device that computes; "auto" is the GPU if there is one."""
    threads: int | None = None
    """Number of CPU threads; all cores if not given."""
    recompute: bool = False
    """Keep only the blocks' inputs for the gradient and run each block again there: the same
    result in less memory and more time."""
    seed: int = 0
    """Seed of the initial weights and of the order of the data."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Trains a model on posed views (``gamba data render`` makes them)."""

    data: tyro.conf.Positional[Path]
    """Dataset folder."""
    preset: Preset = "small"
    """Preset of the model."""
    set: Annotated[tuple[str, ...], tyro.conf.arg(metavar="FIELD=VALUE ...")] = ()
    """Changes to the preset, e.g. prepend=false depth=4; the fields are GambaConfig's."""
    length: LengthConfig = field(default_factory=LengthConfig)
    views: DataConfig = field(default_factory=DataConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    run: RunConfig = field(default_factory=RunConfig)

    def __post_init__(self) -> None:
        positive = {
            "steps": self.length.steps,
            "epochs": self.length.epochs,
            "minutes": self.length.minutes,
            "batch-size": self.views.batch_size,
            "accumulate": self.views.accumulate,
            "size": self.views.size,
            "workers": self.views.workers,
            "log-every": self.run.log_every,
            "save-every": self.run.save_every,
            "keep": self.run.keep,
            "threads": self.run.threads,
            "lr": self.optim.lr,
            "clip": self.optim.clip,
        }
        for name, value in positive.items():
            if value is not None and not value > 0:
                raise UserError(f"--{name} is {value}, it must be positive")
        views = (self.views.views_first, self.views.views_last, self.views.views_per_object or 0)
        if min(views) < 0:
            raise UserError(f"the number of novel views is {min(views)}, it must not be negative")
        if not 0 <= self.optim.ema < 1:
            raise UserError(f"--ema is {self.optim.ema}, not in [0, 1)")

    def model_config(self) -> GambaConfig:
        """The preset with the changes of ``--set``.

        Raises:
            UserError: no such field, or a value that does not fit.
        """
        names = [f.name for f in fields(GambaConfig)]
        changes = {}
        for change in self.set:
            name, equals, text = change.partition("=")
            if not equals or name not in names:
                raise UserError(
                    f"--set {change}: expected FIELD=VALUE, FIELD of {', '.join(names)}"
                )
            try:
                changes[name] = json.loads(text)
            except ValueError:
                changes[name] = text
        return replace(PRESETS[self.preset], **changes)

    def to_dict(self) -> dict:
        """JSON-ready values, the model's full configuration under ``model``."""
        values = json.loads(json.dumps(asdict(self), default=str))
        values["model"] = json.loads(self.model_config().to_json())
        return values


# A run may go on with other values of these: they change where it reads and writes and how far it
# goes, and not what a step computes. All others must stay as they were.
_MAY_CHANGE = {"data", "preset", "set", "length", "run", "views.workers", "views.cache"}
_MUST_STAY = {"run.seed"}


def config_differences(stored: dict, current: dict) -> list[str]:
    """Fields in which two ``to_dict`` values differ but may not, each with both values."""
    old, new = _flatten(stored), _flatten(current)
    differing = []
    for name in sorted(old.keys() | new.keys()):
        free = name in _MAY_CHANGE or name.split(".")[0] in _MAY_CHANGE
        if old.get(name) != new.get(name) and (not free or name in _MUST_STAY):
            differing.append(f"{name} ({old.get(name)} there, {new.get(name)} here)")
    return differing


def _flatten(values: dict, prefix: str = "") -> dict:
    flat = {}
    for name, value in values.items():
        if isinstance(value, dict):
            flat |= _flatten(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat
