"""Mugs, teapots, bottles, bowls, pots with plants; food."""

from __future__ import annotations

import math

import numpy as np
from manifold3d import Manifold

from .details import bow, handle, laid, produce
from .looks import Maker, Parts
from .solids import (
    ball,
    box,
    joined,
    lathe,
    ring,
    ring_of,
    ripple,
    rod,
    slab,
    spline,
    superquadric,
    tube,
)


def _vessel(m: Maker, profile: np.ndarray, wall: float, sides: int = 36) -> Manifold:
    """An open vessel of an outer profile ``[K, 2]`` from its foot to its rim."""
    inner = profile[::-1] - [wall, 0]
    inner = inner[(inner[:, 0] > 0.3 * wall) & (inner[:, 1] > profile[0, 1] + wall)]
    rim = [
        (profile[-1, 0] - 0.15 * wall, profile[-1, 1] + 0.4 * wall),
        (profile[-1, 0] - 0.85 * wall, profile[-1, 1] + 0.4 * wall),
    ]
    floor = profile[0, 1] + wall
    line = [
        (0, profile[0, 1]),
        *profile.tolist(),
        *rim,
        *inner.tolist(),
        (max(float(inner[-1, 0]) - 0.2 * wall, 0.01), floor),
    ]
    return lathe(line, sides)


def _profile(m: Maker, foot: float, rim: float, height: float, swell: float = 0.25) -> np.ndarray:
    """A smooth outer profile ``[16, 2]``."""
    t = np.array([0, 0.33, 0.67, 1.0])
    r = (
        foot
        + (rim - foot) * t
        + np.array([0, 1, 1, 0]) * m.rng.uniform(-0.3, 1, 4) * swell * max(foot, rim)
    )
    return spline(np.stack([np.maximum(r, 0.05), t * height], 1), 16)


def mug(m: Maker) -> list[Manifold]:
    """A mug, cup, glass or beaker, with or without a handle."""
    r, h = m.u(0.25, 0.5), m.u(0.5, 1.1)
    profile = _profile(m, r * m.u(0.6, 1), r, h, m.pick(0.0, 0.05, 0.25))
    names = "striped flowered spotted checked shaded"
    painted = m.pattern(names, contrast=0.7, mapping="round")
    outer = m.pick(m.surface(), m.printed("label", m.color("white any"), "round"), painted)
    cup = m.stamp(_vessel(m, profile, m.u(0.02, 0.05)), outer)
    parts = Parts(m)
    parts.append(cup)
    if m.chance(0.75):
        middle = h * m.u(0.45, 0.6)
        grip = handle(m, m.u(0.2, 0.35), h * m.u(0.4, 0.7), m.u(0.025, 0.05))
        reach = float(np.interp(middle, profile[:, 1], profile[:, 0]))
        grip = grip.translate([reach - 0.03, middle, 0])
        axle = rod(reach - 0.01, h * 1.2, 24)
        handles = [m.stamp(grip - axle, m.pick(outer, m.plain()))]
        if m.chance(0.1):
            handles.append(handles[0].mirror([1, 0, 0]))
        parts += handles
    if m.chance(0.4):
        level = h * m.u(0.6, 0.9)
        part = rod(float(np.interp(level, profile[:, 1], profile[:, 0])) - 0.01, 0.02).translate(
            [0, level, 0]
        ) ^ rod(5, 9)
        parts.add(part, m.plain("earth dark leaf"))
    elif m.chance(0.2):  # a lid
        part = lathe([(r * 1.05, 0), (r * 1.03, 0.08), (r * 0.5, 0.14)])
        parts.add(part, m.plain(), at=(0, h - 0.01, 0))
    angle = m.u(-180, 180) if m.chance(0.3) else m.u(-50, 50)
    return [p.rotate([0, angle, 0]) for p in parts]


