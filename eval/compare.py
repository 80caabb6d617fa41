"""``gamba compare``: reports of several methods with the same protocol and truth in one table.

A method has a report of ``eval-views``, one of ``eval-geometry``, or both. The table covers the
objects that all methods have. It is written as Markdown and JSON.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

import msgspec

from gamba_warp.errors import UserError, one_line
from gamba_warp.image_metrics import METRICS, all_figures, on_grounds
from gamba_warp.untrusted.documents import parse_document, read_bytes
from gamba_warp.versions import __version__

from .averages import BOOTSTRAP, LEVEL, summary_of
from .report import OK, flat
from .tables import Column, Lines, Row, figures, markdown

FORMAT = "gamba_warp.compare.1"
MAX_REPORTS = 50
VIEWS, SHAPES = "eval-views", "eval-geometry"
_MAX_LETTERS = 60  # of a method's name
_MAX_NAMED = 5  # objects of a method named in a line

# Metrics of shapes: those of the paper's table, then the others.
OF_SHAPES = {"chamfer": Column("Chamfer ↓", 4), "iou": Column("Volume IoU ↑", 4)}
_FSCORE = "fscore."  # before a threshold
_MORE_OF_SHAPES = {
    "accuracy": Column("accuracy ↓", 4),
    "completeness": Column("completeness ↓", 4),
    "normal_consistency": Column("normals ↑", 3),
}
# Fields of the protocol that identify the kind of a report.
_KIND_BY_FIELD = {"max_psnr": VIEWS, "occupancy": SHAPES}
# Fields of a protocol that may differ between methods, because no number of an object depends on
# them: names, the method under test, and the pose of its files.
_MAY_DIFFER = {
    VIEWS: (
        *("source", "data", "split", "split_version", "uids", "uids_sha256"),
        *("baselines", "contact_sheet", "distance", "rendering", "pictures", "resize_pictures"),
        *("lpips", "lpips_reason", "grounds", "name", "changed"),
    ),
    SHAPES: ("name", "definitions", "frame", "pred_axes", "reference", "distance"),
}
# Those whose differences are noted in the table.
_NOTED_FIELDS = {
    VIEWS: ("split", "resize_pictures", "rendering", "lpips"),
    SHAPES: ("frame", "pred_axes"),
}

# Gamba (Shen et al. 2024), Table 1: PSNR, SSIM, LPIPS, Chamfer distance, Volume IoU, seconds.
TABLE_1: dict[str, tuple[float | None, ...]] = {
    "One-2-3-45": (14.93, 0.72, 0.28, 0.0683, 0.3485, 40),
    "Point-E": (None, None, None, 0.0515, 0.2643, 78),
    "Shap-E": (None, None, None, 0.0579, 0.3228, 27),
    "Zero-1-to-3": (18.28, 0.76, 0.19, 0.0385, 0.3786, 1800),
    "DreamGaussian": (21.65, 0.82, 0.14, 0.0341, 0.3615, 70),
    "LRM": (21.35, 0.82, 0.15, 0.0325, 0.3872, 0.5),
    "TGS": (22.68, 0.85, 0.12, 0.0257, 0.4121, 0.2),
    "Gamba": (24.74, 0.91, 0.08, 0.0232, 0.4289, 0.05),
}
_OF_TABLE_1 = ("psnr", "ssim", "lpips", *OF_SHAPES)
CAVEAT = (
    "The paper's own figures, of other objects and by a protocol that it does not write "
    "down, on an A100. They cannot be compared with the rows above."
)

Number = Annotated[float, msgspec.Meta(ge=-1e30, le=1e30)]
Figures = dict[str, Number | None]


def _keys(kind: str, protocol: dict[str, Any]) -> list[str]:
    """Return the keys of the compared figures of a kind of report, nested ones with dots."""
    if kind == VIEWS:
        return list(all_figures())
    known = protocol.get("thresholds")
    thresholds = known if isinstance(known, list) else []
    fscores = [f"{_FSCORE}{t:g}" for t in thresholds if isinstance(t, (int, float))]
    return [*OF_SHAPES, *fscores, *_MORE_OF_SHAPES]


class _ViewsRecord(msgspec.Struct):
    """Fields used of an object's record from ``eval-views``, besides its figures."""

    truth_sha256: str
    views: list[int]
    seconds: dict[str, Number] = {}


