"""Lists of Objaverse's and G-Objaverse's objects, in the forms in which they are published.

An object has two names: Objaverse's uid, of 32 letters and digits, and in G-Objaverse
``dictionary_id/instance_id``, two numbers. ``gobjaverse_280k_index_to_objaverse.json`` has the one
by the other: ``{"0/10010": "000-142/d4c6….glb", …}``.
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
    """Reads names of objects.

    Args:
        path: JSON, also packed by gzip: a list of names (``gobjaverse_280k.json``, the lists of its
            ten categories), or lists by category (``lvis-annotations.json.gz``); or text, ``.txt``
            or ``.csv``, with a name in the last field of each line.

    Returns:
        The names: uids of Objaverse, ``dictionary_id/instance_id`` of G-Objaverse.

    Raises:
        UserError: the file cannot be read, is none of these, or names nothing.
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
    """Reads the uid of Objaverse by the name in G-Objaverse.

    Raises:
        UserError: the file cannot be read, or is no such index.
    """
    index = {}
    for name, entry in parse_document(_bytes_of(path), dict[str, str], str(path)).items():
        if not RENDERED.fullmatch(name):
            raise UserError(f"{path}: {name[:80]!r} is not of the form 0/10010")
        index[name] = _name(entry, str(path))
    return index


def read_quality(path: Path) -> dict[str, str]:
    """Reads ``category_annotation.json``: the category of each object by its uid of Objaverse.

    Raises:
        UserError: the file cannot be read, or holds something else.
    """
    rows = parse_document(_bytes_of(path), list[_Annotation], str(path))
    return {_name(row.object_index, str(path)): row.label for row in rows}


def _bytes_of(path: Path) -> bytes:
    """A file's bytes, unpacked where it is packed by gzip, and not more of them than are read."""
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
    """The name that an entry means; ``000-142/d4c6….glb`` means ``d4c6…``."""
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
    """Which objects are taken.

    Attributes:
        names: in G-Objaverse, or of Objaverse where views are not looked for; sorted.
        counts: how many objects each list has, keeps or leaves out; for people and the record.
        uids: uid of Objaverse by the name in G-Objaverse, as far as an index says it.
    """

    names: list[str]
    counts: dict[str, int] = field(default_factory=dict)
    uids: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Lists:
    """The files that choose objects.

    Attributes:
        index: gobjaverse_280k_index_to_objaverse.json; lists by Objaverse's names need it.
        uids: take only what each of these lists names (lvis-annotations.json.gz, ...).
        without: take nothing that one of these lists names (gobjaverse_280k_Poor-quality.json).
        quality: category_annotation.json: leave out what it calls Poor-quality.
    """

    index: Path | None = None
    uids: tuple[Path, ...] = ()
    without: tuple[Path, ...] = ()
    quality: Path | None = None

    def choose(self, there: Iterable[str] | None) -> Choice:
        """Chooses objects.

        Args:
            there: names in G-Objaverse of the objects of a local copy; or None: objects of
                Objaverse, by their uids, of which ``uids`` must have a list.

        Raises:
            UserError: a list cannot be read; names of the other kind need an index that is not
                given; or no object is left.
        """
        index = {} if self.index is None else read_index(self.index)
        if there is None and not self.uids:
            raise UserError("--uids: needed, so that not all of Objaverse is downloaded")
        found, meshes = Choice(sorted(there or ()), {}, index), there is None
        counts = found.counts
        if not meshes:
            counts["in the source"] = len(found.names)
        for path in self.uids:
            names = self._translated(read_list(path), index, meshes, path)
            what = f"of them also in {path.name}" if counts else f"in {path.name}"
            found.names = sorted(names & {*found.names} if counts else names)
            counts[what] = len(found.names)
        for path in self.without:
            names = self._translated(read_list(path), index, meshes, path)
            found.names = [name for name in found.names if name not in names]
            counts[f"left without {path.name}"] = len(found.names)
        if self.quality is not None:
            if not meshes and not index:
                raise UserError(f"{self.quality}: has names of Objaverse; give --index, too")
            labels = read_quality(self.quality)
            label_of = {n: labels.get(n if meshes else index.get(n, "")) for n in found.names}
            known = sum(label is not None for label in label_of.values())
            counts[f"with a category in {self.quality.name}"] = known
            found.names = [name for name in found.names if label_of[name] != POOR]
            counts[f"left without {POOR}"] = len(found.names)
        if not found.names:
            told = ", ".join(f"{count} {what}" for what, count in counts.items())
            raise UserError(f"no object is left ({told})")
        return found

    def _translated(
        self, names: set[str], index: Mapping[str, str], meshes: bool, path: Path
    ) -> set[str]:
        """The names in the kind that is asked for; those that the index does not know are left."""
        rendered = {name for name in names if RENDERED.fullmatch(name)}
        others = names - rendered
        if not (rendered if meshes else others):
            return names
        if not index:
            kind = "G-Objaverse" if meshes else "Objaverse"
            raise UserError(f"{path}: has names of {kind}; give --index, too")
        if meshes:
            return others | {index[name] for name in rendered if name in index}
        return rendered | {name for name, uid in index.items() if uid in others}
