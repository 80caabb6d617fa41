"""Plans of ablations: JSON documents, shipped or given as files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from .. import image_metrics
from ..errors import UserError
from ..files import write_json
from ..fitting.config import Count, FitConfig, RasterizeMode, Steps, Strategy
from ..untrusted.documents import parse_document, read_bytes, read_document
from ..untrusted.names import plain_name
from ..untrusted.ranges import Seed

PLANS = Path(__file__).parent / "plans"
MAX_PLAN = 1 << 20  # bytes; the shipped plans have 5,000
METRICS = (*image_metrics.METRICS, "chamfer", "iou")

Name = Annotated[str, Meta(pattern=r"^[a-z0-9][a-z0-9_-]{0,59}\Z")]
Text = Annotated[str, Meta(max_length=1000)]
Word = Annotated[str, Meta(min_length=1, max_length=200)]
_Scalar = bool | int | float | Annotated[str, Meta(max_length=200)]
Value = _Scalar | Annotated[list[_Scalar], Meta(max_length=100)] | None
Values = Annotated[dict[Word, Value], Meta(max_length=200)]


class FitOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of ``gamba fit`` that a plan may set, with the same meaning."""

    gaussians: Count = FitConfig.gaussians
    steps: Steps = FitConfig.steps
    strategy: Strategy = FitConfig.strategy
    rasterize_mode: RasterizeMode = "classic"
    held_out: Annotated[int, Meta(ge=2, le=100_000)] = 6
    size: Annotated[int, Meta(ge=8, le=4096)] | None = None
    limit: Annotated[int, Meta(ge=1, le=1_000_000)] = 12


class Evaluation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Objects and views of every row's evaluation.

    Attributes:
        split: part of the dataset.
        objects: their number, evenly spaced in the order of names.
        views: per object, including the input, evenly spaced.
        size: height of the pictures compared, pixels; None: the files' own.
        geometry_objects: number of objects whose shapes are evaluated; None: all.
    """

    split: Literal["val", "test"] = "test"
    objects: Annotated[int, Meta(ge=1, le=1_000_000)] = 27
    views: Annotated[int, Meta(ge=2, le=100_000)] = 4
    size: Annotated[int, Meta(ge=16, le=4096)] | None = None
    geometry_objects: Annotated[int, Meta(ge=1, le=1_000_000)] | None = None


class Base(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Defaults of all rows.

    Attributes:
        preset: of ``gamba train``.
        set: fields of ``GambaConfig``.
        options: of ``gamba train``; one of ``steps`` and ``minutes`` is the budget of every row.
        fit: options of ``gamba fit``, for rows of that kind.
    """

    preset: Word = "tiny"
    set: Values = {}
    options: Values = {}
    fit: Values = {}