class _ShapesRecord(msgspec.Struct):
    """Fields used of an object's record from ``eval-geometry``, besides its figures."""

    gt_sha256: str
    kind: str


_RECORDS = {VIEWS: _ViewsRecord, SHAPES: _ShapesRecord}
_TRUTH = ("truth_sha256", "views", "gt_sha256")  # must be equal in two records of an object


class _Document(msgspec.Struct):
    protocol: dict[str, Any]
    objects: list[dict[str, Any]]


@dataclass
class Report:
    """A report of one method.

    Attributes:
        path: its file.
        kind: ``VIEWS`` or ``SHAPES``.
        protocol: as the file states it.
        records: of the objects that were evaluated, by name; see ``_RECORDS``.
        figures: likewise.
        failed: reasons by name, of the objects that failed.
    """

    path: Path
    kind: str
    protocol: dict[str, Any]
    records: dict[str, Any] = field(default_factory=dict)
    figures: dict[str, Figures] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)


@dataclass
class Compared:
    """Methods with their reports.

    Attributes:
        methods: names, in the order of their first report.
        reports: by kind and method.
        seconds: per object, as stated by the user, by method.
        notes: differences between methods that do not change the meaning of a number.
    """

    methods: list[str]
    reports: dict[str, dict[str, Report]]
    seconds: dict[str, float]
    notes: list[str]


def read_reports(arguments: tuple[str, ...], seconds: tuple[str, ...]) -> Compared:
    """Read reports, and check that they have the same protocol and truth.

    Args:
        arguments: ``NAME=FILE`` each, or a folder with a report.json.
        seconds: ``NAME=SECONDS`` each.

    Raises:
        UserError: an argument is malformed, a file is not a report, a method has two of one kind,
            or two reports differ in protocol or truth; the message names the difference.
    """
    if len(arguments) > MAX_REPORTS:
        raise UserError(f"{len(arguments)} reports, at most {MAX_REPORTS} are compared")
    methods: dict[str, None] = {}
    reports: dict[str, dict[str, Report]] = {VIEWS: {}, SHAPES: {}}
    for argument in arguments:
        name, text = _split(argument, "a report.json or its folder")
        report = read_report(Path(text))
        if name in reports[report.kind]:
            raise UserError(f"{argument}: {name} has a report of {report.kind} already")
        methods[name], reports[report.kind][name] = None, report
    stated: dict[str, float] = {}
    for argument in seconds:
        name, text = _split(argument, "seconds", "--seconds ")
        if name not in methods:
            raise UserError(f"--seconds {argument}: there is no report of {name}")
        try:
            stated[name] = float(text)
        except ValueError:
            stated[name] = 0.0
        if not 0 < stated[name] < 1e9:
            raise UserError(f"--seconds {argument}: not a number of seconds above 0")
    notes = []
    for kind, of in reports.items():
        for one, other in combinations(of.values(), 2):
            _check_pair(one, other)
        for key in _NOTED_FIELDS[kind]:
            names: dict[str, list[str]] = {}
            for name, report in of.items():
                names.setdefault(_shown(report.protocol.get(key)), []).append(name)
            if len(names) > 1:
                parts = (f"{value} ({', '.join(who)})" for value, who in names.items())
                notes.append(f"{kind}: {key} is {'; '.join(parts)}")
    return Compared(list(methods), reports, stated, notes)


