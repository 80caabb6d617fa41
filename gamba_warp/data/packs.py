"""Packs: the views of many objects, decoded and resized once, in a few large files.

A pack is a folder with ``pack.json``, its index, and shards. The index names each object with its
split, attribution, shard and size, and the byte in the shard at which each of its arrays begins:

- ``cameras``: ``[V, 28]`` float64: the camera-to-world pose (OpenGL frame, object units), row by
  row, K in pixels, and the CRC-32 of the view's picture, depth and back (0 where there is none);
- ``images``: ``[V, H, W, 4]`` uint8 RGBA, colour not premultiplied;
- ``depths``, ``backs``: ``[V, H, W]`` uint16 or float32 depth, in steps; or none.

The index has the CRC-32 of the cameras. So every byte that is used was checked once, and of an
object only the views that are asked for are read. All numbers are little-endian. A shard is mapped
into memory; one whose name ends in ``.tar`` is a WebDataset of the same arrays (``.npy``), which
lie in it uncompressed.
"""

from __future__ import annotations

import mmap
import stat
import threading
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from ..errors import UserError
from ..images import MAX_PIXELS
from ..untrusted.documents import read_document
from ..untrusted.names import inside, parts_of, plain_name
from .layouts import MAX_SIDE, MAX_VIEWS, ObjectFiles, Stored, check_cameras

INDEX = "pack.json"
FORMAT, VERSION = "gamba-pack", 1
COLUMNS = 28  # of an object's cameras: pose, K, three checksums
_POSE, _K = 16, 25  # where in a row the pose and K end
KINDS = ("images", "depths", "backs")  # as the checksums follow one another

_Offset = Annotated[int, Meta(ge=0, le=1 << 50)]
_Side = Annotated[int, Meta(ge=1, le=MAX_SIDE)]
_Text = Annotated[str, Meta(max_length=1000)]


class Entry(msgspec.Struct, kw_only=True, omit_defaults=True):
    """An object in the index.

    Attributes:
        uid: its name within the dataset.
        split: "train", "val" or "test".
        shard: name of a file beside the index.
        views: V.
        width: of its pictures, pixels.
        height: see above.
        crc: CRC-32 of its cameras.
        cameras: byte of the shard at which they begin, as for the others.
        images: see above.
        depths: see above; None: it has none.
        backs: see above.
        depth_type: of the depths and backs.
        depth_unit: length of a step, object units.
        name: name for people.
        attribution: creator, licence, source.
    """

    uid: str
    split: Literal["train", "val", "test"]
    shard: str
    views: Annotated[int, Meta(ge=1, le=MAX_VIEWS)]
    width: _Side
    height: _Side
    crc: Annotated[int, Meta(ge=0, lt=1 << 32)]
    cameras: _Offset
    images: _Offset
    depths: _Offset | None = None
    backs: _Offset | None = None
    depth_type: Literal["uint16", "float32"] = "uint16"
    depth_unit: Annotated[float, Meta(gt=0, le=1e3)] = 1.0
    name: _Text = ""
    attribution: Annotated[dict[_Text, _Text], Meta(max_length=100)] = {}


class Index(msgspec.Struct, kw_only=True):
    """What ``pack.json`` holds.

    Attributes:
        format: ``FORMAT``.
        version: ``VERSION``.
        finished: whether all objects are in it; else the command that makes it can go on.
        size: height of the pictures; None: what the files had.
        split: which part of the dataset was packed, or "all".
        shards: "arrays" or "webdataset".
        split_version: of the rule, or of the file, that made the split.
        objects: values of ``Entry``; each is looked at when the object is used, so that one that is
            bad spoils no other.
    """

    format: str
    version: int
    finished: bool = True
    size: Annotated[int, Meta(ge=1, le=MAX_SIDE)] | None = None
    split: str = "all"
    shards: str = "arrays"
    split_version: int = 2
    objects: list[dict[str, Any]] = []


@dataclass
class Pack:
    """An opened pack.

    Attributes:
        objects: its objects, not looked at yet.
        size: height of the pictures; None: what the files had.
        split_version: of the rule, or of the file, that made the split.
    """

    objects: list[PackedObject]
    size: int | None
    split_version: int


