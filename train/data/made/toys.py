"""Blocks, games, robots, and groups of objects."""

from __future__ import annotations

import math

import numpy as np
from manifold3d import Manifold

from .composition import shape
from .details import letter
from .looks import Maker, Parts
from .packages import carton
from .solids import (
    ball,
    box,
    extent,
    joined,
    lathe,
    plate,
    ring,
    ring_of,
    rod,
    slab,
    spline,
    tube,
)
from .vessels import bottle, food, mug


def blocks(m: Maker) -> list[Manifold]:
    """Building blocks, stacked rings, letters, a puzzle; loose on the ground or on one another."""
    kind = m.n(0, 4)
    looks = [
        m.pick(m.plain("toy"), m.plain("toy"), m.plain("pastel"), m.wood())
        for _ in range(m.n(2, 5))
    ]
    parts = Parts(m)
    if kind == 0:  # stacked rings on a rod
        y, r, count = 0.06, m.u(0.35, 0.5), m.n(3, 7)
        parts.add(lathe([(r, 0), (r * 0.9, 0.07)]), looks[0])
        for i in range(count):
            t = m.u(0.06, 0.09)
            wide = r * 0.6 > t * 1.5
            one = ring(r * 0.6, t * 1.4, 36, 14, 0.75) if wide else ball([t * 1.5, t, t * 1.5])
            parts.add(one, looks[i % len(looks)], at=(0, y + t, 0))
            y += 1.9 * t
            r *= m.u(0.8, 0.95)
        parts.add(joined([rod(0.05, y, 16), ball(0.09).translate([0, y + 0.05, 0])]), looks[-1])
    elif kind == 1:  # a tower or a castle
        y = 0.0
        for _ in range(m.n(2, 5)):
            h, count = m.u(0.12, 0.35), m.n(1, 3)
            for x in (np.arange(count) - (count - 1) / 2) * 0.42:
                solid = m.pick(
                    box(m.u(0.25, 0.4), h, m.u(0.2, 0.4), 0.015),
                    rod(m.u(0.1, 0.19), h, 28, 0.01).translate([0, -h / 2, 0]),
                )
                parts.add(solid, m.pick(*looks), at=(x, y + h / 2, 0))
            if m.chance(0.3):
                part = box(0.42 * count, 0.06, 0.4, 0.01)
                parts.add(part, m.pick(*looks), at=(0, y + h + 0.03, 0))
                h += 0.06
            y += h
        if m.chance(0.6):
            profile = [(0.22, 0), (0.01, 0.35), (0, 0.36)]
            top = m.pick(slab([(-0.25, 0), (0.25, 0), (0, 0.3)], 0.3), lathe(profile))
            parts.add(top, m.pick(*looks), at=(0, y - 0.001, 0))
    elif kind == 2:  # loose pieces on the ground
        for i in range(m.n(3, 9)):
            piece = m.pick(box, None, None)
            solid = (
                box(m.u(0.15, 0.3), m.u(0.12, 0.3), m.u(0.15, 0.3), 0.015)
                if piece
                else shape(m, True, 20).scale([m.u(0.15, 0.28)] * 3)
            )
            low, _ = extent(solid)
            a, d = 2.4 * i, 0.17 * math.sqrt(i)
            solid = solid.translate([0, -float(low[1]), 0]).rotate([0, m.u(0, 360), 0])
            part = m.stamp(solid, m.pick(*looks)).translate(
                [d * 1.3 * math.sin(a), 0, d * 1.3 * math.cos(a)]
            )
            parts.append(part)
    elif kind == 3:  # studded bricks
        for i in range(m.n(1, 6)):
            nx, nz, h = m.n(1, 4), m.n(1, 2), 0.12
            brick = box(nx * 0.16 - 0.004, h, nz * 0.16 - 0.004)
            stud = rod(0.048, 0.04, 14).translate([(1 - nx) * 0.08, h / 2 - 0.005, (1 - nz) * 0.08])
            studs = [stud.translate([a * 0.16, 0, b * 0.16]) for a, b in np.ndindex(nx, nz)]
            part = m.stamp(joined([brick, *studs]), m.pick(*looks)).translate(
                [m.n(-1, 1) * 0.16, i * h, m.n(0, 1) * 0.08]
            )
            parts.append(part)
    else:  # letters or figures, standing or lying
        for i in range(m.n(1, 4)):
            part = m.stamp(plate(letter(m), m.u(0.12, 0.4)), looks[i % len(looks)]).translate(
                [i * 1.1, 0, 0]
            )
            parts.append(part)
        if m.chance(0.4):
            part = box(1.1 * len(parts) + 0.2, 0.12, 0.5, 0.02)
            parts.add(part, m.wood(), at=((len(parts) - 1) * 0.55, -0.6, 0))
    return parts.turned(0, m.u(-50, 50))