def _split(argument: str, what: str, option: str = "") -> tuple[str, str]:
    name, equals, text = argument.partition("=")
    if not (name and equals and text):
        raise UserError(f"{option}{argument}: give NAME={what}")
    if len(name) > _MAX_LETTERS or not name.isprintable() or "|" in name:
        raise UserError(f"{option}{argument}: a name has at most {_MAX_LETTERS} letters and no '|'")
    return name, text


def read_report(path: Path) -> Report:
    """Read a report of ``eval-views`` or ``eval-geometry``.

    Args:
        path: the file, or the folder with its ``report.json``.

    Raises:
        UserError: it is missing or not such a report; the message gives the reason.
    """
    path = path / "report.json" if path.is_dir() else path
    content = parse_document(read_bytes(path), _Document, str(path))
    kind = next((kind for name, kind in _KIND_BY_FIELD.items() if name in content.protocol), None)
    if kind is None:
        raise UserError(f"{path}: no report of gamba eval-views or gamba eval-geometry")
    report = Report(path, kind, content.protocol)
    for number, item in enumerate(content.objects):
        name = item.get("name")
        if not isinstance(name, str) or name in report.records or name in report.failed:
            raise UserError(f"{path}: objects[{number}] has no name, or that of another one")
        if item.get("status") != OK:
            report.failed[name] = str(item.get("reason", "failed"))
            continue
        try:
            report.records[name] = msgspec.convert(item, _RECORDS[kind])
            found = flat(item)
            values = {key: found.get(key) for key in _keys(kind, content.protocol)}
            report.figures[name] = msgspec.convert(values, Figures)
        except msgspec.ValidationError as error:
            raise UserError(f"{path}: {name}: {error}") from error
    return report


def _check_pair(first: Report, report: Report) -> None:
    """Raise UserError if two reports of one kind cannot share a table."""
    pair = (report, first)
    mine, other = (flat(r.protocol, lists=True) for r in pair)
    for key in dict.fromkeys((*mine, *other)):
        a, b = mine.get(key), other.get(key)
        if a == b:
            continue
        top = key.split(".")[0]
        free = top in _MAY_DIFFER[report.kind] and (top != "lpips" or None in (a, b))
        if top == "surface" and report.kind == SHAPES:  # used for Gaussians only
            free = not all(any(v.kind == "gaussians" for v in r.records.values()) for r in pair)
        if not free:
            raise UserError(
                f"{report.path}: not of the protocol of {first.path}: "
                f"{key} is {_shown(a)}, not {_shown(b)}"
            )
    for uid in sorted(report.records.keys() & first.records.keys()):
        one, two = ([getattr(r.records[uid], key, None) for key in _TRUTH] for r in pair)
        if one != two:
            raise UserError(
                f"{report.path}: {uid} was compared with another truth than in {first.path}"
            )


def _shown(value: Any) -> str:
    return "absent" if value is None else one_line(str(value), 60)


