"""Loading stage of an evaluation: files become ``LoadedShape``, in the truth's unit frame.

``load_truth`` and ``load_prediction`` read a file (``load_shape``), turn Gaussians into a surface,
move the shape into the unit frame, and clean and flag its mesh. ``compare`` is the next stage.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from gamba_warp.data.layouts import Placement
from gamba_warp.errors import UserError
from gamba_warp.formats.clouds import SUFFIXES as CLOUD_SUFFIXES
from gamba_warp.formats.clouds import Cloud, cloud_of, read_cloud
from gamba_warp.formats.gaussians.files import read_gaussians, splat_kind
from gamba_warp.formats.headers import open_shape
from gamba_warp.formats.meshes import Y_TO_Z_UP, default_up, load_mesh
from gamba_warp.formats.names import SPLAT_SUFFIXES
from gamba_warp.formats.ply import gaussians_of
from gamba_warp.formats.ply_data import MAX_SPLATS, PlyData, parse_ply
from gamba_warp.gaussians import Gaussians
from gamba_warp.surfaces.extract import extract_surface
from gamba_warp.surfaces.options import SurfaceOptions

from .flags import FLAGS, STRICT, clean_mesh
from .protocol import GeometryProtocol
from .shape import SUFFIXES, Mesh, Points, Shape, Similarity

HUGE = 1e18  # squares of larger coordinates overflow float32
ROUNDED = 1e-3  # tolerance of a catalogue's rotations, which have few digits
FAR = 1e6  # units of the truth's longest side; beyond, float32 cannot resolve a shape
KINDS = {Gaussians: "gaussians", Mesh: "mesh", Points: "points"}
UNKNOWN = "unknown"  # axes
# From a file's axes to z-up, by their names.
TO_Z_UP = {
    "opencv": Y_TO_Z_UP * [1.0, -1.0, -1.0],
    "opengl": Y_TO_Z_UP,
    "z-up": np.eye(3),
}
# Axes of the frames of predictions; for "gt" they depend on the file.
FRAME_AXES = {"unit": "z-up", "reference": "opencv"}
DATASET = "dataset"  # axes stated by the dataset that was rendered from the meshes
_FOLLOWED = "which was rendered of these meshes with another axis up; --up is followed"
_OTHER_FILES = (
    "other bounding boxes than the meshes that DATA was rendered from; DATA's axes are not used, "
    "those of the format are (--up)"
)


@dataclass
class LoadedShape:
    """A shape ready for comparison.

    Attributes:
        source: as in the file.
        shape: in the truth's unit frame.
        flags: of the mesh (for Gaussians: of their surface), names from ``flags.FLAGS``.
        motion: from the file's coordinates into the unit frame.
        axes: of the file: a key of ``TO_Z_UP``, ``UNKNOWN``, or for a truth ``DATASET``.
        warning: reason why the dataset's placement of a truth is not used; or empty.
        notes: further warnings.
    """

    source: Shape
    shape: Mesh | Points
    flags: list[str]
    motion: Similarity
    axes: str
    warning: str = ""
    notes: list[str] = field(default_factory=list)

    @property
    def kind(self) -> str:
        """Kind of the file's content: "gaussians", "mesh" or "points"."""
        return KINDS[type(self.source)]

    @property
    def warnings(self) -> list[str]:
        """Warnings of the file for a report, one line each."""
        omitted = self.source.omitted if isinstance(self.source, Mesh) else ()
        return [*([self.warning] if self.warning else []), *omitted, *self.notes]

    def is_closed(self) -> bool | None:
        """Return True if the mesh is closed (``Mesh.is_closed``); None for points."""
        return "open" not in self.flags if isinstance(self.shape, Mesh) else None