def teapot(m: Maker) -> list[Manifold]:
    """A teapot, kettle, jug or watering can."""
    r, h = m.u(0.3, 0.5), m.u(0.35, 0.9)
    profile = _profile(m, r * m.u(0.5, 1), r * m.u(0.35, 0.9), h, 0.5)
    painted = m.pattern("flowered spotted", "white pastel", contrast=0.8, mapping="round")
    look = m.pick(m.surface(), m.metal(), painted)
    second = m.surface("dark metal any")
    body = lathe([(0, 0), *profile.tolist(), (0, h)])
    parts = Parts(m)
    parts.add(body, look)
    wide = float(profile[:, 0].max())
    long = m.u(0.25, 0.6)
    line = [
        (wide * 0.7, h * 0.3, 0),
        (wide + long * 0.5, h * m.u(0.35, 0.6), 0),
        (wide + long, h * m.u(0.8, 1.15), 0),
    ]
    spout = tube(line, [0.12, 0.08, m.u(0.04, 0.07)], 14, 20, round_ends=False)
    parts.add(spout, look)
    grip = handle(m, m.u(0.2, 0.4), h * m.u(0.5, 0.9), m.u(0.025, 0.05))
    if m.chance(0.7):
        parts.add(grip, m.pick(look, second), turn=(0, 180, 0), at=(-wide * 0.8, h * 0.55, 0))
    else:
        x = wide * 0.8
        line = [(x, h * 0.8, 0), (x, h * 1.4, 0), (-x, h * 1.4, 0), (-x, h * 0.8, 0)]
        over = tube(line, 0.035, 10, 28)
        parts.add(over, second)
    top = float(profile[-1, 0])
    contour = [
        *((top * 0.98, -0.02), (top * 0.9, 0.06), (0.08, m.u(0.08, 0.2)), (0.05, 0.2)),
        *((0.07, 0.25), (0, 0.3)),
    ]
    lid = lathe(contour)
    parts.add(lid, m.pick(look, second), at=(0, h, 0))
    angle = m.pick(0, 180, m.u(-70, 70))
    return [p.rotate([0, angle, 0]) for p in parts]


def bottle(m: Maker) -> list[Manifold]:
    """A bottle, jar, can, tin or tube with a label and a cap."""
    r, h = m.u(0.14, 0.4), m.u(0.5, 1.2)
    kind = m.n(0, 3)
    shoulder = h * m.u(0.55, 0.95)
    neck = r * m.u(0.25, 0.6) if kind <= 1 else r * m.u(0.8, 1)
    e = 0.06 * r
    soft = m.u(0.2, 1) * (h - shoulder)
    profile = [
        *((r - e, 0), (r, e), (r, shoulder - soft * 0.2)),
        *((0.5 * (r + neck) + 0.1 * r, shoulder + soft * 0.35), (neck, shoulder + soft), (neck, h)),
    ]
    if m.chance(0.25):  # a waist, as a sports bottle has
        waist = (r * m.u(0.75, 0.95), 0.5 * shoulder)
        profile[2:2] = [(r, 0.3 * shoulder), waist, (r, 0.75 * shoulder)]
    flat = m.pick(1, 1, 1, m.u(0.45, 0.85))
    square = m.pick(2, 2, 2, m.u(3, 8))
    body = lathe(profile, 40)
    if square > 2:

        def squared(p: np.ndarray) -> np.ndarray:
            a, b = np.abs(p[:, 0]) + 1e-9, np.abs(p[:, 2]) + 1e-9
            k = np.hypot(a, b) / (a**square + b**square) ** (1 / square)
            k = 1 + (k - 1) * np.clip(1 - (p[:, 1] - shoulder) / max(soft, 0.01), 0, 1)
            return np.stack([p[:, 0] * k, p[:, 1], p[:, 2] * k], -1)

        body = body.warp_batch(squared)
    ground = m.color("white toy any earth")
    parts = Parts(m)
    parts.add(body, m.pick(m.plain(), m.plain("earth white toy"), m.surface()))
    low, high = m.u(0.06, 0.3) * shoulder, m.u(0.7, 0.97) * shoulder
    if m.chance(0.85):
        strip = box(9, high - low, 9).translate([0, (low + high) / 2, 0])
        label = body.scale([1.015, 1, 1.015]) ^ strip
        parts.add(
            label,
            m.printed(m.pick("label", "label", "front"), ground, "round" if flat == 1 else "fit"),
        )
    cap_r, cap_h = neck * m.u(1.05, 1.3), m.u(0.08, 0.25)
    top = m.n(0, 4)
    cap = m.plain("toy white dark metal")
    if top <= 2:
        lid = rod(cap_r, cap_h, 36, 0.02)
        if m.chance(0.4):
            rib = rod(0.012, cap_h * 0.8, 6).translate([cap_r, 0.02, 0])
            ribs = [rib.rotate([0, 360 * i / 23, 0]) for i in range(23)]
            lid = joined([lid, *ribs])
        parts.add(lid, cap, at=(0, h - 0.02, 0))
    elif top == 3:  # a pump or a spray
        parts.add(rod(neck * 1.1, 0.1), cap, at=(0, h - 0.02, 0))
        parts.add(rod(neck * 0.3, 0.25, 14), cap, at=(0, h, 0))
        line = [(0, h + 0.25, -0.08), (0, h + 0.27, 0.1), (0, h + 0.2, m.u(0.2, 0.4))]
        parts.add(tube(line, [0.06, 0.06, 0.03], 10, 14), cap)
    if flat != 1:
        parts = [p.scale([1, 1, flat]) for p in parts]
    return laid(m, parts, 0.12)


