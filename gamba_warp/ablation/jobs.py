"""The commands of a row, and the checks that nothing is wrong with any of them before one runs."""

from __future__ import annotations

import contextlib
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
ROW = "ROW"  # stands for the row's folder in the commands that are kept


@dataclass(frozen=True)
class Settings:
    """A plan, and what is the same for every row of it.

    Attributes:
        plan: the plan.
        data: the dataset.
        out: folder of the ablation.
        evaluation: what every row is evaluated on.
        budget: option ``steps`` or ``minutes``, and its value.
        meshes: folder of the true meshes, or None: no shapes are evaluated.
        device: of all commands that have the option.
    """

    plan: Plan
    data: Path
    out: Path
    evaluation: Evaluation
    budget: tuple[str, float]
    meshes: Path | None
    device: DeviceChoice


class Stage:
    """One command of a row.

    Attributes:
        name: "train", "views", "shapes" or "fit"; its results lie in a folder.
        words: of the command, without ``gamba``; ``ROW`` stands for the row's folder.
        folder: name of the folder of the results, in that of the row.
        makes: the file in it that is there when the command has ended well.
    """

    def __init__(self, name: str, *words: object, makes: str = "report.json") -> None:
        self.name, self.folder = name, FOLDERS[name]
        self.words = [*map(str, words), "--out", f"{ROW}/{self.folder}"]
        self.makes = f"{self.folder}/{makes}"

    def words_in(self, folder: Path) -> list[str]:
        """The words with the row's folder in its place."""
        mark = f"{ROW}/"
        return [str(folder / w.removeprefix(mark)) if w.startswith(mark) else w for w in self.words]


FOLDERS = {"train": "run", "views": "views", "shapes": "shapes", "fit": "fit"}


def budget_of(plan: Plan, steps: int | None, minutes: float | None) -> tuple[str, float]:
    """The budget of every row: the command's, or else the plan's.

    Raises:
        UserError: there is none or more than one, or a row has one of its own.
    """
    for row in plan.rows:
        own = [name for name in _merged(row.options) if name in BUDGET and row.kind == "train"]
        if own:
            raise UserError(f"row {row.name}: {own[0]}: the budget is the same for every row")
    given: dict[str, Any] = {"steps": steps, "minutes": minutes}
    given = {name: value for name, value in given.items() if value is not None}
    given = given or {n: v for n, v in _merged(plan.base.options).items() if n in BUDGET}
    if len(given) != 1 or "epochs" in given:
        raise UserError("the budget of a row: expected steps or minutes, once")
    ((name, value),) = given.items()
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise UserError(f"base: {name} is {str(value)[:80]}, not a number")
    return name, value


def stages(settings: Settings, row: Row, seed: int) -> list[Stage]:
    """The commands of a row, in their order.

    Raises:
        UserError: an option or a field of the row is wrong; names the row.
    """
    what, distance = settings.evaluation, None
    alike = ["--seed", seed, "--device", settings.device]
    if row.kind == "fit":
        words: list[object] = ["fit", settings.data, "--split", what.split]
        for name, value in msgspec.to_builtins(fit_options(settings, row)).items():
            words += [] if value is None else [option(name), value]
        made = [Stage("fit", *words, *alike)]
    else:
        distance = train_config(settings, row).model_config().distance
        words = ["eval-views", "--checkpoint", f"{ROW}/run/model.safetensors"]
        words += ["--data", settings.data, "--split", what.split, "--limit", what.objects]
        words += ["--views", what.views, *(["--size", what.size] if what.size else [])]
        words += ["--strips", STRIPS, "--sheet", 0, "--no-baselines", "--device", settings.device]
        words += ["--save-gaussians"] if settings.meshes else []
        if row.background_margin is not None:
            words += ["--background-margin", row.background_margin]
        training = [*train_words(settings, row), *alike, "--no-tensorboard"]
        made = [Stage("train", *training, makes="model.safetensors"), Stage("views", *words)]
    if settings.meshes:  # of all objects, or of some that ``run.choose`` copies
        count = what.geometry_objects
        folder = f"{made[-1].folder}/gaussians" if count is None else f"chosen-{count}"
        words = ["eval-geometry", f"{ROW}/{folder}", settings.meshes, "--frame", "reference"]
        words += ["--data", settings.data]
        if distance is not None and distance != DEFAULT_DISTANCE:
            words += ["--distance", distance]
        made.append(Stage("shapes", *words))
    return made


