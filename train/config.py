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
from gamba_warp.image_metrics import METRICS
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
    """Length of the training. The schedules end with the steps or epochs, else with the minutes.

    Attributes:
        steps: Number of optimizer steps.
        epochs: Number of passes over the objects, or with --overfit over its views; 400 if no limit
            is given.
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
        batch_size: Objects per step and process, before accumulation; 8 if not given, or 1 with
            --overfit.
        accumulate: Batches per optimizer step.
        size: Side of the rendered pictures, pixels.
        views_first: Novel views per object at the start.
        views_last: Novel views per object at the end; the number grows evenly over the run.
        views_per_object: Fixed number of novel views instead of the growing one; 9 with --overfit.
        background: Colour behind the rendered and the true pictures; "random" draws one for each
            object and step. The input picture always has the model's own background.
        reference: Input view: any, or always the first; "auto" is first with --overfit.
        extra: More datasets, whose training objects are added to those of DATA.
        extra_weights: For each of these, how often one of its objects is taken, relative to one of
            DATA; all 1 if not given.
        front_share: Share of the samples whose input is a view from the front: the object's first,
            or another one at -35 to 35 degrees of azimuth and 0 to 20 of elevation. The other
            samples take any view.
        mirror: Share of the samples whose object is mirrored, with its cameras.
        recolor: Share of the samples whose colour channels are permuted and change gamma.
        made: Share of the samples that show made objects (gamba data made), which other processes
            make and render during the training; the others are of the datasets.
        made_uses: Samples of each made object.
        made_views: Views of each made object.
        made_workers: Processes that make and render; the number does not change the result.
        train_on_gso: Accept objects named as in Google Scanned Objects. The paper and others
            evaluate on this set, so without the option a run refuses them for training and
            validation. With it OUT/model.json, the card of the weights, states their names.
        overfit: Train on this one object (uid or number) and validate on its training views: a
            smoke test.
        cache: Keep decoded pictures in memory.
        cache_device: Decode all pictures at the start and keep them on the training device, with
            8 bits a channel. Depth pictures are read when they are used.
        sampler: Order of the objects: "shuffled" anew for each epoch; "shards", by whole shards, of
            which each process takes its own (docs/training-data.md).
        shuffle_buffer: With --sampler shards: objects of a process that are mixed at a time.
        workers: Threads that decode pictures ahead of the training; also the largest number of
            batches kept ready. The number does not change the result.
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
    extra_weights: tuple[Annotated[float, Meta(gt=0, le=1e6)], ...] = ()
    front_share: Annotated[float, Meta(ge=0, le=1)] = 0.0
    mirror: Annotated[float, Meta(ge=0, le=1)] = 0.0
    recolor: Annotated[float, Meta(ge=0, le=1)] = 0.0
    made: Annotated[float, Meta(ge=0, le=1)] = 0.0
    made_uses: Annotated[int, Meta(ge=1, le=10_000)] = 16
    made_views: Annotated[int, Meta(ge=2, le=1000)] = 12
    made_workers: Annotated[int, Meta(ge=1, le=1024)] = 1
    train_on_gso: bool = False
    overfit: str | None = None
    cache: bool = False
    cache_device: bool = False
    sampler: str = "shuffled"
    shuffle_buffer: Annotated[int, Meta(ge=1, le=10**9)] = 2000
    workers: Annotated[int, Meta(ge=1, le=1024)] = 1

    @property
    def objects(self) -> int:
        """Objects per batch and process."""
        return self.batch_size or (8 if self.overfit is None else 1)


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """Weights of the loss (paper eq. loss_train).

    Attributes:
        mask_weight: Weight of the alpha channel's squared error.
        lpips: Use of LPIPS-VGG: "auto" uses it if its weights are there, "on" requires them. On a
            CPU it multiplies the time of a step (docs/train-your-own.md).
        lpips_weight: Weight of LPIPS.
        lpips_after: Leave LPIPS out for this many steps; early in training it can keep the model
            in a white collapse.
        lpips_crop: Side of a random square, in pixels, that LPIPS compares in one view of each
            object; 0 compares all views whole, which on a CPU would take most of a step.
        ssim_weight: Weight of 1 - SSIM; not in the paper.
        novel_weight: Weight of each novel view relative to the input view, in all terms but LPIPS
            of crops; the result is a weighted mean over the views.
        depth_weight: Weight of the depth loss: the first layer of "rays" is pulled to the first
            surface of the input view, the last layer to the last surface. The data needs depth
            pictures (gamba data render --depth); not in the paper.
        radial_mask: The radial mask constraint on the projected centres (paper Table 2).
        rdist_weight: Weight of the radial mask constraint at the start.
        rdist_epochs: Epochs over which the weight of the radial mask constraint falls linearly to
            0.
        rdist_share: Largest share of the run over which that weight falls; it matters in short
            runs.
        rdist_steps: Steps over which that weight falls, instead of --rdist-epochs and
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
        lr: Peak learning rate; after a warm-up it falls to 0 according to --schedule.
        schedule: "cosine" falls along half a cosine from the end of the warm-up; "trapezoid" stays
            at the peak and falls linearly at the end, so runs of different lengths begin alike.
        decay_share: Share of the run in which "trapezoid" falls.
        warmup_steps: Steps of the linear warm-up, a tenth of the run at most.
        weight_decay: Weight decay of matrices, except those flagged by a module.
        beta2: Second-moment decay of AdamW.
        clip: Largest norm of the gradient.
        ema: Decay of the weights' running average, shorter at the start; 0 turns it off.
        precision: Precision of the products in the network, by autocast; parameters, losses and
            rendering stay float32. "auto" is bfloat16 if a trial of 50 ms finds it faster on all
            processes, else float32; a resumed run chooses again.
        max_skipped: Give up after this many non-finite steps in a row.
        optimizer: Name of any optimizer of torch.optim, such as SGD or RAdam.
        optimizer_options: Its options, NAME=VALUE with values in JSON; with AdamW they replace
            --beta2: betas=[0.9,0.99].
        lr_of: Factors of the learning rate by parameter name or its beginning, NAME=FACTOR:
            encoder=0.1 decoder=2; 0 freezes.
    """

    lr: Annotated[float, Meta(gt=0, le=10)] = 1e-3
    schedule: str = "cosine"
    decay_share: Annotated[float, Meta(gt=0, le=1)] = 0.2
    warmup_steps: _Every = 100
    weight_decay: Annotated[float, Meta(ge=0, le=100)] = 0.05
    beta2: Annotated[float, Meta(ge=0, lt=1)] = 0.95
    clip: Annotated[float, Meta(gt=0, le=1e9)] = 1.0
    ema: Annotated[float, Meta(ge=0, lt=1)] = 0.999
    precision: Precision = "float32"
    max_skipped: _Count = 20
    optimizer: str = "AdamW"
    optimizer_options: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE ...")] = ()
    lr_of: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=FACTOR ...")] = ()


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Files, logging and the machine.

    Attributes:
        out: Run folder.
        config: Take the options of another run: its folder, or its config.json. Further options
            override them, and so does DATA if it comes first; without --out that run itself is
            resumed.
        recipe: Set of options: "paper" is the paper's training, with 256 objects a step over all
            processes; "tiny" or "rays" is that of the shipped model, at its size. Further options
            override it; with --help it shows the recipe's options and their sources.
        resume: "auto" resumes from the newest checkpoint of the run folder; else "never", or the
            path of a checkpoint. The number of processes may be another one, if --batch-size and
            --accumulate keep the number of objects a step.
        override: Options that a resumed run changes, e.g. lr=1e-4,batch_size=4: rates, losses,
            batches and pictures. The optimizer's moments, the step and the order of the data stay.
        init: Start from the weights of this model file, checkpoint or run folder (same
            architecture; the averaged weights if there are any), with a fresh optimizer. Use it
            with another --out to continue with other losses or data.
        init_partial: As --init, from a model of another architecture: tensors of the same name and
            shape are taken; OUT/init.json lists those that were and were not.
        encoder_weights: File of the image encoder's weights, or "random" to train one from scratch.
        log_every: Steps between two lines of the log.
        val_every: Steps between two validations (and sample pictures); 0 for none.
        val_objects: Held-out objects of each dataset to validate on.
        val_views: Novel views of each, evenly spaced in the list; --overfit takes all.
        val_extra: More datasets, whose held-out objects are validated separately, under their
            folder's name.
        best_by: Figure of the best validation, whose weights are OUT/best.safetensors: psnr, ssim,
            lpips or mask_iou, of novel views (of inputs without novel ones), the unweighted mean
            over DATA and --val-extra.
        save_every: Steps between two checkpoints; one is always saved at the end.
        keep: Number of checkpoints kept; the oldest are removed first.
        tensorboard: Write TensorBoard files, if it is installed.
        log: Boards beside TensorBoard: "wandb" is Weights & Biases, configured by its own settings
            (WANDB_PROJECT, WANDB_MODE=offline).
        profile: Profile ten steps, after the first three, with torch's profiler: OUT/profile has
            trace.json for a browser and table.txt.
        device: Device to train on; "auto" is the GPU if there is one.
        threads: Number of CPU threads; all cores if not given.
        recompute: Keep only the blocks' inputs and recompute each block in the backward pass: the
            same result in less memory and more time.
        seed: Seed of the initial weights and of the order of the data.
    """

    out: Path = Path("runs/gamba")
    config: Path | None = None
    recipe: RecipeName | None = None
    resume: str = "auto"
    override: Annotated[tuple[str, ...], tyro.conf.arg(metavar="OPTION=VALUE ...")] = ()
    init: Path | None = None
    init_partial: Path | None = None
    encoder_weights: str | None = None
    log_every: _Count = 10
    val_every: _Every = 500
    val_objects: Annotated[int, Meta(ge=0, le=1_000_000)] = 8
    val_views: Annotated[int, Meta(ge=0, le=100_000)] = 4
    val_extra: tuple[Path, ...] = ()
    best_by: str = "psnr"
    save_every: _Count = 500
    keep: _Count = 2
    tensorboard: bool = True
    log: tuple[Literal["wandb"], ...] = ()
    profile: bool = False
    device: DeviceChoice = "auto"
    threads: Threads | None = None
    recompute: bool = False
    seed: Seed = 0

    @property
    def boards(self) -> tuple[str, ...]:
        """Names of the boards written beside the log."""
        return (*(("tensorboard",) if self.tensorboard else ()), *dict.fromkeys(self.log))


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Train a model on posed views (``gamba data render`` makes them).

    Attributes:
        data: Dataset folder; or, as the first word, the address of shards on a server.
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
        if self.run.best_by not in METRICS:
            raise UserError(
                f"--best-by {self.run.best_by[:60]}: expected one of {', '.join(METRICS)}"
            )
        if self.loss.lpips == "on" and self.views.size < 16:
            raise UserError(f"--lpips on: needs --size 16 or more, it is {self.views.size}")
        if self.loss.lpips_crop and not 16 <= self.loss.lpips_crop <= self.views.size:
            raise UserError(
                f"--lpips-crop {self.loss.lpips_crop}: must be 0, or 16 to --size {self.views.size}"
            )
        if self.run.best_by == "lpips" and self.loss.lpips == "off":
            raise UserError("--best-by lpips: --lpips off leaves it out")
        if self.views.size < (least := METRICS[self.run.best_by].least_side):
            raise UserError(f"--best-by {self.run.best_by}: needs --size {least} or more")
        given, wanted = len(self.views.extra_weights), len(self.views.extra)
        if given not in (0, wanted):
            raise UserError(f"--extra-weights: {given} numbers for {wanted} of --extra")
        if given and self.views.sampler != "shuffled":
            raise UserError("--extra-weights and --sampler: give one of them")
        if self.run.init is not None and self.run.init_partial is not None:
            raise UserError("--init and --init-partial: give one of them")
        if self.views.made and self.views.overfit is not None:
            raise UserError("--made: --overfit trains on one object; leave one of them out")
        if self.run.val_extra and self.views.overfit is not None:
            raise UserError("--val-extra: --overfit validates on its object; leave one of them out")
        if self.loss.depth_weight and self.model_config().decoder != "rays":
            raise UserError('--depth-weight: needs the decoder "rays", whose layers have a depth')
        self.model_config()

    def model_config(self) -> GambaConfig:
        """Return the preset with the changes of ``--set``.

        Raises:
            UserError: a field is unknown, or its value invalid.
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

    def overridden(self) -> TrainConfig:
        """Return the options with those of ``--override``.

        Raises:
            UserError: an option of ``--override`` is unknown or cannot change, or its value is
                invalid.
        """
        values = self.to_dict()
        for name in FOLLOWING & values.keys():
            del values[name]
        for name, text in self.changes().items():
            group, _, field_name = name.partition(".")
            values[group][field_name] = value_of(text)
        return config_of(values, "--override") if self.run.override else self

    def changes(self) -> dict[str, str]:
        """Return the values of ``--override``, as text, by name with the group.

        Raises:
            UserError: as ``overridden``.
        """
        found: dict[str, str] = {}
        for change in ",".join(self.run.override).split(",") if self.run.override else ():
            name, equals, text = change.strip().partition("=")
            full = _OVERRIDABLE.get(name.lstrip("-").replace("-", "_"))
            if not equals or full is None:
                raise UserError(
                    f"--override {change[:60]}: a resumed run cannot change it, only "
                    f"{', '.join(_OVERRIDABLE)}"
                )
            if self.views.made and full in STEP_SIZE:
                raise UserError(f"--override {name}: a run with --made cannot change it")
            found[full] = text
        return found

    def to_dict(self) -> dict:
        """Return JSON-ready values, with the model's full configuration under ``model``."""
        values = json.loads(json.dumps(asdict(self), default=str))
        values["model"] = json.loads(self.model_config().to_json())
        return values


