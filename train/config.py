"""Options of ``gamba train``. Defaults are the paper's (§4.1) where it states them."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import tyro
from msgspec import Meta

from gamba_warp.conventions import DeviceChoice, Precision
from gamba_warp.errors import UserError
from gamba_warp.model.config import PRESETS, GambaConfig, Preset
from gamba_warp.untrusted.documents import value_of
from gamba_warp.untrusted.ranges import Minutes, Seed, Threads, check_options, option

_Count = Annotated[int, Meta(ge=1, le=10**12)]
_Views = Annotated[int, Meta(ge=0, le=1000)]
_Weight = Annotated[float, Meta(ge=0, le=1e6)]
_Every = Annotated[int, Meta(ge=0, le=10**12)]
RecipeName = Literal["paper", "tiny", "rays"]


@dataclass(frozen=True, kw_only=True)
class LengthConfig:
    """How long to train. The schedules end with the steps or epochs, else with the minutes.

    Attributes:
        steps: Number of optimizer steps.
        epochs: Number of passes over the objects, or with --overfit over its views; 400 if no limit
            is given at all.
        minutes: Training time, resumed parts included. If it is the only limit, the schedules
            follow the clock, and two runs are not the same to the bit. A run may be resumed with
            another length: the learning rate then goes on from where it was, and the rest of its
            fall ends with the new length. Where the fall was over, or almost so, it first rises
            again to what a run of the new length has there, over a tenth of the steps that are
            left, and the command says so.
    """

    steps: _Count | None = None
    epochs: Annotated[float, Meta(gt=0, le=1e9)] | None = None
    minutes: Minutes | None = None


@dataclass(frozen=True, kw_only=True)
class DataConfig:
    """What a step sees.

    Attributes:
        batch_size: Objects per step and process, before accumulation; 8 if not given, or 1 with
            --overfit.
        accumulate: Batches per optimizer step.
        size: Side of the rendered pictures, pixels.
        views_first: Novel views per object at the start.
        views_last: Novel views per object at the end; the number grows in equal shares of the run.
        views_per_object: A fixed number of novel views, in place of the growing one; 9 with
            --overfit.
        background: Colour behind the rendered and the true pictures; "random" draws one for each
            object and step. The input picture always lies on the model's own background.
        reference: The view that is the input: any, or always the first; "auto" is first with
            --overfit.
        extra: More datasets, whose training objects are added to those of DATA.
        front_share: Share of the samples whose input is a view from the front: the object's first,
            or another one at -35 to 35 degrees of azimuth and 0 to 20 of elevation; of the others
            it is any view.
        mirror: Share of the samples whose object is mirrored, with its cameras.
        recolor: Share of the samples whose colour channels change places and gamma.
        made: Share of the samples that show made objects (gamba data made), which other processes
            make and render while the model trains; the others are of the datasets.
        made_uses: Samples of each made object.
        made_views: Views of each made object.
        made_workers: Processes that make and render; the number changes no result.
        overfit: Train on this one object (uid or number) and validate on its training views: a
            smoke test.
        cache: Keep decoded pictures in memory.
        cache_device: Decode all pictures at the start and keep them on the device that trains, with
            8 bits a channel. Depth pictures are read when they are used.
        workers: Threads that decode pictures ahead of the training, and batches that lie ready at
            most; the number changes no result.
    """

    batch_size: Annotated[int, Meta(ge=1, le=100_000)] | None = None
    accumulate: Annotated[int, Meta(ge=1, le=100_000)] = 1
    size: Annotated[int, Meta(ge=1, le=4096)] = 128
    views_first: _Views = 2
    views_last: _Views = 6
    views_per_object: _Views | None = None
    background: Literal["white", "black", "random"] = "white"
    reference: Literal["auto", "random", "first"] = "auto"
    extra: tuple[Path, ...] = ()
    front_share: Annotated[float, Meta(ge=0, le=1)] = 0.0
    mirror: Annotated[float, Meta(ge=0, le=1)] = 0.0
    recolor: Annotated[float, Meta(ge=0, le=1)] = 0.0
    made: Annotated[float, Meta(ge=0, le=1)] = 0.0
    made_uses: Annotated[int, Meta(ge=1, le=10_000)] = 16
    made_views: Annotated[int, Meta(ge=2, le=1000)] = 12
    made_workers: Annotated[int, Meta(ge=1, le=1024)] = 1
    overfit: str | None = None
    cache: bool = False
    cache_device: bool = False
    workers: Annotated[int, Meta(ge=1, le=1024)] = 1


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """Weights of the loss (paper eq. loss_train).

    Attributes:
        mask_weight: Weight of the alpha channel's squared error.
        lpips: Use of LPIPS-VGG: "auto" uses it if its weights are there, "on" demands them. On a
            CPU it multiplies a step's time (docs/train-your-own.md).
        lpips_weight: Weight of LPIPS.
        lpips_after: Leave LPIPS out for this many steps; it can hold a young model in a white
            collapse.
        lpips_crop: Side of a random square, in pixels, that LPIPS compares in one view of each
            object; 0 compares all views whole, which on a CPU would take most of a step.
        ssim_weight: Weight of 1 - SSIM; the paper has no such term.
        novel_weight: Weight of each novel view against the input view, in all terms but LPIPS of
            crops; the mean over the views stays a mean.
        depth_weight: Weight of the depth of Gaussians: that of the first layer of "rays" is held to
            the input view's first surface, that of the last layer to the last. The data needs depth
            pictures (gamba data render --depth); the paper has no such term.
        radial_mask: The radial mask constraint on the projected centres (paper Table 2).
        rdist_weight: Weight of the radial mask constraint at the start.
        rdist_epochs: Epochs over which the weight of the radial mask constraint falls linearly to
            0.
        rdist_share: Largest share of the run in which that weight falls; it matters where the run
            is short.
        rdist_steps: Steps over which that weight falls, in place of --rdist-epochs and
            --rdist-share.
    """

    mask_weight: _Weight = 1.0
    lpips: Literal["auto", "on", "off"] = "auto"
    lpips_weight: _Weight = 0.5
    lpips_after: _Every = 0
    lpips_crop: _Every = 0
    ssim_weight: _Weight = 0.0
    novel_weight: _Weight = 1.0
    depth_weight: _Weight = 0.0
    radial_mask: bool = True
    rdist_weight: _Weight = 0.1
    rdist_epochs: Annotated[float, Meta(ge=0, le=1e9)] = 10.0
    rdist_share: Annotated[float, Meta(gt=0, le=1)] = 0.25
    rdist_steps: _Every | None = None


@dataclass(frozen=True, kw_only=True)
class OptimConfig:
    """AdamW, and the running average of the weights.

    Attributes:
        lr: Peak learning rate; after a warm-up it falls to 0 as --schedule says.
        schedule: "cosine" falls from the warm-up on, along half a cosine; "trapezoid" stays at the
            peak and falls linearly at the end, so that a longer run begins as a shorter one does.
        decay_share: Share of the run in which "trapezoid" falls.
        warmup_steps: Steps of the linear warm-up, a tenth of the run at most.
        weight_decay: Weight decay of matrices, except those that a module flags.
        beta2: Second-moment decay of AdamW.
        clip: Largest norm of the gradient.
        ema: Decay of the weights' running average, shorter at the start; 0 turns it off.
        precision: Precision of the products in the network, by autocast; parameters, losses and
            rendering stay float32. "auto" is bfloat16 where a trial of 50 ms finds it faster, on
            all processes, else float32; it chooses anew whenever the run goes on.
        max_skipped: Give up after so many non-finite steps in a row.
    """

    lr: Annotated[float, Meta(gt=0, le=10)] = 1e-3
    schedule: Literal["cosine", "trapezoid"] = "cosine"
    decay_share: Annotated[float, Meta(gt=0, le=1)] = 0.2
    warmup_steps: _Every = 100
    weight_decay: Annotated[float, Meta(ge=0, le=100)] = 0.05
    beta2: Annotated[float, Meta(ge=0, lt=1)] = 0.95
    clip: Annotated[float, Meta(gt=0, le=1e9)] = 1.0
    ema: Annotated[float, Meta(ge=0, lt=1)] = 0.999
    precision: Precision = "float32"
    max_skipped: _Count = 20


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Files, logging and the machine.

    Attributes:
        out: Run folder.
        config: Take the options of another run: its folder, or its config.json. Options beside this
            one replace those, and so does DATA if it comes first; without --out that run itself
            goes on.
        recipe: Options that belong together: "paper" is the paper's training, with 256 objects a
            step over all processes; "tiny" or "rays" that of the shipped model, at its size.
            Options beside it win; with --help it shows what the recipe sets, and from where.
        resume: "auto" goes on where the run folder stands; else "never", or the path of a
            checkpoint.
        init: Start from the weights of this model file, checkpoint or run folder (same
            architecture; the averaged weights where there are such), with a fresh optimizer. A run
            of other losses or data goes on so, in another --out.
        encoder_weights: File of the image encoder's weights, or "random" to train one from scratch.
        log_every: Steps between two lines of the log.
        val_every: Steps between two validations (and sample pictures); 0 for none.
        val_objects: Held-out objects to validate on.
        val_views: Novel views of each of these, evenly spaced in the list; --overfit takes all.
        save_every: Steps between two checkpoints; one is always saved at the end.
        keep: Checkpoints kept; the oldest go first.
        tensorboard: Write TensorBoard files, if it is installed.
        log: Boards beside TensorBoard: "wandb" is Weights & Biases, which its own settings send
            where they say (WANDB_PROJECT, WANDB_MODE=offline).
        device: Device that computes; "auto" is the GPU if there is one.
        threads: Number of CPU threads; all cores if not given.
        recompute: Keep only the blocks' inputs for the gradient and run each block again there: the
            same result in less memory and more time.
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
    val_views: Annotated[int, Meta(ge=0, le=100_000)] = 4
    save_every: _Count = 500
    keep: _Count = 2
    tensorboard: bool = True
    log: tuple[Literal["wandb"], ...] = ()
    device: DeviceChoice = "auto"
    threads: Threads | None = None
    recompute: bool = False
    seed: Seed = 0

    @property
    def boards(self) -> tuple[str, ...]:
        """Names of the boards that are written beside the log."""
        return (*(("tensorboard",) if self.tensorboard else ()), *dict.fromkeys(self.log))


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Trains a model on posed views (``gamba data render`` makes them).

    Attributes:
        data: Dataset folder.
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
        if self.views.made and self.views.overfit is not None:
            raise UserError("--made: --overfit trains on one object alone; leave one of them out")
        if self.loss.depth_weight and self.model_config().decoder != "rays":
            raise UserError('--depth-weight: only layers of the decoder "rays" have a depth')
        self.model_config()

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
            changes[name] = value_of(text)
        try:
            return replace(PRESETS[self.preset], **changes)
        except UserError as error:
            raise UserError(f"--set: {error}") from error

    def to_dict(self) -> dict:
        """JSON-ready values, the model's full configuration under ``model``."""
        values = json.loads(json.dumps(asdict(self), default=str))
        values["model"] = json.loads(self.model_config().to_json())
        return values


