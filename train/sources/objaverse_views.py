"""Makes a dataset of a local copy of G-Objaverse: chosen objects, linked, copied or unpacked.

The set is published as ``dictionary_id/instance_id/campos_512_v4/NNNNN/NNNNN.png`` and seven more
files a view; as a tar of each object, ``dictionary_id/instance_id.tar``; and by a script without
the folder ``campos_512_v4``. Training needs only a view's picture and camera.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Sequence
from pathlib import Path

from gamba_warp.batch import progress_bar
from gamba_warp.data.dataset import open_dataset
from gamba_warp.data.layouts import GOBJAVERSE
from gamba_warp.errors import UserError
from gamba_warp.files import atomic_folder
from gamba_warp.untrusted.archives import open_tar
from gamba_warp.untrusted.documents import read_bytes
from gamba_warp.untrusted.names import inside

VIEWS = 40  # of an object: two orbits, top and bottom
_NUMBER = re.compile(r"[0-9]{1,12}")
_MEMBER = re.compile(r"(?:[^/]+/){0,3}?([0-9]{5})/\1(\.png|\.json)")
_MAX_SIZES = {".png": 64 << 20, ".json": 1 << 20}  # bytes; pictures have 0.2 MB


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
) -> tuple[int, dict[str, str]]:
    """Add missing objects to a dataset.

    Args:
        objects: the local copy, by name.
        names: names of the objects to add.
        out: the dataset.
        least: complete views that an object must have.
        copy: copy the files of folders instead of linking the folder.

    Returns:
        The number of new objects, and failures by name.

    Raises:
        UserError: the system cannot create links.
    """
    failures: dict[str, str] = {}
    wanted = [name for name in names if not (out / name / GOBJAVERSE).exists()]
    for name in progress_bar(wanted, unit="object"):
        try:
            _take(objects[name], out / name, least, copy)
        except UserError as error:
            failures[name] = str(error)
    return len(wanted) - len(failures), failures


def _take(path: Path, target: Path, least: int, copy: bool) -> None:
    if not (path.is_dir() or path.is_file()):
        raise UserError(f"{path}: is neither a folder nor a file")
    # A broken link is replaced; anything else stays.
    names = {p.name for p in target.iterdir()} if target.is_dir() else set()
    broken = (target / GOBJAVERSE).is_symlink() and names <= {GOBJAVERSE}
    with atomic_folder(target, replace=broken) as part:
        made, views = part / GOBJAVERSE, _views_of(path)
        if path.is_file():
            _unpack(path, made)
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
        _check(part, path, least)


def _views_of(path: Path) -> Path:
    """Return the folder of an object's views."""
    return path / GOBJAVERSE if (path / GOBJAVERSE).is_dir() else path


def _unpack(path: Path, target: Path) -> None:
    """Unpack the pictures and cameras of a tar, up to ``_MAX_SIZES``."""
    target.mkdir()
    with path.open("rb") as file, open_tar(file, path, target.parent) as members:
        for member in members:
            match = _MEMBER.fullmatch(member.name.removeprefix("./"))
            if not match:
                continue
            if member.size > (most := _MAX_SIZES[match[2]]):
                raise UserError(f"{path}: {member.name!r} is over {most >> 20} MB")
            unpacked = target / match[1] / f"{match[1]}{match[2]}"
            if unpacked.exists():
                raise UserError(f"{path}: {member.name!r} occurs twice")
            unpacked.parent.mkdir(exist_ok=True)
            with unpacked.open("xb") as out:
                shutil.copyfileobj(member.file, out)


def _check(folder: Path, path: Path, least: int) -> None:
    """Read an object's cameras; raise if they are unreadable or too few views are complete."""
    try:
        files = open_dataset(folder, layout="gobjaverse").files(0)
    except UserError as error:
        reason = str(error).replace(f"{folder}{os.sep}", "").replace(str(folder), "it")
        raise UserError(f"{path}: {reason}") from error
    if len(files.images) < least:
        count = len(files.images)
        raise UserError(f"{path}: has {count} complete views, --min-views is {least}")
