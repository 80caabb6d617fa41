"""The commands of a row, and the checks that nothing is wrong with any of them before one runs."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from ..conventions import DEFAULT_DISTANCE, DeviceChoice
from ..errors import UserError
from ..model.config import PRESETS, GambaConfig
from ..untrusted.ranges import option
from .plan import Evaluation, FitOptions, Plan, Row, Value, Values

if TYPE_CHECKING:
    from gamba_warp.train.config import TrainConfig

# The command gives these to every row alike, or they would make rows see different samples.
RESERVED = ("data", "set", "preset", "out", "config", "resume", "init", "seed", "device")
RESERVED += ("threads", "tensorboard")
BUDGET = ("steps", "epochs", "minutes")
STRIPS = 4  # objects whose pictures are on the page
ROW = Path("ROW")  # stands for the row's folder in the commands that are kept


@dataclass(frozen=True)
class Settings:
    """What is the same for every row.

    Attributes:
        data: the dataset.
        out: folder of the ablation.
        evaluation: what every row is evaluated on.
        budget: option ``steps`` or ``minutes``, and its value.
        meshes: folder of the true meshes, or None: no shapes are evaluated.
        device: of all commands that have the option.
    """

    data: Path
    out: Path
    evaluation: Evaluation
    budget: tuple[str, float]
    meshes: Path | None
    device: DeviceChoice


@dataclass(frozen=True)
class Stage:
    """One command of a row.

    Attributes:
        name: "train", "views", "shapes" or "fit".
        words: of the command, without ``gamba``; ``ROW`` stands for the row's folder.
        makes: the file, in the row's folder, that is there when it has ended well.
    """

    name: str
    words: tuple[str, ...]
    makes: str

    def words_in(self, folder: Path) -> list[str]:
        """The words with the row's folder in its place."""
        mark = f"{ROW}/"
        return [str(folder / w.removeprefix(mark)) if w.startswith(mark) else w for w in self.words]


def budget_of(plan: Plan, steps: int | None, minutes: float | None) -> tuple[str, float]:
    """The budget of every row: the command's, or else the plan's.

    Raises:
        UserError: there is none or more than one, or a row has one of its own.
    """
    for row in plan.rows:
        own = [name for name in _plain(row.options) if name in BUDGET and row.kind == "train"]
        if own:
            raise UserError(f"row {row.name}: {own[0]}: the budget is the same for every row")
    given: dict[str, Any] = {"steps": steps, "minutes": minutes}
    given = {name: value for name, value in given.items() if value is not None}
    if not given:
        options = _plain(plan.base.options)
        given = {name: options[name] for name in BUDGET if options.get(name) is not None}
    if len(given) != 1 or "epochs" in given:
        raise UserError("the budget of a row: expected steps or minutes, once")
    ((name, value),) = given.items()
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise UserError(f"base: {name} is {str(value)[:80]}, not a number")
    return name, value


def stages(plan: Plan, row: Row, seed: int, settings: Settings) -> list[Stage]:
    """The commands of a row, in their order.

    Raises:
        UserError: an option or a field of the row is wrong; names the row.
    """
    if row.kind == "fit":
        return _fit_stages(plan, row, seed, settings)
    what = settings.evaluation
    config = train_config(plan, row, settings)
    views = ["eval-views", "--checkpoint", f"{ROW}/run/model.safetensors"]
    views += ["--data", settings.data, "--split", what.split, "--limit", what.objects]
    views += ["--views", what.views, *(["--size", what.size] if what.size else [])]
    views += ["--strips", STRIPS, "--sheet", 0, "--no-baselines", "--device", settings.device]
    views += ["--save-gaussians"] if settings.meshes else []
    if row.background_margin is not None:
        views += ["--background-margin", row.background_margin]
    made = [
        _stage("train", [*train_words(plan, row, settings), *_run_words(seed, settings)], _MODEL),
        _stage("views", [*views, "--out", f"{ROW}/views"], "views/report.json"),
    ]
    if settings.meshes:
        distance = config.model_config().distance
        made.append(_shapes(settings, "views/gaussians", distance))
    return made


