"""Shards: the views of many objects in a few tar files, as the ``webdataset`` package reads them.

A folder of shards has ``shards.json``, its index, and tars. An object is one sample: ``KEY.json``
with the content of ``transforms.json``, and its pictures, ``KEY.000.webp``, with the bytes that
they had as files. Their names in the document are those without ``KEY.``. ``KEY`` is the uid; as
WebDataset ends a key at the first dot of the file's name, a dot is written as ``%2E``.

The index has the split, size and SHA-256 of each tar, and where each object begins and ends in it.
So a dataset opens by one file, and only the requested pictures of an object are read. The tars lie
beside the index, or at its address: then they are kept in a cache beside it (``shard_cache.py``).
"""

from __future__ import annotations

import hashlib
import io
import threading
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta

from ..batch import counted, warn
from ..errors import UserError
from ..images import load_rgba8, open_picture
from ..untrusted.archives import files_in_tar
from ..untrusted.documents import parse_document, read_document
from ..untrusted.names import parts_of, plain_name
from .layouts import DecodedPicture, ObjectFiles, object_of
from .shard_cache import ADDRESS, Source

INDEX = "shards.json"
FORMAT, VERSION = "gamba-shards", 1
DOCUMENT = "json"  # suffix of an object's document
_MAX_PICTURE = 256 << 20  # bytes of an encoded picture
_MAX_DOCUMENT = 64 << 20

_NAMED = 3  # unread members that a warning names

_Bytes = Annotated[int, Meta(ge=0, le=1 << 50)]
_warned: set[Path] = set()  # tars of which a warning has named the unread members
_warning = threading.Lock()


class Shard(msgspec.Struct, kw_only=True):
    """Tar in the index.

    Attributes:
        name: of the file.
        split: of all its objects.
        bytes: its size.
        sha256: of the file.
        objects: for each object its uid, first byte and number of bytes.
    """

    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}$")]
    split: Literal["train", "val", "test"]
    bytes: _Bytes
    sha256: Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
    objects: Annotated[list[tuple[str, _Bytes, _Bytes]], Meta(min_length=1)]


class Index(msgspec.Struct, kw_only=True, omit_defaults=True):
    """Content of ``shards.json``.

    Attributes:
        format: ``FORMAT``.
        version: ``VERSION``.
        finished: True if all objects are in it; else its command can be continued.
        size: height of the pictures; None keeps the files' bytes.
        split: the packed part of the dataset, or "all".
        split_version: version of the rule or of the file that defines the split.
        address: folder of the tars on a server; empty if they lie beside the index.
        cache_bytes: largest size of all tars that are kept of ``address``.
        shards: the tars.
    """

    format: str
    version: int
    finished: bool = True
    size: Annotated[int, Meta(ge=1, le=16_384)] | None = None
    split: str = "all"
    split_version: int = 2
    address: Annotated[str, Meta(pattern=f"^$|{ADDRESS}")] = ""
    cache_bytes: _Bytes = 0
    shards: list[Shard] = []


class Place(NamedTuple):
    """Object in the tars: number of its shard, its first byte, its number of bytes."""

    shard: int
    start: int
    size: int


def key_of(uid: str) -> str:
    """Return the key of an object in WebDataset's sense."""
    above, _, name = uid.replace("%", "%25").rpartition("/")
    return f"{above}/{name.replace('.', '%2E')}" if above else name.replace(".", "%2E")


def checked_index(index: Index, path: Path | str) -> Index:
    """Check the format and the names of an index.

    Raises:
        UserError: it is not an index or of another version, or a name is invalid or occurs twice.
    """
    if index.format != FORMAT:
        raise UserError(f"{path}: not the index of shards")
    if index.version != VERSION:
        raise UserError(f"{path}: version {index.version} of shards, supported is {VERSION}")
    uids, names = set[str](), set[str]()
    for shard in index.shards:
        if plain_name(shard.name, str(path)) in names:
            raise UserError(f"{path}: the shard {shard.name} occurs twice")
        names.add(shard.name)
        for uid, start, size in shard.objects:
            if "/".join(parts_of(uid, str(path))) != uid:
                raise UserError(f"{path}: the name {uid[:80]!r} is not plain")
            if uid in uids:
                raise UserError(f"{path}: the object {uid} occurs twice")
            if start + size > shard.bytes:
                raise UserError(f"{path}: {uid} ends outside of {shard.name}")
            uids.add(uid)
    return index


def read_index(folder: Path) -> Index:
    """Read the index of shards, finished or not; raises as ``checked_index``."""
    return checked_index(read_document(folder / INDEX, Index), folder / INDEX)


