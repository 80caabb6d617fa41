"""Closed solids by ``manifold3d``, about the origin, y up; lengths have no unit."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from manifold3d import CrossSection, FillRule, Manifold, OpType
from numpy.typing import ArrayLike


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


def lathe(profile: ArrayLike, sides: int) -> Manifold:
    """A solid of revolution about y.

    Args:
        profile: ``[K, 2]`` radius and height; an end that is not on the axis is closed flat.
        sides: number of points around.
    """
    p = np.asarray(profile, float)
    contour = np.concatenate([[[0, p[0, 1]]], p, [[0, p[-1, 1]]]])
    return CrossSection([contour], FillRule.NonZero).revolve(sides).rotate([-90, 0, 0])


def slab(outline: np.ndarray, thickness: float) -> Manifold:
    """An outline ``[N, 2]`` in x and y, thick along z."""
    section = CrossSection([outline], FillRule.NonZero)
    return section.extrude(thickness).translate([0, 0, -thickness / 2])


def box(width: float, height: float, deep: float, radius: float = 0.0) -> Manifold:
    """A box with rounded edges if the radius is not 0."""
    radius = min(radius, 0.49 * min(width, height, deep))
    if radius <= 0:
        return Manifold.cube([width, height, deep], True)
    half = np.array([width, height, deep]) / 2 - radius
    signs = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, 8).T
    return Manifold.batch_hull([ball(radius, 16).translate(sign * half) for sign in signs])


def ball(radius: float, segments: int = 32) -> Manifold:
    """A ball."""
    return Manifold.sphere(radius, segments)


def limb(ends: ArrayLike, radii: Sequence[float]) -> Manifold:
    """A round cone between two points ``[2, 3]``, closed by half balls."""
    balls = [ball(r, 20).translate(p) for p, r in zip(np.asarray(ends).tolist(), radii)]
    return Manifold.batch_hull(balls)


def superquadric(radii: ArrayLike, up: float, around: float, segments: int) -> Manifold:
    """A superquadric.

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


def bend(solid: Manifold, angle: float) -> Manifold:
    """Bend a solid in the plane of y and z, its top towards +z."""
    (low, high) = extent(solid)
    if abs(angle) < 1e-3:
        return solid
    radius = max(float(high[1] - low[1]), 1e-6) / angle

    def move(p: np.ndarray) -> np.ndarray:
        a = (p[:, 1] - low[1]) / radius
        r = radius - p[:, 2]
        return np.stack([p[:, 0], low[1] + r * np.sin(a), radius - r * np.cos(a)], -1)

    return solid.warp_batch(move)


def taper(solid: Manifold, fraction: float) -> Manifold:
    """A solid whose top is ``fraction`` times as wide as its foot."""
    (low, high) = extent(solid)
    length = max(float(high[1] - low[1]), 1e-6)

    def move(p: np.ndarray) -> np.ndarray:
        scale = 1 + (fraction - 1) * (p[:, 1:2] - low[1]) / length
        return np.concatenate([p[:, :1] * scale, p[:, 1:2], p[:, 2:] * scale], 1)

    return solid.warp_batch(move)


def ripple(
    solid: Manifold, rng: np.random.Generator, height: float, length: float, mirrored: bool
) -> Manifold:
    """A solid displaced by a smooth random field.

    Args:
        solid: with faces that are small relative to ``length``.
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
