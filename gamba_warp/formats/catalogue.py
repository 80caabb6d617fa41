"""The meshes of a folder, with what its ``catalogue.json`` says of them."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from ..errors import UserError
from ..untrusted.documents import read_document
from ..untrusted.names import MAX_NAME, parts_of, plain_name
from .meshes import SUFFIXES

CATALOGUE = "catalogue.json"  # beside the meshes: names and attribution, see ``find_meshes``


@dataclass(frozen=True)
class Mesh:
    """One object to render.

    Attributes:
        path: its file.
        uid: its folder in the dataset.
        name: what it is called.
        group: name of the objects that belong on one side of a split.
        attribution: who made it, and under which licence.
        rotation: ``[3, 3]``, turns the file's points upright first, or None.
    """

    path: Path
    uid: str
    name: str
    group: str
    attribution: dict[str, str]
    rotation: list[list[float]] | None = None


def find_meshes(folder: Path) -> list[Mesh]:
    """All mesh files under a folder, sorted by uid.

    ``catalogue.json`` in the folder, if there, has ``objects``: a list of ``model`` (path in the
    folder), ``uid``, ``name``, ``group`` (of variants that belong on one side of a split) and
    ``attribution``. Other meshes are named by their path.

    Raises:
        UserError: no such folder, no meshes, a bad catalogue, or two objects with one uid.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder")
    known = _read_catalogue(folder / CATALOGUE)
    meshes: dict[str, Mesh] = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() not in SUFFIXES or not path.is_file():
            continue
        relative = path.relative_to(folder)
        if any(part.startswith(".") for part in relative.parts):
            continue
        entry = known.get(relative.as_posix())
        uid = entry.uid if entry else _uid(relative)
        if uid in meshes and not entry:
            uid = f"{uid}-{path.suffix[1:].lower()}"
        if uid in meshes:
            raise UserError(f"{path} and {meshes[uid].path} would both be '{uid}'")
        if entry is None:
            meshes[uid] = Mesh(path, uid, path.stem, uid, {})
            continue
        name, group = entry.name or path.stem, entry.group or uid
        meshes[uid] = Mesh(path, uid, name, group, entry.attribution or {}, entry.rotation)
    if not meshes:
        raise UserError(f"{folder}: no mesh files ({', '.join(SUFFIXES)})")
    return [meshes[uid] for uid in sorted(meshes)]


class _Entry(msgspec.Struct):
    """One object of a catalogue; fields that are not named here may be there."""

    model: str
    uid: str
    name: str | None = None
    group: str | None = None
    attribution: dict[str, str] | None = None
    rotation: list[list[float]] | None = None


class _Catalogue(msgspec.Struct):
    objects: list[_Entry] = []


def _read_catalogue(path: Path) -> dict[str, _Entry]:
    """The entries by model; none without the file. Raises UserError where one is not sound."""
    if not path.exists():
        return {}
    known: dict[str, _Entry] = {}
    for number, entry in enumerate(read_document(path, _Catalogue).objects):
        source = f"{path}: object {number}"
        model = "/".join(parts_of(entry.model, source))
        plain_name(entry.uid, source)
        if entry.rotation is not None:
            entry.rotation = check_rotation(entry.rotation, source).tolist()
        if model in known:
            raise UserError(f"{source}: {entry.model!r} is there twice")
        known[model] = entry
    return known


def check_rotation(value: object, source: str) -> np.ndarray:
    """Makes a turn of a mesh's points, ``[3, 3]`` float64, of nine numbers or their texts.

    Raises:
        UserError: not nine finite numbers, or a matrix that flattens the mesh.
    """
    try:
        matrix = np.asarray(value, dtype=np.float64).reshape(3, 3)
    except (TypeError, ValueError) as error:
        raise UserError(f"{source}: the rotation is not nine numbers") from error
    if not np.isfinite(matrix).all() or np.abs(matrix).max() > 1e3:
        raise UserError(f"{source}: the rotation is not finite, or over 1000")
    if abs(np.linalg.det(matrix)) < 1e-6:
        raise UserError(f"{source}: the rotation cannot be turned back")
    return matrix


def _uid(relative: Path) -> str:
    """A folder's name from a path; ``chair/chair.obj`` is just ``chair``."""
    parts = list(relative.with_suffix("").parts)
    if len(parts) > 1 and parts[-1] == parts[-2]:
        parts.pop()
    uid = re.sub(r"[^\w.-]+", "_", "-".join(parts)).lstrip(".") or "_"
    if len(uid.encode()) > MAX_NAME // 2:  # room for a suffix; two long names stay apart
        digest = hashlib.sha256(uid.encode()).hexdigest()[:12]
        uid = uid.encode()[: MAX_NAME // 2].decode(errors="ignore") + digest
    return uid
