"""Plans of ablations: JSON documents, shipped or given as files."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from ..errors import UserError
from ..image_metrics import METRICS
from ..untrusted.documents import parse_document, read_bytes
from ..untrusted.ranges import Seed

PLANS = Path(__file__).parent / "plans"
MAX_PLAN = 1 << 20  # bytes; the shipped plans have 5,000
# Set by the command for all rows, or they would give rows different samples.
RESERVED = ("data", "set", "preset", "out", "config", "resume", "init", "seed", "device")
RESERVED += ("threads",)
BUDGET = {"steps", "minutes"}

_Name = Annotated[str, Meta(pattern=r"^[a-z0-9][a-z0-9_-]{0,59}\Z")]
_Text = Annotated[str, Meta(max_length=1000)]
_Word = Annotated[str, Meta(min_length=1, max_length=200)]
_Scalar = bool | int | float | Annotated[str, Meta(max_length=200)]
_Value = _Scalar | Annotated[list[_Scalar], Meta(max_length=100)] | None
_Values = Annotated[dict[_Word, _Value], Meta(max_length=200)]
_Seeds = Annotated[list[Seed], Meta(min_length=1, max_length=100)]


class Evaluation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Objects and views of every row's evaluation.

    Attributes:
        split: part of the dataset.
        objects: their number, evenly spaced in the order of names.
        views: per object, including the input, evenly spaced.
        size: height of the images compared, pixels; None: the files' own.
    """

    split: Literal["val", "test"] = "test"
    objects: Annotated[int, Meta(ge=1, le=1_000_000)] = 27
    views: Annotated[int, Meta(ge=2, le=100_000)] = 4
    size: Annotated[int, Meta(ge=16, le=4096)] | None = None