def game(m: Maker) -> list[Manifold]:
    """A ball, top, skittles, dumb-bell, xylophone, rattle, drum, house, robot."""
    parts = Parts(m)
    a, b, c = m.surface("toy"), m.surface("toy white"), m.surface("any dark")
    kind = m.n(0, 7)
    if kind == 0:
        names, mapping = "striped checked spotted dotted flowered bricked", m.pick("box", "round")
        parts.add(ball(0.5, 48), m.pattern(names, "toy", contrast=1, mapping=mapping))
        return parts
    if kind == 1:
        points = [(0.03, 0), (0.1, 0.1), (m.u(0.3, 0.5), 0.35), (0.12, 0.55), (0.05, 0.8)]
        profile = np.maximum(spline(points, 24), [0.02, 0])
        look = m.pattern("striped grained shaded", "toy wood", contrast=0.8, mapping="round")
        parts.add(lathe(profile, 36), look)
        return parts.turned(m.u(0, 25))
    if kind == 2:
        points = [(0.1, 0), (0.19, 0.3), (0.07, 0.62), (0.11, 0.76), (0.04, 0.88)]
        profile = np.maximum(spline(points, 22), [0.02, 0])
        look = m.pattern("striped", "white toy", contrast=1, mapping="round", repeats=1)
        pin = m.stamp(lathe(profile, 24), look)
        rows = m.n(1, 3)
        pins = [
            pin.translate([(j - i / 2) * 0.5, 0, -i * 0.4])
            for i in range(rows)
            for j in range(i + 1)
        ]
        return [joined([*pins, m.stamp(ball(0.18).translate([m.u(-0.4, 0.4), 0.18, 0.5]), a)])]
    if kind == 3:
        sides = m.pick(6, 8, 32)
        bar = rod(0.06, 1.0, 20).rotate([0, 0, 90]).translate([0.5, 0, 0])
        parts.add(bar, m.metal())
        for x in (-0.36, -0.25, 0.48, 0.37):
            plate = rod(m.u(0.18, 0.35), 0.12, sides, 0.03)
            parts.add(plate, m.pick(a, c), turn=(0, 0, 90), at=(x, 0, 0))
        return parts.turned(0, m.u(-60, 60))
    if kind == 4:  # a xylophone or abacus
        count = m.n(5, 9)
        parts.pair(box(0.06, 0.08, 0.12 * count, 0.01), m.wood(), turn=(0, 8, 0), at=(0.22, 0, 0))
        for i in range(count):
            part = box(0.75 - 0.06 * i, 0.04, 0.09, 0.01)
            parts.add(part, m.plain("toy"), at=(0, 0.06, (i - (count - 1) / 2) * 0.12))
        stick = joined([rod(0.015, 0.6, 8), ball(0.05, 14)])
        parts.add(stick, m.wood(), turn=(70, 40, 0), at=(-0.2, 0.14, 0.1))
        return parts.turned(m.u(0, 20), m.u(-60, 60))
    if kind == 5:  # a drum or a tin with a lid
        r, h = m.u(0.3, 0.5), m.u(0.25, 0.7)
        parts.add(rod(r, h, 40), m.pick(a, m.printed("label", m.color("toy"), "round")))
        parts.add(ring(r, 0.03, 40, 8, 1.3), b)
        parts.add(ring(r, 0.03, 40, 8, 1.3), b, at=(0, h, 0))
        parts.add(rod(r * 0.97, 0.02, 40), m.plain("white"), at=(0, h - 0.01, 0))
        return parts
    if kind == 6:  # a house
        w, h, d = m.u(0.5, 1), m.u(0.4, 0.9), m.u(0.4, 0.8)
        wall = m.pick(a, m.pattern("bricked grained plain", "any"))
        roof = m.pattern("bricked striped plain", "toy earth")
        trim = m.plain("white dark")
        gable = m.u(0.2, 0.5)
        parts.add(slab([(-w / 2, 0), (w / 2, 0), (w / 2, h), (0, h + gable), (-w / 2, h)], d), wall)
        lean = math.degrees(math.atan2(gable, w / 2))
        side = box(math.hypot(gable, w / 2) * 1.25, 0.05, d * 1.15)
        parts.pair(side, roof, turn=(0, 0, -lean), at=(w * 0.27, h + gable * 0.48, 0))
        parts.add(box(w * 0.2, h * 0.5, 0.06), trim, at=(m.u(-0.2, 0.2) * w, h * 0.25, d / 2))
        part = box(w * 0.18, w * 0.18, 0.05)
        parts.pair(part, m.plain("dark pastel"), at=(w * 0.3, h * 0.65, d / 2))
        if m.chance(0.5):
            parts.add(box(0.1, 0.3, 0.1), roof, at=(w * 0.25, h + gable * 0.7, -d * 0.2))
        return parts.turned(0, m.u(-50, 50))
    # A robot: boxes and rods.
    metal, second, dark = m.pick(m.metal(), a), b, c
    w, h = m.u(0.3, 0.5), m.u(0.35, 0.55)
    parts.add(box(w, h, w * 0.7, m.u(0.0, 0.08)), metal, at=(0, h / 2 + 0.3, 0))
    hw = w * m.u(0.5, 0.9)
    part = box(hw, hw * 0.8, hw * 0.8, m.u(0, 0.1))
    parts.add(part, m.pick(metal, second), at=(0, h + 0.35 + hw * 0.4, 0))
    parts.add(rod(0.06, 0.1, 14), dark, at=(0, h + 0.27, 0))
    part = ball(hw * 0.14, 16)
    parts.pair(part, m.plain("toy white"), at=(hw * 0.25, h + 0.38 + hw * 0.4, hw * 0.4))
    line = [
        (w / 2, h + 0.2, 0),
        (w / 2 + 0.15, h + m.u(-0.1, 0.2), 0),
        (w / 2 + m.u(0.1, 0.2), h - 0.1 + m.u(-0.2, 0.4), m.u(0, 0.25)),
    ]
    arm = tube(line, 0.055, m.pick(12, ring_of(8, 12)), 18)
    parts.pair(arm, second)
    part = box(w * 0.3, 0.34, w * 0.35, 0.02).translate([w * 0.27, 0.15, 0]) + box(
        w * 0.36, 0.1, w * 0.6, 0.02
    ).translate([w * 0.27, 0.02, 0.04])
    parts.pair(part, dark)
    panel = m.printed("label", m.color("dark white"), sides=True)
    parts.add(box(w * 0.7, h * 0.5, 0.05), panel, at=(0, h * 0.55 + 0.3, w * 0.35))
    return parts.turned(0, m.u(-40, 40))


def pieces(m: Maker) -> list[Manifold]:
    """Several things of one kind, or a set of different ones, side by side on the ground."""
    plan = m.pick(bottle, carton, food, mug, game, shape)
    parts = Parts(m)
    x = 0.0
    for _ in range(m.n(2, 3)):
        one = m.stamp(shape(m), m.surface()) if plan is shape else joined(plan(m))
        low, high = extent(one)
        scale = m.u(0.6, 1) / max(float((high - low).max()), 0.1)
        one = one.scale([scale] * 3)
        low, high = extent(one)
        one = one.translate(
            [x - float(low[0]), -float(low[1]), m.u(-0.15, 0.15) - float(low[2] + high[2]) / 2]
        )
        parts.append(one)
        x += float(high[0] - low[0]) + m.u(-0.02, 0.08)
    return parts.turned(0, m.u(-40, 40))
