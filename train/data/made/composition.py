"""Free compositions: random parts that grow on the surfaces of earlier ones."""

from __future__ import annotations

import math

import numpy as np
from manifold3d import CrossSection, Manifold

from .looks import Maker
from .solids import (
    Blend,
    ball,
    bend,
    both,
    box,
    extent,
    joined,
    lathe,
    loft,
    plate,
    ring_of,
    ripple,
    rod,
    rounded,
    slab,
    spline,
    superquadric,
    taper,
    tube,
    twist,
)

ENOUGH = 8_000  # faces of the parts after which no more are added
SCHEMES = (
    *("toy", "toy", "pastel", "dark metal", "white metal", "wood earth"),
    *("fur", "any", "any", "wide", "leather earth", "white dark"),
)


def composition(m: Maker) -> list[Manifold]:
    """A body, and two to nine parts on it: mirrored, in rows, around an axis, or cut out of it."""
    scheme = m.pick(*SCHEMES)
    looks = [m.fur(scheme) if m.chance(0.15) else m.surface(scheme) for _ in range(m.n(2, 4))]
    if m.chance(0.33):
        looks[m.n(0, 1)] = m.printed(
            m.pick("front", "label"), m.color(f"{scheme} white"), m.pick("fit", "round")
        )
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
        parts = [whole_warped(m, parts, mirrored)]
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
    kind = m.n(0, 11)
    a, b, c = np.exp(m.rng.uniform(math.log(0.25), math.log(0.95), 3))
    if kind <= 1:
        return superquadric([a, b, c], m.u(0.15, 1.3), m.u(0.15, 1.3), fine // 4 * 4)
    if kind <= 3:
        return box(2 * a, 2 * b, 2 * c, m.pick(0.0, m.u(0.02, 0.12), m.u(0.1, 0.5) * min(a, b, c)))
    if kind <= 5:
        return turned(m, a, 2 * b, fine)
    if kind == 6:
        return slab(outline(m, fine * 3 // 2), m.u(0.05, 0.6), m.u(0, 0.1)).scale(
            [a / 0.6, b / 0.6, 1]
        )
    if kind <= 8:
        return loafed(m, a, b, c, fine)
    if kind == 9:
        return lumps(m, mirrored, fine * 5 // 4)
    if kind == 10:
        path = m.rng.normal(0, 0.4, (m.n(3, 5), 3)) + np.linspace([0, -0.6, 0], [0, 0.6, 0], 5)[:1]
        if mirrored:
            path[:, 0] *= 0.0 if m.chance(0.7) else 1.0
        return tube(path, m.rng.uniform(0.05, 0.3, 3), fine // 2, fine * 3 // 4, m.u(0.5, 1))
    return plate(letter(m), m.u(0.1, 0.5))


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
    contour = [(0, profile[0, 1]), *profile.tolist(), (0, profile[-1, 1])]
    made = lathe(contour, m.pick(6, 8, fine, fine, fine))
    return made.translate([0, -height / 2, 0])


def loafed(m: Maker, a: float, b: float, c: float, fine: int) -> Manifold:
    """A solid through superellipses whose sizes, positions and forms change along z."""
    count, sides = fine // 2, fine * 7 // 8
    t = np.linspace(-1, 1, count)
    ends = m.u(0.3, 0.95)
    swell = 1 - (np.abs(t) ** m.u(2, 6)) * ends
    wide = a * swell * spline(m.rng.uniform(0.6, 1.1, (4, 1)), count)[:, 0]
    tall = b * swell * spline(m.rng.uniform(0.6, 1.1, (4, 1)), count)[:, 0]
    lift = b * spline(m.rng.uniform(-0.4, 0.4, (3, 1)), count)[:, 0]
    form = ring_of(m.u(1.7, 6), sides)
    rings = np.empty((count, sides, 3))
    rings[..., 0] = form[None, :, 0] * wide[:, None]
    rings[..., 1] = form[None, :, 1] * tall[:, None] + lift[:, None]
    rings[..., 2] = c * 1.3 * t[:, None]
    tips = rings[[0, -1]].mean(1) + [[0, 0, -0.1 * c], [0, 0, 0.1 * c]]
    return loft(rings, tips)


def outline(m: Maker, sides: int = 48) -> np.ndarray:
    """A smooth, starred or toothed outline ``[sides, 2]`` of radius .6 or so."""
    angle = np.arange(sides) * (2 * math.pi / sides)
    kind = m.n(0, 4)
    if kind == 0:
        r = 1 + sum(m.u(-0.25, 0.25) / k * np.cos(k * (angle - math.pi / 2)) for k in range(2, 6))
    elif kind == 1:
        r = 1 + m.u(0.1, 0.35) * np.cos(m.n(3, 8) * (angle - math.pi / 2))
    elif kind == 2:
        teeth = m.n(6, 16)
        r = 1 + m.u(0.05, 0.15) * np.tanh(4 * np.sin(teeth * angle))
    elif kind == 3:
        return 0.6 * ring_of(m.u(1.2, 8), sides)
    else:
        width = m.u(0.5, 1.3)
        return rounded(width, m.u(0.5, 1.3), m.u(0.05, 0.6) * width, sides // 4)
    return 0.6 * np.stack([r * np.cos(angle), r * np.sin(angle)], -1)


def letter(m: Maker) -> CrossSection:
    """A figure of bars and bows, as letters are."""
    w = m.u(0.08, 0.2)
    points = [
        *((-0.4, -0.5), (0.4, -0.5), (-0.4, 0.0), (0.4, 0.0), (-0.4, 0.5), (0.4, 0.5), (0, -0.5)),
        (0, 0.5),
    ]
    dot = (
        CrossSection.circle(w, 12)
        if m.chance(0.5)
        else CrossSection.square([1.7 * w, 1.7 * w], True)
    )
    bars, here = [], points[m.n(0, 7)]
    for _ in range(m.n(2, 5)):
        there = points[m.n(0, 7)]
        bars.append(CrossSection.batch_hull([dot.translate(here), dot.translate(there)]))
        here = there
    made = bars[0]
    for bar in bars[1:]:
        made = made + bar
    if m.chance(0.4):
        bow = CrossSection.circle(0.35, 32) - CrossSection.circle(0.35 - w, 32)
        made = made + bow.translate([m.u(-0.2, 0.2), m.pick(-0.2, 0.2)])
    return made


def lumps(m: Maker, mirrored: bool, cells: int) -> Manifold:
    """Limbs and eggs that flow together."""
    blend = Blend(m.u(0.03, 0.25), mirrored)
    points = [np.zeros(3)]
    blend.egg((0, 0, 0), m.rng.uniform(0.15, 0.5, 3))
    for _ in range(m.n(2, 5)):
        start = points[m.n(0, len(points) - 1)]
        end = start + m.rng.normal(0, 0.4, 3) * [1, 1, 0.8]
        if m.chance(0.35):
            end[0] = start[0]
        r = m.u(0.05, 0.22)
        blend.limb([start, end], [r, r * m.u(0.4, 1.5)])
        points.append(end)
    return blend.solid(cells)


def warped(m: Maker, solid: Manifold, mirrored: bool) -> Manifold:
    """A solid that is refined, then bent, tapered, twisted or displaced."""
    low, high = extent(solid)
    size = float((high - low).max())
    fine = solid.refine_to_length(size / 12) if solid.num_tri() < 2000 else solid
    for _ in range(m.n(1, 2)):
        kind = m.n(0, 3)
        if kind == 0:
            fine = bend(fine, m.u(-1, 1))
        elif kind == 1:
            fine = taper(fine, m.u(0.4, 1.5))
        elif kind == 2:
            fine = fine if mirrored and m.chance(0.7) else twist(fine, m.u(-1.5, 1.5))
        else:
            length = size * m.u(0.15, 0.6)
            fine = ripple(fine, m.rng, length * m.u(0.03, 0.1), length, mirrored)
    return fine


def whole_warped(m: Maker, parts: list[Manifold], mirrored: bool) -> Manifold:
    """All parts as one solid, warped."""
    whole = joined(parts)
    return warped(m, whole, mirrored) if whole.num_tri() < 6_000 else whole


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
    share = 1 - 2 * wall / size
    if (share < 0.2).any():
        return solid
    center = (low + high) / 2
    inner = m.stamp(
        solid.translate((-center).tolist()).scale(share.tolist()).translate(center.tolist()), look
    )
    inner = inner.translate([0, float(size[1]) * m.u(0.1, 0.4), 0])
    level = high[1] - m.u(0.02, 0.3) * size[1]
    if m.chance(0.6):
        wide, tall, deep = (3 * size).tolist()
        above = box(wide, tall, deep).translate(
            [*center[[0]], float(level + 1.5 * size[1]), *center[[2]]]
        )
        inner = inner + m.stamp(above, look)
    made = solid - inner
    return made if made.volume() > 0.05 * solid.volume() else solid


def cut(m: Maker, solid: Manifold, mirrored: bool, look: int) -> Manifold:
    """A solid with a hole, a notch or a slot."""
    size = float((extent(solid)[1] - extent(solid)[0]).max())
    point, normal = surface_point(m, solid)
    if mirrored and m.chance(0.6):
        point[0], normal[0] = 0.0, 0.0
        if not normal.any():
            normal[2] = 1.0
    r = size * m.u(0.04, 0.2)
    tool = m.pick(
        rod(r, size * m.u(0.05, 1.5)), box(r * m.u(0.5, 3), size * m.u(0.1, 0.5), r, 0.0), ball(r)
    )
    tool = m.stamp(turned_to(tool, -normal, point + 0.02 * size * normal), look)
    made = solid - (both(tool) if mirrored else tool)
    return made if made.volume() > 0.3 * solid.volume() else solid
