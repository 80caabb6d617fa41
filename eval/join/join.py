"""Reports of the shards of an evaluation, joined to the report of the undivided one."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
from msgspec import Meta

from gamba_warp.errors import UserError, first_line, one_line
from gamba_warp.untrusted.documents import read_document
from gamba_warp.untrusted.ranges import shard_numbers

from ..shapes.pairs import make_shapes_report
from ..shapes.protocol import protocol_of
from ..shapes.table import PREDICTED, tables_of, text_of
from ..views.evaluate import make_views_report, named
from ..views.table import page

_OF_OBJECTS = ("uids", "uids_sha256")  # fields of a protocol that differ between shards
_NONE_HAS_IT = "none of the objects has it"


class _Part(msgspec.Struct):
    """Fields used of a report, beside those of its objects."""

    protocol: dict[str, Any]
    versions: dict[str, str]
    objects: list[dict[str, Any]]
    failures: list[dict[str, str]]
    num_failed: Annotated[int, Meta(ge=0)]
    baselines: dict[str, dict[str, Any]]
    shard: str = ""
    interrupted: bool = False
    left_out_baselines: dict[str, str] = {}
    inputs: dict[str, str | None] | None = None
    evaluation: dict[str, Any] | None = None


class Joined(NamedTuple):
    """Result of ``join_reports``: the report, the text to print, and files beside the report."""

    report: dict[str, Any]
    text: str
    files: dict[str, str]


def join_reports(paths: Iterable[Path]) -> Joined:
    """Join the reports of all shards of one evaluation.

    Args:
        paths: a report.json, or its folder, of each shard.

    Raises:
        UserError: a file is not such a report, the reports are of different evaluations, a shard is
            missing or given twice, or two have an object in common.
    """
    parts = {path: _read(path) for path in _files(paths)}
    _check(parts)
    ordered = sorted(parts.items(), key=lambda item: shard_numbers(item[1].shard))
    known = [part for _, part in ordered]
    try:
        if known[0].inputs is None:
            return _join_views(known)
        return _join_shapes(known, ordered[0][0])
    except UserError:
        raise
    except Exception as error:  # an invalid record
        reason = f"{type(error).__name__}: {first_line(error)}"
        raise UserError(f"{ordered[0][0]} …: not reports of an evaluation ({reason})") from error


def unjoined(paths: Iterable[Path]) -> list[str]:
    """Return the names of pictures, shapes and pages beside the shards' reports."""
    folders = {path.parent for path in _files(paths) if path.name == "report.json"}
    found = {path for folder in folders for path in folder.iterdir() if path.name[0] != "."}
    return sorted({p.name for p in found if p.suffix not in (".json", ".csv", ".md", ".tex")})


def _files(paths: Iterable[Path]) -> list[Path]:
    return [path / "report.json" if path.is_dir() else path for path in paths]


def _read(path: Path) -> _Part:
    part = read_document(path, _Part, 1 << 30)
    if not part.shard:
        raise UserError(f"{path}: not a report of --shard")
    try:
        shard_numbers(part.shard)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    if part.interrupted:
        raise UserError(f"{path}: its evaluation was interrupted; finish it first")
    for record in part.objects:
        if not isinstance(record.get("name"), str):
            raise UserError(f"{path}: an object without a name")
    return part


def _check(parts: dict[Path, _Part]) -> None:
    """Check that the reports are those of all shards of one evaluation."""
    (first_path, first), *others = parts.items()
    shards: dict[int, Path] = {}
    objects: dict[str, Path] = {}
    count = shard_numbers(first.shard)[1]
    for path, part in parts.items():
        here = f"{path} and {first_path}"
        for what in ("protocol", "versions", "inputs"):
            one, other = _common(part, what), _common(first, what)
            if key := next((k for k in {**one, **other} if one.get(k) != other.get(k)), None):
                values = " and ".join(one_line(repr(d.get(key)))[:60] for d in (one, other))
                raise UserError(f"{here}: {what} differ in {key}: {values}")
        number, of = shard_numbers(part.shard)
        if of != count:
            raise UserError(f"{here}: shards {part.shard} and {first.shard} are of two divisions")
        if number in shards:
            raise UserError(f"{path} and {shards[number]}: the shard {part.shard} twice")
        shards[number] = path
        for record in part.objects:
            if (before := objects.setdefault(record["name"], path)) != path:
                raise UserError(f"{path} and {before}: both have the object {record['name']}")
    if missing := sorted({*range(count)} - shards.keys()):
        listed = ", ".join(f"{number}/{count}" for number in missing[:5])
        raise UserError(f"missing: the reports of --shard {listed}{', …' * (len(missing) > 5)}")


def _common(part: _Part, what: str) -> dict[str, Any]:
    values = getattr(part, what) or {}
    if what == "protocol":
        return {key: value for key, value in values.items() if key not in _OF_OBJECTS}
    return values


def _all(parts: list[_Part]) -> list[dict[str, Any]]:
    return [*chain.from_iterable(part.objects for part in parts)]


def _join_views(parts: list[_Part]) -> Joined:
    uids = chain.from_iterable(part.protocol["uids"] for part in parts)
    left_out = {
        name: reason
        for part in parts
        for name, reason in part.left_out_baselines.items()
        if reason != _NONE_HAS_IT
    }
    beside = chain.from_iterable(part.failures[part.num_failed :] for part in parts)
    protocol = parts[0].protocol | named(uids)
    report = make_views_report(protocol, _all(parts), parts[0].versions, left_out, beside)
    report["interrupted"] = False
    return Joined(report, page(report), {"table.md": page(report)})


def _join_shapes(parts: list[_Part], path: Path) -> Joined:
    first = parts[0]
    objects = {PREDICTED: _all(parts)}
    for name in first.baselines:
        objects[name] = [record for part in parts for record in part.baselines[name]["objects"]]
    assert first.inputs is not None  # by which the kind is known
    report = make_shapes_report(first.protocol, objects, first.versions, first.inputs)
    if first.evaluation is not None:
        found = [part.evaluation or {} for part in parts]
        report["evaluation"] = first.evaluation | {
            "evaluated": sum(each["evaluated"] for each in found),
            "missing": [
                name
                for name in first.evaluation["missing"]
                if all(name in each["missing"] for each in found)
            ],
            "others": sorted({*chain.from_iterable(each["others"] for each in found)}),
        }
    protocol = protocol_of(first.protocol, path)
    return Joined(report, text_of(report, protocol), tables_of(report))