# A run may be resumed with other values of these: they change where it reads and writes and how
# long it is, but not the result of a step. All others must stay the same.
_MAY_CHANGE = {"data", "preset", "set", "length", "run", "views.workers"}
_MAY_CHANGE |= {"views.cache", "views.cache_device", "views.made_workers"}
_MUST_STAY = {"run.seed"}
_COMPARED_IF_FREE = {"data", "length.steps", "length.epochs", "length.minutes"}
# Those of ``--override``, by name. The order of the data follows from the seed, and the model from
# its configuration, so these stay.
_OVERRIDABLE = {
    f.name: f"{group}.{f.name}"
    for group, kind in (("views", DataConfig), ("loss", LossConfig), ("optim", OptimConfig))
    for f in fields(kind)
    if f.name not in {*("extra", "overfit", "train_on_gso", "cache", "cache_device", "workers")}
    and f.name not in {*("optimizer", "optimizer_options", "lr_of", "sampler", "extra_weights")}
    and f.name != "shuffle_buffer"
    and not f.name.startswith("made")
}
STEP_SIZE = {"views.batch_size", "views.accumulate"}
FOLLOWING = {"model"}  # of a config.json: it follows from the options
# These may differ between the processes of one run; files are compared by content.
_PER_MACHINE = {
    *("views.extra", "views.workers", "views.cache", "run.out", "run.config", "run.resume"),
    *("run.init", "run.encoder_weights", "run.device", "run.threads", "run.keep", "run.log"),
    "run.init_partial",
    *("run.tensorboard", "run.val_extra", "views.cache_device", "views.made_workers"),
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


def config_of(values: Mapping[str, Any], source: str) -> TrainConfig:
    """Convert a ``to_dict`` value without ``model`` to options; missing ones get their default.

    Args:
        values: untrusted values.
        source: their origin, for the error message.

    Raises:
        UserError: an option is unknown or has an invalid value; the message names it.
    """
    try:
        config = msgspec.convert(values, TrainConfig, dec_hook=lambda kind, value: kind(value))
    except (msgspec.ValidationError, UserError) as error:
        text = re.sub(r"^(.*) - at `\$\.(?:[a-z]+\.)?(\w+).*`$", r"\2: \1", str(error))
        raise UserError(f"{source}: {text}") from error
    if unknown := sorted(_flatten(dict(values)).keys() - _flatten(config.to_dict()).keys()):
        raise UserError(f"{source}: not the options of a run (unknown {', '.join(unknown)[:200]})")
    return config


def stored_option(stored: dict, name: str) -> object:
    """Return an option of a ``to_dict`` value by its name with the group, or its default."""
    return {**_flatten(_defaults()), **_flatten(stored)}.get(name)


def config_differences(
    stored: dict, current: dict, free: bool = False, ignored: Container[str] = ()
) -> list[str]:
    """Compare two ``to_dict`` values; a missing option counts as its default.

    Args:
        stored: of the resumed run; an older version may have fewer options.
        current: of this run.
        free: also compare the data and the length, which may change when a run is resumed.
        ignored: names of options that are not compared.

    Returns:
        The differing fields, each with both values.
    """
    defaults = _flatten(_defaults())
    old, new = ({**defaults, **_flatten(values)} for values in (stored, current))
    differing = []
    for name in sorted(old.keys() | new.keys()):
        may_change = name in _MAY_CHANGE or name.split(".")[0] in _MAY_CHANGE
        compared = not may_change or name in _MUST_STAY or (free and name in _COMPARED_IF_FREE)
        if old.get(name) != new.get(name) and compared and name not in ignored:
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
