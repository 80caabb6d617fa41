"""Posed views on disk; ``open_dataset`` finds the objects, ``ViewDataset.load`` decodes views.

Layouts are described in ``layouts.py``, lists of checked objects in ``manifest.py``. ``split.json``
in the root lists the uids of ``train``, ``val`` and ``test``; ``split_of`` places other uids by the
hash of the name.
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from ..batch import EXPECTED, progress_bar
from ..cameras import Cameras, from_opengl
from ..errors import UserError, first_line
from ..files import write_json
from ..images import check_size, load_rgba8, open_image
from ..untrusted.documents import read_document
from .layouts import (
    GOBJAVERSE,
    LAYOUTS,
    NERF,
    TRANSFORMS,
    MemoryImage,
    ObjectFiles,
    find_objects,
    one_line,
)
from .manifest import MANIFEST, Entry, Manifest, list_of, marks_of, read_manifest, write_manifest

SPLITS = ("train", "val", "test")
SPLIT_VERSION = 2  # of written files; version 1 had fewer objects in one group
Item = TypeVar("Item")
Reader = Callable[[str], ObjectFiles]  # reads the files of an object, by its uid
KEPT = 1024  # objects whose files are kept: 30 kB each with 40 views
MAX_LOADED = 128 << 20  # pixels of all loaded views of an object: 2 GB


@dataclass
class ObjectViews:
    """V views of one object.

    Attributes:
        uid: the object's name within its dataset.
        name: readable name.
        images: ``[V, H, W, 4]`` float32 RGBA in [0, 1], colour not premultiplied.
        cameras: V cameras, float32, in object units (the object's bounding cube has side 1).
        depths: ``[V, H, W]`` float32 along the optical axis, 0 for the background; or None. Fewer
            than V, of the first views, if ``load`` was called so.
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


def evenly(items: Sequence[Item], count: int) -> list[Item]:
    """Choose ``count`` items, evenly spaced from the first on; all of them if there are fewer."""
    count = min(count, len(items))
    return [items[k * len(items) // count] for k in range(count)]


def split_of(key: str) -> str:
    """Return the split (train 80 %, val 10 %, test 10 %) by the hash of a uid or of its group."""
    digest = hashlib.sha256(key.encode(errors="surrogatepass")).digest()
    part = int.from_bytes(digest[:8], "big") % 100
    return "train" if part < 80 else "val" if part < 90 else "test"


def write_split(folder: str | Path, groups: Mapping[str, str]) -> None:
    """Write ``split.json`` into the dataset's root, atomically.

    Args:
        folder: root of the dataset.
        groups: group by uid. All versions of one thing share a group, so that they are in the same
            split. The group of a single object is its uid.
    """
    parts: dict[str, list[str]] = {name: [] for name in SPLITS}
    for uid in sorted(groups):
        parts[split_of(groups[uid])].append(uid)
    write_json(Path(folder) / "split.json", {"version": SPLIT_VERSION, **parts})


class _Split(msgspec.Struct):
    """Content of ``split.json``: the uids of each part; unknown ones are ignored."""

    version: int | None = None
    train: list[str | int] = []
    val: list[str | int] = []
    test: list[str | int] = []


def _read_split(root: Path) -> tuple[int, dict[str, str]]:
    """Read the version and the split by uid of ``split.json``; empty without the file."""
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


def splits_of(folder: str | Path, uids: Iterable[str]) -> dict[str, str]:
    """Return the split of each object, by ``split.json``, else by hash.

    Raises:
        UserError: that file is invalid.
    """
    _, stated = _read_split(Path(folder))
    return {uid: stated.get(uid) or split_of(uid) for uid in uids}


def open_dataset(folder: str | Path, split: str = "all", cache: bool = False) -> ViewDataset:
    """Find the objects under a folder, without decoding anything yet.

    Args:
        folder: a dataset, or the folder of a single object.
        split: "all", "train", "val" or "test".
        cache: keep decoded views in memory, with 8 bits a channel.

    Raises:
        UserError: the folder does not exist, has no objects or none of the split, or its
            ``split.json`` is invalid.
    """
    root = Path(folder)
    if split not in ("all", *SPLITS):
        raise UserError(f"split '{split}': expected all, train, val or test")
    if not root.is_dir():
        raise UserError(f"{root}: no such folder")
    manifest = None
    if (root / MANIFEST).exists():
        manifest = read_manifest(root)
        layout, uids = manifest.layout, list(manifest.digests)
    else:
        layout, folders, _ = find_objects(root)
        if not folders:
            if any(root.glob("shards-*.json")):
                raise UserError(f"{root}: shards, which only gamba train reads")
            marks = ", ".join(mark for mark, _ in LAYOUTS.values())
            raise UserError(f"{root}: no objects found (none of {marks} in any folder)")
        uids = [folder.relative_to(root).as_posix() for folder in folders]
    count, read = len(uids), partial(_read_folder, root, layout)
    if uids == ["."]:  # the root is an object
        uids, read = [root.resolve().name], partial(_read_root, root, layout)
    version = SPLIT_VERSION
    if split != "all":
        version, stated = _read_split(root)
        uids = [uid for uid in uids if stated.get(uid, split_of(uid)) == split]
        if not uids:
            raise UserError(f"{root}: none of its {count} objects is in the {split} split")
    return ViewDataset(dict.fromkeys(uids, read), layout, cache, version, manifest=manifest)


def _read_folder(root: Path, layout: str, uid: str) -> ObjectFiles:
    return LAYOUTS[layout][1](root / uid)


def _read_root(root: Path, layout: str, uid: str) -> ObjectFiles:
    return LAYOUTS[layout][1](root)


def _read_renamed(read: Reader, prefix: int, uid: str) -> ObjectFiles:
    """Read an object of a joined dataset, after removing ``prefix`` letters of its name."""
    return read(uid[prefix:])


def index_dataset(folder: str | Path) -> tuple[Path, int, dict[str, str]]:
    """Check every object of a dataset, and write its manifest (``manifest.py``).

    Args:
        folder: the dataset; an older manifest is replaced.

    Returns:
        The file, the number of objects, and the reasons by uid of those that cannot be read.

    Raises:
        UserError: the folder is one object, has no objects, or cannot be written.
    """
    root = Path(folder)
    if not root.is_dir():
        raise UserError(f"{root}: no such folder")
    layout, folders, others = find_objects(root)
    if not folders or folders == [root]:
        raise UserError(f"{root}: {'is one object' if folders else 'no objects found'}")
    lists = {p.relative_to(root).as_posix().removeprefix("."): list_of(str(p)) for p in others}
    bad: dict[str, str] = {}

    def entries() -> Iterator[Entry]:
        named = progress_bar(folders, lines=True, delay=2.0, desc="checking", unit="object")
        for path in named:
            uid = path.relative_to(root).as_posix()
            # Before the objects are read: a change during the reading outdates the manifest.
            names = _CAMERA_FILES.get(layout, LAYOUTS[layout][:1])
            marks, digest = marks_of(path, (*names, ".")), "0" * 16
            files = None
            try:
                files = _read_folder(root, layout, uid)
                _check_images(files)
                digest = content_digest(files)
            except (UserError, OSError) as error:
                bad[uid] = one_line(first_line(error))
            if files is not None and layout == "transforms" and isinstance(files.images[0], Path):
                images = files.images[0].parent.relative_to(path).as_posix()
                marks = [*marks, *marks_of(path, [images])] if images != "." else marks
            yield Entry(uid, digest, bad.get(uid, ""), marks)

    return write_manifest(root, layout, lists, entries(), len(folders)), len(folders), bad


# In an object's folder: files and folders whose size and time a manifest compares.
_CAMERA_FILES = {
    "transforms": TRANSFORMS,
    "nerf": NERF,
    "gobjaverse": (GOBJAVERSE,),
    "openlrm": ("intrinsics.npy", "rgba", "pose"),
}


def content_digest(files: ObjectFiles) -> str:
    """Return 16 hexadecimal digits of an object's cameras and kinds of images."""
    kinds = f"{len(files.images)} {files.depths is None} {files.backs is None}"
    digest = hashlib.sha256(kinds.encode())
    for matrices in (files.camera_to_world, files.Ks):
        digest.update(matrices.tobytes())
    return digest.hexdigest()[:16]


def _check_images(files: ObjectFiles) -> None:
    """Raise UserError if an image is missing; folders with many images are listed once."""
    kinds = filter(None, (files.images, files.masks, files.depths, files.backs))
    paths = [path for path in chain.from_iterable(kinds) if isinstance(path, Path)]
    parents = Counter(path.parent for path in paths)
    plain: dict[Path, set[str]] = {}
    for parent in (parent for parent, number in parents.items() if number > 2):
        with suppress(OSError), os.scandir(parent) as entries:
            plain[parent] = {entry.name for entry in entries if not entry.is_symlink()}
    for path in paths:
        if path.name not in plain.get(path.parent, ()) and not os.path.exists(path):  # never raises
            raise UserError(f"{path}: no such file")


class ViewDataset:
    """Objects with posed views, made by ``open_dataset``; picklable for worker processes.

    Attributes:
        uids: names of the objects, their paths under the root, sorted.
        layout: layout of the folders, or "shards".
        split_version: version of the rule or of the file that defines the split.
    """

    def __init__(
        self,
        readers: Mapping[str, Reader],
        layout: str,
        cache: bool,
        split_version: int = SPLIT_VERSION,
        manifest: Manifest | None = None,
    ) -> None:
        """Make a dataset of the reader of each uid; ``cache`` as for ``open_dataset``."""
        self.uids = list(readers)
        self.layout, self.split_version = layout, split_version
        self._readers = dict(readers)
        # Of objects that were checked before; by uid.
        self._digests: dict[str, str] = {} if manifest is None else manifest.digests
        self._bad: dict[str, str] = {} if manifest is None else manifest.bad
        self._files: dict[str, ObjectFiles] = {}  # the last ones used
        # By path and size: the image, and the (width, height) of the file.
        self._images: dict[tuple, tuple[np.ndarray, tuple[int, int]]] | None
        self._images = {} if cache else None

    def __len__(self) -> int:
        return len(self.uids)

    def joined(self, name: str, other: ViewDataset) -> ViewDataset:
        """Return a dataset with the objects of both; ``other``'s come last, as ``name/uid``.

        Raises:
            UserError: such a name already exists.
        """
        renamed = {
            id(read): partial(_read_renamed, read, len(name) + 1)
            for read in other._readers.values()
        }
        added = {f"{name}/{uid}": renamed[id(read)] for uid, read in other._readers.items()}
        if twice := sorted(added.keys() & self._readers.keys()):
            raise UserError(f"two objects are called '{twice[0]}'; rename a dataset's folder")
        cache = self._images is not None
        both = ViewDataset(self._readers | added, self.layout, cache, self.split_version)
        both._digests = self._digests | {f"{name}/{k}": x for k, x in other._digests.items()}
        both._bad = self._bad | {f"{name}/{k}": reason for k, reason in other._bad.items()}
        return both

    def files(self, index: int | str) -> ObjectFiles:
        """Return paths, poses and intrinsics of one object.

        The last ``KEPT`` objects are kept.

        Raises:
            UserError: the object's camera files are missing or invalid; the message names the file.
        """
        uid = self._uid(index)
        files = self._files.get(uid)
        if files is None:
            try:
                files = self._readers[uid](uid)
            except OSError as error:  # of a folder; for files the readers raise UserError
                raise UserError(f"{error.filename or uid}: {error.strerror or error}") from error
            with suppress(RuntimeError, StopIteration):  # other threads change it, too
                while len(self._files) >= KEPT:
                    self._files.pop(next(iter(self._files)), None)
            self._files[uid] = files
        return files

    def digest(self, index: int | str) -> str:
        """Return 16 hexadecimal digits of the cameras of an object; raises as ``files``."""
        uid = self._uid(index)
        return self._digests.get(uid) or content_digest(self.files(uid))

    def _uid(self, index: int | str) -> str:
        if not isinstance(index, str):
            return self.uids[index]
        if index not in self._readers:
            raise UserError(f"no object '{index}' among the {len(self)} of this dataset")
        return index

    def num_views(self, index: int | str) -> int:
        """Return V, the number of views of one object; raises as ``files``."""
        return len(self.files(index).images)

    def check(self) -> dict[str, str]:
        """Return reasons by uid, for objects with invalid cameras or missing images.

        Objects of a manifest were checked before; the others are read, with a progress bar.
        """
        bad = {uid: self._bad[uid] for uid in self.uids if uid in self._bad}
        unknown = [uid for uid in self.uids if uid not in self._digests]
        for uid in progress_bar(unknown, lines=True, delay=2.0, desc="checking", unit="object"):
            try:
                _check_images(self.files(uid))
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
        """Decode views of one object.

        Args:
            index: position in ``uids``, or a uid.
            views: numbers of the views, in this order; None means all. Only their files are opened.
            size: height of the returned images; the width follows. None keeps the files' size.
                Colour is premultiplied and area-filtered, so that no background bleeds in; depth
                takes the nearest sample.
            depths: number of these views, from the first, whose depth images are read, if there
                are any; None means all.

        Raises:
            UserError: a file is missing, damaged, or not of the size stated by the cameras.
        """
        uid = self._uid(index)
        files, wanted = self.files(uid), self._wanted(uid, views, size)
        pixels, Ks = self.images(uid, wanted, size)
        images = torch.from_numpy(np.divide(pixels, np.float32(255), dtype=np.float32))
        height, width = images.shape[1:3]
        unit = np.float32(files.depth_unit)
        near, far = (
            None if steps is None else torch.from_numpy(steps * unit)
            for steps in self.depth_steps(uid, width, height, wanted[:depths])
        )
        viewmats = from_opengl(torch.from_numpy(files.camera_to_world[wanted])).float()
        return ObjectViews(
            uid=uid,
            name=files.name or uid,
            images=images,
            cameras=Cameras(viewmats, torch.from_numpy(Ks).float(), width, height),
            depths=near,
            attribution=files.attribution,
            backs=far,
        )

    def _wanted(self, uid: str, views: Sequence[int] | None, size: int | None) -> list[int]:
        """Return the numbers of the requested views; raise for an empty or invalid list."""
        count = self.num_views(uid)
        wanted = list(range(count)) if views is None else [int(v) for v in views]
        if not wanted:
            raise UserError(f"{uid}: no views requested")
        if outside := [v for v in wanted if not 0 <= v < count]:
            raise UserError(f"{uid}: view {outside[0]} requested, it has {count}")
        if size is not None and size < 1:
            raise UserError(f"size {size}: must be at least 1")
        return wanted

    def images(
        self, index: int | str, views: Sequence[int] | None = None, size: int | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Decode views of one object to 8 bits.

        Args:
            index: as for ``load``.
            views: as for ``load``.
            size: as for ``load``.

        Returns:
            RGBA ``[V, H, W, 4]`` uint8, colour not premultiplied, and K ``[V, 3, 3]`` float64 in
            pixels of that size.

        Raises:
            UserError: as ``load``.
        """
        uid = self._uid(index)
        files, wanted = self.files(uid), self._wanted(uid, views, size)
        pixels: np.ndarray | None = None
        Ks = np.empty((len(wanted), 3, 3))
        for number, v in enumerate(wanted):
            image, Ks[number] = self._view(files, v, size)
            height, width = image.shape[:2]
            if pixels is None:
                if len(wanted) * width * height > MAX_LOADED:
                    raise UserError(
                        f"{uid}: {len(wanted)} views of {width}x{height} are over "
                        f"{MAX_LOADED >> 20} megapixels; ask for smaller images"
                    )
                pixels = np.empty((len(wanted), height, width, 4), np.uint8)
            if image.shape != pixels.shape[1:]:
                got, others = f"{width}x{height}", f"{pixels.shape[2]}x{pixels.shape[1]}"
                raise UserError(f"{files.images[v]}: is {got}, the object's others are {others}")
            pixels[number] = image
        assert pixels is not None  # there is at least one view
        return pixels, Ks

    def depth_steps(
        self, index: int | str, width: int, height: int, views: Sequence[int] | None = None
    ) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Read depth images of an object, of its first and of its last surfaces.

        Args:
            index: as for ``load``.
            width: width of the images, pixels.
            height: height of the images, pixels.
            views: numbers of the views; None means all.

        Returns:
            Each ``[V, height, width]`` float32 in steps of ``files(index).depth_unit``, or None.

        Raises:
            UserError: as ``load``.
        """
        files = self.files(index)
        chosen = range(len(files.images)) if views is None else views
        near, far = (
            np.stack([_read_depth(paths[v], width, height) for v in chosen])
            if paths and chosen
            else None
            for paths in (files.depths, files.backs)
        )
        return near, far

    def _view(
        self, files: ObjectFiles, view: int, size: int | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Load RGBA ``[H, W, 4]`` uint8 and K ``[3, 3]`` of one view at the requested size."""
        path, stated = files.images[view], files.sizes[view]
        loaded = self._images.get((path, size)) if self._images is not None else None
        if loaded is None:
            image = _read_rgba8(path)
            height, width = image.shape[:2]
            if stated not in (None, (width, height)):
                wanted = f"{stated[0]}x{stated[1]}"
                raise UserError(f"{path}: is {width}x{height}, but its cameras are for {wanted}")
            if files.masks is not None:
                image = _masked(image, files.masks[view])
            if size not in (None, height):
                new = (max(1, round(width * size / height)), size)
                check_size(*new, f"{path}: at height {size}")
                # PIL premultiplies RGBA itself, and its box filter is the exact area average, so no
                # background bleeds in.
                kind = Image.Resampling.BOX if size < height else Image.Resampling.BILINEAR
                image = np.asarray(Image.fromarray(image).resize(new, kind))
            loaded = image, (width, height)
            if self._images is not None:
                self._images[path, size] = loaded
        image, original = loaded
        from_size = (1.0, 1.0) if stated is None else original
        factor = [image.shape[1] / from_size[0], image.shape[0] / from_size[1], 1.0]
        return image, files.Ks[view] * np.array(factor)[:, None]


def _read_rgba8(path: Path | MemoryImage) -> np.ndarray:
    return path.read() if isinstance(path, MemoryImage) else load_rgba8(path)


def _masked(image: np.ndarray, path: Path | MemoryImage) -> np.ndarray:
    """Multiply the alpha of RGBA ``[H, W, 4]`` uint8 with a grey image of the same size.

    A mask of zeros and ones counts as black and white, as in nerfstudio.
    """
    mask = _read_rgba8(path)
    if mask.shape != image.shape:
        got, wanted = (f"{x.shape[1]}x{x.shape[0]}" for x in (mask, image))
        raise UserError(f"{path}: the mask is {got}, its image {wanted}")
    if (mask[..., :2] != mask[..., 1:3]).any() or (mask[..., 3] != 255).any():
        raise UserError(f"{path}: a mask must be grey and opaque, white on the object")
    weight = mask[..., 0].astype(np.uint16)
    if weight.max() == 1:
        weight *= 255
    alpha = (image[..., 3] * weight + 127) // 255
    return np.dstack([image[..., :3], alpha.astype(np.uint8)])


def background_note(dataset: ViewDataset) -> str | None:
    """Warning if the images of a dataset have no transparent background, else None.

    Checks the first view of up to eight objects, skipping unreadable ones.
    """
    checked = False
    for uid in evenly(dataset.uids, 8):
        with suppress(*EXPECTED):
            pixels, _ = dataset.images(uid, [0])
            if (pixels[..., 3] < 255).any():
                return None
            checked = True
    if not checked:
        return None
    return "no image has an alpha channel or a mask: the background counts as part of the object"


def camera_note(dataset: ViewDataset) -> str | None:
    """Warning if most cameras of a dataset do not face the origin, else None.

    Checks up to eight objects, skipping unreadable ones. The warning names a convention by which
    the cameras would face it.
    """
    per_object = []
    for uid in evenly(dataset.uids, 8):
        with suppress(*EXPECTED):
            per_object.append(dataset.files(uid).camera_to_world)
    poses = np.concatenate([np.zeros((0, 4, 4)), *per_object])
    facing = _facing(poses)
    if not len(poses) or facing >= 0.5:
        return None
    flip, inverse = np.diag([1.0, -1.0, -1.0, 1.0]), np.linalg.inv(poses)
    others = {
        "in OpenCV's axes": poses @ flip,
        "world to camera": inverse,
        "world to camera in OpenCV's axes": inverse @ flip,
    }
    name = max(others, key=lambda name: _facing(others[name]))
    hint = f"; they would if read as {name}" if _facing(others[name]) >= 0.9 else ""
    return (
        f"{1 - facing:.0%} of the cameras do not face the origin, where the object is expected"
        f"{hint}: poses are camera to world, x right, y up, z back"
    )


def _facing(camera_to_world: np.ndarray) -> float:
    """Fraction of the cameras whose axis is within 60 degrees of the origin's direction."""
    axes, places = camera_to_world[:, :3, 2], camera_to_world[:, :3, 3]
    ahead = (axes * places).sum(-1)
    return float((ahead >= 0.5 * np.linalg.norm(places, axis=-1)).sum() / max(1, len(places)))


def _read_depth(path: Path | MemoryImage, width: int, height: int) -> np.ndarray:
    """Read depth ``[height, width]`` float32 in steps of the file, by nearest samples."""
    with path.open() if isinstance(path, MemoryImage) else open_image(path) as image:
        if len(image.getbands()) != 1:
            raise UserError(f"{path}: has {len(image.getbands())} channels, depth has one")
        if image.size != (width, height):
            image = image.resize((width, height), Image.Resampling.NEAREST)
        values = np.asarray(image, dtype=np.float32)
    if not np.isfinite(values).all() or values.min() < 0:
        raise UserError(f"{path}: a depth is negative or not finite")
    return values
