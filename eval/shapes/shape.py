"""Meshes and point clouds, their transforms, sampling and nearest points.

The parent process, which only passes pairs to children, imports this module, so functions import
torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, TypeAlias, overload

import numpy as np

from gamba_warp.errors import UserError
from gamba_warp.formats.parts import merged
from gamba_warp.versions import import_open3d

if TYPE_CHECKING:
    from gamba_warp.gaussians import Gaussians


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
        """Order of the points by the cells of a grid, and the sorted positions in float32.

        Neighbours are then close in memory, which halves the time of a search.
        """
        positions = self.positions.astype(np.float32)
        low, side = positions.min(0), np.ptp(positions, axis=0).max()
        # 32 cells per side, so that keys have 16 bits, which numpy sorts in linear time.
        cells = ((positions - low) / (side or 1) * 31.999).astype(np.uint16)
        order = np.argsort(cells @ np.array([1024, 32, 1], np.uint16), kind="stable")
        return order, positions[order]

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
        omitted: parts of the file that are not read, one line each.
        flat: number of the file's faces without area, which are left out.
    """

    vertices: np.ndarray
    faces: np.ndarray
    omitted: tuple[str, ...] = ()
    flat: int = 0

    def scene(self):
        """Return an Open3D ``RaycastingScene`` of these triangles."""
        scene = import_open3d().t.geometry.RaycastingScene()
        scene.add_triangles(self.vertices.astype(np.float32), self.faces.astype(np.uint32))
        return scene

    def corners(self) -> np.ndarray:
        """Return ``[F, 3, 3]``, the positions of each face's corners."""
        return self.vertices[self.faces]

    def normals(self) -> np.ndarray:
        """Return ``[F, 3]``, each face's normal, twice as long as the face's area."""
        corners = self.corners()
        return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

    def is_closed(self) -> bool:
        """Return True if every edge has an even number of faces, after merging equal vertices.

        The parity of crossings then separates inside and outside, for any orientation of the faces.
        For a mesh of ``flags.clean_mesh`` it means the absence of the flag "open".
        """
        edges, edge, counts = edges_of(merged(self.vertices)[1][self.faces])
        real = edges[:, 0] != edges[:, 1]  # without degenerate faces' edges
        return bool((counts[edge[real]] % 2 == 0).all())


Shape: TypeAlias = "Mesh | Points | Gaussians"


def directed_edges(faces: np.ndarray) -> np.ndarray:
    """Return edges ``[3 F, 2]`` of faces ``[F, 3]``, in each face's direction."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def edges_of(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the undirected edges of faces ``[F, 3]``.

    Returns:
        Corners ``[3 F, 2]``, the smaller index first; index ``[3 F]`` of each among the E different
        edges; number of faces ``[E]`` of these.
    """
    edges = np.sort(directed_edges(faces), axis=1)
    keys = edges[:, 0] * (faces.max(initial=0) + 1) + edges[:, 1]
    _, index, counts = np.unique(keys, return_inverse=True, return_counts=True)
    return edges, index.reshape(-1), counts


@dataclass
class Similarity:
    """Motion ``x -> scale · rotation · x + translation``.

    Attributes:
        rotation: ``[3, 3]`` float64, proper; for a ground truth that was rendered stretched or
            mirrored it includes that.
        translation: ``[3]`` float64.
        scale: > 0.
    """

    rotation: np.ndarray
    translation: np.ndarray
    scale: float = 1.0

    def points(self, x: np.ndarray) -> np.ndarray:
        """Move points ``[N, 3]``."""
        return self.scale * x @ self.rotation.T + self.translation

    @overload
    def apply(self, shape: Mesh) -> Mesh: ...
    @overload
    def apply(self, shape: Points) -> Points: ...
    @overload
    def apply(self, shape: Gaussians) -> Gaussians: ...
    def apply(self, shape: Shape) -> Shape:
        """Move a shape of any kind."""
        if isinstance(shape, Mesh):
            return Mesh(self.points(shape.vertices), shape.faces)
        if isinstance(shape, Points):
            normals = shape.normals
            if normals is not None:
                normals = normals @ np.linalg.inv(self.rotation)  # transpose of a rotation
                normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
            return Points(self.points(shape.positions), normals)
        import torch

        rotation, translation = (
            torch.from_numpy(v).to(shape.means) for v in (self.rotation, self.translation)
        )
        return shape.transformed(rotation, translation, self.scale)

    def after(self, turn: np.ndarray) -> Similarity:
        """Return this transform after a rotation ``[3, 3]`` about the origin."""
        return Similarity(self.rotation @ turn, self.translation, self.scale)

    def of(self, first: Similarity) -> Similarity:
        """Return this transform after another one."""
        moved = self.points(first.translation[None])[0]
        return Similarity(self.rotation @ first.rotation, moved, self.scale * first.scale)

    def record(self) -> dict:
        """Return the transform for a report: ``scale, rotation, translation`` as plain numbers."""
        return {
            "scale": float(self.scale),
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
        }


