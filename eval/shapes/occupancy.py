"""Voxels filled by a mesh, by several rules, also for open meshes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np

from gamba_warp.formats.parts import merged

from .options import OccupancyRule
from .shape import Mesh, edges_of

VOTERS = 26  # rays per point
RAYS = 1 << 12  # of one call, while the points are fewer


@dataclass
class Grid:
    """Regular grid of points.

    Attributes:
        origin: ``[3]``, the first point.
        step: distance of neighbours.
        shape: numbers of points along x, y and z.
    """

    origin: np.ndarray
    step: float
    shape: tuple[int, int, int]

    def points(self) -> np.ndarray:
        """Return the points ``[X, Y, Z, 3]`` float32."""
        axes = [self.origin[k] + self.step * np.arange(self.shape[k]) for k in range(3)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1).astype(np.float32)


def grid_around(*meshes: Mesh, resolution: int) -> Grid:
    """Return the voxel centres around several meshes, with one empty voxel on each side.

    Voxel faces are at multiples of their side, so the grid is the same for all meshes within a cube
    of side 2; for larger ones the voxels grow.

    Args:
        meshes: at least one.
        resolution: number of voxels per unit of length.
    """
    low = np.min([mesh.vertices.min(0) for mesh in meshes], axis=0)
    high = np.max([mesh.vertices.max(0) for mesh in meshes], axis=0)
    step = max(1.0, (high - low).max() / 2) / resolution
    first = np.floor(low / step).astype(int) - 1
    last = np.ceil(high / step).astype(int) + 1
    x, y, z = (int(n) for n in last - first)
    return Grid((first + 0.5) * step, step, (x, y, z))


def syncdreamer_grid(size: int = 64) -> Grid:
    """Return the lattice of mesh2sdf: ``size`` points per side from -1 in steps of 2 / size."""
    return Grid(np.full(3, -1.0), 2.0 / size, (size, size, size))


def solid(mesh: Mesh, grid: Grid) -> np.ndarray:
    """Occupancy ``[X, Y, Z]`` bool; the grid's border must be outside. See ``RULES``."""
    inside = enclosed(mesh, grid)
    if mesh.is_closed():
        return inside
    parts = open_parts(mesh)
    points = grid.points()
    _add_majority(inside, mesh, points)
    if len(parts) > 1 or len(parts[0].faces) < len(mesh.faces):
        # More than half of the rays can cross a part only within its box.
        for part in parts:
            low, high = part.vertices.min(0), part.vertices.max(0)
            first = np.maximum(np.ceil((low - grid.origin) / grid.step).astype(int), 0)
            last = np.floor((high - grid.origin) / grid.step).astype(int) + 1
            if (last > first).all() and not _is_flat(part):
                box = tuple(slice(i, j) for i, j in zip(first, last))
                _add_majority(inside[box], part, points[box])
    return inside


def joint(mesh: Mesh, grid: Grid) -> np.ndarray:
    """Occupancy ``[X, Y, Z]`` bool; the grid's border must be outside. See ``RULES``."""
    inside = enclosed(mesh, grid)
    if not mesh.is_closed():
        _add_majority(inside, mesh, grid.points())
    return inside


def majority(mesh: Mesh, grid: Grid) -> np.ndarray:
    """Occupancy ``[X, Y, Z]`` bool. See ``RULES``."""
    inside = np.zeros(grid.shape, bool)
    _add_majority(inside, mesh, grid.points())
    return inside


def parity(mesh: Mesh, grid: Grid) -> np.ndarray:
    """Compute occupancy ``[X, Y, Z]`` bool like mesh2sdf without its repair. See ``RULES``.

    Rays follow the grid's lines. A ray that meets an edge is treated as shifted infinitesimally
    along y and by less along z, so that it meets exactly one of the faces. Points on the surface
    are outside; in mesh2sdf rounding decides.
    """
    corners = (mesh.vertices.astype(np.float32).astype(np.float64) - grid.origin) / grid.step
    corners = corners[mesh.faces]
    first = np.ceil(corners[..., 1:].min(1)).clip(0).astype(int)
    last = np.floor(corners[..., 1:].max(1)).astype(int)
    count = (np.minimum(last, np.array(grid.shape[1:]) - 1) - first + 1).clip(0)
    face = np.repeat(np.arange(len(corners)), count.prod(1))  # once per line in its box
    within = np.arange(len(face)) - np.repeat(count.prod(1).cumsum() - count.prod(1), count.prod(1))
    line = first[face] + np.stack(np.divmod(within, count[face, 1]), -1)
    (y, z), x = (corners[face, :, 1:] - line[:, None]).transpose(2, 0, 1), corners[face, :, 0]
    after, later = [1, 2, 0], [2, 0, 1]
    areas = z[:, after] * y[:, later] - y[:, after] * z[:, later]
    ties = np.sign(z[:, later] - z[:, after]) * 2 + np.sign(y[:, after] - y[:, later])
    sides = np.sign(np.where(areas != 0, areas, ties))
    hit = (np.abs(sides.sum(1)) == 3) & (areas.sum(1) != 0)
    at = np.ceil((areas[hit] * x[hit]).sum(1) / areas[hit].sum(1)).clip(0).astype(int)
    line, known = line[hit], at < grid.shape[0]
    crossings = np.zeros(grid.shape, np.int32)
    np.add.at(crossings, (at[known], *line[known].T), 1)
    inside = crossings.cumsum(0) % 2 == 1
    inside[inside] = mesh.scene().compute_distance(grid.points()[inside]).numpy() > 2e-7
    return inside


