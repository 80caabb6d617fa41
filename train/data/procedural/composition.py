"""Free compositions: random parts that grow on the surfaces of earlier ones."""

from __future__ import annotations

import math

import numpy as np
from manifold3d import Manifold

from .looks import Maker
from .solids import (
    ball,
    bend,
    both,
    box,
    extent,
    joined,
    lathe,
    limb,
    ripple,
    slab,
    spline,
    superquadric,
    taper,
)

ENOUGH = 8_000  # faces of the parts after which no more are added
SCHEMES = (  # kinds of colours
    *("toy", "toy blue", "pastel", "dark metal", "white metal", "wood earth"),
    *("any", "any", "wide", "white dark"),
)


def composition(m: Maker) -> list[Manifold]:
    """A body, and two to nine parts on it: mirrored, in rows, around an axis, or cut out of it."""
    scheme = m.pick(*SCHEMES)
    looks = [m.fur(scheme) if m.chance(0.15) else m.surface(scheme) for _ in range(m.n(2, 4))]
    if m.chance(0.33):
        looks[m.n(0, 1)] = m.printed(f"{scheme} white")
    mirrored = m.chance(0.82)
    body = shape(m, mirrored)
    if m.chance(0.2):
        body = warped(m, body, mirrored)
    parts = [m.stamp(body, looks[0])]
    if m.chance(0.3):
        parts[0] = hollowed(m, parts[0], m.surface(scheme))
    for _ in range(m.n(2, m.pick(3, 5, 9)) if m.chance(0.92) else 1):
        if sum(part.num_tri() for part in parts) > ENOUGH:
            break
        # The body carries most of the parts.
        host = parts[0] if m.chance(0.6) else parts[m.n(0, len(parts) - 1)]
        if m.chance(0.12):
            parts[0] = cut(m, parts[0], mirrored, m.pick(*looks))
        else:
            parts.append(grown(m, host, mirrored, m.pick(*looks)))
    if m.chance(0.12):
        whole = joined(parts)
        parts = [warped(m, whole, mirrored)] if whole.num_tri() < 6_000 else [whole]
    return parts if m.chance(0.1) else [largest(joined(parts))]


def largest(solid: Manifold) -> Manifold:
    """Largest connected piece of a solid."""
    return max(solid.decompose(), key=lambda piece: piece.volume(), default=solid)


