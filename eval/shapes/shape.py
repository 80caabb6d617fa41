"""What is evaluated, meshes and points, their motions, and the points drawn on them.

The process that only hands pairs to a child reads this module, so torch is imported by functions.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, TypeAlias, overload

import numpy as np

from gamba_warp.errors import UserError
from gamba_warp.formats.clouds import SUFFIXES as CLOUD_SUFFIXES
from gamba_warp.formats.meshes import SUFFIXES as MESH_SUFFIXES
from gamba_warp.formats.names import SPLAT_SUFFIXES
from gamba_warp.formats.parts import merged
from gamba_warp.versions import import_open3d

if TYPE_CHECKING:
    from gamba_warp.gaussians import Gaussians


SUFFIXES = tuple(dict.fromkeys((*MESH_SUFFIXES, *CLOUD_SUFFIXES, *SPLAT_SUFFIXES)))


@dataclass
class Points:
    """Points on a surface.

    Attributes:
        positions: ``[N, 3]`` float.
        normals: ``[N, 3]`` of unit length and of either sign; or None.
    """

    positions: np.ndarray
    normals: np.ndarray | None = None

    @cached_property
    def _sorted(self) -> tuple[np.ndarray, np.ndarray]:
        """The order of the points by the cells of a grid, and their places in it, float32.

        What lies near each other then lies so in memory too, which halves the time of a search.
        """
        places = self.positions.astype(np.float32)
        low, side = places.min(0), np.ptp(places, axis=0).max()
        # 32 cells a side, so that a key has 16 bits, which numpy sorts in linear time
        cells = ((places - low) / (side or 1) * 31.999).astype(np.uint16)
        order = np.argsort(cells @ np.array([1024, 32, 1], np.uint16), kind="stable")
        return order, places[order]

    @cached_property
    def _tree(self):
        search = import_open3d().core.nns.NearestNeighborSearch(self._sorted[1])
        search.knn_index()
        return search


@dataclass
class Mesh:
    """Triangles.

    Attributes:
        vertices: ``[V, 3]`` float64.
        faces: ``[F, 3]`` int64, F > 0.
        omitted: what of the file's shape is not read, one line each.
    """

    vertices: np.ndarray
    faces: np.ndarray
    omitted: tuple[str, ...] = ()

    def scene(self):
        """Returns an Open3D ``RaycastingScene`` that holds these triangles alone."""
        scene = import_open3d().t.geometry.RaycastingScene()
        scene.add_triangles(self.vertices.astype(np.float32), self.faces.astype(np.uint32))
        return scene

    def corners(self) -> np.ndarray:
        """Returns ``[F, 3, 3]``, the places of each face's three corners."""
        return self.vertices[self.faces]

    def normals(self) -> np.ndarray:
        """Returns ``[F, 3]``, each face's normal; its length is twice the area of the face."""
        corners = self.corners()
        return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

    def is_closed(self) -> bool:
        """Whether every edge has an even number of faces, after vertices at one place are merged.

        The parity of crossings then means inside and outside, whatever the faces' orientation. Of
        a mesh that is ``flags.tidied`` it is the same as having no flag "open".
        """
        faces = merged(self.vertices)[1][self.faces]
        edges = np.sort(directed_edges(faces), axis=1)
        edges = edges[edges[:, 0] != edges[:, 1]]  # without those of faces that have no area
        counts = np.unique(edges[:, 0] * len(self.vertices) + edges[:, 1], return_counts=True)[1]
        return bool((counts % 2 == 0).all())


Shape: TypeAlias = "Mesh | Points | Gaussians"