# A run may go on with other values of these: they change where it reads and writes and how far it
# goes, and not what a step computes. All others must stay as they were.
_MAY_CHANGE = {"data", "preset", "set", "length", "run", "views.workers"}
_MAY_CHANGE |= {"views.cache", "views.cache_device", "views.made_workers"}
_MUST_STAY = {"run.seed"}
_TELLING = {"data", "length.steps", "length.epochs", "length.minutes"}
# The processes of one run may have these apart from one another; of files their contents count.
_OF_A_MACHINE = {
    *("views.extra", "views.workers", "views.cache", "run.out", "run.config", "run.resume"),
    *("run.init", "run.encoder_weights", "run.device", "run.threads", "run.keep", "run.log"),
    *("run.tensorboard", "views.cache_device", "views.made_workers"),
}
# The groups of options in a run's config.json; "model" follows from the preset and --set.
GROUPS = {
    "length": LengthConfig,
    "views": DataConfig,
    "loss": LossConfig,
    "optim": OptimConfig,
    "run": RunConfig,
    "model": GambaConfig,
}


def config_of(values: Mapping[str, Any], source: str) -> TrainConfig:
    """The options that a ``to_dict`` value without ``model`` means; what it lacks is a default.

    Args:
        values: perhaps a stranger's.
        source: where they come from, for the error's message.

    Raises:
        UserError: an option is unknown, or its value is wrong; names it.
    """
    try:
        config = msgspec.convert(values, TrainConfig, dec_hook=lambda kind, value: kind(value))
    except (msgspec.ValidationError, UserError) as error:
        text = re.sub(r"^(.*) - at `\$\.(?:[a-z]+\.)?(\w+).*`$", r"\2: \1", str(error))
        raise UserError(f"{source}: {text}") from error
    if unknown := sorted(_flatten(dict(values)).keys() - _flatten(config.to_dict()).keys()):
        raise UserError(f"{source}: not the options of a run (unknown {', '.join(unknown)[:200]})")
    return config


