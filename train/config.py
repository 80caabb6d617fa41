"""Options of ``gamba train``. Defaults are the paper's (§4.1) where it states them."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Container, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import tyro
from msgspec import Meta

from gamba_warp.conventions import DeviceChoice, Precision
from gamba_warp.errors import UserError
from gamba_warp.kernels.runtime.system import cores
from gamba_warp.model.config import PRESETS, GambaConfig, Preset
from gamba_warp.untrusted.documents import value_of
from gamba_warp.untrusted.ranges import Minutes, Seed, Threads, check_options, option

_Count = Annotated[int, Meta(ge=1, le=10**12)]
_Weight = Annotated[float, Meta(ge=0, le=1e6)]
_Every = Annotated[int, Meta(ge=0, le=10**12)]
RecipeName = Literal["paper", "tiny", "rays"]


@dataclass(frozen=True, kw_only=True)
class LengthConfig:
    """Length of the training. The schedules end with the steps or epochs, else with the minutes.

    Attributes:
        steps: Number of optimizer steps.
        epochs: Number of passes over the objects; 400 if no limit is given.
        minutes: Training time, resumed parts included. If it is the only limit, the schedules
            follow the clock, and two runs are not bit-identical. A run may be resumed with another
            length: the learning rate then continues from its current value and reaches 0 at the new
            end. If it was already near 0, it first rises to the value of a run of the new length,
            over a tenth of the remaining steps, and the command says so.
    """

    steps: _Count | None = None
    epochs: Annotated[float, Meta(gt=0, le=1e9)] | None = None
    minutes: Minutes | None = None


@dataclass(frozen=True, kw_only=True)
class DataConfig:
    """Data of a training step.

    Attributes:
        batch_size: Objects per step and process, before accumulation.
        accumulate: Batches per optimizer step.
        size: Side of the rendered images, pixels.
        views_per_object: Novel views per object; if not given, they grow evenly over the run from 2
            to 6.
        background: Colour behind the rendered and the true images; "random" draws one for each
            object and step. The input image always has the model's own background.
        extra: More datasets; their training objects are added to DATA's. The objects of one
            that is named twice come twice in an epoch.
        front_fraction: Fraction of the samples whose input is a view from the front: the object's
            first, or another one at -35 to 35 degrees of azimuth and 0 to 20 of elevation. The
            other samples take any view.
        flip: Fraction of the samples whose object is mirrored, with its cameras.
        color_jitter: Fraction of the samples whose colour channels are permuted and change gamma.
        procedural: Fraction of the samples that show procedural objects (gamba data procedural),
            which other processes make and render during the training; the others are of the
            datasets.
        cache: Keep decoded images in memory, with 8 bits a channel. Depth images are read when
            they are used.
        workers: Threads that decode images ahead of the training; also the largest number of
            batches kept ready. By default 1, or with a GPU one per core, at most 8. The number
            does not change the result.
    """

    batch_size: Annotated[int, Meta(ge=1, le=100_000)] = 8
    accumulate: Annotated[int, Meta(ge=1, le=100_000)] = 1
    size: Annotated[int, Meta(ge=1, le=4096)] = 128
    views_per_object: Annotated[int, Meta(ge=0, le=1000)] | None = None
    background: Literal["white", "black", "random"] = "white"
    extra: tuple[Path, ...] = ()
    front_fraction: Annotated[float, Meta(ge=0, le=1)] = 0.0
    flip: Annotated[float, Meta(ge=0, le=1)] = 0.0
    color_jitter: Annotated[float, Meta(ge=0, le=1)] = 0.0
    procedural: Annotated[float, Meta(ge=0, le=1)] = 0.0
    cache: bool = False
    workers: Annotated[int, Meta(ge=1, le=1024)] | None = None

    def threads(self, device: str) -> int:
        """Return the number of workers for a device type, "cpu" or "cuda"."""
        return self.workers or (min(8, cores()) if device == "cuda" else 1)


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """Weights of the loss (paper eq. loss_train).

    Attributes:
        lpips: Use of LPIPS-VGG: "auto" uses it if its weights are there, "on" requires them. On a
            CPU it multiplies the time of a step (docs/train-your-own.md).
        lpips_weight: Weight of LPIPS.
        lpips_after: Leave LPIPS out for this many steps; early in training it can keep the model
            in a white collapse.
        lpips_crop: Side of a square around a random pixel of the object that LPIPS compares in one
            novel view of each object; 0 compares all views whole, which on a CPU would take most of
            a step.
        ssim_weight: Weight of 1 - SSIM; not in the paper.
        novel_weight: Weight of each novel view relative to the input view, in all terms but LPIPS
            of crops; the result is a weighted mean over the views.
        depth_weight: Weight of the depth loss: the first layer of "rays" is pulled to the first
            surface of the input view, the last layer to the last surface. The data needs depth
            images (gamba data render --depth); not in the paper.
        mask_l1_weight: Weight of the absolute error of alpha, added to its squared error: where a
            position is unknown, its minimum is at 0 or 1 and not between. Not in the paper.
        translucency_weight: Weight of 4 alpha (1 - alpha) of rendered alpha beyond that of the true
            one, in views more than 20 degrees from the input. Not in the paper.
        radial_mask: The radial mask constraint on the projected centres (paper Table 2).
    """

    lpips: Literal["auto", "on", "off"] = "auto"
    lpips_weight: _Weight = 0.5
    lpips_after: _Every = 0
    lpips_crop: _Every = 0
    ssim_weight: _Weight = 0.0
    novel_weight: _Weight = 1.0
    depth_weight: _Weight = 0.0
    mask_l1_weight: _Weight = 0.0
    translucency_weight: _Weight = 0.0
    radial_mask: bool = True


@dataclass(frozen=True, kw_only=True)
class OptimConfig:
    """AdamW, and the running average of the weights.

    Attributes:
        lr: Peak learning rate; after a warm-up it falls to 0 according to --schedule.
        schedule: "cosine" falls along half a cosine from the end of the warm-up; "trapezoid" stays
            at the peak and falls linearly at the end, so runs of different lengths begin alike.
        decay_fraction: Fraction of the run in which "trapezoid" falls.
        warmup_steps: Steps of the linear warm-up, a tenth of the run at most.
        ema: Decay of the weights' running average, shorter at the start; 0 turns it off.
        precision: Precision of the products in the network, by autocast; parameters, losses and
            rendering stay float32. "auto" is bfloat16 if a trial of 50 ms finds it faster on all
            processes, else float32; a resumed run chooses again.
    """

    lr: Annotated[float, Meta(gt=0, le=10)] = 1e-3
    schedule: str = "cosine"
    decay_fraction: Annotated[float, Meta(gt=0, le=1)] = 0.2
    warmup_steps: _Every = 100
    ema: Annotated[float, Meta(ge=0, lt=1)] = 0.999
    precision: Precision = "float32"


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Files, logging and the machine.

    Attributes:
        out: Run folder.
        config: Take the options of another run: its folder, or its config.json. Further options
            override them, and so does DATA if it comes first; without --out that run itself is
            resumed.
        recipe: Set of options: "paper" is the paper's training, with 256 objects a step over all
            processes; "rays" is the shipped model's network in one run; "tiny" is a small model
            with the paper's decoder, to compare with. Further options override it; with --help it
            shows the recipe's options and their sources.
        resume: "auto" resumes from the newest checkpoint of the run folder; else "never", or the
            path of a checkpoint. The number of processes may be another one, if the number of
            objects a step stays the same (--batch-size and --accumulate).
        init: Start from the weights of this model file, checkpoint or run folder (same
            architecture; the averaged weights if there are any), with a fresh optimizer. Use it
            with another --out to continue with other losses or data.
        encoder_weights: File of the image encoder's weights, or "random" to train one from scratch.
        log_every: Steps between two lines of the log.
        val_every: Steps between two validations (and sample images); 0 for none.
        val_objects: Held-out objects to validate on, and as many training objects beside them.
        save_every: Steps between two checkpoints; one is always saved at the end, and the last two
            are kept.
        save_minutes: Minutes after which a checkpoint is saved anyway, so that a run that is killed
            loses no more.
        device: Device to train on; "auto" is the GPU if there is one.
        threads: Number of CPU threads; all cores if not given.
        activation_checkpointing: Keep only the blocks' inputs and recompute each block in the
            backward pass: the same result in less memory and more time.
        graph: Replay the launches of a step as a CUDA graph: the same result without the launch
            overhead of the host. "auto" does so on a GPU, where a step can be captured.
        seed: Seed of the initial weights and of the order of the data.
    """

    out: Path = Path("runs/gamba")
    config: Path | None = None
    recipe: RecipeName | None = None
    resume: str = "auto"
    init: Path | None = None
    encoder_weights: str | None = None
    log_every: _Count = 10
    val_every: _Every = 500
    val_objects: Annotated[int, Meta(ge=0, le=1_000_000)] = 8
    save_every: _Count = 500
    save_minutes: Minutes | None = None
    device: DeviceChoice = "auto"
    threads: Threads | None = None
    activation_checkpointing: bool = False
    graph: Literal["auto", "off"] = "auto"
    seed: Seed = 0


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Train a model on posed views (``gamba data render`` makes them).

    Attributes:
        data: Dataset folder; or a folder of shards (gamba data pack), or its address on a server,
            http(s)://.
        preset: Preset of the model.
        set: Changes to the preset, e.g. prepend=false depth=4; the fields are GambaConfig's.
    """

    data: tyro.conf.Positional[Path]
    preset: Preset = "small"
    set: Annotated[tuple[str, ...], tyro.conf.arg(metavar="FIELD=VALUE ...")] = ()
    length: LengthConfig = field(default_factory=LengthConfig)
    views: DataConfig = field(default_factory=DataConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    run: RunConfig = field(default_factory=RunConfig)

    def __post_init__(self) -> None:
        for group in (self.length, self.views, self.loss, self.optim, self.run):
            check_options(group)
        if self.loss.lpips == "on" and self.views.size < 16:
            raise UserError(f"--lpips on: needs --size 16 or more, it is {self.views.size}")
        if self.loss.lpips_crop and not 16 <= self.loss.lpips_crop <= self.views.size:
            raise UserError(
                f"--lpips-crop {self.loss.lpips_crop}: must be 0, or 16 to --size {self.views.size}"
            )
        if self.loss.depth_weight and self.model_config().decoder != "rays":
            raise UserError('--depth-weight: needs the decoder "rays", whose layers have a depth')
        self.model_config()

    def model_config(self) -> GambaConfig:
        """Return the preset with the changes of ``--set``.

        An encoder with fresh weights is trained, and stored with the model.

        Raises:
            UserError: a field is unknown, or its value invalid, or a frozen encoder has no weights.
        """
        names = [f.name for f in fields(GambaConfig)]
        changes = {}
        for change in self.set:
            name, equals, text = change.partition("=")
            if not equals or name not in names:
                raise UserError(
                    f"--set {change}: expected FIELD=VALUE, FIELD of {', '.join(names)}"
                )
            changes[name] = value_of(text)
        try:
            config = replace(PRESETS[self.preset], **changes)
            weights, frozen = self.run.encoder_weights, changes.get("encoder_frozen")
            if weights == "random" and frozen:
                raise UserError("encoder_frozen=true needs --encoder-weights FILE, not random ones")
            if frozen is None and (weights == "random" or weights is None and _is_own(config)):
                config = replace(config, encoder_frozen=False)
        except UserError as error:
            raise UserError(f"--set: {error}") from error
        return config

    def to_dict(self) -> dict:
        """Return JSON-ready values, with the model's full configuration under ``model``."""
        values = json.loads(json.dumps(asdict(self), default=str))
        values["model"] = json.loads(self.model_config().to_json())
        return values


