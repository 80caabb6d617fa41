"""``gamba compare``: reports of several methods with the same protocol and ground truth in one
table.

A method has a report of ``eval-views``, one of ``eval-geometry``, or both. The table covers the
objects that all methods have. It is written as Markdown and JSON.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import msgspec

from gamba_warp.batch import counted
from gamba_warp.errors import UserError, one_line
from gamba_warp.image_metrics import METRICS, all_figures, on_grounds
from gamba_warp.untrusted.documents import parse_document, read_bytes
from gamba_warp.versions import __version__

from .averages import BOOTSTRAP, LEVEL, summary_of
from .report import OK, flat
from .tables import Column, Row, figures, markdown

FORMAT = "gamba_warp.compare.1"
MAX_REPORTS = 50
VIEWS, SHAPES = "eval-views", "eval-geometry"
_MAX_LETTERS = 60  # of a method's name
_MAX_NAMED = 5  # objects of a method named in a line

# Metrics of shapes: the paper's table first, then the others.
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
        *("baselines", "contact_sheet", "distance", "rendering", "images", "resize_images"),
        *("lpips", "lpips_reason", "grounds", "name", "changed"),
    ),
    SHAPES: ("name", "definitions", "frame", "pred_axes", "reference", "distance"),
}
_RENAMED = {"pictures": "images", "resize_pictures": "resize_images"}  # of older reports
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


class _ShapesRecord(msgspec.Struct):
    """Fields used of an object's record from ``eval-geometry``, besides its figures."""

    gt_sha256: str
    kind: str


_RECORDS = {VIEWS: _ViewsRecord, SHAPES: _ShapesRecord}
_GT = ("truth_sha256", "views", "gt_sha256")  # must be equal in two records of an object


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


def read_reports(arguments: tuple[str, ...]) -> dict[str, dict[str, Report]]:
    """Read reports, and check that they have the same protocol and ground truth.

    Args:
        arguments: ``NAME=FILE`` each, or a folder with a report.json.

    Returns:
        By method, in the order of their first report, the reports by kind.

    Raises:
        UserError: an argument is malformed, a file is not a report, a method has two of one kind,
            or two reports differ in protocol or ground truth; the message names the difference.
    """
    if len(arguments) > MAX_REPORTS:
        raise UserError(f"{len(arguments)} reports, at most {MAX_REPORTS} can be compared")
    methods: dict[str, dict[str, Report]] = {}
    for argument in arguments:
        name, text = _split(argument)
        report = read_report(Path(text))
        others = [of[report.kind] for of in methods.values() if report.kind in of]
        if report.kind in methods.setdefault(name, {}):
            raise UserError(f"{argument}: {name} already has a report of {report.kind}")
        for other in others:
            _check_pair(other, report)
        methods[name][report.kind] = report
    return methods


def _split(argument: str) -> tuple[str, str]:
    name, equals, text = argument.partition("=")
    if not (name and equals and text):
        raise UserError(f"{argument}: expected NAME=PATH of a report.json or its folder")
    if len(name) > _MAX_LETTERS or not name.isprintable() or "|" in name:
        raise UserError(f"{argument}: a name has at most {_MAX_LETTERS} characters and no '|'")
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
        raise UserError(f"{path}: not a report of gamba eval-views or gamba eval-geometry")
    protocol = {_RENAMED.get(name, name): value for name, value in content.protocol.items()}
    report = Report(path, kind, protocol)
    for number, item in enumerate(content.objects):
        name = item.get("name")
        if not isinstance(name, str) or name in report.records or name in report.failed:
            raise UserError(f"{path}: objects[{number}] has no name, or a duplicate one")
        if item.get("status") != OK:
            report.failed[name] = str(item.get("reason", "failed"))
            continue
        try:
            report.records[name] = msgspec.convert(item, _RECORDS[kind])
            by_key = flat(item)
            values = {key: by_key.get(key) for key in _keys(kind, content.protocol)}
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
                f"{report.path}: its protocol differs from {first.path}: "
                f"{key} is {_shown(a)}, not {_shown(b)}"
            )
    for uid in sorted(report.records.keys() & first.records.keys()):
        one, two = ([getattr(r.records[uid], key, None) for key in _GT] for r in pair)
        if one != two:
            raise UserError(f"{report.path}: {uid} has another ground truth than in {first.path}")


def _shown(value: Any) -> str:
    return "absent" if value is None else one_line(str(value), 60)