def read_index(folder: Path) -> Index:
    """Reads the index of a pack, finished or not.

    Raises:
        UserError: it cannot be read, is of another version, or is none.
    """
    path = folder / INDEX
    index = read_document(path, Index)
    if index.format != FORMAT:
        raise UserError(f"{path}: not the index of a pack")
    if index.version != VERSION:
        raise UserError(f"{path}: version {index.version} of packs, this one reads {VERSION}")
    return index


def open_pack(folder: str | Path) -> Pack:
    """Opens a pack, without reading any shard.

    Raises:
        UserError: its index is bad or unfinished, or two objects have one name.
    """
    folder = Path(folder)
    index = read_index(folder)
    if not index.finished:
        raise UserError(f"{folder}: an unfinished pack; the command that began it goes on with it")
    objects = packed_objects(folder, index)
    if not objects:
        raise UserError(f"{folder}: the pack holds no objects")
    return Pack(objects, index.size, index.split_version)


def packed_objects(folder: Path, index: Index) -> list[PackedObject]:
    """The objects of an index in the order of their names, not looked at yet.

    Raises:
        UserError: an object has no sound name, or two have the same.
    """
    shards = _Shards(folder)
    found: dict[str, PackedObject] = {}
    for values in index.objects:
        uid, source = values.get("uid"), str(folder / INDEX)
        parts_of(uid, source)
        assert isinstance(uid, str)  # parts_of refuses all else
        if uid in found:
            raise UserError(f"{source}: the object {uid} is there twice")
        found[uid] = PackedObject(uid, values, shards)
    return [found[uid] for uid in sorted(found)]


