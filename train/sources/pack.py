"""Writes packs (``gamba_warp/data/packs.py``): the views of a dataset, decoded and resized once."""

from __future__ import annotations

import io
import itertools
import json
import tarfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import msgspec
import numpy as np

from gamba_warp.batch import EXPECTED, progress_bar
from gamba_warp.data.dataset import ViewDataset, open_dataset, splits_of
from gamba_warp.data.packs import (
    FORMAT,
    INDEX,
    KINDS,
    VERSION,
    Entry,
    Index,
    packed_objects,
    read_index,
)
from gamba_warp.data.prefetch import Prefetcher
from gamba_warp.errors import UserError, first_line
from gamba_warp.files import atomic_path, only_process, output_folder, write_text
from gamba_warp.untrusted.documents import MAX_BYTES
from gamba_warp.untrusted.names import parts_of

_ALIGNED = 64  # bytes; an object begins at a multiple
_AHEAD = 2  # objects decoded ahead, by thread
_ABOUT = ("uid", "name", "split", "attribution", "depth_unit")  # what a tar says of an object
SUFFIXES = {"arrays": "bin", "webdataset": "tar"}


@dataclass(frozen=True)
class PackSettings:
    """What a pack is to hold.

    Attributes:
        size: height of the pictures, pixels; None keeps that of the files.
        split: "all", "train", "val" or "test".
        shards: "arrays" or "webdataset".
        shard_bytes: a shard ends with the object that passes this size.
    """

    size: int | None = 128
    split: str = "all"
    shards: str = "arrays"
    shard_bytes: int = 256 << 20


@dataclass
class _Block:
    """One object as it is written: its arrays by their names in the index, and its entry."""

    entry: Entry
    arrays: dict[str, np.ndarray]

    @property
    def size(self) -> int:
        return sum(array.nbytes for array in self.arrays.values())


@dataclass
class Packed:
    """What ``write_pack`` did.

    Attributes:
        written: number of the objects that were packed now.
        there: number of those that were in the pack already.
        shards: number of all shards.
        failures: reasons by uid, of the objects that could not be read.
    """

    written: int
    there: int
    shards: int
    failures: dict[str, str]


def write_pack(
    data: Path, out: Path, settings: PackSettings, workers: int, limit: int | None = None
) -> Packed:
    """Packs a dataset, or goes on with a pack of it that was begun.

    Whole shards stay where the command is killed or the disk is full; nothing else does.

    Args:
        data: the dataset.
        out: folder of the pack, which is made where it is not there.
        settings: see there.
        workers: number of threads that decode.
        limit: number of the objects that are packed, the first ones; None: all.

    Raises:
        UserError: the data cannot be opened, the folder holds something else or a pack of other
            settings, cannot be written, or its disk is full.
    """
    dataset = open_dataset(data, settings.split)
    if dataset.layout == "pack":  # whose splits stand in its index
        splits = {values["uid"]: str(values.get("split")) for values in read_index(data).objects}
    else:
        splits = splits_of(data, dataset.uids)
    before = _begun(out, settings)  # before the folder is made
    out = output_folder(out)
    with only_process(out, "packs"):
        index = before or Index(format=FORMAT, version=VERSION)
        index.size, index.split, index.shards = settings.size, settings.split, settings.shards
        index.split_version = dataset.split_version
        index.objects = _whole(out, index)
        known = {values["uid"] for values in index.objects}
        wanted = dataset.uids[:limit]
        todo = [uid for uid in wanted if uid not in known]
        named = {values["shard"] for values in index.objects}
        for suffix in SUFFIXES.values():  # of a run that was killed, or all damaged
            for path in out.glob(f"shard-*.{suffix}"):
                if path.name not in named:
                    path.unlink(missing_ok=True)
        failures: dict[str, str] = {}
        blocks = _blocks(dataset, todo, splits, settings, workers, failures)
        if todo or not index.finished:
            index.finished = False
            _write_shards(out, index, blocks, settings)
            index.finished = True
            if index.objects:
                _write_index(out, index)
        if not index.objects:
            raise UserError(f"{data}: no object can be packed: {next(iter(failures.values()))}")
    shards = {values["shard"] for values in index.objects}
    there = len(wanted) - len(todo)
    return Packed(len(todo) - len(failures), there, len(shards), failures)


def _begun(out: Path, settings: PackSettings) -> Index | None:
    """The index of a pack that is there already; a folder of anything else is refused."""
    if (out / INDEX).exists():
        index = read_index(out)
        old = {"--size": index.size, "--split": index.split, "--format": index.shards}
        new = dict(zip(old, (settings.size, settings.split, settings.shards)))
        for name, value in old.items():
            if value != new[name]:
                raise UserError(f"{out}: holds a pack of {name} {value}, not {new[name]}")
        return index
    if out.is_dir():
        strange = [p.name for p in sorted(out.iterdir()) if not p.name.startswith(".")]
        strange = [name for name in strange if not name.startswith("shard-")]
        if strange:
            raise UserError(f"{out}: holds other files ({strange[0]}); give an empty folder")
    return None


def _whole(out: Path, index: Index) -> list[dict]:
    """Those objects of an index whose shard is there and long enough, with sound cameras."""
    good = []
    by_uid = {values["uid"]: values for values in index.objects if "uid" in values}
    for packed in packed_objects(out, index):
        try:
            packed.files()
        except UserError:
            continue
        good.append(by_uid[packed.uid])
    return good


