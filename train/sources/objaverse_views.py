"""Makes a dataset of a local copy of G-Objaverse: chosen objects, linked, copied or unpacked.

The set is published as ``dictionary_id/instance_id/campos_512_v4/NNNNN/NNNNN.png`` and seven more
files a view; as a tar of each object, ``dictionary_id/instance_id.tar``; and by a script without
the folder ``campos_512_v4``. Training needs only a view's picture and camera, and for depth its
``_nd.exr`` (normal and depth). The package OpenEXR, a native library, reads the latter in a child
process, which may crash.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from PIL import Image

from gamba_warp.batch import progress_bar
from gamba_warp.data.dataset import open_dataset
from gamba_warp.data.layouts import GOBJAVERSE, GOBJAVERSE_DEPTH, GOBJAVERSE_DEPTH_UNIT, ObjectFiles
from gamba_warp.errors import UserError
from gamba_warp.files import PART, atomic_folder
from gamba_warp.images import MAX_PIXELS
from gamba_warp.untrusted.archives import open_tar
from gamba_warp.untrusted.children import Failed, run_each
from gamba_warp.untrusted.documents import read_bytes
from gamba_warp.untrusted.names import inside

VIEWS = 40  # of an object: two orbits, top and bottom
_NUMBER = re.compile(r"[0-9]{1,12}")
_MEMBER = re.compile(r"(?:[^/]+/){0,3}?([0-9]{5})/\1(\.png|\.json|_nd\.exr)")
_MAX_SIZES = {".png": 64 << 20, ".json": 1 << 20}  # bytes; pictures have 0.2 MB


SUFFIX = "_nd.exr"
MAX_DEPTH_SIZE = 64 << 20  # bytes of a file; published ones have 2 to 4 MB
# Half the diagonal of the unit cube around the object: nearer or farther depths are not surfaces,
# according to the set's own example.
_RADIUS = 3**0.5 / 2
_SECONDS, _MEMORY = 600.0, 4 << 30  # limits for an object's 40 files, which take 2 s and 0.7 GB


def find_rendered(source: Path) -> dict[str, Path]:
    """Find the objects of a local copy, by name; a folder is preferred to a tar.

    Args:
        source: folder of the set, or its parent if the set is in ``savedata/``.

    Raises:
        UserError: the folder does not exist or has no objects.
    """
    if not source.is_dir():
        raise UserError(f"--source {source}: no such folder")
    entries = [
        (f"{group.name}/{path.name.removesuffix('.tar')}", path)
        for top in (source, source / "savedata")
        for group in (sorted(top.iterdir()) if top.is_dir() else ())
        if _NUMBER.fullmatch(group.name) and group.is_dir()
        for path in group.iterdir()
        if _NUMBER.fullmatch(path.name.removesuffix(".tar"))
        and path.is_dir() is not path.name.endswith(".tar")
    ]
    found = dict(sorted(entries, key=lambda entry: entry[1].is_dir()))  # folders last, so they win
    if not found:
        raise UserError(
            f"--source {source}: contains no objects of G-Objaverse (0/10010, 0/10010.tar)"
        )
    return found


def take_views(
    objects: dict[str, Path],
    names: Sequence[str],
    out: Path,
    least: int,
    copy: bool,
    depth: bool = False,
) -> tuple[int, dict[str, str]]:
    """Add missing objects to a dataset.

    Args:
        objects: the local copy, by name.
        names: names of the objects to add.
        out: the dataset.
        least: complete views that an object must have.
        copy: copy the files of folders instead of linking the folder.
        depth: also make depth pictures, even for existing objects that lack them.

    Returns:
        The number of new objects, and failures by name.

    Raises:
        UserError: the system cannot create links.
    """
    failures: dict[str, str] = {}
    parts = (GOBJAVERSE, GOBJAVERSE_DEPTH) if depth else (GOBJAVERSE,)
    wanted = [name for name in names if not all((out / name / part).exists() for part in parts)]
    for name in progress_bar(wanted, unit="object"):
        try:
            _take(objects[name], out / name, least, copy, depth)
        except UserError as error:
            failures[name] = str(error)
    return len(wanted) - len(failures), failures


def _take(path: Path, target: Path, least: int, copy: bool, depth: bool) -> None:
    if not (path.is_dir() or path.is_file()):
        raise UserError(f"{path}: is neither a folder nor a file")
    if (target / GOBJAVERSE).exists():  # only depth is missing
        files = _checked(target, path, least)
        with atomic_folder(target / GOBJAVERSE_DEPTH) as part:
            _add_depth(files, part, path)
        return
    # A broken link is replaced; anything else stays.
    names = {p.name for p in target.iterdir()} if target.is_dir() else set()
    broken = (target / GOBJAVERSE).is_symlink() and names <= {GOBJAVERSE, GOBJAVERSE_DEPTH}
    with atomic_folder(target, replace=broken) as part:
        made, views = part / GOBJAVERSE, _views_of(path)
        if path.is_file():
            _unpack(path, made, _MAX_SIZES)
        elif copy:
            for view in sorted(p for p in views.iterdir() if re.fullmatch("[0-9]{5}", p.name)):
                for suffix, most in _MAX_SIZES.items():
                    file = inside(views, f"{view.name}/{view.name}{suffix}", str(views))
                    if file.is_file():
                        (made / view.name).mkdir(parents=True, exist_ok=True)
                        (made / view.name / file.name).write_bytes(read_bytes(file, most))
        else:
            try:
                made.symlink_to(views.resolve(), target_is_directory=True)
            except OSError as error:
                reason = error.strerror or error
                raise UserError(f"{made.name}: cannot be linked ({reason}); give --copy") from error
        files = _checked(part, path, least)
        if depth:
            (part / GOBJAVERSE_DEPTH).mkdir()
            _add_depth(files, part / GOBJAVERSE_DEPTH, path)


def _views_of(path: Path) -> Path:
    """Return the folder of an object's views."""
    return path / GOBJAVERSE if (path / GOBJAVERSE).is_dir() else path


