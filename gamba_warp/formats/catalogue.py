"""Meshes of a folder, with their entries in its ``catalogue.json``."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath

import msgspec
import numpy as np

from ..errors import UserError
from ..files import visible, warn_of_others
from ..untrusted.documents import read_document
from ..untrusted.names import MAX_NAME, parts_of, plain_name
from .names import MESH_SUFFIXES

CATALOGUE = "catalogue.json"  # next to the meshes: names and attribution, see ``find_meshes``
# Names of files and folders that do not identify an object.
NO_NAMES = frozenset(
    "mesh meshes model model_normalized models normalized_model object raw_model scene source "
    "textured untitled".split()
)

_LONG = MAX_NAME // 2  # bytes of a name, which leave room for a suffix
_DIGITS = 12  # of the hash at the end of a shortened name
_SHORTENED = re.compile(rf"[0-9a-f]{{{_DIGITS}}}$")


@dataclass(frozen=True)
class Mesh:
    """One object to render.

    Attributes:
        path: the file.
        uid: folder in the dataset.
        name: a name for people.
        group: name shared by objects that belong on one side of a split.
        attribution: author and licence.
        rotation: ``[3, 3]``, turns the file's points upright first, or None.
        root: the folder in which it was found, whose files it may use; None: its own.
    """

    path: Path
    uid: str
    name: str
    group: str
    attribution: dict[str, str]
    rotation: list[list[float]] | None = None
    root: Path | None = None


def find_meshes(folder: Path) -> list[Mesh]:
    """Return all mesh files under a folder, sorted by uid.

    An optional ``catalogue.json`` in the folder has ``objects``: a list of ``model`` (path in the
    folder) and the other fields of ``Mesh``. Other meshes are named by their path
    (``object_names``).

    Raises:
        UserError: no such folder, no meshes, a malformed catalogue, or two objects with one uid.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder")
    known = _read_catalogue(folder / CATALOGUE)
    meshes: dict[str, Mesh] = {}
    files = [path for path in visible(folder, "*") if path.is_file()]
    warn_of_others(folder, files, MESH_SUFFIXES)
    paths = sorted(path for path in files if path.suffix.lower() in MESH_SUFFIXES)
    named = _name_parts([path.relative_to(folder).with_suffix("") for path in paths])
    for path, parts in zip(paths, named):
        model = path.relative_to(folder).as_posix()
        entry = known.get(model) or _Entry(model, _uid(parts))
        uid = entry.uid
        if uid in meshes and model not in known:
            uid = f"{uid}-{path.suffix[1:].lower()}"
        if uid in meshes:
            raise UserError(f"{path} and {meshes[uid].path} would both be named '{uid}'")
        name, group = entry.name or parts[-1], entry.group or uid
        attribution = entry.attribution or {}
        meshes[uid] = Mesh(path, uid, name, group, attribution, entry.rotation, folder)
    if not meshes:
        raise UserError(f"{folder}: no mesh files ({', '.join(MESH_SUFFIXES)})")
    return [meshes[uid] for uid in sorted(meshes)]


class _Entry(msgspec.Struct):
    """One object of a catalogue; further fields are ignored."""

    model: str
    uid: str
    name: str | None = None
    group: str | None = None
    attribution: dict[str, str] | None = None
    rotation: list[list[float]] | None = None


class _Catalogue(msgspec.Struct):
    objects: list[_Entry] = []


def _read_catalogue(path: Path) -> dict[str, _Entry]:
    """Return the entries by model; none without the file. Raises UserError if one is invalid."""
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
            raise UserError(f"{source}: {entry.model!r} occurs twice")
        known[model] = entry
    return known


def check_rotation(value: object, source: str) -> np.ndarray:
    """Convert nine numbers or their texts to a rotation of a mesh's points, ``[3, 3]`` float64.

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
        raise UserError(f"{source}: the rotation is not invertible")
    return matrix


def object_names(paths: Sequence[PurePath]) -> list[str]:
    """Return names of the objects in the files of one folder, each valid as a file name.

    ``a/b`` is ``a-b``. Last parts that identify nothing (``NO_NAMES``) or repeat the folder are
    dropped: ``a/b/model`` and ``a/b/b`` are ``a-b`` too. Files that would share a name keep all
    parts. Returned names are unchanged when passed again.

    Args:
        paths: of the files in the folder, without suffix; files of one path are of one object.
    """
    return [_uid(parts) for parts in _name_parts(paths)]


def _name_parts(paths: Sequence[PurePath]) -> list[tuple[str, ...]]:
    """Return the parts of each path that name its object."""
    short: list[tuple[str, ...]] = []
    owners: dict[str, set[PurePath]] = {}
    for path in paths:
        parts = path.parts
        while len(parts) > 1 and parts[-1].lower() in NO_NAMES:
            parts = parts[:-1]
        short.append(_once(parts))
        owners.setdefault(_uid(short[-1]), set()).add(path)
    return [
        parts if len(owners[_uid(parts)]) == 1 else _once(path.parts)
        for path, parts in zip(paths, short)
    ]


def _once(parts: tuple[str, ...]) -> tuple[str, ...]:
    """``chair/chair`` is just ``chair``."""
    return parts[:-1] if len(parts) > 1 and parts[-1] == parts[-2] else parts


def _uid(parts: tuple[str, ...]) -> str:
    """Join parts to one name for a folder."""
    uid = re.sub(r"[^\w.-]+", "_", "-".join(parts)).lstrip(".") or "_"
    size = len(uid.encode())
    if size > _LONG and not (size <= _LONG + _DIGITS and _SHORTENED.search(uid)):
        digest = hashlib.sha256(uid.encode()).hexdigest()[:_DIGITS]  # two long names stay apart
        uid = uid.encode()[:_LONG].decode(errors="ignore") + digest
    return uid