def _blocks(
    dataset: ViewDataset,
    uids: list[str],
    splits: dict[str, str],
    settings: PackSettings,
    workers: int,
    failures: dict[str, str],
) -> Iterator[_Block]:
    """Yields the objects that can be read, in their order, decoded ahead on threads."""
    threads: Prefetcher[_Block, _Block] = Prefetcher(workers)
    try:
        for number, uid in enumerate(progress_bar(uids, desc="packing", unit="object")):
            for ahead in uids[number : number + 1 + _AHEAD * workers]:
                if ahead not in threads:
                    part = partial(_block, dataset, ahead, splits[ahead], settings.size)
                    threads.submit(ahead, [part], lambda made: made[0])
            try:
                yield threads.take(uid)
            except EXPECTED as error:
                failures[uid] = first_line(error)
    finally:
        threads.close()


def _block(dataset: ViewDataset, uid: str, split: str, size: int | None) -> _Block:
    """Decodes one object."""
    parts_of(uid, f"the object {uid!r}")
    files = dataset.files(uid)
    images, Ks = dataset.pictures(uid, None, size)
    views, height, width = images.shape[:3]
    steps = dict(zip(KINDS[1:], dataset.depth_steps(uid, width, height)))
    steps = {kind: values for kind, values in steps.items() if values is not None}
    whole = all((v == np.floor(v)).all() and v.max() < 1 << 16 for v in steps.values())
    dtype = np.dtype("<u2" if whole else "<f4")
    arrays = {"images": images, **{kind: values.astype(dtype) for kind, values in steps.items()}}
    sums = np.zeros((views, len(KINDS)))
    for kind, array in arrays.items():
        sums[:, KINDS.index(kind)] = [zlib.crc32(view) for view in array]
    poses = files.camera_to_world.reshape(views, -1)
    cameras = np.concatenate([poses, Ks.reshape(views, -1), sums], 1).astype("<f8")
    entry = Entry(
        uid=uid,
        split=split,  # pyright: ignore[reportArgumentType]: one of three, as it comes
        shard="",
        views=views,
        width=width,
        height=height,
        crc=zlib.crc32(cameras.tobytes()),
        cameras=0,
        images=0,
        depth_type="uint16" if whole else "float32",
        depth_unit=float(files.depth_unit),
        name=files.name,
        attribution=files.attribution,
    )
    return _Block(entry, {"cameras": cameras, **arrays})


def _write_shards(
    out: Path, index: Index, blocks: Iterator[_Block], settings: PackSettings
) -> None:
    """Writes all objects; the index names a shard as soon as it is whole."""
    write = _write_tar if settings.shards == "webdataset" else _write_arrays
    suffix = SUFFIXES[settings.shards]
    free = (n for n in itertools.count() if not (out / _name(n, suffix)).exists())
    try:
        for first in blocks:
            path = out / _name(next(free), suffix)
            taken = _until(itertools.chain([first], blocks), settings.shard_bytes)
            entries = write(path, taken, len(index.objects))
            index.objects += [msgspec.to_builtins(entry) for entry in entries]
            try:
                _write_index(out, index)
            except BaseException:
                path.unlink(missing_ok=True)  # nothing names it
                raise
    finally:
        blocks.close()  # pyright: ignore[reportAttributeAccessIssue]: a generator's, ends the threads


def _name(number: int, suffix: str) -> str:
    return f"shard-{number:05d}.{suffix}"


def _until(blocks: Iterator[_Block], limit: int) -> Iterator[_Block]:
    """The next blocks, up to the one with which they pass ``limit`` bytes."""
    size = 0
    for block in blocks:
        yield block
        size += block.size
        if size >= limit:
            return


def _write_index(out: Path, index: Index) -> None:
    text = msgspec.json.encode(index).decode()
    if len(text) > MAX_BYTES:
        raise UserError(
            f"{out}: the index would be over {MAX_BYTES >> 20} MB, which is not read; make several "
            "packs of parts of the dataset, and train on them with --extra"
        )
    write_text(out / INDEX, text + "\n")


def _write_arrays(path: Path, blocks: Iterator[_Block], number: int) -> list[Entry]:
    """Writes a shard of bare arrays, one after the other."""
    entries = []
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        for block in blocks:
            file.write(bytes(-file.tell() % _ALIGNED))
            starts = {}
            for kind, array in block.arrays.items():
                starts[kind] = file.tell()
                file.write(np.ascontiguousarray(array).data)
            entries.append(msgspec.structs.replace(block.entry, shard=path.name, **starts))
    return entries


def _write_tar(path: Path, blocks: Iterator[_Block], number: int) -> list[Entry]:
    """Writes a shard as a WebDataset: of each object ``NUMBER.json`` and a ``.npy`` an array."""
    entries = []
    with (
        atomic_path(path) as temporary,
        open(temporary, "wb") as file,
        tarfile.open(fileobj=file, mode="w", format=tarfile.USTAR_FORMAT) as tar,
    ):

        def add(name: str, content: bytes) -> None:
            member = tarfile.TarInfo(name)
            member.size, member.mode = len(content), 0o444
            tar.addfile(member, io.BytesIO(content))

        for key, block in zip((f"{number + n:08d}" for n in itertools.count()), blocks):
            starts = {}
            for kind, array in sorted(block.arrays.items()):
                npy = io.BytesIO()
                np.save(npy, np.ascontiguousarray(array))
                # The array is the last part of what follows the header.
                starts[kind] = file.tell() + tarfile.BLOCKSIZE + npy.tell() - array.nbytes
                add(f"{key}.{kind}.npy", npy.getvalue())
            about = {name: getattr(block.entry, name) for name in _ABOUT}
            add(f"{key}.json", json.dumps(about).encode())
            entries.append(msgspec.structs.replace(block.entry, shard=path.name, **starts))
    return entries
