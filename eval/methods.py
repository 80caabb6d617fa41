"""Reports of several methods: read, and held to one protocol and one truth.

A method has a report of ``eval-views``, one of ``eval-geometry``, or both.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

import msgspec

from gamba_warp.errors import UserError, one_line
from gamba_warp.untrusted.documents import parse_document, read_bytes

from .report import OK, flat

VIEWS, SHAPES = "eval-views", "eval-geometry"
MOST = 50  # reports
_LETTERS = 60  # of a method's name

# What of a protocol decides no number of one object: names, what is under test, and how a method's
# own files lie in space.
_FREE = {
    VIEWS: (
        *("source", "data", "split", "split_version", "uids", "uids_sha256"),
        *("baselines", "contact_sheet", "distance", "rendering", "pictures", "resize_pictures"),
        *("lpips", "lpips_reason", "grounds"),
    ),
    SHAPES: ("name", "definitions", "frame", "pred_axes", "reference", "distance"),
}
# Of those, what is worth a line where methods differ in it.
_NOTED = {VIEWS: ("split", "resize_pictures", "rendering", "lpips"), SHAPES: ("frame", "pred_axes")}

Number = Annotated[float, msgspec.Meta(ge=-1e30, le=1e30)]


class ViewsRecord(msgspec.Struct):
    """What is used of the record of an object that ``eval-views`` evaluated."""

    name: str
    truth_sha256: str
    views: list[int]
    psnr: Number | None = None
    ssim: Number | None = None
    lpips: Number | None = None
    mask_iou: Number | None = None
    psnr_black: Number | None = None
    lpips_black: Number | None = None
    psnr_grey: Number | None = None
    lpips_grey: Number | None = None
    seconds: dict[str, Number] = {}

    @property
    def truth(self) -> str:
        """Says which views were compared."""
        return f"{self.truth_sha256}, views {self.views}"


class ShapesRecord(msgspec.Struct):
    """What is used of the record of an object that ``eval-geometry`` evaluated."""

    name: str
    gt_sha256: str
    kind: str
    chamfer: Number | None = None
    iou: Number | None = None

    @property
    def truth(self) -> str:
        """Says which shape was compared with."""
        return self.gt_sha256


class _Report(msgspec.Struct):
    protocol: dict[str, Any]
    objects: list[dict[str, Any]]
    versions: dict[str, Any] = {}


@dataclass
class Report:
    """A report of one method.

    Attributes:
        path: its file.
        kind: ``VIEWS`` or ``SHAPES``.
        protocol: as the file states it.
        records: of the objects that were evaluated, by name.
        failed: reasons by name, of those that could not be.
        versions: of packages, as the file states them.
    """

    path: Path
    kind: str
    protocol: dict[str, Any]
    records: dict[str, Any]
    failed: dict[str, str]
    versions: dict[str, Any]


@dataclass
class Method:
    """A method and its reports.

    Attributes:
        name: as the user gave it.
        reports: by kind.
        seconds: of an object, as the user stated them; or None.
    """

    name: str
    reports: dict[str, Report] = field(default_factory=dict)
    seconds: float | None = None


def read_methods(
    arguments: tuple[str, ...], seconds: tuple[str, ...]
) -> tuple[list[Method], list[str]]:
    """Reads reports, and checks that they are of one protocol and one truth.

    Args:
        arguments: ``NAME=FILE`` each, or a folder with a report.json.
        seconds: ``NAME=SECONDS`` each.

    Returns:
        The methods in the order of their first report; and remarks on what differs between them
        without changing what a number means.

    Raises:
        UserError: an argument is not of this form, a file is no report, a method has two of one
            kind, or two reports have different protocols or truths; the message says in what.
    """
    if len(arguments) > MOST:
        raise UserError(f"{len(arguments)} reports, at most {MOST} are compared")
    methods: dict[str, Method] = {}
    for argument in arguments:
        name, text = _split(argument, "a report.json or its folder")
        report = read_report(Path(text))
        reports = methods.setdefault(name, Method(name)).reports
        if report.kind in reports:
            raise UserError(f"{argument}: {name} has a report of {report.kind} already")
        reports[report.kind] = report
    for argument in seconds:
        name, text = _split(argument, "seconds", "--seconds ")
        if name not in methods:
            raise UserError(f"--seconds {argument}: there is no report of {name}")
        methods[name].seconds = _positive(text, argument)
    found = list(methods.values())
    return found, [note for kind in (VIEWS, SHAPES) for note in _check_same(found, kind)]


def _split(argument: str, what: str, option: str = "") -> tuple[str, str]:
    name, equals, text = argument.partition("=")
    if not (name and equals and text):
        raise UserError(f"{option}{argument}: give NAME={what}")
    if len(name) > _LETTERS or not name.isprintable() or "|" in name:
        raise UserError(f"{option}{argument}: a name has at most {_LETTERS} letters and no '|'")
    return name, text


def _positive(text: str, argument: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1e9:
        raise UserError(f"--seconds {argument}: not a number of seconds above 0")
    return value


def read_report(path: Path) -> Report:
    """Reads a report of ``eval-views`` or ``eval-geometry``.

    Args:
        path: the file, or the folder with its ``report.json``.

    Raises:
        UserError: there is none, or it is no such report; the message says why.
    """
    path = path / "report.json" if path.is_dir() else path
    content = parse_document(read_bytes(path), _Report, str(path))
    if "max_psnr" in content.protocol:
        kind, record = VIEWS, ViewsRecord
    elif "occupancy" in content.protocol:
        kind, record = SHAPES, ShapesRecord
    else:
        raise UserError(f"{path}: no report of gamba eval-views or gamba eval-geometry")
    records, failed = {}, {}
    for number, item in enumerate(content.objects):
        name, status = item.get("name"), item.get("status")
        if not isinstance(name, str) or name in records or name in failed:
            raise UserError(f"{path}: objects[{number}] has no name, or that of another one")
        if status != OK:
            failed[name] = str(item.get("reason", "failed"))
            continue
        try:
            records[name] = msgspec.convert(item, record)
        except msgspec.ValidationError as error:
            raise UserError(f"{path}: {name}: {error}") from error
    return Report(path, kind, content.protocol, records, failed, content.versions)


def having(methods: list[Method], kind: str) -> dict[str, Report]:
    """The reports of one kind by the method's name."""
    return {m.name: m.reports[kind] for m in methods if kind in m.reports}