class Shards:
    """Objects in shards; picklable."""

    def __init__(self, folder: Path) -> None:
        """Read the index; the tars are not touched.

        Raises:
            UserError: the index is invalid or unfinished, or names no objects.
        """
        self.folder, index = folder, read_index(folder)
        if not index.finished:
            raise UserError(f"{folder}: unfinished shards; run the command that began them again")
        if not index.shards:
            raise UserError(f"{folder}: the shards have no objects")
        self.size, self.split_version = index.size, index.split_version
        self.sources = [
            Source(folder, s.name, s.bytes, s.sha256, index.address, index.cache_bytes)
            for s in index.shards
        ]
        self.splits = [shard.split for shard in index.shards]
        places = {
            uid: Place(number, start, size)
            for number, shard in enumerate(index.shards)
            for uid, start, size in shard.objects
        }
        self.places = {uid: places[uid] for uid in sorted(places)}

    def uids(self, split: str) -> list[str]:
        """Return the names of the objects of a split, or of all, sorted."""
        wanted = [split in ("all", name) for name in self.splits]
        return [uid for uid, place in self.places.items() if wanted[place.shard]]

    def digest(self, uid: str) -> str:
        """Return 16 hexadecimal digits of the content of an object, without reading it."""
        place = self.places[uid]
        text = f"{self.sources[place.shard].sha256} {place.start} {place.size}"
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def bytes(self, place: Place) -> bytes:
        """Read a part of a tar; raises as ``Source.path``."""
        source = self.sources[place.shard]
        with source.open() as file:
            file.seek(place.start)
            data = file.read(place.size)
        if len(data) < place.size:
            raise UserError(f"{source.folder / source.name}: cut short")
        return data

    def read(self, uid: str) -> ObjectFiles:
        """Read the cameras of an object; warn once for a tar with members that nothing reads.

        Raises:
            UserError: its part of the tar is damaged, has other members than its own, or its
                document is invalid.
        """
        files, unread = self._read(uid)
        if unread:
            self._warn_unread(self.places[uid].shard)
        return files

    def _warn_unread(self, number: int) -> None:
        """Name and count the members of a tar that nothing reads, once in a process."""
        path = self.folder / self.sources[number].name
        with _warning:
            if path in _warned:
                return
            _warned.add(path)
        names = list[str]()
        for uid in (uid for uid, place in self.places.items() if place.shard == number):
            with suppress(UserError):  # it is named when it is used
                names += self._read(uid)[1]
        shown = ", ".join([*names[:_NAMED], *(["..."] if len(names) > _NAMED else [])])
        warn(path, [f"{counted(len(names), 'member')} that nothing reads: {shown}"])

    def _read(self, uid: str) -> tuple[ObjectFiles, list[str]]:
        """Return an object, and the names of its members that its document does not name."""
        place, key = self.places[uid], f"{key_of(uid)}."
        source = f"{self.folder / self.sources[place.shard].name}: {uid}"
        with self.sources[place.shard].open() as file:
            members = files_in_tar(file, place.start, place.size, source)
        files = dict[str, ShardPicture]()
        for name, (start, size) in members.items():
            if not name.startswith(key):
                raise UserError(f"{source}: has a foreign member {name[:80]!r}")
            suffix = name.removeprefix(key)
            files[suffix] = ShardPicture(self, Place(place.shard, start, size), f"{source}: {name}")
        document = files.pop(DOCUMENT, None)
        if document is None or document.place.size > _MAX_DOCUMENT:
            raise UserError(f"{source}: has no {key}{DOCUMENT}, or one over 64 MB")
        content, used = parse_document(document.content(), object, str(document)), set[str]()
        found = object_of([(str(document), content, partial(_find, files, used))])
        return found, [key + suffix for suffix in files if suffix not in used]


def _find(
    files: dict[str, ShardPicture], used: set[str], name: object, source: str
) -> ShardPicture:
    if not isinstance(name, str) or name not in files:
        raise UserError(f"{source}: the shard has no {repr(name)[:80]} of this object")
    used.add(name)
    return files[name]


@dataclass(frozen=True)
class ShardPicture(DecodedPicture):
    """Encoded picture in a shard."""

    shards: Shards
    place: Place
    name: str

    def __str__(self) -> str:
        return self.name

    def __hash__(self) -> int:
        return hash(self.name)

    def content(self) -> bytes:
        """Return the bytes of the picture's file; raises as ``Source.path``."""
        if self.place.size > _MAX_PICTURE:
            raise UserError(f"{self}: over {_MAX_PICTURE >> 20} MB")
        return self.shards.bytes(self.place)

    def read(self) -> np.ndarray:
        return load_rgba8(self.name, self.content())

    def open(self):
        """Open it as ``images.open_picture``."""
        return open_picture(io.BytesIO(self.content()), self.name)