def load_truth(
    path: Path,
    protocol: GeometryProtocol,
    rotation: list[list[float]] | None = None,
    placement: Placement | None = None,
) -> LoadedShape:
    """Read a true mesh or cloud, and move it into its unit frame.

    Args:
        path: file.
        protocol: with the upward axis of the file and the refused flags.
        rotation: ``[3, 3]``, applied first, for files whose object is on its side; or None.
        placement: of the dataset's source mesh, or None. It replaces the protocol's axis and the
            rotation if the file has that mesh's bounding box and the protocol asks for no other
            upward axis.

    Raises:
        UserError: the file cannot be read, holds Gaussians, or has no extent; or ``rotation`` is
            not a rotation.
    """
    shape, axes = _read_shape(path)
    if isinstance(shape, Gaussians):
        raise UserError(f"{path}: holds Gaussians; the truth must be a mesh or a point cloud")
    try:
        asked, warning = {"y": "opengl", "z": "z-up"}.get(protocol.up), ""
        if placement is not None and placement.fits(_positions(shape)):
            if asked is None or _same_up(placement, TO_Z_UP[asked], rotation):
                matrix, scale = placement.transform, placement.scale
                motion = Similarity(matrix[:, :3], scale * matrix[:, 3], scale)
                return _loaded(shape, motion.apply(shape), motion, DATASET, protocol)
            warning = f"--up {protocol.up} contradicts DATA, {_FOLLOWED}"
        elif placement is not None and asked is None:
            warning = _OTHER_FILES
        axes = asked or axes
        motion = unit_motion(shape, axes, rotation)
        found = _loaded(shape, motion.apply(shape), motion, axes, protocol)
        return replace(found, warning=warning)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def _same_up(
    placement: Placement, turn: np.ndarray, rotation: list[list[float]] | None = None
) -> bool:
    """Return True if a placement and a rotation to z-up agree on the file's upward direction."""
    if rotation is not None:
        turn = turn @ np.asarray(rotation, np.float64)
    up, other = placement.transform[2, :3], turn[2]
    return up @ other > (1 - ROUNDED) * np.linalg.norm(up) * np.linalg.norm(other)


def turn_between(axes: str, frame: str) -> np.ndarray:
    """Return the rotation ``[3, 3]`` from a file's axes to a frame's; identity if unknown."""
    if UNKNOWN in (axes, frame):
        return np.eye(3)
    return TO_Z_UP[frame].T @ TO_Z_UP[axes]


def load_prediction(
    path: Path, motion: Similarity, frame_axes: str, protocol: GeometryProtocol
) -> LoadedShape:
    """Read a predicted shape, move it, and turn Gaussians into a surface.

    Args:
        path: file.
        motion: from the frame of the predictions into the truth's unit frame.
        frame_axes: of that frame, a key of ``TO_Z_UP`` or ``UNKNOWN``.
        protocol: with the file's axes, the options of surfaces, and the refused flags.

    Raises:
        UserError: it cannot be read, has no surface, or is too far away.
    """
    source, of_file = _read_shape(path)
    axes = protocol.pred_axes
    if axes == "auto" and protocol.frame != "unit":
        axes = of_file
    if axes in ("auto", "frame"):
        axes = frame_axes
    motion = motion.after(turn_between(axes, frame_axes))
    shape = motion.apply(source)
    reach = float(np.abs(_positions(shape)).max())
    if not reach <= FAR:
        raise UserError(f"{path}: reaches {reach:.3g} times the truth's longest side")
    try:
        if isinstance(shape, Gaussians):
            shape = to_surface(shape, protocol.surface, protocol.seed, protocol.num_points)
        return _loaded(source, shape, motion, axes, protocol)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def unit_motion(
    shape: Mesh | Points, axes: str, rotation: list[list[float]] | None = None
) -> Similarity:
    """Return the motion that makes a shape z-up and centred, with a longest side of 1.

    Args:
        shape: at least two distinct points.
        axes: of the shape, a key of ``TO_Z_UP``; otherwise z-up is assumed.
        rotation: ``[3, 3]``, applied first; or None.

    Raises:
        UserError: the extent is zero, or lost to rounding far from the origin; or ``rotation``
            also stretches or mirrors.
    """
    turn = TO_Z_UP.get(axes, np.eye(3))
    if rotation is not None:
        turn = turn @ np.asarray(rotation, np.float64)
        if abs(turn @ turn.T - np.eye(3)).max() > ROUNDED or np.linalg.det(turn) < 0:
            raise UserError("its catalogue's rotation stretches or mirrors, which is invalid")
    points = _positions(shape) @ turn.T
    low, high = points.min(0), points.max(0)
    extent = (high - low).max()
    if extent <= 1e-10 * max(abs(low).max(), abs(high).max()):
        raise UserError("all its points coincide, or are too close to tell apart")
    return Similarity(turn, -(low + high) / 2 / extent, 1 / extent)


def _positions(shape: Shape) -> np.ndarray:
    """Return the vertices, points, or centres of Gaussians, ``[N, 3]``."""
    if isinstance(shape, Gaussians):
        return shape.means.numpy()
    return shape.vertices if isinstance(shape, Mesh) else shape.positions


