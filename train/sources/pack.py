"""Writer of shards (``train/data/shards.py``): the views of a dataset in a few tar files."""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

from PIL import Image

from gamba_warp.batch import EXPECTED, progress_bar
from gamba_warp.data.dataset import SPLITS, ViewDataset, open_dataset, splits_of
from gamba_warp.errors import UserError, first_line
from gamba_warp.files import atomic_folder, output_folder, write_json
from gamba_warp.untrusted.documents import read_bytes

from ..data.shards import INDEX

_OWN = re.compile(r"(train|val|test)-\d+\.tar|shards-(train|val|test)\.json")


def write_pack(
    data: Path, out: Path, size: int | None = None, shard_mb: float = 1000, workers: int = 1
) -> tuple[Counter[str], dict[str, str]]:
    """Write the shards of a dataset, ordered by the hash of the names.

    Args:
        data: the dataset.
        out: folder of the shards; older ones are replaced.
        size: height of the images, pixels; None keeps the bytes of the files.
        shard_mb: a tar ends with the object that exceeds this size.
        workers: number of reading threads.

    Returns:
        Numbers of objects by tar, and the reasons by uid of those that cannot be read.

    Raises:
        UserError: the data cannot be opened, no object can be read, or the folder has files or
            cannot be written.
        ModuleNotFoundError: ``webdataset`` is not installed.
    """
    from webdataset.writer import ShardWriter

    dataset = open_dataset(data)
    output_folder(out.absolute().parent)
    if out.exists() and any(not _OWN.fullmatch(name) for name in os.listdir(output_folder(out))):
        raise UserError(f"{out}: holds other files; give another folder")
    splits = splits_of(data, dataset.uids)
    by_hash = sorted(dataset.uids, key=lambda uid: hashlib.sha256(uid.encode()).digest())
    counts, failures = Counter[str](), dict[str, str]()
    options = {"maxsize": shard_mb * 2**20, "encoder": False, "verbose": 0, "mtime": 0}
    with (
        atomic_folder(out, replace=True) as folder,
        progress_bar(total=len(by_hash), desc="packing", unit="object") as bar,
    ):
        for split in SPLITS:
            if not (uids := [uid for uid in by_hash if splits[uid] == split]):
                continue
            pattern = str(folder / f"{split}-%05d.tar")
            with ThreadPoolExecutor(workers) as pool, ShardWriter(pattern, **options) as writer:
                for start in range(0, len(uids), 2 * workers):  # few are in memory at a time
                    part = uids[start : start + 2 * workers]
                    for uid, sample in zip(part, pool.map(partial(_sample, dataset, size), part)):
                        bar.update(1)
                        if isinstance(sample, str):
                            failures[uid] = sample
                        else:
                            writer.write(sample)
                            counts[Path(str(writer.fname)).name] += 1
            if shards := [{"url": n, "nsamples": counts[n]} for n in counts if n.startswith(split)]:
                write_json(folder / INDEX.format(split), {"shardlist": shards})
        if not counts:
            raise UserError(f"{data}: no object can be packed: {next(iter(failures.values()))}")
    return counts, failures


def _sample(dataset: ViewDataset, size: int | None, uid: str) -> dict[str, Any] | str:
    """Read one object, or return why it is unreadable; each image is decoded, to check it."""
    sample: dict[str, Any] = {"__key__": quote(uid, safe="/").replace(".", "%2E")}
    try:
        files, frames = dataset.files(uid), list[dict[str, Any]]()
        for view, pose in enumerate(files.camera_to_world):
            (pixels,), (K,) = dataset.images(uid, [view], size)
            intrinsics = dict(
                zip(("fl_x", "fl_y", "cx", "cy"), K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist())
            )
            frame = intrinsics | {"w": pixels.shape[1], "h": pixels.shape[0]}
            kinds = {"depth_file": files.depths, "back_file": files.backs}
            if size is None:
                kinds |= {"file": files.images, "mask": files.masks}
            else:
                stream, frame["file_path"] = io.BytesIO(), f"{view:03d}.webp"
                Image.fromarray(pixels).save(stream, "WEBP", lossless=True, exact=True)
                sample[frame["file_path"]] = stream.getvalue()
            for kind, paths in kinds.items():
                if paths is not None:
                    path = Path(str(paths[view]))  # a folder's images are files
                    part = f"{view:03d}.{kind.removesuffix('_file')}".removesuffix(".file")
                    name = part + path.suffix.lower()
                    frame[f"{kind}_path"], sample[name] = name, read_bytes(path, 1 << 30)
            frames.append(frame | {"transform_matrix": pose.tolist()})
    except EXPECTED as error:
        return first_line(error)
    top = {"name": files.name, "attribution": files.attribution, "frames": frames}
    return sample | {"json": json.dumps(top | {"depth_unit": files.depth_unit}).encode()}