class Row(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One row of the table.

    Attributes:
        name: of its folder.
        title: in the table; the name, if empty.
        kind: "train" trains and evaluates a model, "fit" fits objects one by one.
        set: fields of ``GambaConfig`` that differ from the base's.
        options: of ``gamba train``, or of ``gamba fit``, that differ; null removes one of the
            base's.
        seeds: in place of the plan's.
        compare_with: name of the reference row, in place of the plan's.
        series: name of the row's series of numbers of Gaussians.
        background_margin: evaluate the model without tokens of plain background farther than this
            many patches from the object; None: with all.
        paper: figures of the paper, by the metric's name.
        note: a sentence below the table.
    """

    name: Name
    title: Text = ""
    kind: Literal["train", "fit"] = "train"
    set: Values = {}
    options: Values = {}
    seeds: Annotated[list[Seed], Meta(min_length=1, max_length=100)] | None = None
    compare_with: Name | None = None
    series: Name | None = None
    background_margin: Annotated[int, Meta(ge=0, le=4096)] | None = None
    paper: Annotated[dict[Word, float], Meta(max_length=10)] = {}
    note: Text = ""

    @property
    def label(self) -> str:
        """Name in the table."""
        return self.title or self.name


class Plan(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An ablation: rows that are trained and evaluated alike.

    Attributes:
        name: of the plan.
        title: of its page.
        rows: of the table, in its order.
        note: sentences at the head of the page.
        seeds: of every row.
        base: defaults of all rows.
        evaluation: objects and views of the evaluation.
        compare_with: name of the reference row; None without one.
    """

    name: Name
    title: Text
    rows: Annotated[list[Row], Meta(min_length=1, max_length=200)]
    note: Text = ""
    seeds: Annotated[list[Seed], Meta(min_length=1, max_length=100)] = msgspec.field(
        default_factory=lambda: [0, 1]
    )
    base: Base = Base()
    evaluation: Evaluation = Evaluation()
    compare_with: Name | None = None

    def row(self, name: str) -> Row:
        """Return the row of a name. Raises UserError, which lists the names, if it is missing."""
        for row in self.rows:
            if row.name == name:
                return row
        names = ", ".join(row.name for row in self.rows)
        raise UserError(f"plan {self.name} has no row {name}; it has {names}")

    def seeds_of(self, row: Row) -> list[int]:
        """Return the seeds of a row."""
        return list(self.seeds if row.seeds is None else row.seeds)


def shipped() -> list[str]:
    """Return the names of the shipped plans."""
    return sorted(path.stem for path in PLANS.glob("*.json"))


def open_plan(text: str) -> Plan:
    """Read a shipped plan by name, or a plan file.

    Raises:
        UserError: neither exists, or the plan is invalid.
    """
    if text in shipped():
        return read_plan(PLANS / f"{text}.json")
    if not Path(text).exists():
        raise UserError(f"{text}: no such plan; give {', '.join(shipped())}, or a file")
    return read_plan(text)


def read_plan(path: str | Path) -> Plan:
    """Read a plan and check it by itself; ``jobs.check`` checks its options.

    Raises:
        UserError: the file cannot be read, or the plan is invalid; names the row.
    """
    plan = parse_document(read_bytes(path, MAX_PLAN), Plan, str(path))
    with named(path):
        _check(plan)
    return plan


@contextmanager
def named(source: str | Path) -> Iterator[None]:
    """Prefix the message of a UserError with the plan's name."""
    try:
        yield
    except UserError as error:
        raise UserError(f"{source}: {error}") from error


def _check(plan: Plan) -> None:
    plain_name(plan.name, "name")
    known: set[str] = set()
    for text in (plan.title, plan.note, *(t for row in plan.rows for t in (row.title, row.note))):
        if not text.isprintable():  # a table has lines
            raise UserError(f"{text[:80]!r}: a title or note has an unprintable character")
    for row in plan.rows:
        plain_name(row.name, "row")
        if row.name in known:
            raise UserError(f"row {row.name}: there are two of this name")
        known.add(row.name)
        of_models = {"set": bool(row.set), "background_margin": row.background_margin is not None}
        for name in (name for name, given in of_models.items() if given and row.kind == "fit"):
            raise UserError(f"row {row.name}: a fit has no model, so it has no {name}")
        for name in row.paper.keys() - {*METRICS}:
            known_metrics = ", ".join(METRICS)
            raise UserError(f"row {row.name}: paper: no metric {name}; known: {known_metrics}")
        if len({*plan.seeds_of(row)}) != len(plan.seeds_of(row)):
            raise UserError(f"row {row.name}: a seed is repeated")
    others = {plan.compare_with, *(row.compare_with for row in plan.rows)}
    for name in filter(None, others):
        if plan.row(name).kind != "train":
            raise UserError(f"compare_with {name}: rows can be compared with a model only")
    for name in {row.series for row in plan.rows} - {None}:
        kinds = {row.kind for row in plan.rows if row.series == name}
        if len(kinds) > 1:
            raise UserError(f"series {name}: it mixes models and fits")


def save_plan(plan: Plan, out: Path) -> None:
    """Write the plan into the folder, which from then on belongs to it.

    Raises:
        UserError: the folder belongs to another plan, or cannot be written.
    """
    path = out / "plan.json"
    if path.exists():
        name = read_document(path, dict[str, Any], MAX_PLAN).get("name")
        if name != plan.name:
            raise UserError(
                f"{out}: holds the ablation {name}, not {plan.name}; give another --out"
            )
    write_json(path, msgspec.to_builtins(plan))