def join(compared: Compared, against: str | None) -> dict[str, Any]:
    """Make the table of methods.

    A figure is averaged over the objects for which every method with this figure has a value, so an
    object at which one method failed counts for none.

    Args:
        compared: as from ``read_reports``.
        against: baseline of the paired differences; None: the first method.

    Returns:
        ``format, version, against, bootstrap, notes``; ``common``: names of the objects by figure;
        ``rows``: for each method ``name``, ``seconds`` with their origin, and by figure ``{mean,
        interval, median, median_interval}`` or None; ``differences``: likewise, each method minus
        ``against``; ``missing``: by kind of report and method, the reasons by object; ``reports``:
        the files and their protocols.

    Raises:
        UserError: ``against`` is unknown, or no object is common to all.
    """
    names = compared.methods
    base = names[0] if against is None else against
    if base not in names:
        raise UserError(f"--against {base}: the methods are {', '.join(names)}")
    # By figure, method and object; a method without any value of a figure is left out.
    values: dict[str, dict[str, dict[str, float]]] = {}
    common: dict[str, list[str]] = {}
    for kind, reports in compared.reports.items():
        # All protocols have the same thresholds.
        keys = _keys(kind, next((r.protocol for r in reports.values()), {}))
        for key in keys:
            found = {
                name: {uid: value for uid, v in r.figures.items() if (value := v[key]) is not None}
                for name, r in reports.items()
            }
            values[key] = {name: by_uid for name, by_uid in found.items() if by_uid}
            uids = map(set, values[key].values())
            common[key] = sorted(set.intersection(*uids)) if values[key] else []
        if reports and not (common[keys[0]] and all(r.records for r in reports.values())):
            counts = ", ".join(f"{name} {len(r.records)}" for name, r in reports.items())
            fewest = min(reports.values(), key=lambda report: len(report.records))
            raise UserError(
                f"{fewest.path}: no object was evaluated for all methods by {kind}: {counts}"
            )

    def summaries(name: str, less: str | None = None) -> dict[str, Any]:
        """Summarise the figures of a method, or its paired differences to another."""
        found: dict[str, Any] = dict.fromkeys(values)
        for key, of in values.items():
            if common[key] and name in of and (less is None or less in of):
                minus = of[less] if less else dict.fromkeys(common[key], 0.0)
                found[key] = summary_of([of[name][uid] - minus[uid] for uid in common[key]])
        return found

    rows = [{"name": n, **_seconds(compared, n, common["psnr"]), **summaries(n)} for n in names]
    return {
        "format": FORMAT,
        "version": __version__,
        "against": base,
        "bootstrap": BOOTSTRAP,
        "notes": compared.notes,
        "common": common,
        "rows": rows,
        "differences": [
            {"name": f"{name} - {base}", **summaries(name, base)} for name in names if name != base
        ],
        "missing": {kind: _missing(reports) for kind, reports in compared.reports.items()},
        "reports": {
            name: {
                kind: {"file": reports[name].path.name, "protocol": reports[name].protocol}
                for kind, reports in compared.reports.items()
                if name in reports
            }
            for name in names
        },
    }


def _seconds(compared: Compared, name: str, uids: list[str]) -> dict[str, Any]:
    """Return the time per object, and its origin."""
    if name in compared.seconds:
        return {"seconds": compared.seconds[name], "seconds_from": "stated"}
    report = compared.reports[VIEWS].get(name)
    source = report.protocol.get("source") if report else None
    if report and isinstance(source, dict) and source.get("kind") == "checkpoint":
        times = [report.records[uid].seconds for uid in uids if uid in report.records]
        known = [seconds["predict"] for seconds in times if "predict" in seconds]
        if known:  # median, because the first object's time includes compilation
            return {"seconds": statistics.median(known), "seconds_from": "measured"}
    return {"seconds": None, "seconds_from": None}


def _missing(reports: dict[str, Report]) -> dict[str, dict[str, str]]:
    """Return the reasons for objects that a method lacks and another has, by method."""
    known = {uid for report in reports.values() for uid in (*report.records, *report.failed)}
    return {
        name: {
            uid: report.failed.get(uid, "not in its report")
            for uid in sorted(known - report.records.keys())
        }
        for name, report in reports.items()
    }


def _columns(joined: dict[str, Any], paper: bool) -> tuple[dict[str, Column], ...]:
    """Return the columns of the main table, of other backgrounds, and of further shape metrics.

    The main table has the kinds that were evaluated; with ``paper`` all columns of Table 1.
    """
    of_views, grounds = (
        {
            key: Column(f"{metric.title} {'↑' if metric.more_is_better else '↓'}", metric.digits)
            for key, metric in chosen.items()
            if metric.in_compare
        }
        for chosen in (METRICS, on_grounds())
    )
    kinds = {kind for reports in joined["reports"].values() for kind in reports}
    main = {
        key: column
        for kind, columns in ((VIEWS, of_views), (SHAPES, OF_SHAPES))
        for key, column in columns.items()
        if paper or kind in kinds
    }
    fscores = {
        key: Column(f"F-score at {key.removeprefix(_FSCORE)} ↑", 4)
        for key in joined["common"]
        if key.startswith(_FSCORE)
    }
    return main, grounds, fscores | _MORE_OF_SHAPES


