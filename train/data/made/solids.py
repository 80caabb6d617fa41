"""Closed solids by ``manifold3d``: lofts, lathes, tubes, slabs, superquadrics, blended limbs.

The functions are deterministic. Solids are about the origin unless stated otherwise, y up. Rings
and profiles are arrays of points; lengths have no unit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from manifold3d import CrossSection, Error, Manifold, Mesh, OpType
from numpy.typing import ArrayLike
from skimage.measure import marching_cubes

CELLS = 36_000  # of a blended solid's bounding box, at most


def solid_of(vertices: np.ndarray, faces: np.ndarray) -> Manifold:
    """Solid of ``vertices [V, 3]`` and ``faces [F, 3]``, oriented to a positive volume.

    A mesh that is not closed gives an empty solid.
    """
    made = Manifold(
        Mesh(np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.uint32))
    )
    if made.status() != Error.NoError:
        return Manifold()
    if made.volume() < 0:
        return solid_of(vertices, np.asarray(faces)[:, ::-1])
    return made


def joined(solids: Sequence[Manifold]) -> Manifold:
    """The union of solids."""
    return Manifold.batch_boolean(list(solids), OpType.Add)


def both(solid: Manifold) -> Manifold:
    """A solid and its mirror image on the other side of the plane x = 0."""
    return solid + solid.mirror([1, 0, 0])


def extent(solid: Manifold) -> np.ndarray:
    """The lowest and highest corner ``[2, 3]`` of a solid's bounding box."""
    return np.array(solid.bounding_box()).reshape(2, 3)


def spline(points: ArrayLike, count: int) -> np.ndarray:
    """A Catmull-Rom curve ``[count, D]`` through points ``[K, D]``."""
    p = np.asarray(points, float)
    t = np.linspace(0, len(p) - 1, count)
    padded = np.concatenate([[2 * p[0] - p[1]], p, [2 * p[-1] - p[-2]]])
    i = np.minimum(t.astype(int), len(p) - 2)
    f = (t - i)[:, None]
    a, b, c, d = (padded[i + j] for j in range(4))
    return b + f / 2 * (c - a + f * (2 * a - 5 * b + 4 * c - d + f * (3 * (b - c) + d - a)))


@lru_cache(maxsize=256)
def _loft_faces(rings: int, sides: int) -> np.ndarray:
    rows = np.arange(rings - 1)[:, None]
    here = np.arange(sides)[None]
    there = (here + 1) % sides
    a, b = rows * sides + here, rows * sides + there
    c, d = b + sides, a + sides
    first, last, turn = rings * sides, rings * sides + 1, (rings - 1) * sides
    tip = np.full(sides, first)
    faces = [
        np.stack([a, b, c], -1).reshape(-1, 3),
        np.stack([a, c, d], -1).reshape(-1, 3),
        np.stack([tip, there[0], here[0]], -1),
        np.stack([tip * 0 + last, turn + here[0], turn + there[0]], -1),
    ]
    return np.concatenate(faces).astype(np.uint32)


def loft(rings: np.ndarray, tips: np.ndarray | None = None) -> Manifold:
    """A solid through rings of points; its two ends are fans about a point.

    Args:
        rings: ``[R, N, 3]``.
        tips: ``[2, 3]`` middle points of the ends; None: the means of the first and last ring.
    """
    count, sides = rings.shape[:2]
    ends = rings[[0, -1]].mean(1) if tips is None else tips
    return solid_of(np.concatenate([rings.reshape(-1, 3), ends]), _loft_faces(count, sides))


def lathe(profile: ArrayLike, sides: int) -> Manifold:
    """A solid of revolution about y.

    Args:
        profile: ``[K, 2]`` radius and height; an end that is not on the axis is closed flat.
        sides: number of points around.
    """
    p = np.asarray(profile, float)
    tips = np.array([[0, p[0, 1], 0], [0, p[-1, 1], 0]])
    p = p[int(p[0, 0] <= 0) : len(p) - int(p[-1, 0] <= 0)]
    angle = np.arange(sides) * (2 * math.pi / sides)
    r, y = p[:, :1], p[:, 1:]
    rings = np.stack([r * np.sin(angle), np.repeat(y, sides, 1), r * np.cos(angle)], -1)
    return loft(rings, tips)


