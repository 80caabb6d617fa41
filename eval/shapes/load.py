"""Loading stage of an evaluation: files become ``LoadedShape``, in the ground truth's unit frame.

``load_gt`` and ``load_prediction`` read a file (``load_shape``), turn Gaussians into a surface,
move the shape into the unit frame, and clean and flag its mesh. ``compare`` is the next stage.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gamba_warp.data.layouts import Placement
from gamba_warp.errors import UserError
from gamba_warp.formats.read import TO_Z_UP, Cloud, read, rotation_between
from gamba_warp.gaussians import Gaussians
from gamba_warp.surfaces.extract import extract_surface

from .flags import FLAGS, STRICT, clean_mesh
from .protocol import GeometryProtocol
from .shape import Mesh, Points, Shape, Similarity, positions_of, sample, unit_transform

HUGE = 1e18  # squares of larger coordinates overflow float32
ROUNDED = 1e-3  # tolerance of a catalogue's rotations, which have few digits
FAR = 1e6  # units of the ground truth's longest side; beyond, float32 cannot resolve a shape
KINDS = {Gaussians: "gaussians", Mesh: "mesh", Points: "points"}
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
        shape: in the ground truth's unit frame.
        flags: of the mesh (for Gaussians: of their surface), names from ``flags.FLAGS``.
        transform: from the file's coordinates into the unit frame.
        axes: of the file: a key of ``TO_Z_UP``, ``UNKNOWN``, or for a ground truth ``DATASET``.
        warnings: of the file for a report, one line each.
    """

    source: Shape
    shape: Mesh | Points
    flags: list[str]
    transform: Similarity
    axes: str
    warnings: list[str]

    @property
    def kind(self) -> str:
        """Kind of the file's content: "gaussians", "mesh" or "points"."""
        return KINDS[type(self.source)]

    def is_closed(self) -> bool | None:
        """Return True if the mesh is closed (``Mesh.is_closed``); None for points."""
        return "open" not in self.flags if isinstance(self.shape, Mesh) else None


def load_gt(
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
    shape, of_file = load_shape(path)
    if isinstance(shape, Gaussians):
        raise UserError(
            f"{path}: holds Gaussians; the ground truth must be a mesh or a point cloud"
        )
    asked, warnings = {"y": "opengl", "z": "z-up"}.get(protocol.up), []
    axes = asked or of_file
    turn = TO_Z_UP.get(axes, np.eye(3)) @ np.asarray(np.eye(3) if rotation is None else rotation)
    try:
        if placement is not None and placement.fits(positions_of(shape)):
            if asked is None or _same_up(placement, turn):
                matrix, scale = placement.transform, placement.scale
                transform = Similarity(matrix[:, :3], scale * matrix[:, 3], scale)
                return _loaded(shape, transform.apply(shape), transform, DATASET, protocol)
            warnings = [f"--up {protocol.up} contradicts DATA, {_FOLLOWED}"]
        elif placement is not None and asked is None:
            warnings = [_OTHER_FILES]
        if abs(turn @ turn.T - np.eye(3)).max() > ROUNDED or np.linalg.det(turn) < 0:
            raise UserError("its catalogue's rotation stretches or mirrors, which is invalid")
        transform = unit_transform(shape, turn)
        loaded = _loaded(shape, transform.apply(shape), transform, axes, protocol)
        loaded.warnings[:0] = warnings
        return loaded
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def _same_up(placement: Placement, turn: np.ndarray) -> bool:
    """Return True if a placement and a rotation to z-up agree on the file's upward direction."""
    up, other = placement.transform[2, :3], turn[2]
    return up @ other > (1 - ROUNDED) * np.linalg.norm(up) * np.linalg.norm(other)


def load_prediction(
    path: Path, transform: Similarity, frame_axes: str, protocol: GeometryProtocol
) -> LoadedShape:
    """Read a predicted shape, move it, and turn Gaussians into a surface.

    Args:
        path: file.
        transform: from the frame of the predictions into the ground truth's unit frame.
        frame_axes: of that frame, a key of ``TO_Z_UP`` or ``UNKNOWN``.
        protocol: with the file's axes, the options of surfaces, and the refused flags.

    Raises:
        UserError: it cannot be read, has no surface, or is too far away.
    """
    source, of_file = load_shape(path)
    axes = protocol.pred_axes
    if axes == "auto" and protocol.frame != "unit":
        axes = of_file
    if axes in ("auto", "frame"):
        axes = frame_axes
    transform = transform.after(rotation_between(axes, frame_axes))
    shape = transform.apply(source)
    reach = float(np.abs(positions_of(shape)).max())
    if not reach <= FAR:
        raise UserError(f"{path}: reaches {reach:.3g} times the ground truth's longest side")
    try:
        if isinstance(shape, Gaussians):
            if protocol.surface.method == "centers":
                shape = sample(shape, protocol.num_points, protocol.seed)
            else:
                surface = extract_surface(shape, protocol.surface)
                shape = Mesh(surface.vertices, surface.faces)
        return _loaded(source, shape, transform, axes, protocol)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def _loaded(
    source: Shape,
    shape: Mesh | Points,
    transform: Similarity,
    axes: str,
    protocol: GeometryProtocol,
) -> LoadedShape:
    if isinstance(shape, Points):
        return LoadedShape(source, shape, [], transform, axes, [])
    mesh, flags = clean_mesh(shape, protocol.strict)
    if isinstance(source, Mesh) and source.flat:
        flags = [flag for flag in FLAGS if flag in (*flags, "degenerate")]
    if len(mesh.faces) == 0:
        raise UserError("the mesh has no area")
    refused = [flag for flag in flags if flag in STRICT]
    if protocol.strict and isinstance(source, Mesh) and refused:
        raise UserError(f"--strict: {', '.join(refused)}")
    omitted = source.omitted if isinstance(source, Mesh) else ()
    return LoadedShape(source, mesh, flags, transform, axes, [*omitted])


def load_shape(path: Path) -> tuple[Shape, str]:
    """Read a shape, as ``formats.read.read`` does.

    Returns:
        The shape, and its file's axes, a key of ``TO_Z_UP`` or ``UNKNOWN``.

    Raises:
        UserError: as for ``read``, or coordinates are beyond ``HUGE``.
    """
    stored, axes, *_ = read(path)
    shape: Shape
    if isinstance(stored, Gaussians):
        shape = stored
    elif isinstance(stored, Cloud):
        shape = Points(*stored)
    else:
        shape = Mesh(stored.vertices, stored.faces, tuple(stored.omitted), stored.flat)
    if (reach := np.abs(positions_of(shape)).max()) > HUGE:
        raise UserError(f"{path}: coordinates reach {reach:.3g}, over {HUGE:g}")
    return shape, axes