_MODEL = "run/model.safetensors"


def _run_words(seed: int, settings: Settings) -> list[object]:
    words: list[object] = ["--seed", seed, "--device", settings.device, "--no-tensorboard"]
    return [*words, "--out", f"{ROW}/run"]


def _fit_stages(plan: Plan, row: Row, seed: int, settings: Settings) -> list[Stage]:
    options = fit_options(plan, row)
    words: list[object] = ["fit", settings.data, "--split", settings.evaluation.split]
    for name, value in msgspec.to_builtins(options).items():
        words += [] if value is None else [option(name), value]
    words += ["--seed", seed, "--device", settings.device, "--out", f"{ROW}/fit"]
    made = [_stage("fit", words, "fit/report.json")]
    return [*made, _shapes(settings, "fit/gaussians", None)] if settings.meshes else made


def _shapes(settings: Settings, predicted: str, distance: float | None) -> Stage:
    """The evaluation of shapes, of all objects or of some that ``shapes.choose`` copies."""
    count = settings.evaluation.geometry_objects
    folder = predicted if count is None else f"chosen-{count}"
    words = ["eval-geometry", f"{ROW}/{folder}", settings.meshes, "--frame", "reference"]
    words += ["--data", settings.data]
    if distance is not None and distance != DEFAULT_DISTANCE:
        words += ["--distance", distance]
    return _stage("shapes", [*words, "--out", f"{ROW}/shapes"], "shapes/report.json")


def _stage(name: str, words: Sequence[object], makes: str) -> Stage:
    return Stage(name, tuple(map(str, words)), makes)


def fit_options(plan: Plan, row: Row) -> FitOptions:
    """The options of a row's fit. Raises UserError, which names the row."""
    values = _merged(_plain(plan.base.fit), _plain(row.options))
    try:
        return msgspec.convert(values, FitOptions)
    except msgspec.ValidationError as error:
        raise UserError(f"row {row.name}: gamba fit: {error}") from error


def gaussians_of(plan: Plan, row: Row, settings: Settings) -> int:
    """N, the number of Gaussians of a row (with the decoder "rays" the most there can be)."""
    if row.kind == "fit":
        return fit_options(plan, row).gaussians
    return train_config(plan, row, settings).model_config().num_gaussians


def train_words(plan: Plan, row: Row, settings: Settings) -> list[str]:
    """Words of a row's training: what it is trained on, with which model, how and how long."""
    words: list[str] = ["train", str(settings.data), "--preset", plan.base.preset]
    changes = _merged(_plain(plan.base.set), _plain(row.set))
    if changes:
        words += ["--set", *(f"{name}={_text(value)}" for name, value in changes.items())]
    options = _merged(_plain(plan.base.options), _plain(row.options))
    name, value = settings.budget
    options = {n: v for n, v in options.items() if n not in BUDGET} | {name: value}
    for name, value in options.items():
        words += _option_words(name, value)
    return words


def _option_words(name: str, value: Value) -> list[str]:
    if isinstance(value, bool):
        return [option(name if value else f"no_{name}")]
    return [option(name), *map(_text, value if isinstance(value, list) else [value])]


def _text(value: Value) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _plain(values: Values) -> Values:
    """The same, names with underscores."""
    return {name.replace("-", "_"): value for name, value in values.items()}


def _merged(base: Values, row: Values) -> Values:
    both = {**base, **row}
    return {name: value for name, value in both.items() if value is not None}