def _unpack(path: Path, target: Path, most: Mapping[str, int]) -> None:
    """Unpack the view files of a tar whose suffixes are in ``most``, up to these sizes, bytes."""
    target.mkdir()
    with path.open("rb") as file, open_tar(file, path, target.parent) as members:
        for member in members:
            match = _MEMBER.fullmatch(member.name.removeprefix("./"))
            if not match or match[2] not in most:
                continue
            if member.size > most[match[2]]:
                raise UserError(f"{path}: {member.name!r} is over {most[match[2]] >> 20} MB")
            unpacked = target / match[1] / f"{match[1]}{match[2]}"
            if unpacked.exists():
                raise UserError(f"{path}: {member.name!r} occurs twice")
            unpacked.parent.mkdir(exist_ok=True)
            with unpacked.open("xb") as out:
                shutil.copyfileobj(member.file, out)


def _checked(folder: Path, path: Path, least: int) -> ObjectFiles:
    """Read an object's cameras; raise if they are unreadable or too few views are complete."""
    try:
        files = open_dataset(folder, layout="gobjaverse").files(0)
    except UserError as error:
        reason = str(error).replace(f"{folder}{os.sep}", "").replace(str(folder), "it")
        raise UserError(f"{path}: {reason}") from error
    if len(files.images) < least:
        count = len(files.images)
        raise UserError(f"{path}: has {count} complete views, --min-views is {least}")
    return files


def _add_depth(files: ObjectFiles, target: Path, path: Path) -> None:
    """Convert an object's depth files to depth pictures in ``target``."""
    with tempfile.TemporaryDirectory(dir=target, prefix=PART) as scratch:
        raw = _views_of(path)
        if path.is_file():
            raw = Path(scratch) / "views"
            _unpack(path, raw, {SUFFIX: MAX_DEPTH_SIZE})
        distances = np.linalg.norm(files.camera_to_world[:, :3, 3], axis=1).tolist()
        wanted = []
        for image, distance in zip(files.images, distances):
            source = inside(raw, f"{image.stem}/{image.stem}{SUFFIX}", str(path))
            if not source.is_file():
                raise UserError(f"{path}: {source.name}: no such file")
            if source.stat().st_size > MAX_DEPTH_SIZE:
                raise UserError(f"{path}: {source.name}: over {MAX_DEPTH_SIZE >> 20} MB")
            wanted.append((source, target / f"{image.stem}.png", distance))
        for _, result in run_each(_convert, [wanted], seconds=_SECONDS, memory=_MEMORY):
            if isinstance(result, Failed):
                raise UserError(f"{path}: {SUFFIX.lstrip('_')} files: {result.reason}")


def check_package() -> None:
    """Raise UserError if the package OpenEXR is not installed."""
    if find_spec("OpenEXR") is None:
        raise UserError("--depth: needs the package OpenEXR: pip install OpenEXR")


def _convert(files: Sequence[tuple[Path, Path, float]]) -> None:
    """Convert depth files to pictures in a child process, with the cameras' distances."""
    import OpenEXR  # pyright: ignore[reportMissingImports]: optional

    for source, target, distance in files:
        try:
            header = OpenEXR.File(str(source), separate_channels=True, header_only=True).header()
            low, high = (np.asarray(corner, dtype=np.int64) for corner in header["dataWindow"])
            if not 0 < int(np.prod(high - low + 1)) <= MAX_PIXELS:
                reason = f"has more than {MAX_PIXELS >> 20} megapixels, or none"
                raise UserError(f"{source.name}: {reason}")
            channels = OpenEXR.File(str(source), separate_channels=True).channels()
            depth = np.asarray(channels["A"].pixels, dtype=np.float32)
        except UserError:
            raise
        except KeyError as error:
            raise UserError(f"{source.name}: has no fourth channel, the depth") from error
        except Exception as error:  # the library's own types
            raise UserError(f"{source.name}: cannot be read ({error})") from error
        Image.fromarray(depth_steps(depth, distance)).save(target)


def depth_steps(depth: np.ndarray, distance: float) -> np.ndarray:
    """Convert depth along the optical axis to 16-bit steps of ``GOBJAVERSE_DEPTH_UNIT``.

    Args:
        depth: ``[H, W]`` float32, object units; non-finite or outside the unit cube's radius
            without a surface.
        distance: of the camera from the object's centre, object units.

    Returns:
        ``[H, W]`` uint16; 0 without a surface.
    """
    with np.errstate(invalid="ignore"):
        there = np.isfinite(depth) & (np.abs(depth - distance) <= _RADIUS)
    steps = np.rint(np.where(there, depth, 0) / GOBJAVERSE_DEPTH_UNIT)
    return np.clip(steps, 0, 65535).astype(np.uint16)
