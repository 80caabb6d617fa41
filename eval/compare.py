"""``gamba compare``: reports of several methods, held to one protocol and truth, in one table.

A method has a report of ``eval-views``, one of ``eval-geometry``, or both. The table runs over the
objects that all methods have; it is Markdown, JSON, and a page that loads nothing else.
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
from .report import OK, csv_of, flat
from .tables import Column, Lines, Row, figures, markdown

FORMAT = "gamba_warp.compare.1"
MOST = 50  # reports
VIEWS, SHAPES = "eval-views", "eval-geometry"
_LETTERS = 60  # of a method's name
_NAMED = 5  # objects of a method that a line names

# Of shapes, what is compared, and of the table what the paper has besides pictures.
OF_SHAPES = {"chamfer": Column("Chamfer ↓", 4), "iou": Column("Volume IoU ↑", 4)}
_FSCORE = "fscore."  # before a threshold
_MORE_OF_SHAPES = {
    "accuracy": Column("accuracy ↓", 4),
    "completeness": Column("completeness ↓", 4),
    "normal_consistency": Column("normals ↑", 3),
}
# A field of the protocol that tells the kind of a report.
_TELLS = {"max_psnr": VIEWS, "occupancy": SHAPES}
# What of a protocol decides no number of one object: names, what is under test, and how a method's
# own files lie in space.
_FREE = {
    VIEWS: (
        *("source", "data", "split", "split_version", "uids", "uids_sha256"),
        *("baselines", "contact_sheet", "distance", "rendering", "pictures", "resize_pictures"),
        *("lpips", "lpips_reason", "grounds", "name", "changed"),
    ),
    SHAPES: ("name", "definitions", "frame", "pred_axes", "reference", "distance"),
}
# Of those, what is worth a line where methods differ in it.
_NOTED = {VIEWS: ("split", "resize_pictures", "rendering", "lpips"), SHAPES: ("frame", "pred_axes")}

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
    """The figures that are compared of a kind of report, nested ones with dots."""
    if kind == VIEWS:
        return list(all_figures())
    known = protocol.get("thresholds")
    thresholds = known if isinstance(known, list) else []
    fscores = [f"{_FSCORE}{t:g}" for t in thresholds if isinstance(t, (int, float))]
    return [*OF_SHAPES, *fscores, *_MORE_OF_SHAPES]


class _OfViews(msgspec.Struct):
    """What is used of the record of an object that ``eval-views`` evaluated, beside its figures."""

    truth_sha256: str
    views: list[int]
    seconds: dict[str, Number] = {}


class _OfShapes(msgspec.Struct):
    """Likewise, of an object that ``eval-geometry`` evaluated."""

    gt_sha256: str
    kind: str


_RECORDS = {VIEWS: _OfViews, SHAPES: _OfShapes}
_TRUTH = ("truth_sha256", "views", "gt_sha256")  # what two records of an object must agree in


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
        failed: reasons by name, of those that could not be evaluated.
    """

    path: Path
    kind: str
    protocol: dict[str, Any]
    records: dict[str, Any] = field(default_factory=dict)
    figures: dict[str, Figures] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)


@dataclass
class Compared:
    """What is compared.

    Attributes:
        methods: names, in the order of their first report.
        reports: by kind and method.
        seconds: of an object, as the user stated them, by method.
        notes: on what differs between methods without changing what a number means.
    """

    methods: list[str]
    reports: dict[str, dict[str, Report]]
    seconds: dict[str, float]
    notes: list[str]


def read_reports(arguments: tuple[str, ...], seconds: tuple[str, ...]) -> Compared:
    """Reads reports, and checks that they are of one protocol and one truth.

    Args:
        arguments: ``NAME=FILE`` each, or a folder with a report.json.
        seconds: ``NAME=SECONDS`` each.

    Raises:
        UserError: an argument is not of this form, a file is no report, a method has two of one
            kind, or two reports have different protocols or truths; the message says in what.
    """
    if len(arguments) > MOST:
        raise UserError(f"{len(arguments)} reports, at most {MOST} are compared")
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
        for key in _NOTED[kind]:
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
    if len(name) > _LETTERS or not name.isprintable() or "|" in name:
        raise UserError(f"{option}{argument}: a name has at most {_LETTERS} letters and no '|'")
    return name, text


