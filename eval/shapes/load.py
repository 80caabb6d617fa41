"""The load stage of an evaluation: a file becomes an ``Evaluated``, in the truth's unit frame.

``load_truth`` and ``load_prediction`` read a file (``load_shape``), turn Gaussians into a surface,
move the shape into the unit frame, and clean and flag its mesh. ``compare`` is the next stage.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gamba_warp.data.layouts import Placement
from gamba_warp.errors import UserError
from gamba_warp.formats.clouds import SUFFIXES as CLOUD_SUFFIXES
from gamba_warp.formats.clouds import read_cloud
from gamba_warp.formats.gaussians.files import read_gaussians, splat_kind
from gamba_warp.formats.headers import open_shape
from gamba_warp.formats.meshes import Y_TO_Z_UP, default_up, load_mesh
from gamba_warp.formats.names import SPLAT_SUFFIXES
from gamba_warp.formats.ply_data import read_ply_header
from gamba_warp.gaussians import Gaussians
from gamba_warp.surfaces.extract import extract_surface
from gamba_warp.surfaces.options import SurfaceOptions

from .flags import STRICT, tidied
from .protocol import GeometryProtocol
from .shape import SUFFIXES, Mesh, Points, Shape, Similarity

HUGE = 1e18  # the squares of larger coordinates overflow float32
ROUNDED = 1e-3  # how far the rotations of a catalogue, texts of few digits, may be from one
FAR = 1e6  # units of the truth's longest side; farther out float32 holds nothing of a shape
KINDS = {Gaussians: "gaussians", Mesh: "mesh", Points: "points"}
UNKNOWN = "unknown"  # axes
# From a file's axes to z-up, by their names.
TO_Z_UP = {
    "opencv": Y_TO_Z_UP * [1.0, -1.0, -1.0],
    "opengl": Y_TO_Z_UP,
    "z-up": np.eye(3),
}
# Those of the frames that predictions may be in; those of the truth's file depend on the file.
FRAME_AXES = {"unit": "z-up", "reference": "opencv"}
DATASET = "dataset"  # axes of the meshes that a dataset was rendered from, as it says them
_FOLLOWED = "which was rendered of these meshes with another axis up; --up is followed"
_OTHER_FILES = (
    "other bounding boxes than the meshes that DATA was rendered from; DATA's axes are not used, "
    "those of the format are (--up)"
)


@dataclass
class Evaluated:
    """A shape as it is compared.

    Attributes:
        source: as the file holds it.
        shape: in the truth's unit frame.
        flags: of the mesh (for Gaussians: of their surface), names from ``flags.FLAGS``.
        motion: what brought the file's coordinates into the unit frame.
        axes: of the file, a key of ``TO_Z_UP``, ``UNKNOWN``, or of a truth ``DATASET``.
        warning: of a truth, why its place in its dataset is not used; or empty.
    """

    source: Shape
    shape: Mesh | Points
    flags: list[str]
    motion: Similarity
    axes: str
    warning: str = ""

    @property
    def kind(self) -> str:
        """What the file holds: "gaussians", "mesh" or "points"."""
        return KINDS[type(self.source)]

    @property
    def warnings(self) -> list[str]:
        """Warnings of the file for a report, one line each."""
        omitted = self.source.omitted if isinstance(self.source, Mesh) else ()
        return [*([self.warning] if self.warning else []), *omitted]

    def is_closed(self) -> bool | None:
        """Whether the mesh is closed, as ``Mesh.is_closed`` says it; None for points."""
        return "open" not in self.flags if isinstance(self.shape, Mesh) else None


def load_truth(
    path: Path,
    protocol: GeometryProtocol,
    rotation: list[list[float]] | None = None,
    placement: Placement | None = None,
) -> Evaluated:
    """Reads a true mesh or cloud and moves it into its unit frame.

    Args:
        path: file.
        protocol: says which axis of the file points up, and which flags are refused.
        rotation: ``[3, 3]``, applied first, for files whose object lies on its side; or None.
        placement: of the mesh that the dataset was rendered from. It places the truth, in place of
            the protocol and the rotation, where the file has that mesh's bounding box and the
            protocol does not ask for another upward axis. None: there is none.

    Raises:
        UserError: it cannot be read, is made of Gaussians, or has no extent; or ``rotation``
            also stretches.
    """
    shape = load_shape(path)
    if isinstance(shape, Gaussians):
        raise UserError(f"{path}: Gaussians, the truth must be a mesh or a point cloud")
    try:
        asked, warning = {"y": "opengl", "z": "z-up"}.get(protocol.up), ""
        if placement is not None and placement.fits(_positions(shape)):
            if asked is None or _same_up(placement, TO_Z_UP[asked], rotation):
                matrix, scale = placement.transform, placement.scale
                motion = Similarity(matrix[:, :3], scale * matrix[:, 3], scale)
                return _evaluated(shape, motion.apply(shape), motion, DATASET, protocol)
            warning = f"--up {protocol.up} contradicts DATA, {_FOLLOWED}"
        elif placement is not None and asked is None:
            warning = _OTHER_FILES
        axes = asked or axes_of(path, shape)
        motion = unit_motion(shape, axes, rotation)
        found = _evaluated(shape, motion.apply(shape), motion, axes, protocol)
        return replace(found, warning=warning)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def _same_up(
    placement: Placement, turn: np.ndarray, rotation: list[list[float]] | None = None
) -> bool:
    """Tells if one direction in the file points up by a placement, and by a turn to z-up."""
    if rotation is not None:
        turn = turn @ np.asarray(rotation, np.float64)
    up, other = placement.transform[2, :3], turn[2]
    return up @ other > (1 - ROUNDED) * np.linalg.norm(up) * np.linalg.norm(other)


def axes_of(path: Path, shape: Shape) -> str:
    """The axes of a shape's file by its format, or by the comment "axes NAME" of a ``.ply``.

    ``UNKNOWN`` where neither says them.
    """
    if isinstance(shape, Gaussians):
        return "opencv"
    if path.suffix.lower() == ".ply":
        with open_shape(path) as (file, _):
            said = {f"axes {axes}": axes for axes in TO_Z_UP}
            found = [said[c] for c in read_ply_header(path, file).comments if c in said]
        return found[0] if found else UNKNOWN
    return "opengl" if default_up(path) == "y" else UNKNOWN


def turn_between(axes: str, frame: str) -> np.ndarray:
    """``[3, 3]`` from a file's axes to a frame's; none where one of them is not known."""
    if UNKNOWN in (axes, frame):
        return np.eye(3)
    return TO_Z_UP[frame].T @ TO_Z_UP[axes]


def load_prediction(
    path: Path, motion: Similarity, frame_axes: str, protocol: GeometryProtocol
) -> Evaluated:
    """Reads a predicted shape, turns and moves it, and turns Gaussians into a surface.

    Args:
        path: file.
        motion: from the frame of the predictions into the truth's unit frame.
        frame_axes: of that frame, a key of ``TO_Z_UP`` or ``UNKNOWN``.
        protocol: says how the file's axes lie, how Gaussians become a surface, and which flags are
            refused.

    Raises:
        UserError: it cannot be read, has no surface, or lies far away.
    """
    source, axes = load_shape(path), protocol.pred_axes
    if axes == "auto" and protocol.frame != "unit":
        axes = axes_of(path, source)
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
        return _evaluated(source, shape, motion, axes, protocol)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def unit_motion(
    shape: Mesh | Points, axes: str, rotation: list[list[float]] | None = None
) -> Similarity:
    """The motion after which a shape is z-up and centred, with a longest side of 1.

    Args:
        shape: at least two places.
        axes: of the shape, a key of ``TO_Z_UP``; others are taken for z-up.
        rotation: ``[3, 3]``, applied first; or None.

    Raises:
        UserError: it has no extent, or is so far from the origin that its numbers cannot hold it;
            or ``rotation`` also stretches or mirrors.
    """
    turn = TO_Z_UP.get(axes, np.eye(3))
    if rotation is not None:
        turn = turn @ np.asarray(rotation, np.float64)
        if abs(turn @ turn.T - np.eye(3)).max() > ROUNDED or np.linalg.det(turn) < 0:
            raise UserError("the rotation that its catalogue states also stretches or mirrors")
    points = _positions(shape) @ turn.T
    low, high = points.min(0), points.max(0)
    extent = (high - low).max()
    if extent <= 1e-10 * max(abs(low).max(), abs(high).max()):
        raise UserError("all its points are one, or too near to each other to tell apart")
    return Similarity(turn, -(low + high) / 2 / extent, 1 / extent)


def _positions(shape: Shape) -> np.ndarray:
    """``[N, 3]``: the vertices, points, or centres of Gaussians."""
    if isinstance(shape, Gaussians):
        return shape.means.numpy()
    return shape.vertices if isinstance(shape, Mesh) else shape.positions


def _evaluated(
    source: Shape, shape: Mesh | Points, motion: Similarity, axes: str, protocol: GeometryProtocol
) -> Evaluated:
    if isinstance(shape, Points):
        return Evaluated(source, shape, [], motion, axes)
    mesh, flags = tidied(shape)
    if len(mesh.faces) == 0:
        raise UserError("the mesh has no area")
    refused = [flag for flag in flags if flag in STRICT]
    if protocol.strict and isinstance(source, Mesh) and refused:
        raise UserError(f"--strict: {', '.join(refused)}")
    return Evaluated(source, mesh, flags, motion, axes)


def load_shape(path: Path) -> Shape:
    """Reads Gaussians, a mesh, or a point cloud, by what the file holds.

    The counts that the file's header states are compared with its size first, so that a false
    header costs no memory; no native library sees the file's bytes.

    Raises:
        UserError: missing, unreadable, empty, with a false header, or with values that are not
            finite or beyond ``HUGE``.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise UserError(f"{path}: not one of {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    shape: Shape
    if suffix in SPLAT_SUFFIXES and splat_kind(path) is not None:
        shape = read_gaussians(path)
    elif suffix in CLOUD_SUFFIXES and not (suffix == ".ply" and _has_faces(path)):
        shape = _load_points(path)
    else:
        mesh = load_mesh(path, normals=False)
        shape = Mesh(mesh.vertices, mesh.faces, tuple(mesh.omitted))
    reach = np.abs(_positions(shape)).max()
    if reach > HUGE:
        raise UserError(f"{path}: coordinates reach {reach:.3g}, over {HUGE:g}")
    return shape


def _has_faces(path: Path) -> bool:
    """Whether a ``.ply`` says in its header that it has faces."""
    with open_shape(path) as (file, _):
        elements = read_ply_header(path, file).elements
    return any(element.name == "face" and element.count for element in elements)


def _load_points(path: Path) -> Points:
    positions, normals = read_cloud(path)
    if normals is None:
        return Points(positions)
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    usable = np.isfinite(lengths).all() and lengths.all()
    return Points(positions, normals / lengths if usable else None)


def to_surface(
    gaussians: Gaussians, options: SurfaceOptions, seed: int, count: int
) -> Mesh | Points:
    """Turns one object's Gaussians into a mesh, or into points for the method "centers".

    Args:
        gaussians: one object, no batch dimension.
        options: how they become a surface.
        seed: of the points, for "centers".
        count: number of points, for "centers".

    Raises:
        UserError: there is no surface.
    """
    if options.method == "centers":
        return centers(gaussians, count, seed)
    surface = extract_surface(gaussians, options)
    return Mesh(surface.vertices, surface.faces)


def centers(gaussians: Gaussians, count: int, seed: int) -> Points:
    """Draws ``count`` centres with repetition, each with a chance proportional to its opacity.

    Raises:
        UserError: no Gaussian has any opacity.
    """
    weights = gaussians.opacities.double().cpu().numpy()
    if weights.sum() <= 0:
        raise UserError("no Gaussian has any opacity")
    chosen = np.random.default_rng(seed).choice(len(weights), count, p=weights / weights.sum())
    return Points(gaussians.means.double().cpu().numpy()[chosen])