class Base(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Defaults of all rows.

    Attributes:
        preset: of ``gamba train``.
        set: fields of ``GambaConfig``.
        options: of ``gamba train``; one of ``steps`` and ``minutes`` is the budget of every row.
    """

    preset: _Word = "tiny"
    set: _Values = {}
    options: _Values = {}


class Row(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One row of the table.

    Attributes:
        name: of its folder.
        title: in the table; the name, if empty.
        set: fields of ``GambaConfig`` that differ from the base's.
        options: of ``gamba train`` that differ; null removes one of the base's.
        compare_with: name of the reference row, in place of the plan's.
        background_margin: evaluate the model without tokens of plain background farther than this
            many patches from the object; None: with all.
        paper: figures of the paper, by the metric's name.
        note: a sentence below the table.
    """

    name: _Name
    title: _Text = ""
    set: _Values = {}
    options: _Values = {}
    compare_with: _Name | None = None
    background_margin: Annotated[int, Meta(ge=0, le=4096)] | None = None
    paper: Annotated[dict[_Word, float], Meta(max_length=10)] = {}
    note: _Text = ""

    @property
    def label(self) -> str:
        """Name in the table."""
        return self.title or self.name


class Plan(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An ablation: rows that are trained and evaluated alike.

    Attributes:
        name: of the plan.
        title: of its table.
        rows: of the table, in its order.
        note: sentences at its head.
        seeds: of every row.
        base: defaults of all rows.
        evaluation: objects and views of the evaluation.
        compare_with: name of the reference row; None without one.
    """

    name: _Name
    title: _Text
    rows: Annotated[list[Row], Meta(min_length=1, max_length=200)]
    note: _Text = ""
    seeds: _Seeds = msgspec.field(default_factory=lambda: [0, 1])
    base: Base = Base()
    evaluation: Evaluation = Evaluation()
    compare_with: _Name | None = None

    def row(self, name: str) -> Row:
        """Return the row of a name. Raises UserError, which lists the names, if it is missing."""
        for row in self.rows:
            if row.name == name:
                return row
        names = ", ".join(row.name for row in self.rows)
        raise UserError(f"plan {self.name} has no row {name}; it has {names}")


def open_plan(text: str, data: Path) -> Plan:
    """Read a shipped plan by name, or a plan file, and check the commands of its rows.

    Raises:
        UserError: it does not exist or is invalid; names the row.
    """
    shipped = sorted(path.stem for path in PLANS.glob("*.json"))
    path = PLANS / f"{text}.json" if text in shipped else Path(text)
    if not path.exists():
        raise UserError(f"{text}: no such plan; give {', '.join(shipped)}, or a file")
    plan = parse_document(read_bytes(path, MAX_PLAN), Plan, str(path))
    try:
        _check(plan)
        for row in plan.rows:
            commands(plan, row, data, Path())
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    return plan


def _check(plan: Plan) -> None:
    for text in (plan.title, plan.note, *(t for row in plan.rows for t in (row.title, row.note))):
        if not text.isprintable():  # a table has lines
            raise UserError(f"{text[:80]!r}: a title or note has an unprintable character")
    names = [row.name for row in plan.rows]
    for row in plan.rows:
        if names.count(row.name) > 1:
            raise UserError(f"row {row.name}: duplicate name")
        if unknown := row.paper.keys() - {*METRICS}:
            known = ", ".join(METRICS)
            raise UserError(f"row {row.name}: paper: unknown metric {min(unknown)}; known: {known}")
        if budget := [name for name in BUDGET if name in row.options]:
            raise UserError(f"row {row.name}: {budget[0]}: the budget is the same for every row")
    if len({*plan.seeds}) != len(plan.seeds):
        raise UserError("a seed is given twice")
    for name in filter(None, {plan.compare_with, *(row.compare_with for row in plan.rows)}):
        plan.row(name)


def _merged(*groups: _Values) -> _Values:
    """Merge groups of values; later ones win, null removes; names get underscores."""
    both = {name.replace("-", "_"): value for group in groups for name, value in group.items()}
    return {name: value for name, value in both.items() if value is not None}


def commands(
    plan: Plan, row: Row, data: Path, folder: Path, more: Sequence[str] = ()
) -> dict[str, list[str]]:
    """Return the words of a row's training and of its evaluation, by the file that each makes.

    Args:
        plan: the plan.
        row: one of its rows.
        data: the dataset.
        folder: of the row with one seed.
        more: further words of the training.

    Raises:
        UserError: an option is unknown, its value is invalid, or there is no single budget; names
            the row.
    """
    from gamba_warp.train.config import GROUPS, command_line, config_of

    source = f"row {row.name}"
    of_model = {field.name for field in fields(GROUPS["model"])}
    groups = {f.name: group for group in GROUPS if group != "model" for f in fields(GROUPS[group])}
    changes, options = _merged(plan.base.set, row.set), _merged(plan.base.options, row.options)
    if unknown := changes.keys() - of_model:
        raise UserError(f"{source}: set: GambaConfig has no field {min(unknown)}")
    if len(options.keys() & BUDGET) != 1 or "epochs" in options:
        raise UserError("the budget of a row: expected either steps or minutes")
    values: dict[str, Any] = {"data": str(data), "preset": plan.base.preset}
    values["set"] = [
        f"{n}={v if isinstance(v, str) else json.dumps(v)}" for n, v in changes.items()
    ]
    for name, value in options.items():
        if name in RESERVED:
            raise UserError(f"{source}: options: {name} cannot be set by a plan")
        for item in value if isinstance(value, list) else [value]:
            if isinstance(item, str) and (item.startswith("-") or not item.isprintable()):
                raise UserError(f"{source}: {name}: {item!r} is not a valid value of an option")
        values.setdefault(groups.get(name, "run"), {})[name] = value
    training = shlex.split(command_line(config_of(values, source).to_dict()))[1:]
    of, model = plan.evaluation, folder / "run" / "model.safetensors"
    views: list[object] = ["eval-views", "--checkpoint", model, "--data", data, "--split", of.split]
    views += ["--limit", of.objects, "--views", of.views, *(["--size", of.size] if of.size else [])]
    views += ["--strips", 4, "--sheet", 0, "--no-baselines", "--out", folder / "views"]
    if row.background_margin is not None:
        views += ["--background-margin", row.background_margin]
    return {
        "run/model.safetensors": [*training, "--out", str(folder / "run"), *more],
        "views/report.json": [*map(str, views)],
    }