def train_config(plan: Plan, row: Row, settings: Settings) -> TrainConfig:
    """The options of a row's training, as ``gamba train`` parses them.

    Raises:
        UserError: one of them is unknown, or its value is wrong; names the row.
    """
    try:
        _check_names(plan, row)
        return _parsed(train_words(plan, row, settings)[1:])
    except UserError as error:
        raise UserError(f"row {row.name}: {error}") from error
    except SystemExit:
        pass
    reason = "gamba train does not take its options"
    preset = ["--preset", plan.base.preset]
    options = _merged(_plain(plan.base.options), _plain(row.options))
    tried = [preset, *(_option_words(name, value) for name, value in options.items())]
    for words in tried:  # each for itself, to name the one that is wrong
        try:
            _parsed([str(settings.data), *words])
        except SystemExit:
            reason = f"gamba train does not take {' '.join(words)}"
            break
        except UserError:
            continue
    raise UserError(f"row {row.name}: {reason}")


def _parsed(words: list[str]) -> TrainConfig:
    """What ``gamba train`` makes of its words. Raises SystemExit where it takes them not."""
    import tyro

    from gamba_warp.train.config import TrainConfig

    with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
        return tyro.cli(tyro.conf.OmitArgPrefixes[TrainConfig], args=words, prog="gamba train")


def _check_names(plan: Plan, row: Row) -> None:
    """Refuses fields and options that are not there, or that the command itself gives."""
    from gamba_warp.train.config import GROUPS

    known = {field.name for field in fields(GambaConfig)}
    names = {f.name for group, kind in GROUPS.items() if group != "model" for f in fields(kind)}
    if plan.base.preset not in PRESETS:
        raise UserError(f"no preset {plan.base.preset}; there are {', '.join(PRESETS)}")
    for name in _plain(plan.base.set) | _plain(row.set):
        if name not in known:
            raise UserError(f"set: GambaConfig has no field {name}")
    for name in _plain(plan.base.options) | _plain(row.options):
        if name in RESERVED:
            raise UserError(f"options: {name} is not for a plan to give")
        if name not in names:
            raise UserError(f"options: gamba train has no {option(name)}")


def check(plan: Plan, settings: Settings, rows: Sequence[Row]) -> None:
    """Checks every row's commands.

    Raises:
        UserError: names the first row that is wrong, and what of it.
    """
    for row in rows:
        stages(plan, row, plan.seeds_of(row)[0], settings)
    for name in {row.series for row in rows} - {None}:
        members = [row for row in plan.rows if row.series == name]
        numbers = [gaussians_of(plan, row, settings) for row in members]
        if len({*numbers}) != len(numbers):
            raise UserError(f"series {name}: two of its rows have the same number of Gaussians")


def digest(kept: dict[str, list[str]]) -> str:
    """The hash of a row's exact commands, 16 hexadecimal digits."""
    return hashlib.sha256(json.dumps(kept).encode()).hexdigest()[:16]


def difference(old: dict[str, list[str]], new: dict[str, list[str]]) -> str | None:
    """Names the first difference between the commands of a row; None where there is none."""
    for name in [*new, *(name for name in old if name not in new)]:
        if old.get(name) == new.get(name):
            continue
        if name not in old or name not in new:
            return f"the command {(new.get(name) or old[name])[0]} {_came(name in new)}"
        there, here = (_by_option(words[name]) for words in (old, new))
        for word in [*here, *there]:
            if there.get(word) != here.get(word):
                before, after = (_shown(values.get(word)) for values in (there, here))
                return f"{word}: {before} then, {after} now"
    return None


def _came(is_new: bool) -> str:
    return "was not part of it then" if is_new else "is no part of it now"


def _shown(value: str | None) -> str:
    return "not given" if value is None else value or "given"


def _by_option(words: list[str]) -> dict[str, str]:
    """Values by option, of ``--set`` by field."""
    found: dict[str, list[str]] = {}
    key = "DATA"
    for word in words[1:]:
        if word.startswith("--"):
            key = word
            found.setdefault(key, [])
        elif key == "--set":
            field, _, value = word.partition("=")
            found[f"--set {field}"] = [value]
        else:
            found.setdefault(key, []).append(word)
    return {name: " ".join(values) for name, values in found.items()}
