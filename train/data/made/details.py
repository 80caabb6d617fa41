"""Handles, wheels and other parts that several plans have."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from manifold3d import CrossSection, Manifold

from .looks import Maker
from .solids import ball, joined, lathe, ring_of, rod, rounded, superquadric, tube


def handle(m: Maker, width: float, height: float, thick: float) -> Manifold:
    """A bow in the plane of x and y whose ends lie on x = 0, about y = 0."""
    square = m.chance(0.3)
    path = [
        *((0, height / 2, 0), (width * (1 if square else 0.8), height / 2, 0), (width, 0, 0)),
        *((width * (1 if square else 0.75), -height / 2, 0), (0, -height / 2, 0)),
    ]
    return tube(path, thick, 12, 26, flat=(1, m.u(1, 1.8)), round_ends=False)


def bow(half: list, thick: float, count: int = 32, flat: float = 1.0) -> Manifold:
    """A tube through points, the last of which lies on x = 0, and their mirror images."""
    mirrored = [(-x, y, z) for x, y, z in half[-2::-1]]
    return tube([*half, *mirrored], thick, 10, count, flat=(1, flat))


def bar(start: Sequence[float], end: Sequence[float], radius: float) -> Manifold:
    """A straight wire between two points."""
    return tube(np.linspace(start, end, 3), radius, 6, 3, round_ends=False)


def wheel(radius: float, thick: float) -> Manifold:
    """A wheel about the x axis."""
    return rod(radius, thick, 28, 0.25 * thick).translate([0, -thick / 2, 0]).rotate([0, 0, 90])


def laid(m: Maker, parts: list[Manifold], share: float) -> list[Manifold]:
    """Parts that lie on their side in a share of cases, turned about y by some angle."""
    whole = joined(parts)
    if m.chance(share):
        whole = whole.rotate([90 if m.chance(0.5) else -90, 0, 0]).rotate([0, m.u(-90, 90), 0])
    elif m.chance(0.4):
        whole = whole.rotate([0, m.u(-45, 45), 0])
    return [whole]


def produce(m: Maker, r: float) -> Manifold:
    """Something round to eat, about the origin."""
    kind = m.n(0, 4)
    if kind == 0:
        return ball([r, r * m.u(0.8, 1.3), r], 24)
    if kind == 1:
        t = np.linspace(0.05, 0.95, 12) * math.pi
        dent = 1 + 0.18 * np.abs(np.cos(t)) ** 3
        profile = np.stack(
            [r * np.sin(t) * dent, -r * 0.9 * np.cos(t) * (1 - 0.25 * np.exp(-8 * np.sin(t) ** 2))],
            1,
        )
        contour = [(0, profile[0, 1] + 0.05 * r), *profile.tolist(), (0, profile[-1, 1] - 0.1 * r)]
        return lathe(contour, 24)
    if kind == 2:
        return tube([(0, -r, 0), (0.3 * r, 0, 0), (0, r, 0)], [0.25 * r, 0.45 * r, 0.2 * r], 12, 16)
    if kind == 3:
        return superquadric([r, r * 0.8, r], m.u(0.5, 1), m.u(0.4, 1), 24)
    contour = [
        *((0, -r), (r * 0.3, -r * 0.95), (r * 0.9, -0.1 * r), (r * 0.6, 0.6 * r), (0.1 * r, r)),
    ]
    return lathe(contour, 20)


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
