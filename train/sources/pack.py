"""Writer of shards (``gamba_warp/data/shards.py``): the views of a dataset in a few tar files."""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import os
import re
import tarfile
import tempfile
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from PIL import Image

from gamba_warp.batch import EXPECTED, progress_bar
from gamba_warp.data import shards
from gamba_warp.data.dataset import SPLITS, ViewDataset, open_dataset, splits_of
from gamba_warp.data.layouts import DecodedPicture
from gamba_warp.data.shard_cache import ADDRESS, download
from gamba_warp.errors import UserError, first_line
from gamba_warp.files import atomic_path, only_process, output_folder, sha256, write_text
from gamba_warp.untrusted.documents import MAX_BYTES, parse_document, read_bytes
from gamba_warp.untrusted.names import parts_of
from gamba_warp.versions import require

_AHEAD = 2  # objects read ahead, per thread
_MOST = 1 << 30  # bytes of a picture's file


@dataclass(frozen=True)
class PackSettings:
    """Settings of shards.

    Attributes:
        size: height of the pictures, pixels; None keeps the bytes of the files.
        split: "all", "train", "val" or "test".
        shard_bytes: a tar ends with the object that exceeds this size.
    """

    size: int | None = None
    split: str = "all"
    shard_bytes: int = 1000 << 20


@dataclass
class Packed:
    """Result of ``write_pack``.

    Attributes:
        written: number of newly packed objects.
        there: number of objects that were already in the shards.
        shards: number of all tars.
        failures: reasons by uid, of unreadable objects.
    """

    written: int
    there: int
    shards: int
    failures: dict[str, str]


class Block(NamedTuple):
    """Object to write: its uid, its split, and the content of its files by their suffix."""

    uid: str
    split: str
    files: dict[str, bytes]


def write_pack(
    data: Path, out: Path, settings: PackSettings, workers: int, limit: int | None = None
) -> Packed:
    """Write the shards of a dataset, or continue them.

    Each tar has objects of one split only, in the order of the hash of their names, so that any of
    them is a fair sample. If the command is killed or the disk is full, complete tars remain.

    Args:
        data: the dataset.
        out: folder of the shards, created if missing.
        settings: settings of the shards.
        workers: number of reading threads.
        limit: number of objects to pack, the first ones; None means all.

    Raises:
        UserError: the data cannot be opened, the folder holds something else or shards with other
            settings, cannot be written, or its disk is full.
    """
    dataset = open_dataset(data, settings.split)
    splits = splits_of(data, dataset.uids)
    index = _open_index(out, settings)  # before the folder is made
    out = output_folder(out)
    with only_process(out, "packs"):
        index.size, index.split = settings.size, settings.split
        index.split_version = dataset.split_version
        index.shards = [shard for shard in index.shards if _complete(out, shard)]
        known = {uid for shard in index.shards for uid, _, _ in shard.objects}
        wanted = dataset.uids[:limit]
        todo = sorted((uid for uid in wanted if uid not in known), key=_order(splits))
        named = {shard.name for shard in index.shards}
        for path in out.glob("*-[0-9]*.tar"):  # of a killed run, or damaged
            if path.name not in named:
                path.unlink(missing_ok=True)
        failures: dict[str, str] = {}
        if todo or not index.finished:
            index.finished = False
            blocks = _blocks(dataset, todo, splits, settings.size, workers, failures)
            with closing(blocks):
                _write_shards(out, index, blocks, settings)
            index.finished = True
            if index.shards:
                _write_index(out, index)
        if not index.shards:
            raise UserError(f"{data}: no object can be packed: {next(iter(failures.values()))}")
    there = len(wanted) - len(todo)
    return Packed(len(todo) - len(failures), there, len(index.shards), failures)


def _order(splits: dict[str, str]):
    def key(uid: str) -> tuple[int, bytes]:
        digest = hashlib.sha256(uid.encode(errors="surrogatepass")).digest()
        return SPLITS.index(splits[uid]), digest

    return key


def _complete(out: Path, shard: shards.Shard) -> bool:
    try:
        return os.stat(out / shard.name).st_size == shard.bytes
    except OSError:
        return False


def _open_index(out: Path, settings: PackSettings) -> shards.Index:
    """Read the index of existing shards, or make a new one; raise for any other folder."""
    if (out / shards.INDEX).exists():
        index = shards.read_index(out)
        if index.address:
            raise UserError(f"{out}: its shards lie at {index.address}; give another folder")
        for name, old in {"size": index.size, "split": index.split}.items():
            if old != (new := getattr(settings, name)):
                raise UserError(f"{out}: holds shards of --{name} {old}, not {new}")
        return index
    names = sorted(path.name for path in out.iterdir()) if out.is_dir() else []
    if strange := [name for name in names if not name.startswith(".") and name[-4:] != ".tar"]:
        raise UserError(f"{out}: holds other files ({strange[0]}); give an empty folder")
    return shards.Index(format=shards.FORMAT, version=shards.VERSION)


