"""A file to what is evaluated: its header checked, read, moved, Gaussians made a surface."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gamba_warp.errors import UserError
from gamba_warp.formats.headers import check_counts, ply_elements, ply_header
from gamba_warp.formats.meshes import SUFFIXES as MESH_SUFFIXES
from gamba_warp.formats.meshes import Y_TO_Z_UP, default_up, load_mesh
from gamba_warp.formats.ply import load_ply
from gamba_warp.gaussians import Gaussians
from gamba_warp.open3d import import_open3d
from gamba_warp.surfaces.extract import SurfaceOptions, extract_surface

from .flags import STRICT, tidied
from .protocol import GeometryProtocol
from .shape import Mesh, Points, Shape, Similarity

FAR = 1e6  # units of the truth's longest side; farther out float32 holds nothing of a shape
KINDS = {Gaussians: "gaussians", Mesh: "mesh", Points: "points"}


@dataclass
class Evaluated:
    """A shape as it is compared.

    Attributes:
        shape: in the truth's unit frame.
        kind: of the file: "gaussians", "mesh" or "points".
        flags: of the mesh (for Gaussians: of their surface), names from ``flags.FLAGS``.
    """

    shape: Mesh | Points
    kind: str
    flags: list[str]

    def closed(self) -> bool | None:
        """Whether it bounds a volume; None for points."""
        return "open" not in self.flags if isinstance(self.shape, Mesh) else None


def unit_motion(shape: Mesh | Points, up: str) -> Similarity:
    """To z-up, centred on the bounding box, longest side 1.

    Args:
        shape: at least two places.
        up: the axis that points up, "y" or "z".

    Raises:
        UserError: it has no extent, or is so far from the origin that its numbers cannot hold it.
    """
    turn = Y_TO_Z_UP if up == "y" else np.eye(3)
    points = (shape.vertices if isinstance(shape, Mesh) else shape.positions) @ turn.T
    low, high = points.min(0), points.max(0)
    extent = (high - low).max()
    if extent <= 1e-10 * max(abs(low).max(), abs(high).max()):
        raise UserError("all its points are one, or too near to each other to tell apart")
    return Similarity(turn, -(low + high) / 2 / extent, 1 / extent)


def load_truth(path: Path, protocol: GeometryProtocol) -> tuple[Evaluated, Similarity]:
    """A true mesh or cloud in its unit frame, and the motion that brought it there.

    Raises:
        UserError: it cannot be read, is made of Gaussians, or has no extent.
    """
    shape = load_shape(path)
    if isinstance(shape, Gaussians):
        raise UserError(f"{path}: Gaussians, the truth must be a mesh or a point cloud")
    try:
        motion = unit_motion(shape, default_up(path) if protocol.up == "auto" else protocol.up)
        return _evaluated(motion.apply(shape), KINDS[type(shape)], protocol), motion
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def load_prediction(path: Path, motion: Similarity, protocol: GeometryProtocol) -> Evaluated:
    """A predicted shape, moved, its Gaussians turned into a surface.

    Args:
        path: file.
        motion: into the truth's unit frame.
        protocol: how Gaussians become a surface.

    Raises:
        UserError: it cannot be read, has no surface, or lies far away.
    """
    shape = motion.apply(load_shape(path))
    kind = KINDS[type(shape)]
    reach = _reach(shape)
    if not reach <= FAR:
        raise UserError(f"{path}: reaches {reach:.3g} times the truth's longest side")
    try:
        if isinstance(shape, Gaussians):
            shape = to_surface(shape, protocol.surface, protocol.seed, protocol.num_points)
        return _evaluated(shape, kind, protocol)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def _reach(shape: Shape) -> float:
    if isinstance(shape, Gaussians):
        return float(shape.means.abs().max())
    return float(np.abs(shape.vertices if isinstance(shape, Mesh) else shape.positions).max())


def _evaluated(shape: Mesh | Points, kind: str, protocol: GeometryProtocol) -> Evaluated:
    if isinstance(shape, Points):
        return Evaluated(shape, kind, [])
    shape, flags = tidied(shape)
    if len(shape.faces) == 0:
        raise UserError("the mesh has no area")
    refused = [flag for flag in flags if flag in STRICT]
    if protocol.strict and kind == "mesh" and refused:
        raise UserError(f"--strict: {', '.join(refused)}")
    return Evaluated(shape, kind, flags)


CLOUD_SUFFIXES = (".xyz", ".pcd", ".pts")
HUGE = 1e18  # the squares of larger coordinates overflow float32
SUFFIXES = (*MESH_SUFFIXES, *CLOUD_SUFFIXES)


def _ply_kind(path: Path) -> str:
    """What a ``.ply`` holds, by its header: "gaussians", "mesh" or "points"."""
    with open(path, "rb") as file:
        elements = ply_elements(path, ply_header(path, file)[0])
    if any(name == "face" and count for name, count, _ in elements):
        return "mesh"
    properties = {words[-1] for _, _, rows in elements for words in rows}
    # one is enough, so that a file that lacks the others is not taken for a point cloud
    return "gaussians" if {"opacity", "scale_0", "rot_0", "f_dc_0"} & properties else "points"


def load_shape(path: Path) -> Shape:
    """Reads Gaussians (3DGS ``.ply``), a mesh, or a point cloud, by what the file holds.

    Raises:
        UserError: missing, unreadable, empty, untrue about its counts, or with values that are not
            finite or beyond ``HUGE``.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise UserError(f"{path}: not one of {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    if path.stat().st_size == 0:
        raise UserError(f"{path}: the file is empty")
    check_counts(path)
    kind = _ply_kind(path) if suffix == ".ply" else "mesh"
    if kind == "gaussians":
        shape, positions = (gaussians := load_ply(path)), gaussians.means.numpy()
    elif kind == "points" or suffix in CLOUD_SUFFIXES:
        shape, positions = (points := _load_points(path)), points.positions
    else:
        shape = _load_triangles(path)
        positions = shape.vertices
    if np.abs(positions).max() > HUGE:
        raise UserError(f"{path}: coordinates reach {np.abs(positions).max():.3g}, over {HUGE:g}")
    return shape


def _load_triangles(path: Path) -> Mesh:
    try:
        mesh = load_mesh(path)
    except UserError as error:
        mixed = path.suffix.lower() == ".ply" and "cannot be read" in str(error)
        if not mixed:  # trimesh reads no binary .ply whose faces differ in their corners
            raise
        import pymeshlab

        meshes = pymeshlab.MeshSet()
        try:
            meshes.load_new_mesh(str(path))
        except pymeshlab.PyMeshLabException:
            raise error from None
        read = meshes.current_mesh()
        mesh = Mesh(read.vertex_matrix(), read.face_matrix().astype(np.int64))
        if len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
            raise
    return Mesh(mesh.vertices, mesh.faces)


def _load_points(path: Path) -> Points:
    o3d = import_open3d()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.io.read_point_cloud(str(path))
    positions = np.asarray(cloud.points)
    if len(positions) == 0:
        raise UserError(f"{path}: no points in it, or it cannot be read")
    bad = np.count_nonzero(~np.isfinite(positions).all(1))
    if bad:
        raise UserError(f"{path}: {bad} of {len(positions)} points are not finite")
    normals = np.asarray(cloud.normals)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    usable = len(normals) == len(positions) and np.isfinite(lengths).all() and lengths.all()
    return Points(positions, normals / lengths if usable else None)


def to_surface(
    gaussians: Gaussians, options: SurfaceOptions, seed: int, count: int
) -> Mesh | Points:
    """One object's Gaussians to a ``Mesh``, or to ``count`` ``Points`` for the method centers.

    Raises:
        UserError: there is no surface.
    """
    if options.method == "centers":
        return centers(gaussians, count, seed)
    surface = extract_surface(gaussians, options)
    return Mesh(surface.vertices, surface.faces)


def centers(gaussians: Gaussians, count: int, seed: int) -> Points:
    """Centres drawn with a chance proportional to opacity, ``count`` times, with repetition.

    Raises:
        UserError: no Gaussian has any opacity.
    """
    weights = gaussians.opacities.double().cpu().numpy()
    if weights.sum() <= 0:
        raise UserError("no Gaussian has any opacity")
    chosen = np.random.default_rng(seed).choice(len(weights), count, p=weights / weights.sum())
    return Points(gaussians.means.double().cpu().numpy()[chosen])