def positions_of(shape: Shape) -> np.ndarray:
    """Return the vertices, points, or centres of Gaussians, ``[N, 3]``."""
    if isinstance(shape, Mesh):
        return shape.vertices
    return shape.positions if isinstance(shape, Points) else shape.means.numpy()


def unit_transform(shape: Mesh | Points, turn: np.ndarray) -> Similarity:
    """Return the transform that rotates a shape, centres it, and makes its longest side 1.

    Args:
        shape: at least two distinct points.
        turn: rotation ``[3, 3]`` to z-up.

    Raises:
        UserError: the extent is zero, or lost to rounding far from the origin.
    """
    points = positions_of(shape) @ turn.T
    low, high = points.min(0), points.max(0)
    extent = (high - low).max()
    if extent <= 1e-10 * max(abs(low).max(), abs(high).max()):
        raise UserError("all its points coincide, or are too close to tell apart")
    return Similarity(turn, -(low + high) / 2 / extent, 1 / extent)


def sample(shape: Shape, count: int, seed: int) -> Points:
    """Sample points of a shape.

    Those of a mesh are uniform by area, those of a cloud at most ``count`` of it, and those of
    Gaussians centres, drawn with replacement and with probability proportional to opacity.

    Args:
        shape: of any kind; a cloud of at most ``count`` points is returned unchanged.
        count: number of points.
        seed: of the draw.

    Raises:
        UserError: the mesh has no area, or all Gaussians are fully transparent.
    """
    rng = np.random.default_rng(seed)
    if isinstance(shape, Points):
        if len(shape.positions) <= count:
            return shape
        keep = rng.choice(len(shape.positions), count, replace=False)
        normals = None if shape.normals is None else shape.normals[keep]
        return Points(shape.positions[keep], normals)
    if not isinstance(shape, Mesh):
        weights = shape.opacities.double().cpu().numpy()
        if weights.sum() <= 0:
            raise UserError("all Gaussians are fully transparent")
        chosen = rng.choice(len(weights), count, p=weights / weights.sum())
        return Points(shape.means.double().cpu().numpy()[chosen])
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
    """Find the nearest of M points to each of N queries, in float32.

    The sorted arrays and the points' tree are built at the first use, and cached.

    Returns:
        Distances ``[N]`` float32 and indices ``[N]``.
    """
    order, positions = queries._sorted
    ranks, squared = points._tree.knn_search(positions, 1)
    distances, indices = np.empty(len(order), np.float32), np.empty(len(order), np.int64)
    distances[order] = np.sqrt(squared.numpy()[:, 0])
    indices[order] = points._sorted[0][ranks.numpy()[:, 0]]
    return distances, indices


def halves(points: Points, count: int, seed: int) -> tuple[Points, Points]:
    """Draw two disjoint parts of a cloud, each of at most ``count`` points.

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
    """Back-project depth maps like SyncDreamer's script, with one mean point per voxel.

    As there, depth is interpolated linearly in the image, not in space, and the depth of a
    pixel's centre is put on the ray through its upper left corner. Neither is exact: with large
    faces points move by hundredths. But exact points would change the figures.

    Args:
        mesh: visible to the cameras.
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
    visible = []
    for viewmat in viewmats.astype(np.float64):
        camera = mesh.vertices @ viewmat[:3, :3].T + viewmat[:3, 3]
        pixels = camera @ K.T
        flat = Mesh(np.column_stack([pixels[:, :2] / pixels[:, 2:], camera[:, 2]]), mesh.faces)
        depth = flat.scene().cast_rays(rays)["t_hit"].numpy().astype(np.float64)
        hit = np.isfinite(depth)
        scaled = np.column_stack([corners[hit], np.ones(hit.sum())]) * depth[hit][:, None]
        visible.append((scaled @ np.linalg.inv(K).T - viewmat[:3, 3]) @ viewmat[:3, :3])
    points = np.concatenate(visible).astype(np.float32)
    if len(points) == 0:
        raise UserError("no camera sees the mesh")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    return Points(np.asarray(cloud.voxel_down_sample(voxel).points))
