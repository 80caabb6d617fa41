"""Manifest of a dataset: its objects, checked once and listed in ``DATA/gamba-manifest.jsonl``.

Opening a large dataset takes hundreds of system calls for each object: its folder, its camera file,
and each image. ``gamba data index`` makes them once; ``open_dataset`` then reads the manifest
and compares at most three sizes and times of each object, and the list of each folder above them.

The first line is a ``Head``, each further line an ``Entry``. Times are of this machine's copy:
a copy of the dataset keeps them (``rsync -a``), or needs its own manifest.
"""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, NamedTuple

import msgspec
from msgspec import Meta

from ..errors import UserError
from ..files import atomic_path, plain_file
from ..untrusted.documents import parse_document
from ..untrusted.names import parts_of
from .layouts import LAYOUTS, one_line

MANIFEST = "gamba-manifest.jsonl"
FORMAT, VERSION = "gamba-manifest", 1
_MAX_LINE = 1 << 20  # bytes; an entry takes 200
_MARKS = 3  # files and folders of an object that are compared
_FOLDER = -1  # in place of a size

_Digest = Annotated[str, Meta(pattern="^[0-9a-f]{16}$")]
_Mark = tuple[str, int, int]  # name in the object's folder, bytes or _FOLDER, time in ns


class Head(msgspec.Struct, kw_only=True):
    """First line of a manifest.

    Attributes:
        format: ``FORMAT``.
        version: ``VERSION``.
        layout: a layout of ``LAYOUTS``.
        objects: number of the entries.
        folders: by their path under the root ("" for the root), the digest of the list of each
            folder above the objects.
    """

    format: str
    version: int
    layout: str
    objects: Annotated[int, Meta(ge=1, le=10**9)]
    folders: dict[str, _Digest]


class Entry(msgspec.Struct, array_like=True):
    """Object of a manifest.

    Attributes:
        uid: path of its folder under the root.
        digest: of its cameras, see ``ViewDataset.digest``; zeros if it cannot be read.
        reason: why it cannot be read, or empty.
        marks: its camera files and the folders of its images, at most three.
    """

    uid: str
    digest: _Digest
    reason: Annotated[str, Meta(max_length=2000)]
    marks: Annotated[list[_Mark], Meta(min_length=1, max_length=_MARKS)]


class Manifest(NamedTuple):
    """A verified manifest.

    Attributes:
        layout: layout of the objects.
        digests: of the objects' cameras, by uid, in the order of the names.
        bad: reasons by uid, of objects that cannot be read.
    """

    layout: str
    digests: dict[str, str]
    bad: dict[str, str]


def list_of(folder: str) -> str:
    """Return a digest of the names in a folder that decide which objects it contains.

    Raises:
        OSError: it cannot be read.
    """
    marks = {mark for mark, _ in LAYOUTS.values()}
    with os.scandir(folder) as entries:
        names = [e.name for e in entries if e.name in marks or (e.name[0] != "." and e.is_dir())]
    return hashlib.sha256(os.fsencode("\n".join(sorted(names)))).hexdigest()[:16]


def marks_of(folder: Path, names: Iterable[str]) -> list[_Mark]:
    """Return sizes and times of files and folders in an object's folder, which are compared later.

    Raises:
        UserError: none of them exists.
    """
    marks: list[_Mark] = []
    for name in dict.fromkeys(names):
        try:
            marks.append((name, *_mark(os.path.join(folder, name))))
        except OSError:  # of an object that cannot be read
            continue
    if not marks:
        raise UserError(f"{folder}: removed while it was read")
    return marks[:_MARKS]


def _mark(path: str) -> tuple[int, int]:
    status = os.stat(path)
    size = _FOLDER if stat.S_ISDIR(status.st_mode) else status.st_size
    return size, status.st_mtime_ns


def write_manifest(
    root: Path, layout: str, folders: Mapping[str, str], entries: Iterable[Entry], count: int
) -> Path:
    """Write a manifest, atomically.

    Args:
        root: root of the dataset.
        layout: layout of its objects.
        folders: as for ``Head``.
        entries: the objects in the order of their names; made one by one.
        count: their number.

    Raises:
        UserError: it cannot be written, or a name is not UTF-8.
    """
    path, encode = root / MANIFEST, msgspec.json.Encoder().encode
    head = Head(format=FORMAT, version=VERSION, layout=layout, objects=count, folders=dict(folders))
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        try:
            file.write(encode(head) + b"\n")
            for entry in entries:
                file.write(encode(entry) + b"\n")
        except UnicodeEncodeError as error:
            raise UserError(f"{root}: a name is not UTF-8: {error.object[:100]!r}") from error
    return path


def read_manifest(root: Path) -> Manifest:
    """Read a manifest and compare it with the dataset; done once in a process.

    Raises:
        UserError: it is invalid, cut short, or older than its dataset; the message names the
            command that writes it again.
    """
    status = plain_file(root / MANIFEST)
    return _read(root, status.st_mtime_ns, status.st_size, status.st_ino)


@lru_cache(maxsize=8)
def _read(root: Path, *status: int) -> Manifest:
    path, again = root / MANIFEST, f"gamba data index {root} writes it again"

    def older(name: str) -> UserError:
        return UserError(f"{path}: older than its dataset, {name or '.'} has changed; {again}")

    with open(path, "rb") as file:
        head = parse_document(file.readline(_MAX_LINE), Head, f"{path}: line 1")
        if head.format != FORMAT or head.version != VERSION or head.layout not in LAYOUTS:
            raise UserError(f"{path}: not a manifest of version {VERSION}; {again}")
        for name, wanted in head.folders.items():
            parts = _parts(name, f"{path}: line 1") if name else ()
            try:
                same = list_of(os.path.join(root, *parts)) == wanted
            except OSError:
                same = False
            if not same:
                raise older(name)
        manifest, base = Manifest(head.layout, {}, {}), os.fspath(root)
        for number in range(2, head.objects + 2):
            source = f"{path}: line {number}"
            line = file.readline(_MAX_LINE)
            if not line.endswith(b"\n"):
                raise UserError(f"{path}: cut short at line {number}; {again}")
            entry = parse_document(line, Entry, source)
            uid = "/".join(_parts(entry.uid, source))
            if uid in manifest.digests:
                raise UserError(f"{source}: the object {uid} occurs twice")
            for name, *wanted in entry.marks:
                if name != ".":
                    _parts(name, source)
                try:
                    same = [*_mark(f"{base}/{uid}/{name}")] == wanted
                except OSError:
                    same = False
                if not same:
                    raise older(uid)
            manifest.digests[uid] = entry.digest
            if entry.reason:
                manifest.bad[uid] = one_line(entry.reason)
        if file.read(1):
            raise UserError(f"{path}: has more than {head.objects} objects; {again}")
    return manifest


def _parts(name: str, source: str) -> tuple[str, ...]:
    """Parts of a relative name, none of which begins with a dot."""
    parts = parts_of(name, source)
    if any(part.startswith(".") for part in parts):
        raise UserError(f"{source}: the name {name[:80]!r} has a part with a leading dot")
    return parts
