"""Which voxels a mesh fills, for meshes that are not closed as well."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from .shapes import Mesh

VOTERS = 26
SOLID_RULE = (
    "solid: a voxel is outside if its centre can be reached from the grid's border by steps "
    "between the centres of face neighbours that do not cross the surface; so closed cavities are "
    "filled and parts may overlap. In meshes with open edges a voxel is also inside if "
    f"more than half of {VOTERS} rays, in {VOTERS // 2} fixed directions and their opposites, "
    "cross the surface an odd number of times."
)
PARITY_RULE = (
    "parity: a point is inside if a ray along -x crosses the surface an odd number of times"
)


@dataclass
class Grid:
    """Points of a regular grid.

    Attributes:
        origin: ``[3]`` the first point.
        step: distance of neighbours.
        shape: points along x, y, z.
    """

    origin: np.ndarray
    step: float
    shape: tuple[int, int, int]

    def points(self) -> np.ndarray:
        """``[X, Y, Z, 3]`` float32."""
        axes = [self.origin[k] + self.step * np.arange(self.shape[k]) for k in range(3)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1).astype(np.float32)


def grid_around(*meshes: Mesh, resolution: int) -> Grid:
    """Voxel centres around several meshes, with one empty voxel on each side.

    Voxel faces lie on multiples of their side, so the grid does not depend on the meshes' extents
    as long as they fit into a cube of side 2; around larger ones the voxels grow with them.

    Args:
        meshes: at least one.
        resolution: voxels a unit of length.
    """
    low = np.min([mesh.vertices.min(0) for mesh in meshes], axis=0)
    high = np.max([mesh.vertices.max(0) for mesh in meshes], axis=0)
    step = max(1.0, (high - low).max() / 2) / resolution
    first = np.floor(low / step).astype(int) - 1
    last = np.ceil(high / step).astype(int) + 1
    return Grid((first + 0.5) * step, step, tuple(int(n) for n in last - first))


def syncdreamer_grid(size: int = 64) -> Grid:
    """The lattice of mesh2sdf: ``size`` points a side from -1 in steps of 2 / size."""
    return Grid(np.full(3, -1.0), 2.0 / size, (size, size, size))


def solid(mesh: Mesh, grid: Grid) -> np.ndarray:
    """Occupancy ``[X, Y, Z]`` bool by ``SOLID_RULE``; the grid's border must be outside."""
    inside = _enclosed(mesh, grid)
    if not mesh.is_closed():
        inside |= _majority(mesh, grid)
    return inside


def parity(mesh: Mesh, grid: Grid) -> np.ndarray:
    """Occupancy ``[X, Y, Z]`` bool by ``PARITY_RULE``, what mesh2sdf does without its repair."""
    return _crossings(mesh.scene(), grid.points(), np.array([-1.0, 0, 0])) % 2 == 1


Rule = Literal["solid", "parity"]
RULES: dict[Rule, tuple[str, Callable[[Mesh, Grid], np.ndarray]]] = {
    "solid": (SOLID_RULE, solid),
    "parity": (PARITY_RULE, parity),
}


def _crossings(scene, points: np.ndarray, direction: np.ndarray) -> np.ndarray:
    rays = np.concatenate([points, np.broadcast_to(direction.astype(np.float32), points.shape)], -1)
    return scene.count_intersections(rays).numpy()


def _enclosed(mesh: Mesh, grid: Grid) -> np.ndarray:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    scene, points = mesh.scene(), grid.points()
    number = np.arange(points[..., 0].size).reshape(grid.shape)
    starts, ends = [], []
    for axis in range(3):
        cut = [slice(None)] * 3
        cut[axis] = slice(None, -1)
        origins = points[tuple(cut)]
        step = np.zeros_like(origins)
        step[..., axis] = grid.step
        blocked = scene.test_occlusions(np.concatenate([origins, step], -1), 0.0, 1.0).numpy()
        neighbours = np.roll(number, -1, axis)[tuple(cut)]
        starts.append(number[tuple(cut)][~blocked])
        ends.append(neighbours[~blocked])
    start, end = np.concatenate(starts), np.concatenate(ends)
    links = coo_array((np.ones(len(start), bool), (start, end)), shape=(number.size, number.size))
    labels = connected_components(links, directed=False)[1].reshape(grid.shape)
    border = np.ones(grid.shape, bool)
    border[1:-1, 1:-1, 1:-1] = False
    return ~np.isin(labels, np.unique(labels[border]))


def _majority(mesh: Mesh, grid: Grid) -> np.ndarray:
    scene, points = mesh.scene(), grid.points()
    votes = np.zeros(grid.shape, np.int32)
    half = fibonacci_sphere(VOTERS)[: VOTERS // 2]
    # opposite pairs, so that a flat sheet never gets more than half of the votes
    for direction in np.concatenate([half, -half]):
        votes += _crossings(scene, points, direction) % 2
    return 2 * votes > VOTERS


def fibonacci_sphere(count: int) -> np.ndarray:
    """``[count, 3]`` unit vectors spread evenly, none along an axis."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + 5**0.5) * k
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1)
