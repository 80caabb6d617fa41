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

import math
import mmap
import os
import stat
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from ..errors import UserError
from ..images import MAX_PIXELS
from ..untrusted.documents import read_document
from ..untrusted.names import inside, parts_of, plain_name
from .layouts import (
    MAX_SIDE,
    MAX_VIEWS,
    ObjectFiles,
    Stored,
    check_cameras,
    one_text,
    read_placement,
)

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
        applied_transform: of the mesh that was rendered, as ``transforms.json`` has it; or None.
        applied_scale: see above.
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
    applied_transform: list[list[float]] | None = None
    applied_scale: float = 1.0


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


def read_index(folder: Path) -> Index:
    """Reads the index of a pack, finished or not; its objects come in the order of their names.

    Raises:
        UserError: it cannot be read, is of another version, or is none; or an object has no sound
            name, or two have the same.
    """
    path = folder / INDEX
    index = read_document(path, Index)
    if index.format != FORMAT:
        raise UserError(f"{path}: not the index of a pack")
    if index.version != VERSION:
        raise UserError(f"{path}: version {index.version} of packs, this one reads {VERSION}")
    found: dict[str, dict[str, Any]] = {}
    for values in index.objects:
        uid = "/".join(parts_of(values.get("uid"), str(path)))
        if uid in found:
            raise UserError(f"{path}: the object {uid} is there twice")
        found[uid] = values
    index.objects = [found[uid] for uid in sorted(found)]
    return index


def open_pack(folder: Path) -> Index:
    """Reads the index of a finished pack, and no shard.

    Raises:
        UserError: its index is bad or unfinished, or names no objects.
    """
    index = read_index(folder)
    if not index.finished:
        raise UserError(f"{folder}: an unfinished pack; the command that began it goes on with it")
    if not index.objects:
        raise UserError(f"{folder}: the pack holds no objects")
    return index


def read_packed(folder: Path, values: dict[str, Any]) -> ObjectFiles:
    """Cameras and pictures of an object; the pictures are checked when they are read.

    Args:
        folder: of the pack.
        values: of the object, as the index has them.

    Raises:
        UserError: the index is wrong about it, its shard is missing or too short, or its cameras
            are damaged or impossible.
    """
    name = f"{folder / INDEX}: {values['uid']}"
    try:
        entry = msgspec.convert(values, Entry)
    except msgspec.ValidationError as error:
        raise UserError(f"{name}: {error}") from error
    if entry.width * entry.height > MAX_PIXELS:
        raise UserError(f"{name}: {entry.width}x{entry.height} is over {MAX_PIXELS >> 20} MP")
    shard = inside(folder, plain_name(entry.shard, str(folder / INDEX)), str(folder))
    place = f"{shard}: {entry.uid}"
    shape, depth_type = (entry.height, entry.width), np.dtype(entry.depth_type).newbyteorder("<")
    kinds = {"images": ((*shape, 4), np.dtype(np.uint8))}
    kinds |= dict.fromkeys(KINDS[1:], (shape, depth_type))
    data = _read(shard, entry.cameras, entry.views * COLUMNS * 8)
    if zlib.crc32(data) != entry.crc:
        raise UserError(f"{place}: damaged (cameras of another checksum)")
    rows = np.frombuffer(data, "<f8").reshape(entry.views, COLUMNS).astype(np.float64)
    sums = rows[:, _K:]
    if not (np.isfinite(rows).all() and ((sums >= 0) & (sums < 1 << 32)).all()):
        raise UserError(f"{place}: its cameras are not finite numbers")
    poses, Ks = rows[:, :_POSE].reshape(-1, 4, 4), rows[:, _POSE:_K].reshape(-1, 3, 3)
    sizes: list[tuple[int, int] | None] = [(entry.width, entry.height)] * entry.views
    check_cameras(poses, Ks, sizes, [f"{place}: view {view}" for view in range(entry.views)])

    def stored(kind: str) -> Sequence[Stored] | None:
        start, (shape, dtype) = getattr(entry, kind), kinds[kind]
        if start is None:
            return None
        length = dtype.itemsize * math.prod(shape)
        _read(shard, start, entry.views * length)  # looks whether it is long enough
        return [
            _Picture(shard, start + view * length, shape, dtype, int(crc), f"{name}, {kind} {view}")
            for view, crc in enumerate(sums[:, KINDS.index(kind)])
        ]

    return ObjectFiles(
        images=stored("images") or [],
        camera_to_world=poses,
        Ks=Ks,
        sizes=sizes,
        depths=stored("depths"),
        backs=stored("backs"),
        depth_unit=entry.depth_unit,
        name=one_text(entry.name),
        attribution={one_text(k): one_text(v) for k, v in entry.attribution.items()},
        placement=read_placement(msgspec.structs.asdict(entry), name),
    )


@dataclass(eq=False)
class _Picture(Stored):
    """One picture in a shard, which may be a part of the map itself; checked when first read."""

    shard: Path
    start: int
    shape: tuple[int, ...]
    dtype: np.dtype
    crc: int
    name: str
    checked: bool = False

    def __str__(self) -> str:
        return self.name

    def read(self) -> np.ndarray:
        data = _read(self.shard, self.start, self.dtype.itemsize * math.prod(self.shape))
        if not self.checked and zlib.crc32(data) != self.crc:
            raise UserError(f"{self.shard}: {self.name}: damaged (it has another checksum)")
        self.checked = True
        values = np.frombuffer(data, self.dtype).reshape(self.shape)
        return values if len(self.shape) == 3 else values.astype(np.float32)


def _read(path: Path, start: int, count: int) -> memoryview:
    """``count`` bytes of a shard from ``start``.

    Raises:
        UserError: there is no such shard, or it is too short.
    """
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode):
            raise UserError(f"{path}: not a plain file")
        # Reading behind the end of a file that was cut short since would kill the process.
        if start + count > status.st_size:
            raise UserError(
                f"{path}: cut short ({status.st_size:,} bytes, {start + count:,} are needed)"
            )
        data = _mapped(path, status.st_ino, status.st_mtime_ns, status.st_size)
    except OSError as error:
        raise UserError(f"{path}: {error.strerror or error}") from error
    return memoryview(data)[start : start + count]


@lru_cache(maxsize=256)  # in each process
def _mapped(path: Path, *status: int) -> mmap.mmap:
    """The map of a file; one that was written anew has another ``status``."""
    with path.open("rb") as file:
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