def main_lines(joined: dict[str, Any], paper: bool) -> Lines:
    """Return the lines of the main table, one per method, with its time."""
    rows = [Row([row["name"]], row) for row in joined["rows"]]
    lines = figures([""], _columns(joined, paper)[0], rows)
    lines[0].append("time [s] ↓")
    for line, row in zip(lines[1:], joined["rows"]):
        known = row["seconds"] is not None
        line.append(f"{row['seconds']:.3g} ({row['seconds_from']})" if known else "-")
    return lines


def _parts(joined: dict[str, Any], paper: bool) -> Iterator[str | Lines]:
    """Yield texts and tables in order."""
    columns, grounds, of_shapes = _columns(joined, paper)
    yield main_lines(joined, paper)
    counts: dict[int, list[str]] = {}
    for key, column in columns.items():
        counts.setdefault(len(joined["common"][key]), []).append(column.title[:-2])
    of = "; ".join(f"{', '.join(labels)}: {_count(n)}" for n, labels in counts.items())
    yield (
        f"Means over the objects that every method with the metric has ({of}), with "
        f"{100 * LEVEL:g} % bootstrap intervals over objects. Views: novel views, on white here. "
        f"Lengths: the longest side of the true shape is {_unit(joined):g}. Time: measured by the "
        "evaluation on its machine (median), or stated by whoever made this table."
    )
    for kind, methods in joined["missing"].items():
        for name, missing in methods.items():
            if missing:
                some = "; ".join(
                    one_line(f"{u}: {r}") for u, r in list(missing.items())[:_MAX_NAMED]
                )
                more = "; ..." if len(missing) > _MAX_NAMED else ""
                yield f"{kind}: {name} lacks {_count(len(missing))} ({some}{more})."
    yield from (f"{note}." for note in joined["notes"])
    if joined["differences"]:
        yield "Differences, object by object:"
        yield figures([""], columns, [Row([r["name"]], r, True) for r in joined["differences"]])
    if any(joined["common"][key] for key in grounds):
        count = _count(len(joined["common"][next(iter(grounds))]))
        yield f"The same novel views on black and on grey, of methods with alpha ({count}):"
        yield figures([""], grounds, [Row([row["name"]], row) for row in joined["rows"]])
    if any(joined["common"].get(key) for key in of_shapes):
        yield "More of the shapes, and its differences:"
        rows = [Row([row["name"]], row) for row in joined["rows"]]
        rows += [Row([row["name"]], row, True) for row in joined["differences"]]
        yield figures([""], of_shapes, rows)
    if paper:
        yield CAVEAT
        head = ["", *(columns[key].title for key in _OF_TABLE_1), "time [s] ↓"]
        texts = [["-" if v is None else f"{v:g}" for v in row] for row in TABLE_1.values()]
        yield [head, *([name, *row] for name, row in zip(TABLE_1, texts))]


def _unit(joined: dict[str, Any]) -> float:
    """Return the length of the true shape's longest side in reports of shapes."""
    protocols = (
        kinds[SHAPES]["protocol"] for kinds in joined["reports"].values() if SHAPES in kinds
    )
    unit = next(protocols, {}).get("unit", 1)
    return unit if isinstance(unit, (int, float)) else 1


def _count(number: int) -> str:
    return f"{number or 'no'} object{'' if number == 1 else 's'}"


def markdown_page(joined: dict[str, Any], paper: bool) -> str:
    """Return the text of ``compare.md``.

    Args:
        joined: the result of ``join``.
        paper: add the paper's own figures.
    """
    parts = [p if isinstance(p, str) else markdown(p) for p in _parts(joined, paper)]
    return "\n\n".join(parts) + "\n"