def winding(mesh: Mesh, grid: Grid) -> np.ndarray:
    """Compute occupancy ``[X, Y, Z]`` bool. See ``RULES``.

    The generalised winding number (Jacobson et al. 2013) is the mean of a ray's signed crossings
    over all directions; here over the directions of ``majority``.
    """
    scene, points, normals = mesh.scene(), grid.points().reshape(-1, 3), mesh.normals()
    total = np.zeros(len(points))
    for direction in directions():
        hits = scene.list_intersections(_rays(points, direction))
        ray, face = (hits[key].numpy().astype(np.int64) for key in ("ray_ids", "primitive_ids"))
        total += np.bincount(ray, np.sign(normals @ direction)[face], len(points))
    return (2 * np.abs(total) > VOTERS).reshape(grid.shape)


def _rays(points: np.ndarray, direction: np.ndarray) -> np.ndarray:
    return np.concatenate([points, np.broadcast_to(direction.astype(np.float32), points.shape)], -1)


def _add_majority(inside: np.ndarray, mesh: Mesh, points: np.ndarray) -> None:
    """Set ``inside [..]`` at the points ``[.., 3]`` for which more than half of the rays vote.

    Points inside already, and points whose majority is decided, cast no rays.
    """
    at = np.flatnonzero(~inside)
    origins, rays = points.reshape(-1, 3)[at], directions()
    # If a plane separates a point from the mesh, one ray of each opposite pair misses.
    reach, rays = (mesh.vertices @ rays.T).max(0), rays.astype(np.float32)
    left = (origins @ rays.T <= reach + 1e-5).all(1)
    at, origins = at[left], origins[left]
    if not len(at):
        return
    scene = mesh.scene()
    votes, cast = np.zeros(len(at), np.int64), 0
    while cast < VOTERS and len(at):
        now = rays[cast : cast + max(1, RAYS // len(at))]
        both = np.concatenate(np.broadcast_arrays(origins[None], now[:, None]), -1)
        votes += (scene.count_intersections(both).numpy() % 2).sum(0)
        cast += len(now)
        inside.flat[at[2 * votes > VOTERS]] = True
        left = (2 * votes <= VOTERS) & (2 * (votes + VOTERS - cast) > VOTERS)
        at, origins, votes = at[left], origins[left], votes[left]


def enclosed(mesh: Mesh, grid: Grid) -> np.ndarray:
    """Occupancy ``[X, Y, Z]`` bool; the grid's border must be outside. See ``RULES``."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from skimage.measure import label

    scene = mesh.scene()
    near = _near(mesh, grid)
    # Connected points away from all faces form one node; each point near a face is its own node.
    node = cast(np.ndarray, label(~near, connectivity=1))
    node[near] = node.max() + 1 + np.arange(np.count_nonzero(near))
    links = []
    for axis in range(3):
        start, end = ([slice(None)] * 3 for _ in range(2))
        start[axis], end[axis] = slice(None, -1), slice(1, None)
        steps = near[tuple(start)] | near[tuple(end)]
        index = np.argwhere(steps)
        rays = np.zeros((len(index), 6), np.float32)
        rays[:, :3], rays[:, 3 + axis] = grid.origin + grid.step * index, grid.step
        free = ~scene.test_occlusions(rays, 0.0, 1.0).numpy()
        links.append([node[tuple(cut)][steps][free] for cut in (start, end)])
    one, two = np.concatenate(links, axis=1)
    size = node.max() + 1
    graph = coo_array((np.ones(len(one), bool), (one, two)), shape=(size, size))
    labels = connected_components(graph, directed=False)[1][node]
    border = np.ones(grid.shape, bool)
    border[1:-1, 1:-1, 1:-1] = False
    return ~np.isin(labels, np.unique(labels[border]))


def _near(mesh: Mesh, grid: Grid) -> np.ndarray:
    """Mark points ``[X, Y, Z]`` bool so that each step across a face has one at an end.

    They are in the boxes of the faces, and one step before each box.
    """
    one, two, three = ((mesh.vertices - grid.origin) / grid.step)[mesh.faces.T]
    last, margin = np.array(grid.shape) - 1, 0.01  # margin for rounding
    low = np.minimum(np.minimum(one, two), three) - margin
    high = np.maximum(np.maximum(one, two), three) + margin
    low, high = (np.floor(end).clip(0, last).astype(int) for end in (low, high))
    # 1 where a box begins and -1 where it ends, along each axis: cumulative sums count the boxes.
    shape = np.array(grid.shape) + 1
    count = np.zeros(shape.prod())
    for ends in np.ndindex(2, 2, 2):
        at = np.ravel_multi_index(tuple(np.where(ends, high + 1, low).T), tuple(shape))
        count += (-1) ** sum(ends) * np.bincount(at, minlength=len(count))
    count = count.reshape(shape)
    for axis in range(3):
        count = count.cumsum(axis)
    return count[:-1, :-1, :-1] > 0


def _is_flat(part: Mesh) -> bool:
    """Return True if all faces of a connected part lie in one plane, which bounds no volume."""
    normals = part.normals()
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return bool(np.abs(np.cross(normals, normals[0])).max() < 1e-6)


def directions() -> np.ndarray:
    """Return unit vectors ``[VOTERS, 3]`` in opposite pairs, so a sheet gets at most half."""
    from gamba_warp.cameras import fibonacci_sphere  # imports torch

    half = fibonacci_sphere(VOTERS)[: VOTERS // 2]
    return np.concatenate([half, -half])


def open_parts(mesh: Mesh) -> list[Mesh]:
    """Return the open ones of the parts that share no edge, after merging equal vertices."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    vertices, index = merged(mesh.vertices)
    faces = index[mesh.faces]
    edges, edge, count = edges_of(faces)
    face, size = np.repeat(np.arange(len(faces)), 3), len(faces) + len(count)
    links = coo_array((np.ones(len(face), bool), (face, len(faces) + edge)), shape=(size, size))
    label = connected_components(links, directed=False)[1][: len(faces)]
    odd = (count[edge] % 2 == 1) & (edges[:, 0] != edges[:, 1])  # as in Mesh.is_closed
    open_faces = np.flatnonzero(np.isin(label, label[face[odd]]))
    open_faces = open_faces[np.argsort(label[open_faces], kind="stable")]
    parts = []
    for ids in np.split(open_faces, np.flatnonzero(np.diff(label[open_faces])) + 1):
        used, corners = np.unique(faces[ids], return_inverse=True)
        parts.append(Mesh(vertices[used], corners.reshape(-1, 3)))
    return parts


_RAYS = f"{VOTERS} rays, in {VOTERS // 2} fixed directions and their opposites,"
ENCLOSED = (
    "a voxel is outside if its centre can be reached from the grid's border by steps between the "
    "centres of face neighbours that do not cross the surface; so closed cavities are filled and "
    "parts may overlap"
)


class Rule(NamedTuple):
    """A rule of occupancy.

    Attributes:
        meaning: description for reports.
        fill: function of a mesh and a grid that returns occupancy, ``[X, Y, Z]`` bool.
    """

    meaning: str
    fill: Callable[[Mesh, Grid], np.ndarray]


RULES: dict[OccupancyRule, Rule] = {
    "solid": Rule(
        f"{ENCLOSED}. Where a part (faces joined by edges) is open, a voxel is also inside if more "
        f"than half of {_RAYS} cross an odd number of times the whole mesh, or one open part alone",
        solid,
    ),
    "joint": Rule(
        f"{ENCLOSED}. If the mesh is open, a voxel is also inside if more than half of {_RAYS} "
        "cross it an odd number of times",
        joint,
    ),
    "enclosed": Rule(ENCLOSED, enclosed),
    "majority": Rule(
        f"a point is inside if more than half of {_RAYS} cross the surface an odd number of times",
        majority,
    ),
    "winding": Rule(
        "a point is inside if its generalised winding number, estimated by the signed crossings "
        f"of {_RAYS} is over 1/2 or under -1/2",
        winding,
    ),
    "parity": Rule(
        "a point is inside if a ray along -x crosses the surface an odd number of times, and it is "
        "not on the surface",
        parity,
    ),
}