def bowl(m: Maker) -> list[Manifold]:
    """A bowl, plate, basket, pan or bucket, often with things in it."""
    r, h = m.u(0.4, 0.7), m.u(0.08, 0.7)
    profile = _profile(m, r * m.u(0.4, 0.95), r, h, 0.15)
    names, mapping = "striped flowered woven checked dotted speckled", m.pick("box", "round")
    painted = m.pattern(names, contrast=0.6, mapping=mapping)
    look = m.pick(m.surface(), m.wood(), m.metal(), painted)
    sides = m.pick(36, 36, 36, 6, 8)
    vessel = _vessel(m, profile, m.u(0.02, 0.05), sides)
    if m.chance(0.25):
        vessel = vessel.scale([1, 1, m.u(0.55, 0.85)])
    parts = Parts(m)
    parts.add(vessel, look)
    kind = m.n(0, 5)
    if kind == 0:  # a pan's handle
        line = [(r * 0.95, h * 0.8, 0), (r + 0.3, h + 0.05, 0), (r + m.u(0.5, 0.9), h + 0.08, 0)]
        parts.add(tube(line, [0.04, 0.035, 0.05], 10, 14), m.surface("dark wood"))
    elif kind == 1:  # a bucket's
        half = [(r * 0.97, h * 0.9, 0), (r * 0.8, h + 0.6 * r, 0), (0, h + r, 0)]
        parts.add(bow(half, m.u(0.015, 0.05)), m.surface("metal wood any"))
    elif kind == 2:
        parts.pair(handle(m, 0.15, 0.25, 0.025), look, turn=(90, 0, 0), at=(r * 0.93, h * 0.85, 0))
    if m.chance(0.5):
        things = [m.surface("toy leaf earth") for _ in range(3)]
        inside = r * 0.6
        size = m.u(0.1, 0.25)
        for _ in range(m.n(1, 9)):
            a, d = m.u(0, 6.3), m.u(0, 1) ** 0.5 * max(inside - size, 0.02)
            item = produce(m, size * m.u(0.8, 1.2)).rotate([m.u(0, 360), m.u(0, 360), 0])
            y = max(h * 0.7, size) + m.u(-0.05, 0.1)
            parts.add(item, m.pick(*things), at=(d * math.sin(a), y, d * math.cos(a)))
    return parts


