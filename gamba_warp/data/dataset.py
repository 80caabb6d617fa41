"""Posed views on disk; ``open_dataset`` finds the objects, ``ViewDataset.load`` decodes views.

Layouts are described in ``layouts.py``. ``split.json`` in the root names the uids of ``train``,
``val`` and ``test``; where a uid is in none, ``split_of`` decides by the hash of its name.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from ..cameras import Cameras, from_opengl
from ..errors import UserError
from ..files import write_json
from ..images import check_size, load_rgba8, open_picture
from ..untrusted.documents import read_document
from .layouts import LAYOUTS, ObjectFiles, find_objects

SPLITS = ("train", "val", "test")
SPLIT_VERSION = 2  # of what is written; 1 had fewer objects in one group
MAX_LOADED = 128 << 20  # pixels of all views of an object that are loaded together: 2 GB


@dataclass
class ObjectViews:
    """V views of one object.

    Attributes:
        uid: the object's name within its dataset.
        name: name for people.
        images: ``[V, H, W, 4]`` float32 RGBA in [0, 1], colour not premultiplied.
        cameras: V cameras, float32, in object units (the object's bounding cube has side 1).
        depths: ``[V, H, W]`` float32 along the optical axis, 0 for the background; or None. Of the
            first views only, where ``load`` was asked for no more.
        backs: as ``depths``, of the last surface behind a pixel; or None.
        attribution: creator, licence, source; may be empty.
    """

    uid: str
    name: str
    images: Tensor
    cameras: Cameras
    depths: Tensor | None
    attribution: dict[str, str]
    backs: Tensor | None = None


def split_of(key: str) -> str:
    """Returns the split (train 80 %, val 10 %, test 10 %) by the hash of a uid or of its group."""
    digest = hashlib.sha256(key.encode(errors="surrogatepass")).digest()
    part = int.from_bytes(digest[:8], "big") % 100
    return "train" if part < 80 else "val" if part < 90 else "test"


def write_split(folder: str | Path, groups: Mapping[str, str]) -> None:
    """Writes ``split.json`` into the dataset's root, atomically.

    Args:
        folder: root of the dataset.
        groups: group by uid. All versions of one thing share a group, so that none is in the test
            split while its twin is in train. An object on its own has its uid as group.
    """
    parts: dict[str, list[str]] = {name: [] for name in SPLITS}
    for uid in sorted(groups):
        parts[split_of(groups[uid])].append(uid)
    write_json(Path(folder) / "split.json", {"version": SPLIT_VERSION, **parts})


class _Split(msgspec.Struct):
    """What ``split.json`` holds: the uids of each part; those that are not there do no harm."""

    version: int | None = None
    train: list[str | int] = []
    val: list[str | int] = []
    test: list[str | int] = []


def _read_split(root: Path) -> tuple[int, dict[str, str]]:
    """The version of ``split.json``, and what it states of each uid; without the file nothing."""
    path = root / "split.json"
    if not path.exists():
        return SPLIT_VERSION, {}
    parts = read_document(path, _Split)
    if parts.version not in (1, SPLIT_VERSION):
        raise UserError(f"{path}: version {parts.version!r}, expected 1 or {SPLIT_VERSION}")
    chosen: dict[str, str] = {}
    for name in SPLITS:
        for uid in getattr(parts, name):
            if chosen.setdefault(str(uid), name) != name:
                raise UserError(f"{path}: {uid} is in both {chosen[uid]} and {name}")
    return parts.version, chosen


def open_dataset(
    folder: str | Path, split: str = "all", layout: str = "auto", cache: bool = False
) -> ViewDataset:
    """Finds the objects under a folder, without decoding anything yet.

    Args:
        folder: a dataset, or the folder of a single object.
        split: "all", "train", "val" or "test".
        layout: "auto", "transforms", "gobjaverse" or "openlrm".
        cache: whether decoded views are kept in memory, with 8 bits a channel.

    Raises:
        UserError: the folder does not exist, holds no objects or none of the split, or its
            ``split.json`` is bad.
    """
    root = Path(folder)
    if split not in ("all", *SPLITS):
        raise UserError(f"split '{split}': expected all, train, val or test")
    if layout not in ("auto", *LAYOUTS):
        raise UserError(f"layout '{layout}': expected auto, {', '.join(LAYOUTS)}")
    if not root.is_dir():
        raise UserError(f"{root}: no such folder")
    layout, folders = find_objects(root, layout)
    if not folders:
        marks = ", ".join(mark for mark, _ in LAYOUTS.values())
        raise UserError(f"{root}: no objects found (none of {marks} in any folder)")
    if folders == [root]:
        objects = {root.resolve().name: root}
    else:
        objects = {folder.relative_to(root).as_posix(): folder for folder in folders}
    version = SPLIT_VERSION
    if split != "all":
        version, stated = _read_split(root)
        objects = {u: f for u, f in objects.items() if stated.get(u, split_of(u)) == split}
        if not objects:
            raise UserError(f"{root}: none of its {len(folders)} objects is in the {split} split")
    return ViewDataset(objects, layout, cache, version)


class ViewDataset:
    """Objects with posed views, made by ``open_dataset``; it may be sent to worker processes.

    Attributes:
        uids: names of the objects, which are their paths under the root, sorted.
        layout: layout of the folders.
        split_version: version of the rule, or of the file, that made the split.
    """

    def __init__(
        self,
        objects: dict[str, Path],
        layout: str,
        cache: bool,
        split_version: int = SPLIT_VERSION,
    ) -> None:
        self.uids = list(objects)
        self.layout = layout
        self.split_version = split_version
        self._folders = objects
        self._layouts = dict.fromkeys(objects, layout)
        self._files: dict[str, ObjectFiles] = {}
        # A path and a size give the picture, and the (width, height) of the file.
        self._pictures: dict[tuple, tuple[np.ndarray, tuple[int, int]]] | None
        self._pictures = {} if cache else None

    def __len__(self) -> int:
        return len(self.uids)

    def joined(self, name: str, other: ViewDataset) -> ViewDataset:
        """Returns a set with the objects of both; those of ``other`` come last, as ``name/uid``.

        Raises:
            UserError: an object has such a name already.
        """
        renamed = {uid: f"{name}/{uid}" for uid in other.uids}
        if twice := sorted(set(renamed.values()) & set(self.uids)):
            raise UserError(f"two objects are called '{twice[0]}'; rename a dataset's folder")
        folders = {renamed[uid]: folder for uid, folder in other._folders.items()}
        cache = self._pictures is not None
        made = ViewDataset(self._folders | folders, self.layout, cache, self.split_version)
        made._layouts = self._layouts | {renamed[u]: lay for u, lay in other._layouts.items()}
        return made

    def _uid(self, index: int | str) -> str:
        if isinstance(index, str):
            if index not in self._folders:
                raise UserError(f"no object '{index}' among the {len(self)} of this dataset")
            return index
        return self.uids[index]

    def files(self, index: int | str) -> ObjectFiles:
        """Returns paths, poses and intrinsics of one object, which are read once.

        Raises:
            UserError: the object's camera files are missing or bad; the message names the file.
        """
        uid = self._uid(index)
        if uid not in self._files:
            try:
                self._files[uid] = LAYOUTS[self._layouts[uid]][1](self._folders[uid])
            except OSError as error:  # of a folder; the readers name the file otherwise
                place = error.filename or self._folders[uid]
                raise UserError(f"{place}: {error.strerror or error}") from error
        return self._files[uid]

    def num_views(self, index: int | str) -> int:
        """Returns V, the number of views of one object; the errors are those of ``files``."""
        return len(self.files(index).images)

    def check(self) -> dict[str, str]:
        """Returns reasons by uid, for objects with bad cameras or missing pictures."""
        bad = {}
        for uid in self.uids:
            try:
                files = self.files(uid)
                for path in files.images + (files.depths or []) + (files.backs or []):
                    if not os.path.exists(path):  # never raises, whatever the name
                        raise UserError(f"{path}: no such file")
            except UserError as error:
                bad[uid] = str(error)
        return bad

    def load(
        self,
        index: int | str,
        views: Sequence[int] | None = None,
        size: int | None = None,
        depths: int | None = None,
    ) -> ObjectViews:
        """Decodes views of one object.

        Args:
            index: position in ``uids``, or a uid.
            views: numbers of the views, in this order; None means all. Only their files are opened.
            size: height of the returned pictures, whose width follows; None keeps the files' size.
                Colour is premultiplied and area-filtered, so that no background bleeds in; depth
                takes the nearest sample.
            depths: of how many of these views, the first ones, the depth pictures are read, where
                there are any; None means of all.

        Raises:
            UserError: a file is missing, broken, or not of the size that the cameras state.
        """
        uid = self._uid(index)
        files = self.files(uid)
        wanted = list(range(len(files.images))) if views is None else [int(v) for v in views]
        if not wanted:
            raise UserError(f"{uid}: no views asked for")
        outside = [v for v in wanted if not 0 <= v < len(files.images)]
        if outside:
            raise UserError(f"{uid}: view {outside[0]} asked for, it has {len(files.images)}")
        if size is not None and size < 1:
            raise UserError(f"size {size}: must be at least 1")
        images: Tensor | None = None
        Ks = np.empty((len(wanted), 3, 3))
        for number, v in enumerate(wanted):
            picture, Ks[number] = self._view(files, v, size)
            height, width = picture.shape[:2]
            if images is None:
                _check_room(len(wanted), width, height, uid)
                images = torch.empty(len(wanted), height, width, 4)
            if picture.shape != images.shape[1:]:
                got, others = f"{width}x{height}", f"{images.shape[2]}x{images.shape[1]}"
                raise UserError(f"{files.images[v]}: is {got}, the object's others {others}")
            np.divide(picture, np.float32(255), out=images[number].numpy())
        assert images is not None  # there is at least one view
        height, width = images.shape[1:3]
        first = wanted[:depths]
        viewmats = from_opengl(torch.from_numpy(files.camera_to_world[wanted])).float()
        return ObjectViews(
            uid=uid,
            name=files.name or uid,
            images=images,
            cameras=Cameras(viewmats, torch.from_numpy(Ks).float(), width, height),
            depths=_read_depths(files.depths, first, width, height, files.depth_unit),
            attribution=files.attribution,
            backs=_read_depths(files.backs, first, width, height, files.depth_unit),
        )

    def _view(
        self, files: ObjectFiles, view: int, size: int | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Loads RGBA ``[H, W, 4]`` uint8 and K ``[3, 3]`` of one view at the size asked for."""
        path = files.images[view]
        key = (path, size)
        if self._pictures is not None and key in self._pictures:
            picture, original = self._pictures[key]
        else:
            picture = load_rgba8(path)
            original = (picture.shape[1], picture.shape[0])
            stated = files.sizes[view]
            if stated is not None and stated != original:
                got, want = (f"{w}x{h}" for w, h in (original, stated))
                raise UserError(f"{path}: is {got}, but its cameras are for {want}")
            picture = _resize(picture, size, path)
            if self._pictures is not None:
                self._pictures[key] = (picture, original)
        from_size = (1.0, 1.0) if files.sizes[view] is None else original
        factor = [picture.shape[1] / from_size[0], picture.shape[0] / from_size[1], 1.0]
        return picture, files.Ks[view] * np.array(factor)[:, None]


def _check_room(count: int, width: int, height: int, uid: str) -> None:
    """Refuses views that together have more pixels than are kept in memory at once."""
    if count * width * height > MAX_LOADED:
        raise UserError(
            f"{uid}: {count} views of {width}x{height} are over {MAX_LOADED >> 20} megapixels; "
            "ask for smaller pictures"
        )


def _resize(picture: np.ndarray, size: int | None, path: Path) -> np.ndarray:
    height, width = picture.shape[:2]
    if size is None or size == height:
        return picture
    new = (max(1, round(width * size / height)), size)
    check_size(*new, f"{path}: at height {size}")
    # PIL premultiplies RGBA by itself, and its box filter is the exact area average.
    kind = Image.Resampling.BOX if size < height else Image.Resampling.BILINEAR
    return np.asarray(Image.fromarray(picture).resize(new, kind))


def _read_depths(
    paths: list[Path] | None, views: Sequence[int], width: int, height: int, unit: float
) -> Tensor | None:
    """Reads depth ``[V, height, width]`` of some views, object units; None where there is none."""
    if paths is None or not views:
        return None
    steps = np.stack([_read_depth(paths[v], width, height) for v in views])
    return torch.from_numpy(steps * np.float32(unit))


def _read_depth(path: Path, width: int, height: int) -> np.ndarray:
    """Reads depth ``[height, width]`` float32, in the steps of the file."""
    with open_picture(path) as image:
        if len(image.getbands()) != 1:
            raise UserError(f"{path}: has {len(image.getbands())} channels, depth has one")
        if image.size != (width, height):
            image = image.resize((width, height), Image.Resampling.NEAREST)
        values = np.asarray(image, dtype=np.float32)
    if not np.isfinite(values).all() or values.min() < 0:
        raise UserError(f"{path}: a depth is negative or not finite")
    return values