class _Shards:
    """The shards of a pack, each mapped when it is first used; a copy for a process maps anew."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._maps: dict[str, mmap.mmap] = {}
        self._lock = threading.Lock()

    def __getstate__(self) -> Path:
        return self.folder

    def __setstate__(self, folder: Path) -> None:
        self.__init__(folder)

    def read(self, name: str, start: int, count: int) -> memoryview:
        """``count`` bytes from ``start``.

        Raises:
            UserError: there is no such shard, or it is too short.
        """
        with self._lock:
            if name not in self._maps:
                self._maps[name] = self._opened(name)
            data = self._maps[name]
        # The file may have been cut short since; reading behind its end would kill the process.
        if start + count > min(len(data), data.size()):
            at_most = f"{data.size():,} bytes, {start + count:,} are needed"
            raise UserError(f"{self.folder / name}: cut short ({at_most})")
        return memoryview(data)[start : start + count]

    def _opened(self, name: str) -> mmap.mmap:
        path = inside(self.folder, plain_name(name, str(self.folder / INDEX)), str(self.folder))
        try:
            if not stat.S_ISREG(path.stat().st_mode):
                raise UserError(f"{path}: not a plain file")
            with path.open("rb") as file:
                return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError) as error:  # ValueError: an empty file
            reason = getattr(error, "strerror", None) or "the shard is empty"
            raise UserError(f"{path}: {reason}") from error


class PackedObject:
    """An object in a pack.

    Attributes:
        uid: its name within the dataset.
        split: "train", "val", "test", or what else the index says.
    """

    def __init__(self, uid: str, values: dict[str, Any], shards: _Shards) -> None:
        self.uid, self.split = uid, values.get("split")
        self._values, self._shards = values, shards
        self._entry: Entry | None = None
        self._sums = np.empty(0)
        self._checked: set[tuple[str, int]] = set()

    def __str__(self) -> str:
        return f"{self._shards.folder / INDEX}: {self.uid}"

    def entry(self) -> Entry:
        """What the index says, checked by itself.

        Raises:
            UserError: a value is missing, of another type, or out of its range.
        """
        try:
            entry = msgspec.convert(self._values, Entry)
        except msgspec.ValidationError as error:
            raise UserError(f"{self}: {error}") from error
        if entry.width * entry.height > MAX_PIXELS:
            raise UserError(f"{self}: {entry.width}x{entry.height} is over {MAX_PIXELS >> 20} MP")
        return entry

    def files(self) -> ObjectFiles:
        """Cameras and pictures of the object; the pictures are checked when they are read.

        Raises:
            UserError: the index is wrong about it, its shard is missing or too short, or its
                cameras are damaged or impossible.
        """
        entry = self.entry()
        for kind in KINDS:  # reading maps the shard, and looks whether it is long enough
            if (start := getattr(entry, kind)) is not None:
                self._shards.read(entry.shard, start, entry.views * _bytes(entry, kind))
        data = self._shards.read(entry.shard, entry.cameras, entry.views * COLUMNS * 8)
        if zlib.crc32(data) != entry.crc:
            raise UserError(f"{self._place(entry)}: damaged (cameras of another checksum)")
        rows = np.frombuffer(data, "<f8").reshape(entry.views, COLUMNS).astype(np.float64)
        sums = rows[:, _K:]
        if not (np.isfinite(rows).all() and ((sums >= 0) & (sums < 1 << 32)).all()):
            raise UserError(f"{self._place(entry)}: its cameras are not finite numbers")
        poses, Ks = rows[:, :_POSE].reshape(-1, 4, 4), rows[:, _POSE:_K].reshape(-1, 3, 3)
        check_cameras(poses, Ks, entry.width, entry.height, self._place(entry))
        self._entry, self._sums = entry, sums

        def stored(kind: str) -> Sequence[Stored] | None:
            if getattr(entry, kind) is None:
                return None
            return [_PackedPicture(self, kind, view) for view in range(entry.views)]

        return ObjectFiles(
            images=stored("images") or [],
            camera_to_world=poses,
            Ks=Ks,
            sizes=[(entry.width, entry.height)] * entry.views,
            depths=stored("depths"),
            backs=stored("backs"),
            depth_unit=entry.depth_unit,
            name=_line(entry.name),
            attribution={_line(k): _line(v) for k, v in entry.attribution.items()},
        )

    def _place(self, entry: Entry) -> str:
        return f"{self._shards.folder / entry.shard}: {self.uid}"

    def read(self, kind: str, view: int) -> np.ndarray:
        """The picture of one view, after ``files``; its checksum is looked at once.

        Args:
            kind: one of ``KINDS``.
            view: number of the view.

        Returns:
            As ``Stored.read``; it may be a part of the shard itself, which cannot be written.

        Raises:
            UserError: the shard is too short by now, or the picture is damaged.
        """
        entry = self._entry
        assert entry is not None
        length = _bytes(entry, kind)
        data = self._shards.read(entry.shard, getattr(entry, kind) + view * length, length)
        if (kind, view) not in self._checked:
            if zlib.crc32(data) != self._sums[view, KINDS.index(kind)]:
                what = f"view {view} of its {kind} has another checksum"
                raise UserError(f"{self._place(entry)}: damaged ({what})")
            self._checked.add((kind, view))
        if kind == "images":
            return np.frombuffer(data, np.uint8).reshape(entry.height, entry.width, 4)
        dtype = "<u2" if entry.depth_type == "uint16" else "<f4"
        steps = np.frombuffer(data, dtype).reshape(entry.height, entry.width).astype(np.float32)
        if not (np.isfinite(steps).all() and steps.min() >= 0):
            raise UserError(f"{self._place(entry)}: a depth is negative or not finite")
        return steps


@dataclass(frozen=True, eq=False)
class _PackedPicture(Stored):
    """One picture in a pack."""

    object: PackedObject
    kind: str
    view: int

    def __str__(self) -> str:
        return f"{self.object}, {self.kind} {self.view}"

    def read(self) -> np.ndarray:
        return self.object.read(self.kind, self.view)


def _bytes(entry: Entry, kind: str) -> int:
    """Bytes of one view."""
    values = entry.width * entry.height
    if kind == "images":
        return 4 * values
    return values * (2 if entry.depth_type == "uint16" else 4)


def _line(text: str) -> str:
    return " ".join(text.split())[:500]