def config_differences(stored: dict, current: dict, free: bool = False) -> list[str]:
    """Compares two ``to_dict`` values; an option that one of them lacks has its default there.

    Args:
        stored: of the run that is gone on with; an older version may have known fewer options.
        current: of this run.
        free: whether those that may change when a run goes on are compared, too, apart from where
            it reads and writes.

    Returns:
        The fields that differ, each with both values.
    """
    defaults = _flatten(_defaults())
    old, new = ({**defaults, **_flatten(values)} for values in (stored, current))
    differing = []
    for name in sorted(old.keys() | new.keys()):
        may_change = name in _MAY_CHANGE or name.split(".")[0] in _MAY_CHANGE
        compared = not may_change or name in _MUST_STAY or (free and name in _TELLING)
        if old.get(name) != new.get(name) and compared:
            there, here = (str(values.get(name))[:80] for values in (old, new))
            differing.append(f"{name} ({there} there, {here} here)")
    return differing


def options_of_all(values: dict) -> dict[str, object]:
    """The options that all processes of a run must have in common.

    Args:
        values: of ``to_dict``.

    Returns:
        Values by name. Left out is where a machine reads and writes, and how fast it does so.
    """
    flat = _flatten({name: value for name, value in values.items() if name not in ("data", "set")})
    return {name: value for name, value in flat.items() if name not in _OF_A_MACHINE}


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
    """The ``gamba train`` command that means a ``to_dict`` value; defaults are left out."""
    words = ["gamba", "train", str(values.get("data")), "--preset", str(values.get("preset"))]
    if values.get("set"):
        words += ["--set", *map(str, values["set"])]
    for group, default in _defaults().items():
        if group == "model":  # it follows from the preset and --set
            continue
        for name, value in values.get(group, {}).items():
            # A recipe's options are there by themselves, and those that were given have won.
            if name not in default or value == default[name] or name == "recipe":
                continue
            if isinstance(value, bool):
                words.append(option(name if value else f"no_{name}"))
            else:
                words += [option(name), *map(str, value if isinstance(value, list) else [value])]
    return shlex.join(words)
