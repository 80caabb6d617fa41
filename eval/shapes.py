"""Shapes under evaluation: meshes and points, how they are read, moved and sampled."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from gamba_warp.errors import UserError
from gamba_warp.gaussians import Gaussians
from gamba_warp.meshes import SUFFIXES as MESH_SUFFIXES
from gamba_warp.meshes import load_mesh
from gamba_warp.open3d import import_open3d
from gamba_warp.ply import load_ply

from .headers import check_counts, ply_elements, ply_header
from .metrics import Points

CLOUD_SUFFIXES = (".xyz", ".pcd", ".pts")
HUGE = 1e18  # the squares of larger coordinates overflow float32
SUFFIXES = (*MESH_SUFFIXES, *CLOUD_SUFFIXES)


@dataclass
class Mesh:
    """Triangles.

    Attributes:
        vertices: ``[V, 3]`` float64.
        faces: ``[F, 3]`` int64, F > 0.
    """

    vertices: np.ndarray
    faces: np.ndarray

    def scene(self):
        """An Open3D ``RaycastingScene`` of these triangles alone."""
        scene = import_open3d().t.geometry.RaycastingScene()
        scene.add_triangles(self.vertices.astype(np.float32), self.faces.astype(np.uint32))
        return scene

    def is_closed(self) -> bool:
        """Whether every edge has an even number of faces, after vertices at one place are merged.

        The parity of crossings then means inside and outside, whatever the faces' orientation.
        """
        faces = merged(self.vertices)[1][self.faces]
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        edges = edges[edges[:, 0] != edges[:, 1]]  # of faces without area
        counts = np.unique(edges[:, 0] * len(self.vertices) + edges[:, 1], return_counts=True)[1]
        return bool((counts % 2 == 0).all())


Shape = Mesh | Points | Gaussians


def merged(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct rows of ``[V, 3]`` and ``[V]`` the index of each row among them."""
    rows = np.ascontiguousarray(vertices, np.float64) + 0.0  # one zero, not two
    _, first, index = np.unique(
        rows.view([("", rows.dtype)] * 3)[:, 0], return_index=True, return_inverse=True
    )
    return rows[first], index.reshape(-1)


@dataclass
class Similarity:
    """The motion ``x -> scale · rotation · x + translation``.

    Attributes:
        rotation: ``[3, 3]`` float64, proper.
        translation: ``[3]`` float64.
        scale: > 0.
    """

    rotation: np.ndarray
    translation: np.ndarray
    scale: float = 1.0

    def points(self, x: np.ndarray) -> np.ndarray:
        """Moves ``[N, 3]``."""
        return self.scale * x @ self.rotation.T + self.translation

    def apply(self, shape: Shape) -> Shape:
        """Moves a shape of any kind."""
        if isinstance(shape, Mesh):
            return Mesh(self.points(shape.vertices), shape.faces)
        if isinstance(shape, Points):
            normals = None if shape.normals is None else shape.normals @ self.rotation.T
            return Points(self.points(shape.positions), normals)
        rotation, translation = (
            torch.from_numpy(v).to(shape.means) for v in (self.rotation, self.translation)
        )
        return shape.transformed(rotation, translation, self.scale)

    def record(self) -> dict:
        """For a report."""
        return {
            "scale": float(self.scale),
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
        }


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


def sample(shape: Mesh | Points, count: int, seed: int) -> Points:
    """Points on a shape: area-uniform on a mesh; of a cloud, ``count`` at most, drawn at random.

    Raises:
        UserError: the mesh has no area.
    """
    if isinstance(shape, Points):
        if len(shape.positions) <= count:
            return shape
        keep = np.random.default_rng(seed).choice(len(shape.positions), count, replace=False)
        normals = None if shape.normals is None else shape.normals[keep]
        return Points(shape.positions[keep], normals)
    o3d = import_open3d()
    corners = shape.vertices[shape.faces]
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    solid = np.linalg.norm(sides, axis=1) > 0
    if not solid.any():
        raise UserError("the mesh has no area")
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(shape.vertices),
        o3d.utility.Vector3iVector(shape.faces[solid].astype(np.int32)),
    )
    o3d.utility.random.seed(seed)
    cloud = mesh.sample_points_uniformly(count, use_triangle_normal=True)
    return Points(np.asarray(cloud.points), np.asarray(cloud.normals))


def halves(points: Points, count: int, seed: int) -> tuple[Points, Points]:
    """Two random parts of a cloud without a common point, ``count`` points each at most.

    Args:
        points: at least two.
        count: at least one.
        seed: of the draw.
    """
    order = np.random.default_rng(seed).permutation(len(points.positions))
    size = min(count, len(order) // 2)
    return tuple(Points(points.positions[part]) for part in (order[:size], order[-size:]))


def visible_points(
    mesh: Mesh, viewmats: np.ndarray, K: np.ndarray, size: int, voxel: float
) -> Points:
    """Back-projected depth maps of a mesh, thinned to one mean point a voxel; without normals.

    Args:
        mesh: what is seen.
        viewmats: ``[V, 4, 4]`` world to camera, OpenCV.
        K: ``[3, 3]`` pixels.
        size: side of the square pictures.
        voxel: its side, object units.

    Raises:
        UserError: no camera sees the mesh.
    """
    o3d = import_open3d()
    scene = mesh.scene()
    seen = []
    for viewmat in viewmats.astype(np.float64):
        rays = scene.create_rays_pinhole(K.astype(np.float64), viewmat, size, size)
        depth = scene.cast_rays(rays)["t_hit"].numpy()
        rays, hit = rays.numpy(), np.isfinite(depth)
        seen.append(rays[hit][:, :3] + depth[hit][:, None] * rays[hit][:, 3:])
    points = np.concatenate(seen)
    if len(points) == 0:
        raise UserError("no camera sees the mesh")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    return Points(np.asarray(cloud.voxel_down_sample(voxel).points))