def ring_of(exponent: float, sides: int) -> np.ndarray:
    """A superellipse ``[sides, 2]`` of half sizes 1: exponent 2 is a circle, more is squarer."""
    angle = np.arange(sides) * (2 * math.pi / sides)
    c, s = np.cos(angle), np.sin(angle)
    r = (np.abs(c) ** exponent + np.abs(s) ** exponent) ** (-1 / exponent)
    return np.stack([r * c, r * s], -1)


def rounded(width: float, height: float, radius: float, corner: int = 5) -> np.ndarray:
    """A rectangle ``[4 corner, 2]`` with rounded corners, counterclockwise."""
    radius = min(radius, 0.499 * width, 0.499 * height)
    angle = np.linspace(0, math.pi / 2, corner)
    arcs = []
    for quarter, (sx, sy) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        a = angle + quarter * math.pi / 2
        x, y = sx * (width / 2 - radius), sy * (height / 2 - radius)
        arcs.append(np.stack([x + radius * np.cos(a), y + radius * np.sin(a)], -1))
    return np.concatenate(arcs)


def inset(outline: np.ndarray, distance: float) -> np.ndarray:
    """A counterclockwise outline ``[N, 2]`` moved inwards."""
    edge = np.roll(outline, -1, 0) - np.roll(outline, 1, 0)
    normal = np.stack([-edge[:, 1], edge[:, 0]], -1)
    return outline + distance * normal / np.maximum(
        np.linalg.norm(normal, axis=1, keepdims=True), 1e-9
    )


def slab(outline: np.ndarray, thickness: float, bevel: float) -> Manifold:
    """An outline in x and y, thick along z, with rounded edges.

    Args:
        outline: ``[N, 2]`` counterclockwise; star-shaped about its mean.
        thickness: along z, about 0.
        bevel: radius of the edges.
    """
    half = thickness / 2
    bevel = min(bevel, 0.99 * half)
    if bevel <= 0:
        layers = [(0.0, -half), (0.0, half)]
    else:
        angle = np.linspace(0, math.pi / 2, 4)
        below = [(bevel * (1 - math.sin(a)), -half + bevel * (1 - math.cos(a))) for a in angle]
        layers = [*below, *[(d, -z) for d, z in reversed(below)]]
    rings = np.stack(
        [np.column_stack([inset(outline, d), np.full(len(outline), z)]) for d, z in layers]
    )
    return loft(rings)


def box(width: float, height: float, deep: float, radius: float = 0.0) -> Manifold:
    """A box about the origin, with rounded edges if the radius is not 0."""
    if radius <= 0:
        return Manifold.cube([width, height, deep], True)
    radius = min(radius, 0.49 * min(width, height, deep))
    return slab(rounded(width, height, 1.3 * radius), deep, radius)


def plate(cross: CrossSection, thickness: float) -> Manifold:
    """A flat shape in x and y, thick along z, about z = 0."""
    return cross.extrude(thickness).translate([0, 0, -thickness / 2])


def rod(radius: float, height: float) -> Manifold:
    """A cylinder along y that stands on y = 0."""
    return lathe([(radius, 0), (radius, height)], 24)


def ball(radius: float) -> Manifold:
    """A ball about the origin."""
    return Manifold.sphere(1.0, 32).scale([radius] * 3)


def superquadric(radii: ArrayLike, up: float, around: float, segments: int) -> Manifold:
    """A superquadric about the origin.

    Args:
        radii: half sizes along x, y and z.
        up: exponent along y: 1 is round, towards 0 a box, above 1 pointed.
        around: exponent across y.
        segments: number of points around.
    """

    def shape(p: np.ndarray) -> np.ndarray:
        a = np.abs(p) + 1e-9
        flat = a[:, 0] ** (2 / around) + a[:, 2] ** (2 / around)
        r = (flat ** (around / up) + a[:, 1] ** (2 / up)) ** (-up / 2)
        return p * r[:, None]

    return Manifold.sphere(1.0, segments).warp_batch(shape).scale(np.asarray(radii, float).tolist())


