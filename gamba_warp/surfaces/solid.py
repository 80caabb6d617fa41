"""Closed surface of a solid, from a mesh that may have holes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import UserError
from ..versions import import_open3d

if TYPE_CHECKING:
    from manifold3d import Manifold

_VOTES = 15  # rays of each point; odd
_MARGIN = 2  # grid points around the object
_CHUNK = 1 << 20  # points asked at once
_FRACTION = 0.01  # of the volume; smaller parts vanish
_TOUCHING = 1e-5  # voxels
_LEAST = 1e-3  # voxels that a grid point is at least off the surface: on it, corners would coincide
_EMPTY = "the surface encloses nothing: it has no solid"


def solid_of(
    vertices: np.ndarray, faces: np.ndarray, voxels: int, max_faces: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Return the closed surface of what a mesh encloses, as the level set of its signed distance.

    A point is inside if most rays from it cross the mesh an odd number of times, so that holes do
    not count; cavities without a way out are filled. Parts thinner than a voxel vanish, and so do
    parts under a hundredth of the volume.

    Args:
        vertices: ``[V, 3]``, an object about the origin with a longest side of about 1.
        faces: ``[F, 3]``, outside in front.
        voxels: number of grid points per unit.
        max_faces: target of the decimation; 0: none.

    Returns:
        Vertices ``[W, 3]`` float64, and faces ``[G, 3]`` int64 of a manifold, outside in front.

    Raises:
        UserError: the mesh encloses nothing.
    """
    from manifold3d import Manifold
    from manifold3d import Mesh as Triangles
    from scipy.ndimage import binary_dilation, binary_erosion, binary_fill_holes, median_filter
    from skimage.measure import marching_cubes

    first = np.floor(vertices.min(0) * voxels).astype(int) - _MARGIN
    shape = np.ceil(vertices.max(0) * voxels).astype(int) + _MARGIN + 1 - first
    points = ((np.indices(shape).reshape(3, -1).T + first) / voxels).astype(np.float32)
    scene = _scene(vertices, faces)
    parts = [points[at : at + _CHUNK] for at in range(0, len(points), _CHUNK)]
    votes = np.concatenate([_votes(scene, part) for part in parts])
    # Near a hole the votes are noisy: the median closes tunnels of a voxel.
    inside = median_filter(2 * votes.reshape(shape) > _VOTES, 3)
    filled = np.asarray(binary_fill_holes(inside))
    if not filled.any():
        raise UserError(_EMPTY)
    # Only points near the surface need their distance; the walls of a filled cavity do not count.
    depth = np.where(filled, 1.0, -1.0)
    inner = np.asarray(binary_erosion(filled, iterations=5), bool)
    beside = binary_dilation(filled, iterations=5) & ~inner & (inside | ~filled)
    distance = scene.compute_distance(points[beside.ravel()]).numpy() * voxels
    depth[beside] *= np.maximum(distance, _LEAST)
    corners, triangles, _, _ = marching_cubes(depth, 0.0, gradient_direction="ascent")
    solid = Manifold(Triangles(corners.astype(np.float32), triangles.astype(np.uint32)))
    large = [part for part in solid.decompose() if part.volume() > _FRACTION * solid.volume()]
    if not large:
        raise UserError(_EMPTY)
    corners, triangles = _decimated(Manifold.compose(large), max_faces)
    return (corners + first) / voxels, triangles


def _votes(scene, points: np.ndarray) -> np.ndarray:
    """Return the number ``[P]`` of rays from points ``[P, 3]`` that cross a mesh an odd number
    of times, of ``_VOTES`` rays in fixed directions.
    """
    votes = np.zeros(len(points), int)
    for direction in np.random.default_rng(0).normal(size=(_VOTES, 3)):
        rays = np.concatenate([points, np.broadcast_to(direction, points.shape)], 1)
        votes += scene.count_intersections(rays.astype(np.float32)).numpy() % 2
    return votes


def _decimated(solid: Manifold, max_faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of a manifold, at most ``max_faces`` unless that is 0."""
    from manifold3d import Manifold
    from manifold3d import Mesh as Triangles
    from pymeshlab import Mesh, MeshSet  # pyright: ignore[reportAttributeAccessIssue]

    if 0 < max_faces < solid.num_tri():
        mesh, meshes = solid.to_mesh(), MeshSet()
        vertices = mesh.vert_properties[:, :3].astype(np.float64)
        meshes.add_mesh(Mesh(vertices, mesh.tri_verts.astype(np.int32)))
        meshes.meshing_decimation_quadric_edge_collapse(
            targetfacenum=max_faces, preservenormal=True, preservetopology=True
        )
        meshes.meshing_remove_unreferenced_vertices()
        decimated = meshes.current_mesh()
        corners = decimated.vertex_matrix().astype(np.float32)
        # Edges where two sheets touch have four faces; they are split.
        split = Manifold(Triangles(corners, decimated.face_matrix().astype(np.uint32)))
        solid = split.simplify(_TOUCHING)
    mesh = solid.to_mesh()
    return mesh.vert_properties[:, :3].astype(np.float64), mesh.tri_verts.astype(np.int64)


def distances(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the distance ``[P]`` of points ``[P, 3]`` from a mesh."""
    return _scene(vertices, faces).compute_distance(points.astype(np.float32)).numpy()


def _scene(vertices: np.ndarray, faces: np.ndarray):
    """Return Open3D's scene of a mesh."""
    o3d = import_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(vertices.astype(np.float32), faces.astype(np.uint32))
    return scene
