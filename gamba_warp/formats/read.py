"""Reader of every file of a shape: Gaussians, a mesh or points, by the file's content.

Points are ``.xyz`` and ``.ply``, text or binary, read completely or refused: the readers of Open3D
keep a part of a malformed file, even memory that was never written.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import UserError
from ..files import warn_of_others
from ..gaussians import Gaussians
from ..images import IMAGE_SUFFIXES
from .gaussians.glb import gltf_gaussians, has_gaussians
from .gaussians.splat import read_splat
from .gaussians.spz import GZIP, MAGIC, read_spz
from .gltf import gltf_parts
from .gltf_file import open_gltf
from .headers import MAX_VALUES, Source, open_shape, read_rows
from .materials import SideFiles
from .mesh_files import ply_parts
from .meshes import Y_TO_Z_UP, Y_UP, TexturedMesh, mesh_of, read_mesh
from .names import MESH_SUFFIXES, SHAPE_SUFFIXES, SPLAT_SUFFIXES
from .ply import TURNED, ply_gaussians
from .ply_data import MAX_SPLATS, PlyData, parse_ply

# From a file's axes to z-up, by their names.
TO_Z_UP = {"opencv": Y_TO_Z_UP * [1.0, -1.0, -1.0], "opengl": Y_TO_Z_UP, "z-up": np.eye(3)}
UNKNOWN = "unknown"  # axes
MAX_POINTS = MAX_VALUES // 3
_CONVERTED = (".sog", ".ksplat", ".rad")  # Gaussians in formats of single programs


class Cloud(NamedTuple):
    """Points of a file."""

    positions: np.ndarray  # [N, 3] float64, finite, N > 0
    normals: np.ndarray | None = None  # [N, 3] float64 of unit length; None if one has none


_WORDS = {Gaussians: "Gaussians", TexturedMesh: "a mesh", Cloud: "points"}


class ShapeFile(NamedTuple):
    """Content of a file.

    Attributes:
        shape: Gaussians are in OpenCV's axes; the others as in the file.
        axes: of the shape, a key of ``TO_Z_UP`` or ``UNKNOWN``: by the format, or by the comment
            "axes NAME" of a ``.ply``.
        comments: of a ``.ply``, such as its origin, at most 32 lines of 200 characters.
        warnings: missing content of a mesh that was replaced, and unread content; or the number of
            Gaussians that were left out; one line each.
    """

    shape: Gaussians | TexturedMesh | Cloud
    axes: str
    comments: Sequence[str] = ()
    warnings: Sequence[str] = ()


def read(path: str | Path, drop_bad: bool = False, only: type | None = None) -> ShapeFile:
    """Read Gaussians, a mesh or points by the file's content, and then by its name.

    Gaussians are ``.ply`` (binary, text or compressed), ``.splat``, ``.spz`` and ``.glb`` with
    ``KHR_gaussian_splatting``, from this or another program; meshes as for ``meshes.load_mesh``;
    points ``.ply`` and ``.xyz``. The counts in a header are compared with the file's size first, so
    an invalid header costs no memory. No native library reads the file.

    Args:
        path: the file.
        drop_bad: leave out Gaussians that cannot be drawn (a row of NaN, a rotation of length
            zero), with a warning; else such a file is refused.
        only: type of the shape; others are refused before their numbers are used.

    Raises:
        UserError: the file is missing, a folder, of another kind, truncated or longer than it
            states, or its values are invalid.
    """
    path = Path(path)
    if path.is_dir():
        inside = sorted(p for p in path.glob("[!.]*") if p.suffix.lower() in SHAPE_SUFFIXES)
        such = f", such as {inside[0]}" if inside else ""
        raise UserError(f"{path}: a folder; give one file{such}")
    with open_shape(path, MAX_SPLATS) as source:
        return _read(source, [] if drop_bad else None, only)


def _read(source: Source, left_out: list[str] | None, only: type | None) -> ShapeFile:
    path, suffix, head = source.path, source.path.suffix.lower(), source.head(4)
    spz = head.startswith(GZIP) or head == MAGIC
    ply = head.startswith(b"ply") or (suffix == ".ply" and not spz)
    if not ply:  # the header of a .ply says which limit applies
        source.check()
    sides, comments, axes = SideFiles(path), [], "opengl" if suffix in Y_UP else UNKNOWN
    build: Callable[[], Any]
    if ply:
        data = parse_ply(source)
        comments = [line[:200] for line in data.header.comments if line != TURNED][:32]
        stated = {f"axes {name}": name for name in TO_Z_UP}
        axes = next((stated[line] for line in data.header.comments if line in stated), UNKNOWN)
        if data.header.has_gaussians:
            kind, build = Gaussians, lambda: ply_gaussians(path, data, left_out)
        elif data.header.has_faces:
            kind, build = TexturedMesh, lambda: mesh_of(ply_parts(data, sides), sides)
        else:
            kind, build = Cloud, lambda: _ply_cloud(path, data)
    elif head == b"glTF" or (suffix in (".glb", ".gltf") and not spz):
        file = open_gltf(source, sides)
        kind, build = TexturedMesh, lambda: mesh_of(gltf_parts(file, sides), sides)
        if has_gaussians(file):
            kind, build = Gaussians, lambda: gltf_gaussians(file, left_out)
    elif spz or suffix == ".spz":
        kind, build = Gaussians, lambda: read_spz(source, left_out)
    elif suffix == ".splat":  # which has no header
        kind, build = Gaussians, lambda: read_splat(source, left_out)
    elif suffix == ".xyz":
        kind, build = Cloud, lambda: _xyz_cloud(source)
    elif suffix in MESH_SUFFIXES:
        kind, build = TexturedMesh, lambda: read_mesh(source, sides)
    else:
        advice = f"not one of {', '.join(SHAPE_SUFFIXES)}"
        if suffix in IMAGE_SUFFIXES:
            advice = "an image; gamba reconstruct makes Gaussians of it"
        elif suffix in _CONVERTED:
            tool = "SuperSplat (superspl.at/editor) and splat-transform convert it to .ply"
            advice = f"the format {suffix} is not supported; {tool}"
        raise UserError(f"{path}: {advice}")
    if only not in (None, kind):
        raise UserError(f"{path}: contains {_WORDS[kind]}, not {_WORDS[only]}")
    shape = build()
    warnings = shape.warnings if kind is TexturedMesh else left_out or ()
    return ShapeFile(shape, "opencv" if kind is Gaussians else axes, comments, warnings)


def _xyz_cloud(source: Source) -> Cloud:
    """Return the points of a ``.xyz`` file.

    Of its columns, at least three, those after the first three (normals or colours, the format does
    not say) are checked and not used.
    """
    name = str(source.path)
    table = read_rows(source.file.read(), name, comments=True).table(name)
    if len(table) and table.shape[1] < 3:
        raise UserError(f"{name}: {table.shape[1]} columns, expected x y z")
    return _cloud(source.path, np.ascontiguousarray(table[:, :3]), None)


def _ply_cloud(path: Path, data: PlyData) -> Cloud:
    positions = data.numbers("x", "y", "z")
    if positions is None:
        raise UserError(f"{path}: its vertices have no x, y and z")
    return _cloud(path, positions, data.numbers("nx", "ny", "nz"))


def _cloud(path: Path, positions: np.ndarray, normals: np.ndarray | None) -> Cloud:
    """Return a cloud. Raises UserError if it has no points, too many, or one is not finite."""
    count = len(positions)
    if count == 0:
        raise UserError(f"{path}: contains no points")
    if count > MAX_POINTS:
        raise UserError(f"{path}: {count} points, over the limit of {MAX_POINTS}")
    bad = count - np.count_nonzero(np.isfinite(positions).all(1))
    if bad:
        raise UserError(f"{path}: {bad} of {count} points are not finite")
    if normals is not None:
        with np.errstate(over="ignore"):
            lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = normals / lengths if np.isfinite(lengths).all() and lengths.all() else None
    return Cloud(positions, normals)


def rotation_between(axes: str, others: str) -> np.ndarray:
    """Return the rotation ``[3, 3]`` from a file's axes to others; identity if one is unknown."""
    if UNKNOWN in (axes, others):
        return np.eye(3)
    return TO_Z_UP[others].T @ TO_Z_UP[axes]