def _loaded(
    source: Shape, shape: Mesh | Points, motion: Similarity, axes: str, protocol: GeometryProtocol
) -> LoadedShape:
    if isinstance(shape, Points):
        return LoadedShape(source, shape, [], motion, axes)
    mesh, flags = clean_mesh(shape, protocol.strict)
    if isinstance(source, Mesh) and source.flat:
        flags = [flag for flag in FLAGS if flag in (*flags, "degenerate")]
    if len(mesh.faces) == 0:
        raise UserError("the mesh has no area")
    refused = [flag for flag in flags if flag in STRICT]
    if protocol.strict and isinstance(source, Mesh) and refused:
        raise UserError(f"--strict: {', '.join(refused)}")
    return LoadedShape(source, mesh, flags, motion, axes)


def load_shape(path: Path) -> Shape:
    """Read Gaussians, a mesh or a point cloud, by the content of the file.

    The counts in the header are compared with the file's size first, so an invalid header costs
    no memory. No native library reads the file.

    Raises:
        UserError: missing, unreadable, empty, with an invalid header, or with values that are not
            finite or beyond ``HUGE``.
    """
    return _read_shape(path)[0]


def _read_shape(path: Path) -> tuple[Shape, str]:
    """Return a shape as ``load_shape`` does, and its file's axes, a key of ``TO_Z_UP``.

    The axes come from the format, or from the comment "axes NAME" of a ``.ply``; ``UNKNOWN``
    without either.
    """
    suffix, ply = path.suffix.lower(), None
    if suffix not in SUFFIXES:
        raise UserError(f"{path}: not one of {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    if suffix in SPLAT_SUFFIXES:
        with open_shape(path, MAX_SPLATS) as (file, size):
            if file.read(3) == b"ply":
                file.seek(0)
                ply = parse_ply(path, file, size)
    shape: Shape
    axes = "opengl" if default_up(path) == "y" else UNKNOWN
    if ply is not None and ply.header.has_gaussians:
        shape, axes = gaussians_of(path, ply), "opencv"
    elif ply is not None and suffix == ".ply":
        known = {f"axes {name}": name for name in TO_Z_UP}
        axes = next((known[line] for line in ply.header.comments if line in known), UNKNOWN)
        shape = _mesh(path, ply) if ply.header.has_faces else _points(cloud_of(path, ply))
    elif suffix in SPLAT_SUFFIXES and splat_kind(path) is not None:
        shape, axes = read_gaussians(path), "opencv"
    else:
        shape = _points(read_cloud(path)) if suffix in CLOUD_SUFFIXES else _mesh(path)
    reach = np.abs(_positions(shape)).max()
    if reach > HUGE:
        raise UserError(f"{path}: coordinates reach {reach:.3g}, over {HUGE:g}")
    return shape, axes


def _mesh(path: Path, ply: PlyData | None = None) -> Mesh:
    mesh = load_mesh(path, ply=ply)
    return Mesh(mesh.vertices, mesh.faces, tuple(mesh.omitted), mesh.flat)


def _points(cloud: Cloud) -> Points:
    positions, normals = cloud
    if normals is None:
        return Points(positions)
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    usable = np.isfinite(lengths).all() and lengths.all()
    return Points(positions, normals / lengths if usable else None)


def scale_note(shape: Mesh | Points, protocol: GeometryProtocol) -> str:
    """Return a warning if a prediction's size is far from the truth's, which is 1; else ""."""
    side = float(np.ptp(_positions(shape), axis=0).max())
    if {"box", "scale", "icp"} & {*protocol.align} or 0.1 <= side <= 10:
        return ""
    return f"its side is {side:.3g} times the truth's: other units? --align scale fits them"


def to_surface(
    gaussians: Gaussians, options: SurfaceOptions, seed: int, count: int
) -> Mesh | Points:
    """Turn one object's Gaussians into a mesh, or into points for the method "centers".

    Args:
        gaussians: one object, no batch dimension.
        options: of the surface.
        seed: of the points, for "centers".
        count: number of points, for "centers".

    Raises:
        UserError: the surface is empty.
    """
    if options.method == "centers":
        return centers(gaussians, count, seed)
    surface = extract_surface(gaussians, options)
    return Mesh(surface.vertices, surface.faces)


def centers(gaussians: Gaussians, count: int, seed: int) -> Points:
    """Draw ``count`` centres with replacement, with probability proportional to opacity.

    Raises:
        UserError: all Gaussians are fully transparent.
    """
    weights = gaussians.opacities.double().cpu().numpy()
    if weights.sum() <= 0:
        raise UserError("all Gaussians are fully transparent")
    chosen = np.random.default_rng(seed).choice(len(weights), count, p=weights / weights.sum())
    return Points(gaussians.means.double().cpu().numpy()[chosen])