def join(methods: dict[str, dict[str, Report]], against: str | None) -> dict[str, Any]:
    """Make the table of methods.

    A figure is averaged over the objects for which every method with this figure has a value, so an
    object at which one method failed counts for none.

    Args:
        methods: as from ``read_reports``.
        against: baseline of the paired differences; None: the first method.

    Returns:
        ``format, version, against, bootstrap``; ``common``: names of the objects by figure;
        ``rows``: for each method ``name`` and by figure ``{mean, interval, median,
        median_interval}`` or None; ``differences``: likewise, each method minus ``against``;
        ``missing``: by kind of report and method, the reasons by object; ``reports``: the files and
        their protocols.

    Raises:
        UserError: ``against`` is unknown, or no object is common to all.
    """
    names = list(methods)
    base = names[0] if against is None else against
    if base not in names:
        raise UserError(f"--against {base}: expected one of {', '.join(names)}")
    # By figure, method and object; a method without any value of a figure is left out.
    values: dict[str, dict[str, dict[str, float]]] = {}
    common: dict[str, list[str]] = {}
    missing: dict[str, dict[str, dict[str, str]]] = {}
    for kind in (VIEWS, SHAPES):
        reports = {name: of[kind] for name, of in methods.items() if kind in of}
        # All protocols have the same thresholds.
        keys = _keys(kind, next((r.protocol for r in reports.values()), {}))
        for key in keys:
            by_method = {
                name: {uid: value for uid, v in r.figures.items() if (value := v[key]) is not None}
                for name, r in reports.items()
            }
            values[key] = {name: by_uid for name, by_uid in by_method.items() if by_uid}
            uids = map(set, values[key].values())
            common[key] = sorted(set.intersection(*uids)) if values[key] else []
        if reports and not (common[keys[0]] and all(r.records for r in reports.values())):
            counts = ", ".join(f"{name} {len(r.records)}" for name, r in reports.items())
            fewest = min(reports.values(), key=lambda report: len(report.records))
            raise UserError(
                f"{fewest.path}: no object was evaluated for all methods by {kind}: {counts}"
            )
        known = {uid for report in reports.values() for uid in (*report.records, *report.failed)}
        missing[kind] = {
            name: {
                uid: report.failed.get(uid, "not in its report")
                for uid in sorted(known - report.records.keys())
            }
            for name, report in reports.items()
        }

    def summaries(name: str, less: str | None = None) -> dict[str, Any]:
        """Summarise the figures of a method, or its paired differences to another."""
        row: dict[str, Any] = dict.fromkeys(values)
        for key, of in values.items():
            if common[key] and name in of and (less is None or less in of):
                minus = of[less] if less else dict.fromkeys(common[key], 0.0)
                row[key] = summary_of([of[name][uid] - minus[uid] for uid in common[key]])
        return row

    return {
        "format": FORMAT,
        "version": __version__,
        "against": base,
        "bootstrap": BOOTSTRAP,
        "common": common,
        "rows": [{"name": name, **summaries(name)} for name in names],
        "differences": [
            {"name": f"{name} - {base}", **summaries(name, base)} for name in names if name != base
        ],
        "missing": missing,
        "reports": {
            name: {
                kind: {"file": report.path.name, "protocol": report.protocol}
                for kind, report in of.items()
            }
            for name, of in methods.items()
        },
    }


def _columns(joined: dict[str, Any]) -> tuple[dict[str, Column], dict[str, Column]]:
    """Return the columns of the paper's metrics, and of the further ones, as far as evaluated."""
    views, grounds = (
        {
            key: Column(f"{metric.title} {'↑' if metric.more_is_better else '↓'}", metric.digits)
            for key, metric in chosen.items()
            if metric.in_compare
        }
        for chosen in (METRICS, on_grounds())
    )
    fscores = {
        key: Column(f"F-score at {key.removeprefix(_FSCORE)} ↑", 4)
        for key in joined["common"]
        if key.startswith(_FSCORE)
    }

    def evaluated(columns: dict[str, Column]) -> dict[str, Column]:
        return {key: column for key, column in columns.items() if joined["common"].get(key)}

    return evaluated(views | OF_SHAPES), evaluated(grounds | fscores | _MORE_OF_SHAPES)


def markdown_page(joined: dict[str, Any]) -> str:
    """Return the text of ``compare.md`` from the result of ``join``."""
    main, more = _columns(joined)
    rows = [Row([row["name"]], row) for row in joined["rows"]]
    rows += [Row([row["name"]], row, True) for row in joined["differences"]]
    counts: dict[int, list[str]] = {}
    for key, column in (main | more).items():
        counts.setdefault(len(joined["common"][key]), []).append(column.title[:-2])
    of = "; ".join(f"{', '.join(titles)}: {counted(n, 'object')}" for n, titles in counts.items())
    parts = [
        markdown(figures([""], main, rows)),
        f"Means over the objects that every method with the metric has ({of}), with "
        f"{100 * LEVEL:g} % bootstrap intervals over objects; differences object by object. Views: "
        "novel views, on white unless the title says otherwise. Lengths: the longest side of the "
        f"true shape is {_unit(joined):g}.",
    ]
    protocols = {
        name: of.get(VIEWS, {}).get("protocol", {}) for name, of in joined["reports"].items()
    }
    if resized := [name for name, of in protocols.items() if of.get("resize_images")]:
        parts.append(f"Images of {', '.join(resized)} were resized to the true ones.")
    for kind, methods in joined["missing"].items():
        for name, missing in methods.items():
            if missing:
                some = [one_line(f"{u}: {r}") for u, r in list(missing.items())[:_MAX_NAMED]]
                some += ["..."] if len(missing) > _MAX_NAMED else []
                count = counted(len(missing), "object")
                parts.append(f"{kind}: {name} lacks {count} ({'; '.join(some)}).")
    if more:
        parts += ["Further metrics:", markdown(figures([""], more, rows))]
    return "\n\n".join(parts) + "\n"


def _unit(joined: dict[str, Any]) -> float:
    """Return the length of the true shape's longest side in reports of shapes."""
    protocols = (
        kinds[SHAPES]["protocol"] for kinds in joined["reports"].values() if SHAPES in kinds
    )
    unit = next(protocols, {}).get("unit", 1)
    return unit if isinstance(unit, (int, float)) else 1