def read_gaussians(path: str | Path, left_out: list[str] | None = None) -> Gaussians:
    """Read one object's Gaussians, as ``read`` does.

    Args:
        path: the file.
        left_out: receives a line that counts the Gaussians left out because they cannot be drawn;
            None: a file with such Gaussians is refused.

    Returns:
        Float32 Gaussians on the CPU in OpenCV's axes (y down), ``quats`` normalised; colours may
        lie outside of [0, 1].

    Raises:
        UserError: as for ``read``, or the file contains no Gaussians.
    """
    file = read(path, left_out is not None, Gaussians)
    if left_out is not None:
        left_out += file.warnings
    assert isinstance(file.shape, Gaussians)
    return file.shape


def find_gaussians(inputs: Sequence[Path]) -> tuple[list[Path], list[tuple[Path, str]]]:
    """Resolve files and folders to files of Gaussians, each once; files of a folder are sorted.

    In folders a .glb with a mesh is skipped, because commands write them next to the Gaussians. So
    are names that begin with a dot: hidden files, and unfinished ones of killed commands.

    Returns:
        The files, and the inputs that are missing or hold none, with the reason.

    Raises:
        UserError: without inputs.
    """
    files: dict[Path, None] = {}
    failures = []
    if not inputs:
        raise UserError("give at least one file of Gaussians (.ply, .splat, .spz, .glb) or folder")
    for path in inputs:
        if not path.is_dir():
            if path.exists():
                files[path] = None
            else:
                failures.append((path, "no such file"))
            continue
        inside = sorted(p for p in path.glob("[!.]*") if p.is_file())
        warn_of_others(path, inside, (*SPLAT_SUFFIXES, ".html", ".gif", ".mp4"))
        inside = [p for p in inside if p.suffix.lower() in SPLAT_SUFFIXES]
        inside = [p for p in inside if p.suffix.lower() != ".glb" or not _is_mesh(p)]
        files.update(dict.fromkeys(inside))
        if not inside:
            failures.append((path, "the folder holds no .ply, .splat, .spz or .glb files"))
    return list(files), failures


def _is_mesh(path: Path) -> bool:
    """Return True if a .glb holds a mesh, False for Gaussians or if it is unreadable."""
    try:
        with open_shape(path) as source:
            return not has_gaussians(open_gltf(source, SideFiles(path)))
    except UserError:  # reading it gives this error
        return False
