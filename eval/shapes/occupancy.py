"""The voxels that a mesh fills, by several rules, for meshes that are not closed as well."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np

from gamba_warp.formats.parts import merged

from .command import OccupancyRule
from .shape import Mesh, directed_edges

VOTERS = 26  # rays from a point


@dataclass
class Grid:
    """Points of a regular grid.

    Attributes:
        origin: ``[3]``, the first point.
        step: distance of neighbours.
        shape: numbers of points along x, y and z.
    """

    origin: np.ndarray
    step: float
    shape: tuple[int, int, int]

    def points(self) -> np.ndarray:
        """Returns ``[X, Y, Z, 3]`` float32."""
        axes = [self.origin[k] + self.step * np.arange(self.shape[k]) for k in range(3)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1).astype(np.float32)


def grid_around(*meshes: Mesh, resolution: int) -> Grid:
    """The voxel centres around several meshes, with one empty voxel on each side.

    Voxel faces lie on multiples of their side, so the grid does not depend on the meshes' extents
    as long as they fit into a cube of side 2; around larger ones the voxels grow with them.

    Args:
        meshes: at least one.
        resolution: number of voxels in a unit of length.
    """
    low = np.min([mesh.vertices.min(0) for mesh in meshes], axis=0)
    high = np.max([mesh.vertices.max(0) for mesh in meshes], axis=0)
    step = max(1.0, (high - low).max() / 2) / resolution
    first = np.floor(low / step).astype(int) - 1
    last = np.ceil(high / step).astype(int) + 1
    x, y, z = (int(n) for n in last - first)
    return Grid((first + 0.5) * step, step, (x, y, z))


def syncdreamer_grid(size: int = 64) -> Grid:
    """The lattice of mesh2sdf: ``size`` points a side from -1 in steps of 2 / size."""
    return Grid(np.full(3, -1.0), 2.0 / size, (size, size, size))


def solid(mesh: Mesh, grid: Grid) -> np.ndarray:
    """Occupancy ``[X, Y, Z]`` bool; the grid's border must be outside. See ``RULES``."""
    inside = enclosed(mesh, grid)
    if mesh.is_closed():
        return inside
    parts = [part for part in connected_parts(mesh) if not part.is_closed()]
    inside |= majority(mesh, grid)
    if len(parts) > 1 or len(parts[0].faces) < len(mesh.faces):
        points = grid.points()
        # only within a part's box can more than half of the rays cross it
        for part in parts:
            low, high = part.vertices.min(0), part.vertices.max(0)
            first = np.maximum(np.ceil((low - grid.origin) / grid.step).astype(int), 0)
            last = np.floor((high - grid.origin) / grid.step).astype(int) + 1
            if (last > first).all() and not _is_flat(part):
                box = tuple(slice(i, j) for i, j in zip(first, last))
                inside[box] |= _majority_at(part, points[box])
    return inside


def joint(mesh: Mesh, grid: Grid) -> np.ndarray:
    """Occupancy ``[X, Y, Z]`` bool; the grid's border must be outside. See ``RULES``."""
    inside = enclosed(mesh, grid)
    return inside if mesh.is_closed() else inside | majority(mesh, grid)


def majority(mesh: Mesh, grid: Grid) -> np.ndarray:
    """Occupancy ``[X, Y, Z]`` bool. See ``RULES``."""
    return _majority_at(mesh, grid.points())


def parity(mesh: Mesh, grid: Grid) -> np.ndarray:
    """Occupancy ``[X, Y, Z]`` bool, as mesh2sdf has it without its repair. See ``RULES``.

    Rays run along the grid's lines. One that meets an edge is decided as if it were moved by very
    little along y and by less along z, so that it meets exactly one of the faces there. Places on
    the surface are outside; in mesh2sdf the rounding of their distance decides.
    """
    corners = (mesh.vertices.astype(np.float32).astype(np.float64) - grid.origin) / grid.step
    corners = corners[mesh.faces]
    first = np.ceil(corners[..., 1:].min(1)).clip(0).astype(int)
    last = np.floor(corners[..., 1:].max(1)).astype(int)
    count = (np.minimum(last, np.array(grid.shape[1:]) - 1) - first + 1).clip(0)
    face = np.repeat(np.arange(len(corners)), count.prod(1))  # once for each line in its box
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
    """Occupancy ``[X, Y, Z]`` bool. See ``RULES``.

    The generalised winding number (Jacobson et al. 2013) is the mean, over all directions, of the
    signed crossings of a ray; here over the directions of ``majority``.
    """
    scene, points, normals = mesh.scene(), grid.points().reshape(-1, 3), mesh.normals()
    total = np.zeros(len(points))
    for direction in directions():
        found = scene.list_intersections(_rays(points, direction))
        ray, face = (found[key].numpy().astype(np.int64) for key in ("ray_ids", "primitive_ids"))
        total += np.bincount(ray, np.sign(normals @ direction)[face], len(points))
    return (2 * np.abs(total) > VOTERS).reshape(grid.shape)