def frames(path: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tangents and two normals ``[R, 3]`` each along a curve, with minimal rotation."""
    t = np.gradient(path, axis=0)
    t /= np.maximum(np.linalg.norm(t, axis=1, keepdims=True), 1e-9)
    first = np.eye(3)[np.abs(t[0]).argmin()]
    u = np.empty_like(t)
    before = first
    for i, tangent in enumerate(t):
        before = before - (before @ tangent) * tangent
        before = before / max(math.sqrt(before @ before), 1e-9)
        u[i] = before
    return t, u, np.cross(t, u)


def tube(path: ArrayLike, radii: ArrayLike, sides: int, count: int, flat: float) -> Manifold:
    """An ellipse swept along a smooth curve; half balls close its ends.

    Args:
        path: ``[K, 3]`` points that the curve goes through.
        radii: several, spread along the curve.
        sides: points around.
        count: rings along the curve.
        flat: ratio of the ellipse's axes.
    """
    line = spline(path, count)
    r = np.maximum(spline(np.asarray(radii, float)[:, None], count)[:, 0], 1e-4)
    profile = ring_of(2, sides) * (1, flat)
    t, u, v = frames(line)
    angles = np.radians([75, 50, 25])
    head = line[0] - np.outer(np.sin(angles) * r[0], t[0])
    tail = line[-1] + np.outer(np.sin(angles[::-1]) * r[-1], t[-1])
    tips = np.stack([line[0] - r[0] * t[0], line[-1] + r[-1] * t[-1]])
    line = np.concatenate([head, line, tail])
    r = np.concatenate([np.cos(angles) * r[0], r, np.cos(angles[::-1]) * r[-1]])
    u, v = (np.concatenate([w[[0] * 3], w, w[[-1] * 3]]) for w in (u, v))
    rings = line[:, None] + r[:, None, None] * (
        profile[None, :, :1] * u[:, None] + profile[None, :, 1:] * v[:, None]
    )
    return loft(rings, tips)


class Blend:
    """A solid of limbs and eggs that flow into one another.

    Args:
        soft: length over which two of them flow together.
        symmetric: add each on both sides of x = 0.
    """

    def __init__(self, soft: float, symmetric: bool) -> None:
        self.soft, self.symmetric = soft, symmetric
        self._items: list[tuple[np.ndarray, np.ndarray, Callable]] = []

    def _add(self, low: np.ndarray, high: np.ndarray, distance: Callable) -> None:
        self._items.append((low, high, distance))
        if self.symmetric:
            flip = np.array([-1, 1, 1], np.float32)
            a, b = low * flip, high * flip
            mirrored = np.minimum(a, b), np.maximum(a, b)
            if mirrored[0][0] > low[0] + 1e-6 or mirrored[1][0] < high[0] - 1e-6:
                self._items.append((*mirrored, lambda x, y, z: distance(-x, y, z)))

    def limb(self, path: ArrayLike, radii: ArrayLike) -> None:
        """Add round cones through points ``[K, 3]`` with a radius at each."""
        p = np.asarray(path, np.float32)
        r = np.broadcast_to(np.asarray(radii, np.float32), len(p))
        for a, b, ra, rb in zip(p, p[1:], r, r[1:]):
            self._add(np.minimum(a - ra, b - rb), np.maximum(a + ra, b + rb), _cone(a, b, ra, rb))

    def egg(self, center: ArrayLike, radii: ArrayLike) -> None:
        """Add an ellipsoid."""
        c, r = np.asarray(center, np.float32), np.asarray(radii, np.float32)
        self._add(c - r, c + r, _egg(c, r))

    def solid(self, cells: int) -> Manifold:
        """Make the solid with this many cells along the longest side."""
        lows = np.stack([item[0] for item in self._items])
        highs = np.stack([item[1] for item in self._items])
        low, high = lows.min(0), highs.max(0)
        step = max(float((high - low).max()) / cells, float((high - low).prod() / CELLS) ** (1 / 3))
        margin = self.soft / 2 + 2 * step
        low = low - margin + 0.37e-3 * step  # so that no surface lies right on the grid
        shape = np.ceil((high + margin - low) / step).astype(int) + 1
        far = np.float32(2 * margin)
        field = np.full(shape, far, np.float32)
        axes = [low[i] + step * np.arange(shape[i], dtype=np.float32) for i in range(3)]
        k = np.float32(self.soft)
        for a, b, distance in self._items:
            first = np.maximum(np.floor((a - margin - low) / step).astype(int), 0)
            last = np.minimum(np.ceil((b + margin - low) / step).astype(int) + 1, shape)
            part = tuple(slice(i, j) for i, j in zip(first, last))
            d = distance(
                axes[0][part[0]][:, None, None],
                axes[1][part[1]][None, :, None],
                axes[2][part[2]][None, None, :],
            )
            there = field[part]
            h = np.maximum(k - np.abs(there - d), 0)
            field[part] = np.minimum(there, d) - h * h / (4 * k)
        np.minimum(field, far, out=field)
        for axis in range(3):  # nothing reaches the border of the grid
            edge = np.moveaxis(field, axis, 0)
            edge[0] = edge[-1] = far
        vertices, faces, _, _ = marching_cubes(field, 0.0, allow_degenerate=False)
        return solid_of(vertices * step + low, faces)


def _cone(a: np.ndarray, b: np.ndarray, ra: float, rb: float) -> Callable:
    along = b - a
    scale = 1 / max(float(along @ along), 1e-12)

    def distance(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        px, py, pz = x - a[0], y - a[1], z - a[2]
        t = np.clip((px * along[0] + py * along[1] + pz * along[2]) * np.float32(scale), 0, 1)
        dx, dy, dz = px - t * along[0], py - t * along[1], pz - t * along[2]
        return np.sqrt(dx * dx + dy * dy + dz * dz) - (ra + t * (rb - ra))

    return distance


def _egg(c: np.ndarray, r: np.ndarray) -> Callable:
    least = np.float32(r.min())

    def distance(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        px, py, pz = x - c[0], y - c[1], z - c[2]
        inner = np.sqrt((px / r[0]) ** 2 + (py / r[1]) ** 2 + (pz / r[2]) ** 2)
        slope = np.sqrt((px / r[0] ** 2) ** 2 + (py / r[1] ** 2) ** 2 + (pz / r[2] ** 2) ** 2)
        return np.maximum(inner * (inner - 1) / np.maximum(slope, np.float32(1e-6)), -least)

    return distance


def bend(solid: Manifold, angle: float) -> Manifold:
    """Bend a solid in the plane of y and z, its top towards +z."""
    (low, high) = extent(solid)
    length = max(float(high[1] - low[1]), 1e-6)
    if abs(angle) < 1e-3:
        return solid
    radius = length / angle

    def move(p: np.ndarray) -> np.ndarray:
        a = (p[:, 1] - low[1]) / radius
        r = radius - p[:, 2]
        return np.stack([p[:, 0], low[1] + r * np.sin(a), radius - r * np.cos(a)], -1)

    return solid.warp_batch(move)


def taper(solid: Manifold, share: float) -> Manifold:
    """A solid whose top is ``share`` times as wide as its foot."""
    (low, high) = extent(solid)
    length = max(float(high[1] - low[1]), 1e-6)

    def move(p: np.ndarray) -> np.ndarray:
        scale = 1 + (share - 1) * (p[:, 1:2] - low[1]) / length
        return np.concatenate([p[:, :1] * scale, p[:, 1:2], p[:, 2:] * scale], 1)

    return solid.warp_batch(move)


def twist(solid: Manifold, angle: float) -> Manifold:
    """A solid whose top is turned about y by an angle in radians."""
    (low, high) = extent(solid)
    length = max(float(high[1] - low[1]), 1e-6)

    def move(p: np.ndarray) -> np.ndarray:
        a = angle * (p[:, 1] - low[1]) / length
        c, s = np.cos(a), np.sin(a)
        return np.stack([c * p[:, 0] + s * p[:, 2], p[:, 1], c * p[:, 2] - s * p[:, 0]], -1)

    return solid.warp_batch(move)


def ripple(
    solid: Manifold, rng: np.random.Generator, height: float, length: float, mirrored: bool
) -> Manifold:
    """A solid displaced by a smooth random field.

    Args:
        solid: with faces that are small beside ``length``.
        rng: random generator.
        height: typical displacement.
        length: wavelength of the field.
        mirrored: make the field symmetric about x = 0.
    """
    waves = rng.normal(size=(3, 7, 3)) * (2 * math.pi / length / 1.7)
    phases = rng.uniform(0, 2 * math.pi, (3, 7))

    def move(p: np.ndarray) -> np.ndarray:
        q = np.abs(p) * [1, 0, 0] + p * [0, 1, 1] if mirrored else p
        field = np.sin(np.einsum("pk,dwk->pdw", q, waves) + phases).sum(-1) * (height / 2)
        if mirrored:
            field[:, 0] *= np.tanh(p[:, 0] / max(length / 4, 1e-6))
        return p + field

    return solid.warp_batch(move)