def _is_own(config: GambaConfig) -> bool:
    """Return True if a script has added the model's encoder to ``ENCODERS``."""
    if config.encoder in ("none", "vgg16"):
        return False
    from gamba_warp.model.encoders import ENCODERS

    return config.encoder in ENCODERS


# A run may be resumed with other values of these: they change where it reads and writes and how
# long it is, but not the result of a step. All others must stay the same.
_MAY_CHANGE = {"data", "preset", "set", "length", "run", "views.workers", "views.cache"}
_MUST_STAY = {"run.seed"}
# The batch of a process and its accumulation may change if the objects of a step stay.
STEP_SIZE = {"views.batch_size", "views.accumulate"}
FOLLOWING = {"model"}  # of a config.json: it follows from the options
# These may differ between the processes of one run; files are compared by content.
_PER_MACHINE = {
    *("views.extra", "views.workers", "views.cache", "run.out", "run.config", "run.resume"),
    *("run.init", "run.encoder_weights", "run.device", "run.threads"),
}
# Groups of options in a run's config.json; "model" follows from the preset and --set.
GROUPS = {
    "length": LengthConfig,
    "views": DataConfig,
    "loss": LossConfig,
    "optim": OptimConfig,
    "run": RunConfig,
    "model": GambaConfig,
}