def plant(m: Maker) -> list[Manifold]:
    """A pot, with a plant in most cases; a vase with flowers; a cactus."""
    r, h = m.u(0.2, 0.4), m.u(0.25, 0.9)
    profile = _profile(m, r * m.u(0.6, 1), r, h, m.pick(0.1, 0.5))
    sides = m.pick(36, 36, 4, 6, 8)
    names, kinds = "speckled clouded woven striped", "earth white any"
    painted = m.pattern(names, kinds, contrast=0.4, mapping="round")
    look = m.pick(m.surface(kinds), painted)
    parts = Parts(m)
    parts.add(_vessel(m, profile, 0.03, sides), look)
    if m.chance(0.3):
        parts.add(ring(float(profile[-1, 0]), 0.035, 36, 8), look, at=(0, h, 0))
    if m.chance(0.3):
        return parts
    rim = float(profile[-3, 0]) - 0.02
    parts.add(rod(max(rim, 0.03), 0.05), m.pattern("speckled", "earth dark"), at=(0, h - 0.1, 0))
    leaf = m.pattern("plain clouded shaded", "leaf")
    kind = m.n(0, 3)
    if kind == 0:  # a ball of leaves or a bonsai
        for _ in range(m.n(1, 5)):
            s = m.u(0.15, 0.4)
            x, y, z = m.u(-0.2, 0.2), h + m.u(0.1, 0.6), m.u(-0.2, 0.2)
            clump = ripple(ball([s, s * m.u(0.6, 1.1), s], 24), m.rng, 0.12 * s, 0.5 * s, False)
            parts.add(clump, leaf, at=(x, y, z))
            part = tube([(0, h - 0.1, 0), (x * 0.4, (h + y) / 2, z * 0.4), (x, y, z)], 0.03, 8, 12)
            parts.add(part, m.wood())
    elif kind == 1:  # long leaves
        for i in range(m.n(4, 11)):
            a, long, lean = 2.4 * i, m.u(0.4, 1.0), m.u(0.1, 0.7)
            line = [(0, 0, 0), (0, long * 0.6, lean * long * 0.3), (0, long, lean * long)]
            blade = tube(line, [0.03, m.u(0.04, 0.1), 0.01], 6, 10, flat=(0.2, 1))
            parts.add(blade, leaf, turn=(0, math.degrees(a), 0), at=(0, h - 0.08, 0))
    elif kind == 2:  # a cactus
        ribs = m.n(6, 12)
        c, tall = m.u(0.1, 0.22), m.u(0.3, 0.9)
        angle = np.linspace(0, 2 * math.pi, 49)[:-1]
        form = ring_of(2, 48) * (1 + 0.1 * np.cos(ribs * angle))[:, None]
        line = [(0, h - 0.1, 0), (0, h + tall / 2, 0), (0, h + tall, 0)]
        parts.add(tube(line, [c * 0.9, c, c * 0.8], form, 14), leaf)
        if m.chance(0.5):
            line = [
                (0, h + tall * 0.4, 0),
                (c + 0.15, h + tall * 0.45, 0),
                (c + 0.18, h + tall * 0.8, 0),
            ]
            arm = tube(line, [0.07, 0.08, 0.06], 12, 18)
            parts.add(arm, leaf)
    else:  # flowers on stalks
        petal, heart = m.plain("toy pastel white"), m.plain("toy earth")
        for _ in range(m.n(2, 6)):
            x, z, y = m.u(-0.3, 0.3), m.u(-0.3, 0.3), h + m.u(0.3, 0.7)
            part = tube([(0, h - 0.1, 0), (x * 0.3, (h + y) / 2, z * 0.3), (x, y, z)], 0.018, 8, 12)
            parts.add(part, leaf)
            s = m.u(0.1, 0.18)
            bloom = slab(outline_of_flower(m.n(5, 8)) * s, 0.04, 0.015).rotate(
                [m.u(-80, -10), m.u(-60, 60), 0]
            )
            parts.add(bloom, petal, at=(x, y, z))
            parts.add(ball(0.35 * s, 16), heart, at=(x, y + 0.02, z + 0.02))
    return parts


def outline_of_flower(petals: int) -> np.ndarray:
    """An outline ``[40, 2]`` of radius 1 with petals."""
    angle = np.arange(40) * (2 * math.pi / 40)
    r = 0.75 + 0.25 * np.cos(petals * angle)
    return np.stack([r * np.cos(angle), r * np.sin(angle)], -1)


