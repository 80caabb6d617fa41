"""Published lists of the objects of G-Objaverse.

An object has two names: Objaverse's uid, of 32 letters and digits, and in G-Objaverse
``dictionary_id/instance_id``, two numbers. ``gobjaverse_280k_index_to_objaverse.json`` maps the
latter to the former: ``{"0/10010": "000-142/d4c6….glb", …}``.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec

from gamba_warp.errors import UserError
from gamba_warp.untrusted.documents import MAX_BYTES, parse_document, read_bytes

POOR = "Poor-quality"  # the category of G-Objaverse that training leaves out
RENDERED = re.compile(r"[0-9]{1,6}/[0-9]{1,12}")
UID = re.compile(r"[0-9a-zA-Z_-]{1,80}")


class _Annotation(msgspec.Struct):
    """One object of ``category_annotation.json``."""

    object_index: str
    label: str = ""


def read_list(path: Path) -> set[str]:
    """Read names of objects.

    Args:
        path: JSON, possibly gzipped: a list of names (``gobjaverse_280k.json``, the lists of its
            ten categories), or lists by category (``lvis-annotations.json.gz``); or text, ``.txt``
            or ``.csv``, with a name in the last field of each line.

    Returns:
        The names: uids of Objaverse, ``dictionary_id/instance_id`` of G-Objaverse.

    Raises:
        UserError: the file cannot be read, has another format, or names no objects.
    """
    if path.suffix.lower() in (".txt", ".csv"):
        rows = _bytes_of(path).decode("utf-8", "replace").splitlines()
        entries: Iterable[str] = [row.rpartition(",")[2] for row in rows if row.strip()]
    else:
        value: Any = parse_document(_bytes_of(path), list[str] | dict[str, list[str]], str(path))
        entries = value if isinstance(value, list) else (e for part in value.values() for e in part)
    names = {_name(entry, str(path)) for entry in entries}
    if not names:
        raise UserError(f"{path}: names no objects")
    return names


def read_index(path: Path) -> dict[str, str]:
    """Read the uid of Objaverse by the name in G-Objaverse.

    Raises:
        UserError: the file cannot be read, or is not such an index.
    """
    index = {}
    for name, entry in parse_document(_bytes_of(path), dict[str, str], str(path)).items():
        if not RENDERED.fullmatch(name):
            raise UserError(f"{path}: {name[:80]!r} is not of the form 0/10010")
        index[name] = _name(entry, str(path))
    return index


def read_quality(path: Path) -> dict[str, str]:
    """Read ``category_annotation.json``: the category of each object by its uid of Objaverse.

    Raises:
        UserError: the file cannot be read, or has another format.
    """
    rows = parse_document(_bytes_of(path), list[_Annotation], str(path))
    return {_name(row.object_index, str(path)): row.label for row in rows}


def _bytes_of(path: Path) -> bytes:
    """Read a file, with a limited size, and unpack it if it is gzipped."""
    data = read_bytes(path)
    if not data.startswith(b"\x1f\x8b"):
        return data
    try:
        reader = zlib.decompressobj(16 + zlib.MAX_WBITS)
        unpacked = reader.decompress(data, MAX_BYTES + 1)
    except zlib.error as error:
        raise UserError(f"{path}: cannot be unpacked ({error})") from error
    if len(unpacked) > MAX_BYTES or not reader.eof:
        raise UserError(f"{path}: is cut short, or unpacks to over {MAX_BYTES >> 20} MB")
    return unpacked


def _name(entry: str, source: str) -> str:
    """Parse the name in an entry; ``000-142/d4c6….glb`` gives ``d4c6…``."""
    text = entry.strip()
    for suffix in (".glb", ".tar"):
        text = text.removesuffix(suffix)
    if RENDERED.fullmatch(text):
        return text
    name = PurePosixPath(text).name
    if not UID.fullmatch(name) or len(text) > 200:
        raise UserError(f"{source}: {entry[:80]!r} is not the name of an object")
    return name


@dataclass
class Choice:
    """Selected objects.

    Attributes:
        names: in G-Objaverse, sorted.
        counts: number of objects in each list, and left after it; for the user and the record.
        uids: uid of Objaverse by the name in G-Objaverse, if known from an index.
    """

    names: list[str]
    counts: dict[str, int] = field(default_factory=dict)
    uids: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Lists:
    """Files that select objects.

    Attributes:
        index: gobjaverse_280k_index_to_objaverse.json; lists of Objaverse's names need it.
        uids: take only objects named by all of these lists (lvis-annotations.json.gz, ...).
        without: leave out objects named by one of these lists (gobjaverse_280k_Poor-quality.json).
        quality: category_annotation.json: leave out the objects of its category Poor-quality.
    """

    index: Path | None = None
    uids: tuple[Path, ...] = ()
    without: tuple[Path, ...] = ()
    quality: Path | None = None

    def choose(self, there: Iterable[str]) -> Choice:
        """Choose objects.

        Args:
            there: names in G-Objaverse of the objects of a local copy.

        Raises:
            UserError: a list cannot be read, names of Objaverse need a missing index, or no object
                is left.
        """
        index = {} if self.index is None else read_index(self.index)
        found = Choice(sorted(there), {}, index)
        counts = found.counts
        counts["in the source"] = len(found.names)
        for path in self.uids:
            names = self._rendered(read_list(path), index, path)
            found.names = sorted(names & {*found.names})
            counts[f"of them also in {path.name}"] = len(found.names)
        for path in self.without:
            names = self._rendered(read_list(path), index, path)
            found.names = [name for name in found.names if name not in names]
            counts[f"left without {path.name}"] = len(found.names)
        if self.quality is not None:
            if not index:
                raise UserError(f"{self.quality}: has names of Objaverse; give --index, too")
            labels = read_quality(self.quality)
            label_of = {n: labels.get(index.get(n, "")) for n in found.names}
            known = sum(label is not None for label in label_of.values())
            counts[f"with a category in {self.quality.name}"] = known
            found.names = [name for name in found.names if label_of[name] != POOR]
            counts[f"left without {POOR}"] = len(found.names)
        if not found.names:
            listed = ", ".join(f"{count} {what}" for what, count in counts.items())
            raise UserError(f"no object is left ({listed})")
        return found

    def _rendered(self, names: set[str], index: Mapping[str, str], path: Path) -> set[str]:
        """Return names in G-Objaverse; those that are missing from the index are dropped."""
        rendered = {name for name in names if RENDERED.fullmatch(name)}
        others = names - rendered
        if others and not index:
            raise UserError(f"{path}: has names of Objaverse; give --index, too")
        return rendered | {name for name, uid in index.items() if uid in others}