def _rays(points: np.ndarray, direction: np.ndarray) -> np.ndarray:
    return np.concatenate([points, np.broadcast_to(direction.astype(np.float32), points.shape)], -1)


def _crossings(scene, points: np.ndarray, direction: np.ndarray) -> np.ndarray:
    return scene.count_intersections(_rays(points, direction)).numpy()


def _majority_at(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Asks rays from points ``[.., 3]``, of each until its majority can no longer change."""
    scene, places, ways = mesh.scene(), points.reshape(-1, 3), directions()
    # Where a plane parts a point from the mesh, one ray of each opposite pair meets nothing.
    reach, at = mesh.vertices @ ways.T, places @ ways.astype(np.float32).T
    asked = np.flatnonzero((at <= reach.max(0) + 1e-5).all(1))
    votes = np.zeros(len(places), np.int32)
    for left, direction in zip(range(VOTERS - 1, -1, -1), ways):
        votes[asked] += _crossings(scene, places[asked], direction) % 2
        found = votes[asked]
        asked = asked[(2 * found <= VOTERS) & (2 * (found + left) > VOTERS)]
    return (2 * votes > VOTERS).reshape(points.shape[:-1])


def enclosed(mesh: Mesh, grid: Grid) -> np.ndarray:
    """Occupancy ``[X, Y, Z]`` bool; the grid's border must be outside. See ``RULES``."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from skimage.measure import label

    scene = mesh.scene()
    near = _near(mesh, grid)
    # Places that no face is near to are one with their neighbours: what they form is a node each,
    # and so is every place near a face.
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
    """Marks the points ``[X, Y, Z]`` bool of which one is at an end of any step that meets a face.

    Those are in the boxes of the faces, and one step before each of them.
    """
    one, two, three = ((mesh.vertices - grid.origin) / grid.step)[mesh.faces.T]
    last, room = np.array(grid.shape) - 1, 0.01  # for rounding
    low = np.minimum(np.minimum(one, two), three) - room
    high = np.maximum(np.maximum(one, two), three) + room
    low, high = (np.floor(end).clip(0, last).astype(int) for end in (low, high))
    # 1 where a box begins and -1 where it ends, along each axis, so that sums count the boxes
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
    """Whether all faces of a connected part lie in one plane, which bounds nothing."""
    normals = part.normals()
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return bool(np.abs(np.cross(normals, normals[0])).max() < 1e-6)


def directions() -> np.ndarray:
    """Unit vectors ``[VOTERS, 3]`` in opposite pairs, so that a sheet never gets more than half."""
    from gamba_warp.cameras import fibonacci_sphere  # with torch, which few need

    half = fibonacci_sphere(VOTERS)[: VOTERS // 2]
    return np.concatenate([half, -half])


def connected_parts(mesh: Mesh) -> list[Mesh]:
    """The parts of a mesh that share no edge, where vertices at one place count as one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    vertices, index = merged(mesh.vertices)
    faces = index[mesh.faces]
    edges = np.sort(directed_edges(faces), axis=1)
    edge = np.unique(edges[:, 0] * len(vertices) + edges[:, 1], return_inverse=True)[1].reshape(-1)
    face, size = np.repeat(np.arange(len(faces)), 3), len(faces) + edge.max() + 1
    links = coo_array((np.ones(len(face), bool), (face, len(faces) + edge)), shape=(size, size))
    label = connected_components(links, directed=False)[1][: len(faces)]
    order = np.argsort(label, kind="stable")
    parts = []
    for ids in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
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
        meaning: in words, for reports.
        fill: gives the voxels of a grid that a mesh fills, ``[X, Y, Z]`` bool.
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
