"""Writer of packs (``gamba_warp/data/packs.py``): views of a dataset, decoded and resized once."""

from __future__ import annotations

import io
import itertools
import json
import tarfile
import zlib
from collections.abc import Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from gamba_warp.batch import EXPECTED, progress_bar
from gamba_warp.data import packs
from gamba_warp.data.dataset import ViewDataset, open_dataset, splits_of
from gamba_warp.errors import UserError, first_line
from gamba_warp.files import atomic_path, only_process, output_folder, write_text
from gamba_warp.untrusted.documents import MAX_BYTES
from gamba_warp.untrusted.names import parts_of

_ALIGNMENT = 64  # bytes; an object begins at a multiple
_AHEAD = 2  # objects decoded ahead, per thread
_METADATA = ("uid", "name", "split", "attribution", "depth_unit")  # of an object in a tar
SUFFIXES = {"arrays": "bin", "webdataset": "tar"}

# Object to write: its entry, and its arrays by their names in the index.
Block = tuple[packs.Entry, dict[str, np.ndarray]]


@dataclass(frozen=True)
class PackSettings:
    """Settings of a pack.

    Attributes:
        size: height of the pictures, pixels; None keeps that of the files.
        split: "all", "train", "val" or "test".
        shards: "arrays" or "webdataset".
        shard_bytes: a shard ends with the object that exceeds this size.
    """

    size: int | None = 128
    split: str = "all"
    shards: str = "arrays"
    shard_bytes: int = 256 << 20


@dataclass
class Packed:
    """Result of ``write_pack``.

    Attributes:
        written: number of newly packed objects.
        there: number of objects that were already in the pack.
        shards: number of all shards.
        failures: reasons by uid, of unreadable objects.
    """

    written: int
    there: int
    shards: int
    failures: dict[str, str]


def write_pack(
    data: Path, out: Path, settings: PackSettings, workers: int, limit: int | None = None
) -> Packed:
    """Pack a dataset, or continue a pack of it.

    If the command is killed or the disk is full, only complete shards remain.

    Args:
        data: the dataset.
        out: folder of the pack, created if missing.
        settings: settings of the pack.
        workers: number of decoding threads.
        limit: number of objects to pack, the first ones; None means all.

    Raises:
        UserError: the data cannot be opened, the folder holds something else or a pack with other
            settings, cannot be written, or its disk is full.
    """
    dataset = open_dataset(data, settings.split)
    splits = splits_of(data, dataset.uids)
    index = _open_index(out, settings)  # before the folder is made
    out = output_folder(out)
    with only_process(out, "packs"):
        index.size, index.split, index.shards = settings.size, settings.split, settings.shards
        index.split_version = dataset.split_version
        stored, index.objects = index.objects, []
        for values in stored:  # keep entries with a complete shard and valid cameras
            with suppress(UserError):
                packs.read_packed(out, values)
                index.objects.append(values)
        known = {values["uid"] for values in index.objects}
        wanted = dataset.uids[:limit]
        todo = [uid for uid in wanted if uid not in known]
        named = {values["shard"] for values in index.objects}
        for suffix in SUFFIXES.values():  # of a killed run, or damaged
            for path in out.glob(f"shard-*.{suffix}"):
                if path.name not in named:
                    path.unlink(missing_ok=True)
        failures: dict[str, str] = {}
        if todo or not index.finished:
            index.finished = False
            with closing(
                _blocks(dataset, todo, splits, settings.size, workers, failures)
            ) as blocks:
                _write_shards(out, index, blocks, settings)
            index.finished = True
            if index.objects:
                _write_index(out, index)
        if not index.objects:
            raise UserError(f"{data}: no object can be packed: {next(iter(failures.values()))}")
    shards = {values["shard"] for values in index.objects}
    there = len(wanted) - len(todo)
    return Packed(len(todo) - len(failures), there, len(shards), failures)


def _open_index(out: Path, settings: PackSettings) -> packs.Index:
    """Read the index of an existing pack, or make a new one; raise for any other folder."""
    if (out / packs.INDEX).exists():
        index = packs.read_index(out)
        old = {"--size": index.size, "--split": index.split, "--format": index.shards}
        for (name, value), new in zip(
            old.items(), (settings.size, settings.split, settings.shards)
        ):
            if value != new:
                raise UserError(f"{out}: holds a pack of {name} {value}, not {new}")
        return index
    names = sorted(path.name for path in out.iterdir()) if out.is_dir() else []
    if strange := [name for name in names if not name.startswith((".", "shard-"))]:
        raise UserError(f"{out}: holds other files ({strange[0]}); give an empty folder")
    return packs.Index(format=packs.FORMAT, version=packs.VERSION)