def fit_options(settings: Settings, row: Row) -> FitOptions:
    """The options of a row's fit. Raises UserError, which names the row."""
    try:
        return msgspec.convert(_merged(settings.plan.base.fit, row.options), FitOptions)
    except msgspec.ValidationError as error:
        raise UserError(f"row {row.name}: gamba fit: {error}") from error


def gaussians_of(settings: Settings, row: Row) -> int:
    """N, the number of Gaussians of a row (with the decoder "rays" the most there can be)."""
    if row.kind == "fit":
        return fit_options(settings, row).gaussians
    return train_config(settings, row).model_config().num_gaussians


def train_words(settings: Settings, row: Row) -> list[str]:
    """Words of a row's training: what it is trained on, with which model, how and how long."""
    base = settings.plan.base
    words: list[str] = ["train", str(settings.data), "--preset", base.preset]
    if changes := _merged(base.set, row.set):
        words += ["--set", *(f"{name}={_text(value)}" for name, value in changes.items())]
    options = {n: v for n, v in _merged(base.options, row.options).items() if n not in BUDGET}
    for name, value in {**options, settings.budget[0]: settings.budget[1]}.items():
        words += _option_words(name, value)
    return words


def _option_words(name: str, value: Value) -> list[str]:
    if isinstance(value, bool):
        return [option(name if value else f"no_{name}")]
    return [option(name), *map(_text, value if isinstance(value, list) else [value])]


def _text(value: Value) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _merged(*groups: Values) -> Values:
    """Groups joined, the later ones first; null takes away; names with underscores."""
    both = {name.replace("-", "_"): value for group in groups for name, value in group.items()}
    return {name: value for name, value in both.items() if value is not None}


def train_config(settings: Settings, row: Row) -> TrainConfig:
    """The options of a row's training, as ``gamba train`` parses them.

    Raises:
        UserError: one of them is unknown, or its value is wrong; names the row.
    """
    base = settings.plan.base
    try:
        _check_names(settings.plan, row)
        return _parsed(train_words(settings, row)[1:])
    except UserError as error:
        raise UserError(f"row {row.name}: {error}") from error
    except SystemExit:
        wrong = "its options"
    options = _merged(base.options, row.options).items()
    for words in (["--preset", base.preset], *(_option_words(*pair) for pair in options)):
        try:  # each for itself, to name the one that is wrong
            _parsed([str(settings.data), *words])
        except SystemExit:
            wrong = " ".join(words)
            break
        except UserError:
            continue
    raise UserError(f"row {row.name}: gamba train does not take {wrong}")


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
    for name in (name.replace("-", "_") for name in [*plan.base.set, *row.set]):
        if name not in known:
            raise UserError(f"set: GambaConfig has no field {name}")
    for name in (name.replace("-", "_") for name in [*plan.base.options, *row.options]):
        if name in RESERVED:
            raise UserError(f"options: {name} is not for a plan to give")
        if name not in names:
            raise UserError(f"options: gamba train has no {option(name)}")


def check(settings: Settings) -> None:
    """Checks the commands of every row of the plan.

    Raises:
        UserError: names the first row that is wrong, and what of it.
    """
    plan = settings.plan
    for row in plan.rows:
        stages(settings, row, plan.seeds_of(row)[0])
    for name in {row.series for row in plan.rows} - {None}:
        numbers = [gaussians_of(settings, row) for row in plan.rows if row.series == name]
        if len({*numbers}) != len(numbers):
            raise UserError(f"series {name}: two of its rows have the same number of Gaussians")


def difference(old: dict[str, list[str]], new: dict[str, list[str]]) -> str | None:
    """Names the first difference between the commands of a row; None where there is none."""
    for name in [*new, *old]:
        if old.get(name) == new.get(name):
            continue
        if name not in old:
            return f"the command {new[name][0]} was not part of it then"
        if name not in new:
            return f"the command {old[name][0]} is no part of it now"
        there, here = (_by_option(words[name]) for words in (old, new))
        for word in [*here, *there]:
            if there.get(word) != here.get(word):
                before, after = (
                    "not given" if word not in values else values[word] or "given"
                    for values in (there, here)
                )
                return f"{word}: {before} then, {after} now"
        return "the order of its options"
    return None


def _by_option(words: Sequence[str]) -> dict[str, str]:
    """Values by option, of ``--set`` by field."""
    found: dict[str, str] = {}
    key = "DATA"
    for word in words[1:]:
        if word.startswith("--"):
            key = word
            found.setdefault(key, "")
        elif key == "--set":
            field, _, value = word.partition("=")
            found[f"--set {field}"] = value
        else:
            found[key] = f"{found.get(key, '')} {word}".strip()
    return found