def read_report(path: Path) -> Report:
    """Reads a report of ``eval-views`` or ``eval-geometry``.

    Args:
        path: the file, or the folder with its ``report.json``.

    Raises:
        UserError: there is none, or it is no such report; the message says why.
    """
    path = path / "report.json" if path.is_dir() else path
    content = parse_document(read_bytes(path), _Document, str(path))
    kind = next((kind for told, kind in _TELLS.items() if told in content.protocol), None)
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
    """Raises UserError where two reports of one kind cannot stand in one table."""
    pair = (report, first)
    mine, other = (flat(r.protocol, lists=True) for r in pair)
    for key in dict.fromkeys((*mine, *other)):
        a, b = mine.get(key), other.get(key)
        if a == b:
            continue
        top = key.split(".")[0]
        free = top in _FREE[report.kind] and (top != "lpips" or None in (a, b))
        if top == "surface" and report.kind == SHAPES:  # of Gaussians, which a method may not have
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
    """Makes the table of methods.

    A figure is averaged over the objects for which every method that has this figure at all has a
    value, so that no method is spared the objects that it failed at without the others being spared
    them too.

    Args:
        compared: as ``read_reports`` returns it.
        against: the method that the others are compared with, object by object; the first one if
            None.

    Returns:
        ``format, version, against, bootstrap, notes``; ``common``: the names of the objects by
        figure; ``rows``: for each method ``name``, ``seconds`` with where they come from, and by
        figure ``{mean, interval, median, median_interval}``, None where it has no such figure;
        ``differences``: likewise, each method minus ``against``; ``missing``: by kind of report and
        method, the reasons by object; ``reports``: the files and their protocols.

    Raises:
        UserError: there is no such method, or no object is common to all.
    """
    names = compared.methods
    base = names[0] if against is None else against
    if base not in names:
        raise UserError(f"--against {base}: the methods are {', '.join(names)}")
    # by figure, method and object; a method without any value of a figure does not have it
    values: dict[str, dict[str, dict[str, float]]] = {}
    common: dict[str, list[str]] = {}
    for kind, reports in compared.reports.items():
        # the protocols are the same but for what decides no number
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
        """The figures of a method, or its values less another one's, object by object."""
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
    """The time of one object, and where it comes from."""
    if name in compared.seconds:
        return {"seconds": compared.seconds[name], "seconds_from": "stated"}
    report = compared.reports[VIEWS].get(name)
    source = report.protocol.get("source") if report else None
    if report and isinstance(source, dict) and source.get("kind") == "checkpoint":
        times = [report.records[uid].seconds for uid in uids if uid in report.records]
        known = [seconds["predict"] for seconds in times if "predict" in seconds]
        if known:  # the median: the first object's time holds the compilation of the kernels
            return {"seconds": statistics.median(known), "seconds_from": "measured"}
    return {"seconds": None, "seconds_from": None}


def _missing(reports: dict[str, Report]) -> dict[str, dict[str, str]]:
    """By method, why it lacks objects that another one has or tried."""
    known = {uid for report in reports.values() for uid in (*report.records, *report.failed)}
    return {
        name: {
            uid: report.failed.get(uid, "not in its report")
            for uid in sorted(known - report.records.keys())
        }
        for name, report in reports.items()
    }


def _columns(joined: dict[str, Any], paper: bool) -> tuple[dict[str, Column], ...]:
    """Those of the table, of the one on other grounds, and of the one of more about shapes.

    The first one has the kinds that were evaluated, and beside the paper's table all that it has.
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
    """The lines of the first table: a method each, with its time; arguments as below."""
    rows = [Row([row["name"]], row) for row in joined["rows"]]
    lines = figures([""], _columns(joined, paper)[0], rows)
    lines[0].append("time [s] ↓")
    for line, row in zip(lines[1:], joined["rows"]):
        known = row["seconds"] is not None
        line.append(f"{row['seconds']:.3g} ({row['seconds_from']})" if known else "-")
    return lines


def csv_text(joined: dict[str, Any]) -> str:
    """The text of ``compare.csv``: a line for each method and each difference.

    Figures have the columns ``KEY.mean``, ``KEY.low`` and ``KEY.high`` (of the interval).
    """

    def plain(value: Any) -> Any:
        if not isinstance(value, dict):
            return value
        low, high = value["interval"] or (None, None)
        return {"mean": value["mean"], "low": low, "high": high}

    rows = [*joined["rows"], *joined["differences"]]
    return csv_of({"objects": [{k: plain(v) for k, v in row.items() if v} for row in rows]})


def _parts(joined: dict[str, Any], paper: bool) -> Iterator[str | Lines]:
    """Texts and tables in their order."""
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
                some = "; ".join(one_line(f"{u}: {r}") for u, r in list(missing.items())[:_NAMED])
                more = "; ..." if len(missing) > _NAMED else ""
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
    """The length of the longest side of the true shape, in reports of shapes."""
    protocols = (
        kinds[SHAPES]["protocol"] for kinds in joined["reports"].values() if SHAPES in kinds
    )
    unit = next(protocols, {}).get("unit", 1)
    return unit if isinstance(unit, (int, float)) else 1


def _count(number: int) -> str:
    return f"{number or 'no'} object{'' if number == 1 else 's'}"


def markdown_page(joined: dict[str, Any], paper: bool) -> str:
    """The text of ``compare.md``.

    Args:
        joined: what ``join`` returns.
        paper: whether the paper's own figures are printed too.
    """
    parts = [p if isinstance(p, str) else markdown(p) for p in _parts(joined, paper)]
    return "\n\n".join(parts) + "\n"


def html_page(joined: dict[str, Any], paper: bool) -> str:
    """The text of ``compare.html``; arguments as for ``markdown_page``."""
    from gamba_warp.pages.page import Section, page_text  # with torch, which the table does without

    sections, texts = [], []
    for part in _parts(joined, paper):
        if isinstance(part, str):
            texts.append(part)
        else:
            head, *rows = part
            sections.append(Section("", "\n\n".join(texts), header=head, table=rows))
            texts = []
    sections += [Section("", "\n\n".join(texts))] if texts else []
    return page_text("Methods compared", "", sections)