def shape(m: Maker, mirrored: bool = True, fine: int = 32) -> Manifold:
    """A random solid about the origin, with sides of .3 to 2.

    Args:
        m: random source.
        mirrored: make it symmetric about x = 0 if its kind allows it.
        fine: number of points around a round one.
    """
    kind = m.n(0, 8)
    a, b, c = np.exp(m.rng.uniform(math.log(0.25), math.log(0.95), 3))
    if kind <= 2:
        return superquadric([a, b, c], m.u(0.15, 1.3), m.u(0.15, 1.3), fine // 4 * 4)
    if kind <= 4:
        return box(2 * a, 2 * b, 2 * c, m.pick(0.0, m.u(0.02, 0.12), m.u(0.1, 0.5) * min(a, b, c)))
    if kind <= 6:
        return turned(m, a, 2 * b, fine)
    if kind == 7:
        return slab(outline(m, fine * 3 // 2) * [a, b], m.u(0.05, 0.6))
    return limbs(m, mirrored)


def turned(m: Maker, radius: float, height: float, fine: int) -> Manifold:
    """A random solid of revolution, sometimes with a profile that is not round."""
    count = m.n(3, 6)
    profile = np.stack(
        [m.rng.uniform(0.25, 1, count) * radius, np.linspace(0, 1, count) * height], 1
    )
    if m.chance(0.7):
        profile = np.maximum(spline(profile, fine // 2), [0.02, -1])
    if m.chance(0.3):  # a rounded top
        angle = np.linspace(0.1, math.pi / 2, 6)[1:]
        end = profile[-1]
        cap = np.stack([end[0] * np.cos(angle), end[1] + end[0] * m.u(0.2, 1) * np.sin(angle)], 1)
        profile = np.concatenate([profile, np.maximum(cap, [0.005, -1])])
    solid = lathe(profile, m.pick(6, 8, fine, fine, fine))
    return solid.translate([0, -height / 2, 0])


def outline(m: Maker, sides: int) -> np.ndarray:
    """A smooth, starred, toothed or square outline ``[sides, 2]`` of radius 1 or so."""
    angle = np.arange(sides) * (2 * math.pi / sides)
    kind = m.n(0, 3)
    if kind == 0:
        r = 1 + sum(m.u(-0.25, 0.25) / k * np.cos(k * (angle - math.pi / 2)) for k in range(2, 6))
    elif kind == 1:
        r = 1 + m.u(0.1, 0.35) * np.cos(m.n(3, 8) * (angle - math.pi / 2))
    elif kind == 2:
        r = 1 + m.u(0.05, 0.15) * np.tanh(4 * np.sin(m.n(6, 16) * angle))
    else:  # a superellipse
        power = m.u(1.2, 8)
        r = (abs(np.cos(angle)) ** power + abs(np.sin(angle)) ** power) ** (-1 / power)
    return np.stack([r * np.cos(angle), r * np.sin(angle)], -1)


def limbs(m: Maker, mirrored: bool) -> Manifold:
    """Round cones from joint to joint."""
    joints, radii = [np.zeros(3)], [m.u(0.15, 0.4)]
    parts = [ball(radii[0])]
    for _ in range(m.n(2, 5)):
        start = m.n(0, len(joints) - 1)
        end = joints[start] + m.rng.normal(0, 0.4, 3) * [1, 1, 0.8]
        if m.chance(0.35):
            end[0] = joints[start][0]
        joints.append(end)
        radii.append(m.u(0.05, 0.22))
        parts.append(limb([joints[start], end], [min(radii[start], 0.22), radii[-1]]))
    return both(joined(parts)) if mirrored else joined(parts)


def warped(m: Maker, solid: Manifold, mirrored: bool) -> Manifold:
    """A solid that is refined, then bent, tapered or displaced."""
    low, high = extent(solid)
    size = float((high - low).max())
    fine = solid.refine_to_length(size / 12) if solid.num_tri() < 2000 else solid
    for _ in range(m.n(1, 2)):
        kind = m.n(0, 2)
        if kind == 0:
            fine = bend(fine, m.u(-1, 1))
        elif kind == 1:
            fine = taper(fine, m.u(0.4, 1.5))
        else:
            length = size * m.u(0.15, 0.6)
            fine = ripple(fine, m.rng, length * m.u(0.03, 0.1), length, mirrored)
    return fine


def surface_point(m: Maker, solid: Manifold) -> tuple[np.ndarray, np.ndarray]:
    """A point ``[3]`` of a solid's surface, and its normal."""
    mesh = solid.to_mesh()
    faces = np.asarray(mesh.tri_verts)
    corners = np.asarray(mesh.vert_properties)[:, :3].astype(float)[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    total = np.cumsum(area)
    chosen = min(int(np.searchsorted(total, m.rng.random() * total[-1])), len(faces) - 1)
    weights = m.rng.dirichlet((1, 1, 1))
    return weights @ corners[chosen], across[chosen] / max(area[chosen], 1e-12)


def turned_to(solid: Manifold, normal: np.ndarray, place: np.ndarray) -> Manifold:
    """Rotate a solid's y axis to a direction, and move its origin to a position."""
    y = normal / max(float(np.linalg.norm(normal)), 1e-9)
    side = np.array([1.0, 0, 0]) if abs(y[0]) < 0.9 else np.array([0, 0, 1.0])
    z = np.cross(side, y)
    z /= np.linalg.norm(z)
    x = np.cross(y, z)
    return solid.transform(np.column_stack([x, y, z, place]))


def grown(m: Maker, host: Manifold, mirrored: bool, look: int) -> Manifold:
    """A part on the surface of another: one in the middle, a pair, a row, or several around y."""
    size = float((extent(host)[1] - extent(host)[0]).max())
    arrangement = m.pick("one", "one", "pair", "pair", "row", "around")
    part = shape(m, mirrored, 24 if arrangement == "one" else 16)
    low, high = extent(part)
    scale = size * float(np.exp(m.u(math.log(0.12), math.log(0.65)))) / float((high - low).max())
    stretch = np.ones(3)
    if m.chance(0.35):  # a rod, or a sheet
        stretch[m.n(0, 2)] = m.u(0.1, 0.35)
    part = part.scale(scale * stretch)
    low, high = extent(part)
    sunk = m.u(0.05, 0.5)
    part = part.translate([0, -low[1] - sunk * (high[1] - low[1]), 0])
    point, normal = surface_point(m, host)
    if m.chance(0.5):  # along an axis
        axis = int(np.abs(normal).argmax())
        normal = np.eye(3)[axis] * np.sign(normal[axis])
    if not mirrored and arrangement == "pair":
        arrangement = "one"
    if mirrored and arrangement in ("one", "row"):
        center = (extent(host)[0] + extent(host)[1]) / 2
        point[0], normal[0] = center[0] if abs(center[0]) < 1e-3 else point[0], 0.0
        if not normal.any():
            normal[1] = 1.0
    one = m.stamp(turned_to(part, normal, point), look)
    if arrangement == "pair" or (mirrored and arrangement == "one" and abs(point[0]) > 1e-3):
        return both(one)
    if arrangement == "row":
        count = m.n(2, 5)
        axis = m.pick(1, 2) if mirrored else m.n(0, 2)
        step = np.eye(3)[axis] * size * m.u(0.12, 0.3)
        return joined(
            [one.translate((step * (i - (count - 1) / 2)).tolist()) for i in range(count)]
        )
    if arrangement == "around":
        count = m.pick(3, 4, 6, 8)
        center = (extent(host)[0] + extent(host)[1]) / 2
        centered = one.translate((-center).tolist())
        return joined([centered.rotate([0, 360 * i / count, 0]) for i in range(count)]).translate(
            center.tolist()
        )
    return one


def hollowed(m: Maker, solid: Manifold, look: int) -> Manifold:
    """A solid open at its top: a scaled copy of it is cut out."""
    low, high = extent(solid)
    size = high - low
    wall = m.u(0.03, 0.12) * float(size.min())
    fraction = 1 - 2 * wall / size
    if (fraction < 0.2).any():
        return solid
    center = (low + high) / 2
    inner = m.stamp(
        solid.translate((-center).tolist()).scale(fraction.tolist()).translate(center.tolist()),
        look,
    )
    inner = inner.translate([0, float(size[1]) * m.u(0.1, 0.4), 0])
    level = high[1] - m.u(0.02, 0.3) * size[1]
    if m.chance(0.6):
        wide, tall, deep = (3 * size).tolist()
        above = box(wide, tall, deep).translate(
            [*center[[0]], float(level + 1.5 * size[1]), *center[[2]]]
        )
        inner = inner + m.stamp(above, look)
    hollow = solid - inner
    return hollow if hollow.volume() > 0.05 * solid.volume() else solid


def cut(m: Maker, solid: Manifold, mirrored: bool, look: int) -> Manifold:
    """A solid with a hole, a notch or a slot."""
    size = float((extent(solid)[1] - extent(solid)[0]).max())
    point, normal = surface_point(m, solid)
    if mirrored and m.chance(0.6):
        point[0], normal[0] = 0.0, 0.0
        if not normal.any():
            normal[2] = 1.0
    r = size * m.u(0.04, 0.2)
    height = size * m.u(0.05, 1.5)
    tool = m.pick(lathe([(r, 0), (r, height)], 24), box(r * m.u(0.5, 3), height / 2, r), ball(r))
    tool = m.stamp(turned_to(tool, -normal, point + 0.02 * size * normal), look)
    remainder = solid - (both(tool) if mirrored else tool)
    return remainder if remainder.volume() > 0.3 * solid.volume() else solid