def directed_edges(faces: np.ndarray) -> np.ndarray:
    """``[3 F, 2]`` edges of ``[F, 3]`` faces, in the direction in which each face runs along it."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


@dataclass
class Similarity:
    """The motion ``x -> scale · rotation · x + translation``.

    Attributes:
        rotation: ``[3, 3]`` float64, proper; of a truth that was rendered stretched or mirrored,
            what that was, too.
        translation: ``[3]`` float64.
        scale: > 0.
    """

    rotation: np.ndarray
    translation: np.ndarray
    scale: float = 1.0

    def points(self, x: np.ndarray) -> np.ndarray:
        """Moves ``[N, 3]``."""
        return self.scale * x @ self.rotation.T + self.translation

    @overload
    def apply(self, shape: Mesh) -> Mesh: ...
    @overload
    def apply(self, shape: Points) -> Points: ...
    @overload
    def apply(self, shape: Gaussians) -> Gaussians: ...
    def apply(self, shape: Shape) -> Shape:
        """Moves a shape of any kind."""
        if isinstance(shape, Mesh):
            return Mesh(self.points(shape.vertices), shape.faces)
        if isinstance(shape, Points):
            normals = shape.normals
            if normals is not None:
                normals = normals @ np.linalg.inv(self.rotation)  # the transpose of a rotation
                normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
            return Points(self.points(shape.positions), normals)
        import torch

        rotation, translation = (
            torch.from_numpy(v).to(shape.means) for v in (self.rotation, self.translation)
        )
        return shape.transformed(rotation, translation, self.scale)

    def after(self, turn: np.ndarray) -> Similarity:
        """This motion after a rotation ``[3, 3]`` about the origin."""
        return Similarity(self.rotation @ turn, self.translation, self.scale)

    def of(self, first: Similarity) -> Similarity:
        """This motion after another one."""
        moved = self.points(first.translation[None])[0]
        return Similarity(self.rotation @ first.rotation, moved, self.scale * first.scale)

    def record(self) -> dict:
        """Returns the motion for a report: ``scale, rotation, translation`` as plain numbers."""
        return {
            "scale": float(self.scale),
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
        }


def sample(shape: Mesh | Points, count: int, seed: int) -> Points:
    """Draws points on a shape: uniformly by area on a mesh, at most ``count`` from a cloud.

    Args:
        shape: a mesh or a cloud; a cloud of no more than ``count`` points comes back as it is.
        count: number of points.
        seed: of the draw.

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
    has_area = np.linalg.norm(shape.normals(), axis=1) > 0
    if not has_area.any():
        raise UserError("the mesh has no area")
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(shape.vertices),
        o3d.utility.Vector3iVector(shape.faces[has_area].astype(np.int32)),
    )
    o3d.utility.random.seed(seed)
    cloud = mesh.sample_points_uniformly(count, use_triangle_normal=True)
    return Points(np.asarray(cloud.points), np.asarray(cloud.normals))


def nearest(queries: Points, points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Finds the nearest of M points to each of N queries, in float32.

    Both are sorted, and the points' tree is built, when they are first used so, and kept.

    Returns:
        Distances ``[N]`` float32 and indices ``[N]``.
    """
    order, places = queries._sorted
    found, squared = points._tree.knn_search(places, 1)
    distances, indices = np.empty(len(order), np.float32), np.empty(len(order), np.int64)
    distances[order] = np.sqrt(squared.numpy()[:, 0])
    indices[order] = points._sorted[0][found.numpy()[:, 0]]
    return distances, indices


def halves(points: Points, count: int, seed: int) -> tuple[Points, Points]:
    """Draws two parts of a cloud that share no point, each of at most ``count`` points.

    Args:
        points: at least two points.
        count: at least one.
        seed: of the draw.

    Returns:
        Two clouds of one size, without normals.
    """
    order = np.random.default_rng(seed).permutation(len(points.positions))
    size = min(count, len(order) // 2)
    return Points(points.positions[order[:size]]), Points(points.positions[order[-size:]])


def visible_points(
    mesh: Mesh, viewmats: np.ndarray, K: np.ndarray, size: int, voxel: float
) -> Points:
    """Points of depth maps as SyncDreamer's script takes them, one mean point in each voxel.

    Depth is interpolated between the corners as they lie in the picture, not in space, and what
    is seen at a pixel's centre is put on the ray through its upper left corner. Neither is exact;
    with large faces it moves points by hundredths, and without it the figures are others.

    Args:
        mesh: what the cameras see.
        viewmats: ``[V, 4, 4]`` world to camera, OpenCV.
        K: ``[3, 3]`` intrinsics in pixels, of every camera.
        size: side of the square depth maps, pixels.
        voxel: side of a voxel, object units.

    Returns:
        Points without normals.

    Raises:
        UserError: no camera sees the mesh.
    """
    o3d = import_open3d()
    corners = np.stack(np.meshgrid(np.arange(size), np.arange(size)), -1).reshape(-1, 2)
    rays = np.zeros((size * size, 6), np.float32)
    rays[:, :2], rays[:, 5] = corners + 0.5, 1  # along the depth, in pixels
    seen = []
    for viewmat in viewmats.astype(np.float64):
        there = mesh.vertices @ viewmat[:3, :3].T + viewmat[:3, 3]
        pixels = there @ K.T
        flat = Mesh(np.column_stack([pixels[:, :2] / pixels[:, 2:], there[:, 2]]), mesh.faces)
        depth = flat.scene().cast_rays(rays)["t_hit"].numpy().astype(np.float64)
        hit = np.isfinite(depth)
        places = np.column_stack([corners[hit], np.ones(hit.sum())]) * depth[hit][:, None]
        seen.append((places @ np.linalg.inv(K).T - viewmat[:3, 3]) @ viewmat[:3, :3])
    points = np.concatenate(seen).astype(np.float32)
    if len(points) == 0:
        raise UserError("no camera sees the mesh")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    return Points(np.asarray(cloud.voxel_down_sample(voxel).points))