def _blocks(
    dataset: ViewDataset,
    uids: list[str],
    splits: dict[str, str],
    size: int | None,
    workers: int,
    failures: dict[str, str],
) -> Generator[Block, None, None]:
    """Yield the readable objects in order, read ahead on threads."""
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
    """Read one object; each picture is decoded, so that none is damaged."""
    parts_of(uid, f"the object {uid!r}")
    found, frames, lenses = dataset.files(uid), list[dict[str, Any]](), list[dict[str, Any]]()
    files: dict[str, bytes] = {"": b""}  # the document comes first
    names = dict[Any, str]()  # of a picture that frames share

    def take(picture: Path | DecodedPicture, kind: str) -> str:
        if picture not in names:
            names[picture] = f"{len(frames):03d}{kind}{Path(str(picture)).suffix.lower()}"
            files[names[picture]] = _content(picture)
        return names[picture]

    for view, pose in enumerate(found.camera_to_world):
        (pixels,), (K,) = dataset.pictures(uid, [view], size)
        frame: dict[str, Any] = {"transform_matrix": pose.tolist()}
        if size is None:
            frame["file_path"] = take(found.images[view], "")
        else:
            frame["file_path"] = f"{view:03d}.webp"
            files[frame["file_path"]] = _encoded(Image.fromarray(pixels))
        more: dict[str, Sequence | None] = {"depth": found.depths, "back": found.backs}
        more = {f"{kind}_file": paths for kind, paths in more.items()}
        more |= {"mask": found.masks if size is None else None}
        for kind, paths in more.items():
            if paths is not None:
                frame[f"{kind}_path"] = take(paths[view], f".{kind.removesuffix('_file')}")
        frames.append(frame)
        lens = {"w": pixels.shape[1], "h": pixels.shape[0], "fl_x": K[0, 0], "fl_y": K[1, 1]}
        lenses.append(lens | {"cx": K[0, 2], "cy": K[1, 2]})
    height, width = lenses[0]["h"], lenses[0]["w"]
    for view in range(len(frames)):
        dataset.depth_steps(uid, width, height, [view])
    top: dict[str, Any] = {"uid": uid, "name": found.name, "attribution": found.attribution}
    top["depth_unit"] = float(found.depth_unit)
    if found.placement is not None:
        top["applied_transform"] = found.placement.transform.tolist()
        top["applied_scale"] = found.placement.scale
    if all(lens == lenses[0] for lens in lenses):
        top |= lenses[0]
    else:
        frames = [frame | lens for frame, lens in zip(frames, lenses)]
    files[""] = json.dumps({**top, "frames": frames}).encode()
    return Block(uid, split, {name or shards.DOCUMENT: content for name, content in files.items()})


def _content(picture: Path | DecodedPicture) -> bytes:
    if isinstance(picture, Path):
        return read_bytes(picture, _MOST)
    assert isinstance(picture, shards.ShardPicture)
    return picture.content()


def _encoded(picture: Image.Image) -> bytes:
    content = io.BytesIO()
    picture.save(content, "WEBP", lossless=True, exact=True)
    return content.getvalue()


def _write_shards(
    out: Path, index: shards.Index, blocks: Iterator[Block], settings: PackSettings
) -> None:
    """Write all objects; the index names a tar as soon as it is complete."""
    for split, members in itertools.groupby(blocks, lambda block: block.split):
        names = (f"{split}-{number:05d}.tar" for number in itertools.count())
        free = (out / name for name in names if not (out / name).exists())
        for first in members:
            path = next(free)
            rest = itertools.chain([first], members)  # noqa: B031
            taken = _take_bytes(rest, settings.shard_bytes)
            index.shards.append(_write_shard(path, split, taken))
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
        size += sum(map(len, block.files.values()))
        if size >= limit:
            return


def _write_index(out: Path, index: shards.Index) -> None:
    text = msgspec.json.encode(index).decode()
    if len(text) > MAX_BYTES:
        raise UserError(
            f"{out}: the index would exceed {MAX_BYTES >> 20} MB, the limit of readers; pack "
            "several parts of the dataset, and train on them with --extra"
        )
    write_text(out / shards.INDEX, text + "\n")


def _write_shard(path: Path, split: str, blocks: Iterator[Block]) -> shards.Shard:
    """Write a tar."""
    objects = []
    with atomic_path(path) as temporary:
        with tarfile.open(temporary, "w", format=tarfile.GNU_FORMAT) as tar:
            for block in blocks:
                start, key = tar.offset, shards.key_of(block.uid)
                for suffix, content in block.files.items():
                    member = tarfile.TarInfo(f"{key}.{suffix}")
                    member.size, member.mode = len(content), 0o444
                    tar.addfile(member, io.BytesIO(content))
                objects.append((block.uid, start, tar.offset - start))
        size, digest = os.stat(temporary).st_size, sha256(temporary)
    about = {"name": path.name, "bytes": size, "sha256": digest, "objects": objects}
    return shards.Shard(split=split, **about)  # pyright: ignore[reportArgumentType]: one of three


def take_index(address: str, out: Path, cache_bytes: int) -> shards.Index:
    """Write the index of shards on a server; their tars are fetched when they are used.

    Args:
        address: address of their folder: http(s)://, s3:// or gs://.
        out: folder for the index and the cache; made, or of the same kind.
        cache_bytes: largest size of all tars in the cache.

    Raises:
        UserError: the address is none, its index cannot be fetched or is invalid or unfinished, or
            the folder has other files.
    """
    if not re.fullmatch(ADDRESS, address):
        raise UserError(f"{address[:200]}: expected http(s)://, s3:// or gs://, in plain letters")
    if (out / shards.INDEX).exists():
        if not shards.read_index(out).address:
            raise UserError(f"{out}: holds shards of its own; give another folder")
    elif out.is_dir() and (names := [p.name for p in out.iterdir() if p.name[0] != "."]):
        raise UserError(f"{out}: holds other files ({min(names)}); give an empty folder")
    require("webdataset")
    address = address.rstrip("/")
    url = f"{address}/{shards.INDEX}"
    with tempfile.TemporaryDirectory() as folder:
        download(url, Path(folder) / shards.INDEX, MAX_BYTES)
        content = read_bytes(Path(folder) / shards.INDEX)
    index = shards.checked_index(parse_document(content, shards.Index, url), url)
    if not index.finished or not index.shards:
        raise UserError(f"{url}: unfinished shards")
    index.address, index.cache_bytes = address, cache_bytes
    _write_index(output_folder(out), index)
    return index