def _check_same(methods: list[Method], kind: str) -> list[str]:
    """Holds the reports of a kind against one another; returns remarks."""
    reports = having(methods, kind)
    for one, other in combinations(reports.values(), 2):
        _check_pair(one, other)
    notes = []
    for key in _NOTED[kind]:
        names: dict[str, list[str]] = {}
        for name, report in reports.items():
            names.setdefault(_shown(report.protocol.get(key)), []).append(name)
        if len(names) > 1:
            parts = (f"{value} ({', '.join(who)})" for value, who in names.items())
            notes.append(f"{kind}: {key} is {'; '.join(parts)}")
    return notes


def _check_pair(first: Report, report: Report) -> None:
    """Raises UserError where two reports of one kind cannot stand in one table."""
    for key, mine, other in _differences(report.protocol, first.protocol):
        top = key.split(".")[0]
        free = top in _FREE[report.kind] or _of_surfaces_alone(top, report, first)
        if not free or (top == "lpips" and None not in (mine, other)):
            raise UserError(
                f"{report.path}: not of the protocol of {first.path}: "
                f"{key} is {_shown(mine)}, not {_shown(other)}"
            )
    for uid in sorted(report.records.keys() & first.records.keys()):
        if report.records[uid].truth != first.records[uid].truth:
            raise UserError(
                f"{report.path}: {uid} was compared with another truth than in {first.path}"
            )


def _of_surfaces_alone(key: str, *reports: Report) -> bool:
    """Whether this says only how Gaussians become surfaces, and one method has no Gaussians."""
    if key != "surface":
        return False
    kinds = [{record.kind for record in r.records.values()} for r in reports]
    return not all("gaussians" in kind for kind in kinds)


def _differences(one: dict[str, Any], other: dict[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    a, b = (flat(values, lists=True) for values in (one, other))
    for key in dict.fromkeys((*a, *b)):
        if a.get(key) != b.get(key):
            yield key, a.get(key), b.get(key)


def _shown(value: Any) -> str:
    return "absent" if value is None else one_line(str(value), 60)
