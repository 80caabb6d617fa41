"""Packs: the views of many objects, decoded and resized once, in a few large files.

A pack is a folder with ``pack.json``, its index, and shards. The index names each object with its
split, attribution, shard and size, and the byte in the shard at which each of its arrays begins:

- ``cameras``: ``[V, 28]`` float64: the camera-to-world pose (OpenGL frame, object units), row by
  row, K in pixels, and the CRC-32 of the view's picture, depth and back (0 if missing);
- ``images``: ``[V, H, W, 4]`` uint8 RGBA, colour not premultiplied;
- ``depths``, ``backs``: ``[V, H, W]`` uint16 or float32 depth, in steps; optional.

The index has the CRC-32 of the cameras, so every byte is checked before its first use, and only
the requested views of an object are read. All numbers are little-endian. A shard is mapped into
memory; one whose name ends in ``.tar`` is a WebDataset of the same arrays (``.npy``), uncompressed.
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
    DecodedPicture,
    ObjectFiles,
    check_cameras,
    one_line,
    read_placement,
)

INDEX = "pack.json"
FORMAT, VERSION = "gamba-pack", 1
COLUMNS = 28  # of an object's cameras: pose, K, three checksums
_POSE, _K = 16, 25  # end of the pose and of K in a row
KINDS = ("images", "depths", "backs")  # in the order of the checksums

_Offset = Annotated[int, Meta(ge=0, le=1 << 50)]
_Side = Annotated[int, Meta(ge=1, le=MAX_SIDE)]
_Text = Annotated[str, Meta(max_length=1000)]


class Entry(msgspec.Struct, kw_only=True, omit_defaults=True):
    """Object in the index.

    Attributes:
        uid: its name within the dataset.
        split: "train", "val" or "test".
        shard: name of a file beside the index.
        views: V.
        width: width of its pictures, pixels.
        height: height of its pictures, pixels.
        crc: CRC-32 of its cameras.
        cameras: offset of the cameras in the shard, bytes.
        images: offset of the pictures.
        depths: offset of the depths, or None.
        backs: offset of the backs, or None.
        depth_type: dtype of the depths and backs.
        depth_unit: length of a step, object units.
        name: readable name.
        attribution: creator, licence, source.
        applied_transform: of the rendered mesh, as in ``transforms.json``, or None.
        applied_scale: of the rendered mesh, as in ``transforms.json``.
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
    """Content of ``pack.json``.

    Attributes:
        format: ``FORMAT``.
        version: ``VERSION``.
        finished: True if all objects are in it; else its command can be continued.
        size: height of the pictures; None keeps that of the files.
        split: the packed part of the dataset, or "all".
        shards: "arrays" or "webdataset".
        split_version: version of the rule or of the file that defines the split.
        objects: values of ``Entry``; each is validated when the object is used, so that an invalid
            one does not affect the others.
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
    """Read the index of a pack, finished or not, with its objects in the order of their names.

    Raises:
        UserError: it cannot be read, is not an index or of another version; or a name is invalid or
            occurs twice.
    """
    path = folder / INDEX
    index = read_document(path, Index)
    if index.format != FORMAT:
        raise UserError(f"{path}: not the index of a pack")
    if index.version != VERSION:
        raise UserError(f"{path}: pack version {index.version}, supported is {VERSION}")
    found: dict[str, dict[str, Any]] = {}
    for values in index.objects:
        uid = "/".join(parts_of(values.get("uid"), str(path)))
        if uid in found:
            raise UserError(f"{path}: the object {uid} occurs twice")
        found[uid] = values
    index.objects = [found[uid] for uid in sorted(found)]
    return index


def open_pack(folder: Path) -> Index:
    """Read the index of a finished pack, without its shards.

    Raises:
        UserError: its index is invalid or unfinished, or names no objects.
    """
    index = read_index(folder)
    if not index.finished:
        raise UserError(f"{folder}: an unfinished pack; run the command that began it again")
    if not index.objects:
        raise UserError(f"{folder}: the pack has no objects")
    return index


def read_packed(folder: Path, values: dict[str, Any]) -> ObjectFiles:
    """Read the cameras of an object; its pictures are checked when they are read.

    Args:
        folder: folder of the pack.
        values: the object's entry in the index.

    Raises:
        UserError: the entry is invalid, its shard is missing or too short, or its cameras are
            damaged or impossible.
    """
    name = f"{folder / INDEX}: {values['uid']}"
    try:
        entry = msgspec.convert(values, Entry)
    except msgspec.ValidationError as error:
        raise UserError(f"{name}: {error}") from error
    if entry.width * entry.height > MAX_PIXELS:
        raise UserError(f"{name}: {entry.width}x{entry.height} is over {MAX_PIXELS >> 20} MP")
    shard = inside(folder, plain_name(entry.shard, str(folder / INDEX)), str(folder))
    source = f"{shard}: {entry.uid}"
    shape, depth_type = (entry.height, entry.width), np.dtype(entry.depth_type).newbyteorder("<")
    kinds = {"images": ((*shape, 4), np.dtype(np.uint8))}
    kinds |= dict.fromkeys(KINDS[1:], (shape, depth_type))
    data = _read(shard, entry.cameras, entry.views * COLUMNS * 8)
    if zlib.crc32(data) != entry.crc:
        raise UserError(f"{source}: damaged (the checksum of the cameras differs)")
    rows = np.frombuffer(data, "<f8").reshape(entry.views, COLUMNS).astype(np.float64)
    sums = rows[:, _K:]
    if not (np.isfinite(rows).all() and ((sums >= 0) & (sums < 1 << 32)).all()):
        raise UserError(f"{source}: its cameras are not finite numbers")
    poses, Ks = rows[:, :_POSE].reshape(-1, 4, 4), rows[:, _POSE:_K].reshape(-1, 3, 3)
    sizes: list[tuple[int, int] | None] = [(entry.width, entry.height)] * entry.views
    check_cameras(poses, Ks, sizes, [f"{source}: view {view}" for view in range(entry.views)])

    def pictures(kind: str) -> Sequence[DecodedPicture] | None:
        start, (shape, dtype) = getattr(entry, kind), kinds[kind]
        if start is None:
            return None
        length = dtype.itemsize * math.prod(shape)
        _read(shard, start, entry.views * length)  # checks the length of the shard
        return [
            _PackPicture(
                shard, start + view * length, shape, dtype, int(crc), f"{name}, {kind} {view}"
            )
            for view, crc in enumerate(sums[:, KINDS.index(kind)])
        ]

    return ObjectFiles(
        images=pictures("images") or [],
        camera_to_world=poses,
        Ks=Ks,
        sizes=sizes,
        depths=pictures("depths"),
        backs=pictures("backs"),
        depth_unit=entry.depth_unit,
        name=one_line(entry.name),
        attribution={one_line(k): one_line(v) for k, v in entry.attribution.items()},
        placement=read_placement(msgspec.structs.asdict(entry), name),
    )


@dataclass(eq=False)
class _PackPicture(DecodedPicture):
    """Picture in a shard, possibly a view of the memory map; checked when first read."""

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
            raise UserError(f"{self.shard}: {self.name}: damaged (its checksum differs)")
        self.checked = True
        values = np.frombuffer(data, self.dtype).reshape(self.shape)
        return values if len(self.shape) == 3 else values.astype(np.float32)


def _read(path: Path, start: int, count: int) -> memoryview:
    """Read ``count`` bytes of a shard from ``start``.

    Raises:
        UserError: the shard is missing or too short.
    """
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode):
            raise UserError(f"{path}: not a plain file")
        # Reading past the end of a mapped file that was truncated meanwhile would kill the process.
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
    """Memory map of a file; a rewritten file has another ``status``."""
    with path.open("rb") as file:
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