def food(m: Maker) -> list[Manifold]:
    """A fruit, a loaf, a cake, a burger, a doughnut, an ice cream."""
    parts = Parts(m)
    kind = m.n(0, 6)
    if kind == 0:
        look = m.pattern("clouded speckled striped shaded plain", "toy leaf earth", contrast=0.3)
        parts.add(produce(m, 0.5), look)
        stem = tube([(0, 0.3, 0), (0.03, 0.55, 0), (0.08, 0.65, 0.02)], [0.03, 0.025, 0.035], 8, 10)
        parts.add(stem, m.plain("wood leaf"))
        if m.chance(0.5):
            leaf = (
                slab(ring_of(1.3, 16) * [0.22, 0.1], 0.02)
                .rotate([70, 20, 0])
                .translate([0.22, 0.55, 0])
            )
            parts.add(leaf, m.plain("leaf"))
        return parts
    if kind == 1:  # a loaf, with cuts
        crust = m.pattern("clouded speckled", "wood")
        crumb = m.pattern("speckled", "white wood")
        loaf = superquadric(
            [m.u(0.5, 0.9), m.u(0.25, 0.4), m.u(0.25, 0.45)], m.u(0.5, 0.9), m.u(0.4, 1), 40
        )
        loaf = m.stamp(ripple(loaf, m.rng, 0.02, 0.4, False).trim_by_plane([0, 1, 0], -0.15), crust)
        cuts = [
            m.stamp(box(0.05, 0.12, 0.5).rotate([0, 30, 0]).translate([x, 0.32, 0]), crumb)
            for x in np.linspace(-0.35, 0.35, m.n(2, 5))
        ]
        return [loaf - joined(cuts)]
    if kind == 2:  # a cake in layers, sometimes a slice
        r, y = m.u(0.4, 0.6), 0.0
        looks = [m.pattern("speckled", "wood pastel"), m.plain("white pastel toy")]
        for i in range(m.n(2, 5)):
            t = m.u(0.06, 0.2)
            parts.add(rod(r - 0.01 * (i % 2), t + 0.004, 40, 0.02), looks[i % 2], at=(0, y, 0))
            y += t
        for a in np.linspace(0, 2 * math.pi, m.n(1, 10))[:-1]:
            look = m.pick(*looks) if m.chance(0.3) else m.plain("toy")
            at = (0.75 * r * math.sin(a), y + 0.05, 0.75 * r * math.cos(a))
            parts.add(produce(m, 0.08), look, at=at)
        whole = joined(parts)
        if m.chance(0.4):
            form = [(0, 0), (1.5, 0), (1.5, m.u(0.8, 2.5))]
            wedge = m.stamp(slab(form, 4).rotate([90, 0, 0]).rotate([0, m.u(0, 360), 0]), looks[0])
            whole = whole ^ wedge if m.chance(0.5) else whole - wedge
        return [whole]
    if kind == 3:  # a burger or a sandwich: layers between halves
        y, square = 0.0, m.pick(1.0, m.u(0.2, 0.5))
        bun = m.pattern("speckled plain", "wood")
        parts.add(superquadric([0.5, 0.1, 0.5], 0.6, square), bun)
        for _ in range(m.n(2, 5)):
            y += m.u(0.07, 0.12)
            layer = superquadric([m.u(0.46, 0.58), m.u(0.03, 0.08), m.u(0.46, 0.58)], 0.5, square)
            layer = ripple(layer, m.rng, 0.012, 0.2, False) if m.chance(0.5) else layer
            parts.add(layer, m.surface("leaf toy earth"), at=(0, y, 0))
        top = superquadric([0.5, m.u(0.15, 0.3), 0.5], 0.9, square).trim_by_plane([0, 1, 0], -0.03)
        parts.add(top, bun, at=(0, y + 0.08, 0))
        return parts
    if kind == 4:  # a doughnut
        r = m.u(0.12, 0.2)
        dough = ring(0.35, r, 40, 18, m.u(0.7, 1))
        ice = ring(0.35, r * 1.06, 40, 18, 0.85).translate([0, 0.02, 0])
        ice = ripple(ice, m.rng, 0.02, 0.25, False).trim_by_plane([0, 1, 0], 0.02)
        parts.add(dough, m.plain("wood"))
        parts.add(ice, m.plain("pastel earth toy"))
        flip = [90.0 if m.chance(0.3) else 0.0, 0.0, 0.0]
        return [p.rotate(flip) for p in parts]
    if kind == 5:  # an ice cream
        cone = lathe([(0.03, 0), (m.u(0.18, 0.28), 0.7)], 24)
        parts.add(cone, m.pattern("checked", "wood", repeats=4))
        y, r = 0.78, 0.26
        for _ in range(m.n(1, 3)):
            scoop = ripple(ball(r, 28), m.rng, 0.012, 0.15, False)
            parts.add(scoop, m.pattern("speckled plain", "pastel earth white"), at=(0, y, 0))
            y += r * 1.2
            r *= m.u(0.8, 1)
        return parts
    look = m.pattern("plain clouded", "toy leaf earth")  # a root or a banana
    line = [(0, -0.7, 0), (m.u(-0.2, 0.2), -0.2, 0), (m.u(-0.3, 0.3), 0.4, 0), (0, 0.8, 0)]
    body = tube(line, [0.04, m.u(0.1, 0.2), m.u(0.12, 0.28), m.u(0.05, 0.15)], m.pick(16, 6), 32)
    parts.add(body, look)
    if m.chance(0.6):
        for _ in range(m.n(2, 6)):
            line = [
                (0, 0.75, 0),
                (m.u(-0.2, 0.2), 1.0, m.u(-0.2, 0.2)),
                (m.u(-0.4, 0.4), 1.25, m.u(-0.4, 0.4)),
            ]
            parts.add(tube(line, [0.04, 0.05, 0.02], 8, 12), m.plain("leaf"))
    return parts.turned(0, 0, m.pick(0, 90, m.u(60, 120)))