# Options of earlier versions, by group.
_RENAMED = {
    "views": {
        "made": "procedural",
        "front_share": "front_fraction",
        "mirror": "flip",
        "recolor": "color_jitter",
    },
    "optim": {"decay_share": "decay_fraction"},
    "run": {"recompute": "activation_checkpointing"},
}


def renamed(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a ``to_dict`` value with the present names of an earlier version's options."""
    present = dict(values)
    for group, names in _RENAMED.items():
        if isinstance(options := present.get(group), dict):
            present[group] = {names.get(name, name): value for name, value in options.items()}
    return present


def config_of(values: Mapping[str, Any], source: str) -> TrainConfig:
    """Convert a ``to_dict`` value without ``model`` to options; missing ones get their default.

    Args:
        values: untrusted values.
        source: their origin, for the error message.

    Raises:
        UserError: an option is unknown or has an invalid value; the message names it.
    """
    values = renamed(values)
    try:
        config = msgspec.convert(values, TrainConfig, dec_hook=lambda kind, value: kind(value))
    except (msgspec.ValidationError, UserError) as error:
        text = re.sub(r"^(.*) - at `\$\.(?:[a-z]+\.)?(\w+).*`$", r"\2: \1", str(error))
        raise UserError(f"{source}: {text}") from error
    if unknown := sorted(_flatten(values).keys() - _flatten(config.to_dict()).keys()):
        raise UserError(f"{source}: not the options of a run (unknown {', '.join(unknown)[:200]})")
    return config


def config_differences(stored: dict, current: dict, ignored: Container[str] = ()) -> list[str]:
    """Compare two ``to_dict`` values; a missing option counts as its default.

    Args:
        stored: of the resumed run; an older version may have fewer options.
        current: of this run.
        ignored: names of options that are not compared.

    Returns:
        The differing fields, each with both values.
    """
    defaults = _flatten(_defaults())
    old, new = ({**defaults, **_flatten(values)} for values in (stored, current))
    differing = []
    for name in sorted(old.keys() | new.keys()):
        may_change = {name, name.split(".")[0]} & _MAY_CHANGE and name not in _MUST_STAY
        if old.get(name) != new.get(name) and not may_change and name not in ignored:
            there, here = (str(values.get(name))[:80] for values in (old, new))
            differing.append(f"{name} ({there} there, {here} here)")
    return differing


def options_of_all(values: dict) -> dict[str, object]:
    """Options that all processes of a run must have in common.

    Args:
        values: result of ``to_dict``.

    Returns:
        Values by name, without paths, devices and numbers of workers of a machine.
    """
    flat = _flatten({name: value for name, value in values.items() if name not in ("data", "set")})
    return {name: value for name, value in flat.items() if name not in _PER_MACHINE}


def _defaults() -> dict:
    return json.loads(json.dumps({k: asdict(v()) for k, v in GROUPS.items()}, default=str))


def _flatten(values: dict, prefix: str = "") -> dict:
    flat = {}
    for name, value in values.items():
        if isinstance(value, dict):
            flat |= _flatten(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = value
    return flat


def command_line(values: dict) -> str:
    """Return the ``gamba train`` command of a ``to_dict`` value, without defaults."""
    words = ["gamba", "train", str(values.get("data")), "--preset", str(values.get("preset"))]
    if values.get("set"):
        words += ["--set", *map(str, values["set"])]
    for group, default in _defaults().items():
        if group == "model":  # follows from the preset and --set
            continue
        for name, value in values.get(group, {}).items():
            # The recipe's options are already in the values, overridden by the given ones.
            if name not in default or value == default[name] or name == "recipe":
                continue
            if isinstance(value, bool):
                words.append(option(name if value else f"no_{name}"))
            else:
                words += [option(name), *map(str, value if isinstance(value, list) else [value])]
    return shlex.join(words)