def _blocks(
    dataset: ViewDataset,
    uids: list[str],
    splits: dict[str, str],
    size: int | None,
    workers: int,
    failures: dict[str, str],
) -> Generator[Block, None, None]:
    """Yield the readable objects in order, decoded ahead on threads."""
    pool, waiting = ThreadPoolExecutor(workers), dict[str, Future[Block]]()
    try:
        for number, uid in enumerate(progress_bar(uids, desc="packing", unit="object")):
            for ahead in uids[number : number + 1 + _AHEAD * workers]:
                if ahead not in waiting:
                    waiting[ahead] = pool.submit(_block, dataset, ahead, splits[ahead], size)
            try:
                yield waiting.pop(uid).result()
            except EXPECTED as error:
                failures[uid] = first_line(error)
    finally:
        pool.shutdown(cancel_futures=True)


def _block(dataset: ViewDataset, uid: str, split: str, size: int | None) -> Block:
    """Decode one object."""
    parts_of(uid, f"the object {uid!r}")
    files = dataset.files(uid)
    images, Ks = dataset.pictures(uid, None, size)
    views, height, width = images.shape[:3]
    steps = dict(zip(packs.KINDS[1:], dataset.depth_steps(uid, width, height)))
    steps = {kind: values for kind, values in steps.items() if values is not None}
    whole = all((v == np.floor(v)).all() and v.max() < 1 << 16 for v in steps.values())
    dtype = np.dtype("<u2" if whole else "<f4")
    arrays = {"images": images, **{kind: values.astype(dtype) for kind, values in steps.items()}}
    sums = np.zeros((views, len(packs.KINDS)))
    for kind, array in arrays.items():
        sums[:, packs.KINDS.index(kind)] = [zlib.crc32(view) for view in array]
    poses = files.camera_to_world.reshape(views, -1)
    cameras = np.concatenate([poses, Ks.reshape(views, -1), sums], 1).astype("<f8")
    entry = packs.Entry(
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
    if files.placement is not None:
        entry.applied_transform = files.placement.transform.tolist()
        entry.applied_scale = files.placement.scale
    return entry, {"cameras": cameras, **arrays}


def _write_shards(
    out: Path, index: packs.Index, blocks: Iterator[Block], settings: PackSettings
) -> None:
    """Write all objects; the index names a shard as soon as it is complete."""
    names = (f"shard-{n:05d}.{SUFFIXES[settings.shards]}" for n in itertools.count())
    free = (out / name for name in names if not (out / name).exists())
    for first in blocks:
        path = next(free)
        taken = _take_bytes(itertools.chain([first], blocks), settings.shard_bytes)
        entries = _write_shard(path, taken, len(index.objects))
        index.objects += [msgspec.to_builtins(entry) for entry in entries]
        try:
            _write_index(out, index)
        except BaseException:
            path.unlink(missing_ok=True)  # nothing names it
            raise


def _take_bytes(blocks: Iterator[Block], limit: int) -> Iterator[Block]:
    """Yield the next blocks, up to the one that exceeds ``limit`` bytes."""
    size = 0
    for block in blocks:
        yield block
        size += sum(array.nbytes for array in block[1].values())
        if size >= limit:
            return


def _write_index(out: Path, index: packs.Index) -> None:
    text = msgspec.json.encode(index).decode()
    if len(text) > MAX_BYTES:
        raise UserError(
            f"{out}: the index would exceed {MAX_BYTES >> 20} MB, the limit of readers; make "
            "several packs of parts of the dataset, and train on them with --extra"
        )
    write_text(out / packs.INDEX, text + "\n")


def _write_shard(path: Path, blocks: Iterator[Block], number: int) -> list[packs.Entry]:
    """Write a shard: raw arrays one after the other, or a WebDataset.

    A WebDataset has ``NUMBER.json`` and a ``.npy`` per array of each object, from ``number`` on.
    """
    entries = []
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        tar = None
        if path.suffix == ".tar":
            tar = tarfile.open(fileobj=file, mode="w", format=tarfile.USTAR_FORMAT)

        def add(tar: tarfile.TarFile, name: str, content: bytes) -> None:
            member = tarfile.TarInfo(name)
            member.size, member.mode = len(content), 0o444
            tar.addfile(member, io.BytesIO(content))

        for key, (entry, arrays) in enumerate(blocks, number):
            starts = {}
            if tar is None:
                file.write(bytes(-file.tell() % _ALIGNMENT))
                for kind, array in arrays.items():
                    starts[kind] = file.tell()
                    file.write(np.ascontiguousarray(array).data)
            else:
                for kind, array in sorted(arrays.items()):
                    npy = io.BytesIO()
                    np.save(npy, np.ascontiguousarray(array))
                    # The array comes last, after the headers of tar and npy.
                    starts[kind] = file.tell() + tarfile.BLOCKSIZE + npy.tell() - array.nbytes
                    add(tar, f"{key:08d}.{kind}.npy", npy.getvalue())
                about = {name: getattr(entry, name) for name in _METADATA}
                add(tar, f"{key:08d}.json", json.dumps(about).encode())
            entries.append(msgspec.structs.replace(entry, shard=path.name, **starts))
        if tar is not None:
            tar.close()
    return entries
