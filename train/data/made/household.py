"""Vessels, packages, food, plants, lamps, furniture."""

from __future__ import annotations

import math

import numpy as np
from manifold3d import Manifold

from .composition import handle, outline, shape
from .looks import Maker
from .solids import (
    ball, bend, both, box, extent, joined, lathe, loft, ring, ring_of, ripple, rod, rounded, slab,
    spline, superquadric, taper, tube,
)


def _vessel(m: Maker, profile: np.ndarray, wall: float, sides: int = 36) -> Manifold:
    """An open vessel of an outer profile ``[K, 2]`` from its foot to its rim."""
    inner = profile[::-1] - [wall, 0]
    inner = inner[(inner[:, 0] > 0.3 * wall) & (inner[:, 1] > profile[0, 1] + wall)]
    rim = [(profile[-1, 0] - 0.15 * wall, profile[-1, 1] + 0.4 * wall), (profile[-1, 0] - 0.85 * wall, profile[-1, 1] + 0.4 * wall)]
    floor = profile[0, 1] + wall
    line = [(0, profile[0, 1]), *profile.tolist(), *rim, *inner.tolist(), (max(float(inner[-1, 0]) - 0.2 * wall, 0.01), floor), (0, floor)]
    return lathe(line, sides)


def _profile(m: Maker, foot: float, rim: float, height: float, swell: float = 0.25) -> np.ndarray:
    """A smooth outer profile ``[16, 2]``."""
    t = np.array([0, 0.33, 0.67, 1.0])
    r = foot + (rim - foot) * t + np.array([0, 1, 1, 0]) * m.rng.uniform(-0.3, 1, 4) * swell * max(foot, rim)
    return spline(np.stack([np.maximum(r, 0.05), t * height], 1), 16)


def mug(m: Maker) -> list[Manifold]:
    """A mug, cup, glass or beaker, with or without a handle."""
    r, h = m.u(0.25, 0.5), m.u(0.5, 1.1)
    profile = _profile(m, r * m.u(0.6, 1), r, h, m.pick(0.0, 0.05, 0.25))
    outer = m.pick(m.surface(), m.printed("label", m.color("white", "any"), "round"), m.pattern(("striped", "flowered", "spotted", "checked", "shaded"), "any", contrast=0.7, mapping="round"))
    cup = m.stamp(_vessel(m, profile, m.u(0.02, 0.05)), outer)
    parts = [cup]
    if m.chance(0.75):
        middle = h * m.u(0.45, 0.6)
        bow = handle(m, m.u(0.2, 0.35), h * m.u(0.4, 0.7), m.u(0.025, 0.05))
        reach = float(np.interp(middle, profile[:, 1], profile[:, 0]))
        bow = bow.translate([reach - 0.03, middle, 0])
        axle = rod(reach - 0.01, h * 1.2, 24)
        handles = [m.stamp(bow - axle, m.pick(outer, m.plain()))]
        if m.chance(0.1):
            handles.append(handles[0].mirror([1, 0, 0]))
        parts += handles
    if m.chance(0.4):
        level = h * m.u(0.6, 0.9)
        parts.append(m.stamp(rod(float(np.interp(level, profile[:, 1], profile[:, 0])) - 0.01, 0.02).translate([0, level, 0]) ^ rod(5, 9), m.plain("earth", "dark", "leaf")))
    elif m.chance(0.2):  # a lid
        parts.append(m.stamp(lathe([(0, 0), (r * 1.05, 0), (r * 1.03, 0.08), (r * 0.5, 0.14), (0, 0.14)]).translate([0, h - 0.01, 0]), m.plain()))
    angle = m.u(-180, 180) if m.chance(0.3) else m.u(-50, 50)
    return [p.rotate([0, angle, 0]) for p in parts]


def teapot(m: Maker) -> list[Manifold]:
    """A teapot, kettle, jug or watering can."""
    r, h = m.u(0.3, 0.5), m.u(0.35, 0.9)
    profile = _profile(m, r * m.u(0.5, 1), r * m.u(0.35, 0.9), h, 0.5)
    look, second = m.pick(m.surface(), m.metal(), m.pattern(("flowered", "spotted"), "white", "pastel", contrast=0.8, mapping="round")), m.surface("dark", "metal", "any")
    body = lathe([(0, 0), *profile.tolist(), (0, h)])
    parts = [m.stamp(body, look)]
    wide = float(profile[:, 0].max())
    long = m.u(0.25, 0.6)
    spout = tube([(wide * 0.7, h * 0.3, 0), (wide + long * 0.5, h * m.u(0.35, 0.6), 0), (wide + long, h * m.u(0.8, 1.15), 0)], [0.12, 0.08, m.u(0.04, 0.07)], 14, 20, round_ends=False)
    parts.append(m.stamp(spout, look))
    bow = handle(m, m.u(0.2, 0.4), h * m.u(0.5, 0.9), m.u(0.025, 0.05))
    if m.chance(0.7):
        parts.append(m.stamp(bow.rotate([0, 180, 0]).translate([-wide * 0.8, h * 0.55, 0]), m.pick(look, second)))
    else:
        over = tube([(wide * 0.8, h * 0.8, 0), (wide * 0.8, h * 1.4, 0), (-wide * 0.8, h * 1.4, 0), (-wide * 0.8, h * 0.8, 0)], 0.035, 10, 28)
        parts.append(m.stamp(over, second))
    top = float(profile[-1, 0])
    lid = lathe([(0, -0.02), (top * 0.98, -0.02), (top * 0.9, 0.06), (0.08, m.u(0.08, 0.2)), (0.05, 0.2), (0.07, 0.25), (0, 0.3)])
    parts.append(m.stamp(lid.translate([0, h, 0]), m.pick(look, second)))
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
    profile = [(0, 0), (r - e, 0), (r, e), (r, shoulder - soft * 0.2), (0.5 * (r + neck) + 0.1 * r, shoulder + soft * 0.35), (neck, shoulder + soft), (neck, h), (0, h)]
    if m.chance(0.25):  # a waist, as a sports bottle has
        profile[3:3] = [(r, 0.3 * shoulder), (r * m.u(0.75, 0.95), 0.5 * shoulder), (r, 0.75 * shoulder)]
    flat = m.pick(1, 1, 1, m.u(0.45, 0.85))
    square = m.pick(2, 2, 2, m.u(3, 8))
    body = lathe(profile, 40)
    if square > 2:
        def squared(p: np.ndarray) -> np.ndarray:
            a, b = np.abs(p[:, 0]) + 1e-9, np.abs(p[:, 2]) + 1e-9
            k = np.hypot(a, b) / (a**square + b**square) ** (1 / square)
            k = np.where(p[:, 1] > shoulder, 1 + (k - 1) * np.clip(1 - (p[:, 1] - shoulder) / max(soft, 0.01), 0, 1), k)
            return np.stack([p[:, 0] * k, p[:, 1], p[:, 2] * k], -1)
        body = body.warp_batch(squared)
    ground = m.color("white", "toy", "any", "earth")
    parts = [m.stamp(body, m.pick(m.plain(), m.plain("earth", "white", "toy"), m.surface()))]
    low, high = m.u(0.06, 0.3) * shoulder, m.u(0.7, 0.97) * shoulder
    if m.chance(0.85):
        strip = box(9, high - low, 9).translate([0, (low + high) / 2, 0])
        label = body.scale([1.015, 1, 1.015]) ^ strip
        parts.append(m.stamp(label, m.printed(m.pick("label", "label", "front"), ground, "round" if flat == 1 else "fit")))
    cap_r, cap_h = neck * m.u(1.05, 1.3), m.u(0.08, 0.25)
    top = m.n(0, 4)
    cap = m.plain("toy", "white", "dark", "metal")
    if top <= 2:
        lid = rod(cap_r, cap_h, 36, 0.02)
        if m.chance(0.4):
            ribs = [rod(0.012, cap_h * 0.8, 6).translate([cap_r * math.sin(a), 0.02, cap_r * math.cos(a)]) for a in np.linspace(0, 2 * math.pi, 24)[:-1]]
            lid = joined([lid, *ribs])
        parts.append(m.stamp(lid.translate([0, h - 0.02, 0]), cap))
    elif top == 3:  # a pump or a spray
        parts.append(m.stamp(rod(neck * 1.1, 0.1).translate([0, h - 0.02, 0]), cap))
        parts.append(m.stamp(rod(neck * 0.3, 0.25, 14).translate([0, h, 0]), cap))
        parts.append(m.stamp(tube([(0, h + 0.25, -0.08), (0, h + 0.27, 0.1), (0, h + 0.2, m.u(0.2, 0.4))], [0.06, 0.06, 0.03], 10, 14), cap))
    if flat != 1:
        parts = [p.scale([1, 1, flat]) for p in parts]
    return laid(m, parts, 0.12)


def laid(m: Maker, parts: list[Manifold], share: float) -> list[Manifold]:
    """Parts that lie on their side in a share of cases, turned about y by some angle."""
    whole = joined(parts)
    if m.chance(share):
        whole = whole.rotate([90 if m.chance(0.5) else -90, 0, 0]).rotate([0, m.u(-90, 90), 0])
    elif m.chance(0.4):
        whole = whole.rotate([0, m.u(-45, 45), 0])
    return [whole]


def bowl(m: Maker) -> list[Manifold]:
    """A bowl, plate, basket, pan or bucket, often with things in it."""
    r, h = m.u(0.4, 0.7), m.u(0.08, 0.7)
    profile = _profile(m, r * m.u(0.4, 0.95), r, h, 0.15)
    look = m.pick(m.surface(), m.wood(), m.metal(), m.pattern(("striped", "flowered", "woven", "checked", "dotted", "speckled"), "any", contrast=0.6, mapping=m.pick("box", "round")))
    sides = m.pick(36, 36, 36, 6, 8)
    vessel = _vessel(m, profile, m.u(0.02, 0.05), sides)
    if m.chance(0.25):
        vessel = vessel.scale([1, 1, m.u(0.55, 0.85)])
    parts = [m.stamp(vessel, look)]
    kind = m.n(0, 5)
    if kind == 0:  # a pan's handle
        parts.append(m.stamp(tube([(r * 0.95, h * 0.8, 0), (r + 0.3, h + 0.05, 0), (r + m.u(0.5, 0.9), h + 0.08, 0)], [0.04, 0.035, 0.05], 10, 14), m.surface("dark", "wood")))
    elif kind == 1:  # a bucket's
        parts.append(m.stamp(tube([(r * 0.97, h * 0.9, 0), (r * 0.8, h + 0.6 * r, 0), (0, h + r, 0), (-r * 0.8, h + 0.6 * r, 0), (-r * 0.97, h * 0.9, 0)], m.u(0.015, 0.05), 10, 32), m.surface("metal", "wood", "any")))
    elif kind == 2:
        parts.append(both(m.stamp(handle(m, 0.15, 0.25, 0.025).rotate([90, 0, 0]).translate([r * 0.93, h * 0.85, 0]), look)))
    if m.chance(0.5):
        things = [m.surface("toy", "leaf", "earth") for _ in range(3)]
        inside = r * 0.6
        size = m.u(0.1, 0.25)
        for _ in range(m.n(1, 9)):
            a, d = m.u(0, 6.3), m.u(0, 1) ** 0.5 * max(inside - size, 0.02)
            item = _produce(m, size * m.u(0.8, 1.2)).rotate([m.u(0, 360), m.u(0, 360), 0])
            parts.append(m.stamp(item.translate([d * math.sin(a), max(h * 0.7, size) + m.u(-0.05, 0.1), d * math.cos(a)]), m.pick(*things)))
    return parts


def _produce(m: Maker, r: float) -> Manifold:
    """Something round to eat, about the origin."""
    kind = m.n(0, 4)
    if kind == 0:
        return ball([r, r * m.u(0.8, 1.3), r], 24)
    if kind == 1:
        t = np.linspace(0.05, 0.95, 12) * math.pi
        dent = 1 + 0.18 * np.abs(np.cos(t)) ** 3
        profile = np.stack([r * np.sin(t) * dent, -r * 0.9 * np.cos(t) * (1 - 0.25 * np.exp(-8 * np.sin(t) ** 2))], 1)
        return lathe([(0, profile[0, 1] + 0.05 * r), *profile.tolist(), (0, profile[-1, 1] - 0.1 * r)], 24)
    if kind == 2:
        return tube([(0, -r, 0), (0.3 * r, 0, 0), (0, r, 0)], [0.25 * r, 0.45 * r, 0.2 * r], 12, 16)
    if kind == 3:
        return superquadric([r, r * 0.8, r], m.u(0.5, 1), m.u(0.4, 1), 24)
    return lathe([(0, -r), (r * 0.3, -r * 0.95), (r * 0.9, -0.1 * r), (r * 0.6, 0.6 * r), (0.1 * r, r), (0, r)], 20)


def food(m: Maker) -> list[Manifold]:
    """A fruit, a loaf, a cake, a burger, a doughnut, an ice cream."""
    kind = m.n(0, 6)
    if kind == 0:
        look = m.pattern(("clouded", "speckled", "striped", "shaded", "plain"), "toy", "leaf", "earth", contrast=0.3)
        parts = [m.stamp(_produce(m, 0.5), look)]
        stem = tube([(0, 0.3, 0), (0.03, 0.55, 0), (0.08, 0.65, 0.02)], [0.03, 0.025, 0.035], 8, 10)
        parts.append(m.stamp(stem, m.plain("wood", "leaf")))
        if m.chance(0.5):
            leaf = slab(ring_of(1.3, 16) * [0.22, 0.1], 0.02).rotate([70, 20, 0]).translate([0.22, 0.55, 0])
            parts.append(m.stamp(leaf, m.plain("leaf")))
        return parts
    if kind == 1:  # a loaf, with cuts
        crust, crumb = m.pattern(("clouded", "speckled"), "wood"), m.pattern("speckled", "white", "wood")
        loaf = superquadric([m.u(0.5, 0.9), m.u(0.25, 0.4), m.u(0.25, 0.45)], m.u(0.5, 0.9), m.u(0.4, 1), 40)
        loaf = m.stamp(ripple(loaf, m.rng, 0.02, 0.4, False).trim_by_plane([0, 1, 0], -0.15), crust)
        cuts = [m.stamp(box(0.05, 0.12, 0.5).rotate([0, 30, 0]).translate([x, 0.32, 0]), crumb) for x in np.linspace(-0.35, 0.35, m.n(2, 5))]
        return [loaf - joined(cuts)]
    if kind == 2:  # a cake in layers, sometimes a slice
        r, y, parts = m.u(0.4, 0.6), 0.0, []
        looks = [m.pattern("speckled", "wood", "pastel"), m.plain("white", "pastel", "toy")]
        for i in range(m.n(2, 5)):
            t = m.u(0.06, 0.2)
            parts.append(m.stamp(rod(r - 0.01 * (i % 2), t + 0.004, 40, 0.02).translate([0, y, 0]), looks[i % 2]))
            y += t
        for a in np.linspace(0, 2 * math.pi, m.n(1, 10))[:-1]:
            parts.append(m.stamp(_produce(m, 0.08).translate([0.75 * r * math.sin(a), y + 0.05, 0.75 * r * math.cos(a)]), m.pick(*looks) if m.chance(0.3) else m.plain("toy")))
        whole = joined(parts)
        if m.chance(0.4):
            wedge = m.stamp(slab(np.array([(0, 0), (1.5, 0), (1.5, m.u(0.8, 2.5))]), 4).rotate([90, 0, 0]).rotate([0, m.u(0, 360), 0]), looks[0])
            whole = whole ^ wedge if m.chance(0.5) else whole - wedge
        return [whole]
    if kind == 3:  # a burger or a sandwich: layers between halves
        y, parts, square = 0.0, [], m.pick(1.0, m.u(0.2, 0.5))
        bun = m.pattern(("speckled", "plain"), "wood")
        parts.append(m.stamp(superquadric([0.5, 0.1, 0.5], 0.6, square), bun))
        for _ in range(m.n(2, 5)):
            y += m.u(0.07, 0.12)
            layer = superquadric([m.u(0.46, 0.58), m.u(0.03, 0.08), m.u(0.46, 0.58)], 0.5, square)
            layer = ripple(layer, m.rng, 0.012, 0.2, False) if m.chance(0.5) else layer
            parts.append(m.stamp(layer.translate([0, y, 0]), m.surface("leaf", "toy", "earth")))
        top = superquadric([0.5, m.u(0.15, 0.3), 0.5], 0.9, square).trim_by_plane([0, 1, 0], -0.03)
        parts.append(m.stamp(top.translate([0, y + 0.08, 0]), bun))
        return parts
    if kind == 4:  # a doughnut
        r = m.u(0.12, 0.2)
        dough = ring(0.35, r, 40, 18, m.u(0.7, 1))
        ice = ring(0.35, r * 1.06, 40, 18, 0.85).translate([0, 0.02, 0])
        ice = ripple(ice, m.rng, 0.02, 0.25, False).trim_by_plane([0, 1, 0], 0.02)
        parts = [m.stamp(dough, m.plain("wood")), m.stamp(ice, m.plain("pastel", "earth", "toy"))]
        flip = [90, 0, 0] if m.chance(0.3) else [0, 0, 0]
        return [p.rotate(flip) for p in parts]
    if kind == 5:  # an ice cream
        cone = lathe([(0, 0), (0.03, 0), (m.u(0.18, 0.28), 0.7), (0, 0.7)], 24)
        parts = [m.stamp(cone, m.pattern("checked", "wood", repeats=4))]
        y, r = 0.78, 0.26
        for _ in range(m.n(1, 3)):
            scoop = ripple(ball(r, 28), m.rng, 0.012, 0.15, False)
            parts.append(m.stamp(scoop.translate([0, y, 0]), m.pattern(("speckled", "plain"), "pastel", "earth", "white")))
            y += r * 1.2
            r *= m.u(0.8, 1)
        return parts
    look = m.pattern(("plain", "clouded"), "toy", "leaf", "earth")  # a root or a banana
    body = tube([(0, -0.7, 0), (m.u(-0.2, 0.2), -0.2, 0), (m.u(-0.3, 0.3), 0.4, 0), (0, 0.8, 0)], [0.04, m.u(0.1, 0.2), m.u(0.12, 0.28), m.u(0.05, 0.15)], m.pick(16, 6), 32)
    parts = [m.stamp(body, look)]
    if m.chance(0.6):
        for _ in range(m.n(2, 6)):
            parts.append(m.stamp(tube([(0, 0.75, 0), (m.u(-0.2, 0.2), 1.0, m.u(-0.2, 0.2)), (m.u(-0.4, 0.4), 1.25, m.u(-0.4, 0.4))], [0.04, 0.05, 0.02], 8, 12), m.plain("leaf")))
    return [p.rotate([0, 0, m.pick(0, 90, m.u(60, 120))]) for p in parts]


def carton(m: Maker) -> list[Manifold]:
    """A printed box that stands or lies, closed or open; a book, a case, a present."""
    w, h = m.u(0.3, 1.0), m.u(0.3, 1.0)
    d = m.pick(m.u(0.06, 0.2), m.u(0.15, 0.45), m.u(0.3, 1.0))
    body = box(w, h, d, m.pick(0.0, 0.0, m.u(0.004, 0.03)))
    ground = m.color("white", "toy", "dark", "any", "wood")
    inks = m.inks(4)
    look = _carton_look(m, w, h, d, ground, inks)
    if m.chance(0.12):
        body = ripple(body.refine_to_length(0.1), m.rng, 0.006, 0.4, False)
    parts = [m.stamp(body, look)]
    kind = m.n(0, 9)
    if kind == 0:  # open, with flaps
        inner = m.stamp(box(w - 0.03, h, d - 0.03).translate([0, 0.03, 0]), m.plain("wood", "white"))
        parts = [parts[0] - inner]
        flap = m.painted(ground * 0.95)
        tilt = m.u(10, 130)
        for side in (1, -1):
            sheet = box(0.012, w * 0.45, d * 0.96).translate([0, w * 0.22, 0]).rotate([0, 0, -tilt * side]).translate([side * (w / 2 - 0.006), h / 2 - 0.005, 0])
            parts.append(m.stamp(sheet, flap))
    elif kind == 1:  # ribbon
        ribbon = m.plain("toy")
        parts.append(m.stamp(box(w * 0.14, h * 1.01, d * 1.02), ribbon))
        parts.append(m.stamp(box(w * 1.01, h * 1.011, d * 0.14), ribbon))
        bow = tube([(0, 0, 0), (0.18, 0.14, 0), (0.25, 0.02, 0), (0, 0, 0)], 0.03, 10, 24, flat=(1, 2))
        parts.append(both(m.stamp(bow.translate([0, h / 2, 0]), ribbon)))
    elif kind == 2:  # a window with the thing behind it
        pane = m.stamp(box(w * m.u(0.5, 0.8), h * m.u(0.4, 0.7), 0.1).translate([0, -0.05 * h, d / 2]), m.plain("dark", "white"))
        thing = shape(m)
        low, high = extent(thing)
        thing = thing.translate((-(low + high) / 2).tolist()).scale([0.4 * min(w, h) / float((high - low).max())] * 3)
        thing = thing.scale([1, 1, min(1, 0.15 / max(float(np.ptp(extent(thing)[:, 2])), 0.01))])
        parts = [parts[0] - pane, m.stamp(thing.translate([0, -0.05 * h, d / 2 - 0.04]), m.surface("toy", "any"))]
    elif kind == 3:  # a carry handle
        parts.append(m.stamp(tube([(-0.15 * w, h / 2 - 0.02, 0), (-0.15 * w, h / 2 + 0.12, 0), (0.15 * w, h / 2 + 0.12, 0), (0.15 * w, h / 2 - 0.02, 0)], 0.02, 10, 24, flat=(1, 1.5)), m.plain()))
    elif kind == 4:  # a gable top, as milk has
        roof = slab(np.array([(-w / 2, 0), (w / 2, 0), (0.0, 0.5 * w)]), d).translate([0, h / 2, 0])
        parts += [m.stamp(roof, m.painted(inks[0])), m.stamp(box(0.03, 0.12, d).translate([0, h / 2 + 0.5 * w, 0]), m.painted(ground))]
    elif kind == 5:  # a stack of them
        for i in range(1, m.n(2, 4)):
            parts.append(parts[0].translate([m.u(-0.08, 0.08), 0, 0]).rotate([0, m.u(-15, 15), 0]).translate([0, i * h * 0.999, 0]))
    elif kind == 6:  # a sleeve or lid of another colour
        parts.append(m.stamp(box(w * 1.02, h * m.u(0.15, 0.5), d * 1.02).translate([0, h * m.u(-0.2, 0.35), 0]), m.surface()))
    return laid(m, parts, 0.25)


def _carton_look(m: Maker, w: float, h: float, d: float, ground: np.ndarray, inks: list[np.ndarray]) -> int:
    from .looks import Look, material, plain_material
    from .textures import package

    if m.chance(0.1):
        return m.pattern(("plain", "striped", "dotted", "flowered", "checked"), contrast=0.7)

    def side(kind: str, wide: float, tall: float):
        scale = 256 / max(wide, tall)
        return material(package(m.rng, ground, inks, kind, max(48, int(wide * scale)), max(48, int(tall * scale))))

    front = side("front", w, h)
    back = front if m.chance(0.3) else side("back", w, h)
    if min(d / w, d / h) < 0.12 or m.chance(0.15):
        edge = top = plain_material(m.pick(ground, inks[0]))
    else:
        edge, top = side(m.pick("back", "front"), d, h), side("front", w, d) if m.chance(0.5) else plain_material(m.pick(ground, inks[1]))
    return m.add(Look([edge, edge, top, top, front, back], "fit"))


def pouch(m: Maker) -> list[Manifold]:
    """A bag of crisps, a sachet, a pillow or a sack."""
    w, h, d = m.u(0.5, 0.9), m.u(0.6, 1.2), m.u(0.15, 0.4)
    count, sides = 26, 36
    t = np.linspace(0, 1, count)
    flat_foot = m.chance(0.4)
    depth = d / 2 * np.clip(np.sin(math.pi * (t * 0.85 + 0.15 if flat_foot else t)), 0.0, 1) ** m.u(0.5, 0.9) + 0.008
    pinch = 1 - m.u(0.0, 0.18) * np.sin(math.pi * t)
    form = ring_of(m.u(2, 3.5), sides)
    rings = np.empty((count, sides, 3))
    rings[..., 0] = form[None, :, 0] * (w / 2 * pinch)[:, None]
    rings[..., 1] = h * t[:, None]
    rings[..., 2] = form[None, :, 1] * depth[:, None]
    body = ripple(loft(rings), m.rng, m.u(0.003, 0.015), m.u(0.15, 0.5), False)
    cloth = m.chance(0.25)
    look = m.cloth() if cloth else m.printed("front", m.color("toy", "white", "dark", "any", "metal"))
    parts = [m.stamp(body, look)]
    if m.chance(0.5):  # seams
        for y in (0.0, h):
            parts.append(m.stamp(box(w, 0.06, 0.015).translate([0, y, 0]), m.plain("metal", "any")))
    elif m.chance(0.4):
        parts.append(m.stamp(rod(0.08, 0.12).translate([m.u(-0.2, 0.2), h - 0.03, 0]), m.plain()))
    return laid(m, parts, 0.3)


def plant(m: Maker) -> list[Manifold]:
    """A pot, with a plant in most cases; a vase with flowers; a cactus."""
    r, h = m.u(0.2, 0.4), m.u(0.25, 0.9)
    profile = _profile(m, r * m.u(0.6, 1), r, h, m.pick(0.1, 0.5))
    sides = m.pick(36, 36, 4, 6, 8)
    look = m.pick(m.surface("earth", "white", "any"), m.pattern(("speckled", "clouded", "woven", "striped"), "earth", "white", "any", contrast=0.4, mapping="round"))
    parts = [m.stamp(_vessel(m, profile, 0.03, sides), look)]
    if m.chance(0.3):
        parts.append(m.stamp(ring(float(profile[-1, 0]), 0.035, 36, 8).translate([0, h, 0]), look))
    if m.chance(0.3):
        return parts
    rim = float(profile[-3, 0]) - 0.02
    parts.append(m.stamp(rod(max(rim, 0.03), 0.05).translate([0, h - 0.1, 0]), m.pattern("speckled", "earth", "dark")))
    leaf = m.pattern(("plain", "clouded", "shaded"), "leaf")
    kind = m.n(0, 3)
    if kind == 0:  # a ball of leaves or a bonsai
        for _ in range(m.n(1, 5)):
            s = m.u(0.15, 0.4)
            x, y, z = m.u(-0.2, 0.2), h + m.u(0.1, 0.6), m.u(-0.2, 0.2)
            clump = ripple(ball([s, s * m.u(0.6, 1.1), s], 32), m.rng, 0.12 * s, 0.5 * s, False)
            parts.append(m.stamp(clump.translate([x, y, z]), leaf))
            parts.append(m.stamp(tube([(0, h - 0.1, 0), (x * 0.4, (h + y) / 2, z * 0.4), (x, y, z)], 0.03, 8, 12), m.wood()))
    elif kind == 1:  # long leaves
        for i in range(m.n(5, 14)):
            a, long, lean = 2.4 * i, m.u(0.4, 1.0), m.u(0.1, 0.7)
            blade = tube([(0, 0, 0), (0, long * 0.6, lean * long * 0.3), (0, long, lean * long)], [0.03, m.u(0.04, 0.1), 0.01], 8, 14, flat=(0.2, 1))
            parts.append(m.stamp(blade.rotate([0, math.degrees(a), 0]).translate([0, h - 0.08, 0]), leaf))
    elif kind == 2:  # a cactus
        ribs = m.n(6, 12)
        c, tall = m.u(0.1, 0.22), m.u(0.3, 0.9)
        angle = np.linspace(0, 2 * math.pi, 49)[:-1]
        form = ring_of(2, 48) * (1 + 0.1 * np.cos(ribs * angle))[:, None]
        parts.append(m.stamp(tube([(0, h - 0.1, 0), (0, h + tall / 2, 0), (0, h + tall, 0)], [c * 0.9, c, c * 0.8], form, 14), leaf))
        if m.chance(0.5):
            arm = tube([(0, h + tall * 0.4, 0), (c + 0.15, h + tall * 0.45, 0), (c + 0.18, h + tall * 0.8, 0)], [0.07, 0.08, 0.06], 12, 18)
            parts.append(m.stamp(arm, leaf))
    else:  # flowers on stalks
        petal, heart = m.plain("toy", "pastel", "white"), m.plain("toy", "earth")
        for i in range(m.n(2, 6)):
            x, z, y = m.u(-0.3, 0.3), m.u(-0.3, 0.3), h + m.u(0.3, 0.7)
            parts.append(m.stamp(tube([(0, h - 0.1, 0), (x * 0.3, (h + y) / 2, z * 0.3), (x, y, z)], 0.018, 8, 12), leaf))
            s = m.u(0.1, 0.18)
            bloom = slab(outline_of_flower(m.n(5, 8)) * s, 0.04, 0.015).rotate([m.u(-80, -10), m.u(-60, 60), 0])
            parts.append(m.stamp(bloom.translate([x, y, z]), petal))
            parts.append(m.stamp(ball(0.35 * s, 16).translate([x, y + 0.02, z + 0.02]), heart))
    return parts


def outline_of_flower(petals: int) -> np.ndarray:
    """An outline ``[60, 2]`` of radius 1 with petals."""
    angle = np.arange(60) * (2 * math.pi / 60)
    r = 0.75 + 0.25 * np.cos(petals * angle)
    return np.stack([r * np.cos(angle), r * np.sin(angle)], -1)


def lamp(m: Maker) -> list[Manifold]:
    """A lamp, a lantern or a candlestick on a stand."""
    height, foot = m.u(0.4, 1.4), m.u(0.12, 0.3)
    metal, shade = m.pick(m.metal(), m.wood(), m.surface()), m.pick(m.plain("white", "pastel", "any"), m.cloth())
    bulge = np.abs(m.rng.normal(0, 0.08, 8)) * (m.rng.random() < 0.6) + m.u(0.015, 0.05)
    heights = np.linspace(0.05, height, 8)
    line = spline(np.stack([bulge, heights], 1), 24)
    stand = lathe([(0, 0), (foot, 0), (foot, 0.03), *np.maximum(line, [0.01, 0]).tolist(), (0, height)], 28)
    low, high, tall = m.u(0.15, 0.4), m.u(0.06, 0.35), m.u(0.15, 0.5)
    sides = m.pick(36, 36, 4, 6)
    bell = lathe([(0, tall - 0.03), (high - 0.02, tall - 0.03), (low - 0.02, 0), (low, 0), (high, tall), (0, tall)], sides)
    if m.chance(0.2):
        bell = ball([low, low * m.u(0.8, 1.2), low])
    tilt = [m.pick(0, 0, 0, m.u(20, 80)), 0, 0]
    parts = [m.stamp(stand, metal), m.stamp(bell.rotate(tilt).translate([0, height - tall * 0.3, 0]), shade)]
    if m.chance(0.2):
        for a in range(m.n(2, 4)):
            rail = tube([(low, height + 0.3, 0), (low, 0.1, 0), (low * 0.9, 0.0, 0)], 0.015, 8, 12)
            parts.append(m.stamp(rail.rotate([0, 90 * a, 0]), metal))
    return parts


def furniture(m: Maker) -> list[Manifold]:
    """A table, chair, sofa, shelf, cabinet or bed."""
    main, second, third = (m.pick(m.wood(), m.wood(), m.surface("white", "dark", "wood"), m.cloth("earth", "any")) for _ in range(3))
    w, d, h = m.u(0.5, 1.4), m.u(0.35, 0.9), m.u(0.2, 0.8)
    kind = m.n(0, 5)
    parts: list[Manifold] = []
    soft = m.pick(0.0, m.u(0.01, 0.05))

    def block(look: int, size: tuple, at: tuple, radius: float | None = None) -> None:
        parts.append(m.stamp(box(*size, soft if radius is None else radius).translate(list(at)), look))

    def legs(wide: float, deep: float, high: float) -> None:
        r = m.u(0.02, 0.05)
        splay, square = m.u(0, 0.08), m.chance(0.5)
        leg = box(2 * r, high + 0.01, 2 * r).translate([0, high / 2, 0]) if square else lathe([(0, 0), (r * 0.7, 0), (r, high * 0.7), (r * 1.1, high + 0.01), (0, high + 0.01)], 14)
        leg = leg.rotate([math.degrees(-splay), 0, math.degrees(splay)])
        x, z = wide / 2 - 1.3 * r, deep / 2 - 1.3 * r
        one = m.stamp(leg.translate([x, 0, z]), second)
        pair = both(one)
        parts.append(pair + pair.mirror([0, 0, 1]))

    if kind == 0:
        thick = m.u(0.02, 0.08)
        if m.chance(0.35):
            parts.append(m.stamp(rod(w / 2, thick, 40, 0.3 * thick).translate([0, h, 0]), main))
            parts.append(m.stamp(lathe([(0, 0), (w * 0.3, 0), (w * 0.28, 0.03), (0.04, 0.08), (m.u(0.03, 0.08), h * 0.6), (0.05, h + 0.01), (0, h + 0.01)]), second))
        else:
            block(main, (w, thick, d), (0, h + thick / 2, 0))
            legs(w, d, h)
            if m.chance(0.4):
                block(second, (w * 0.85, 0.03, d * 0.8), (0, h * 0.3, 0))
    elif kind == 1:
        w, d = m.u(0.4, 1.2), m.u(0.4, 0.6)
        thick, back, deep = m.u(0.04, 0.2), m.u(0.3, 0.7), m.u(0.03, 0.16)
        seat = h * 0.6 + thick
        block(main, (w, thick, d), (0, seat - thick / 2, 0))
        legs(w, d, h * 0.6)
        if m.chance(0.6):
            rest = box(w, back, deep, m.pick(soft, 0.4 * deep)).rotate([-m.u(0, 15), 0, 0])
            parts.append(m.stamp(rest.translate([0, seat + back / 2 - 0.02, -d / 2 + deep / 2]), main))
        else:
            for x in np.linspace(-w / 2 + 0.03, w / 2 - 0.03, m.n(3, 6)):
                block(second, (0.035, back, 0.035), (float(x), seat + back / 2, -d / 2 + 0.03), 0.0)
            block(second, (w, 0.08, 0.045), (0, seat + back, -d / 2 + 0.03))
        if m.chance(0.4):
            arm = m.u(0.12, 0.25)
            for side in (-1, 1):
                block(third, (0.07, arm, d), (side * (w / 2 - 0.02), seat + arm / 2, 0))
    elif kind == 2:
        h, w, d, t = m.u(0.5, 1.6), m.u(0.4, 1.1), m.u(0.2, 0.4), m.u(0.02, 0.05)
        for side in (-1, 1):
            block(main, (t, h, d), (side * w / 2, h / 2, 0), 0.0)
        if m.chance(0.7):
            block(second, (w, h, 0.02), (0, h / 2, -d / 2 + 0.01), 0.0)
        levels = np.linspace(t / 2, h - t / 2, m.n(2, 6))
        for low, high in zip(levels, [*levels[1:], h]):
            block(main, (w, t, d), (0, float(low), 0), 0.0)
            x = -w / 2 + 0.05
            while high - low > 0.15 and x < w / 2 - 0.1 and m.chance(0.75):
                wide, tall = m.u(0.03, 0.2), m.u(0.5, 0.9) * float(high - low)
                block(m.plain("any"), (wide, tall, 0.7 * d), (x + wide / 2, float(low) + t / 2 + tall / 2 - 0.005, 0), 0.0)
                x += wide + m.u(0.003, 0.1)
    elif kind == 3:
        h, foot = m.u(0.3, 1.4), m.u(0, 0.15)
        block(main, (w, h, d), (0, foot + h / 2, 0))
        columns, rows = m.n(1, 3), m.n(1, 4)
        wide, tall = w / columns, h / rows
        for i, j in np.ndindex(columns, rows):
            x, y = (i + 0.5) * wide - w / 2, foot + (j + 0.5) * tall
            block(third, (0.9 * wide, 0.9 * tall, 0.03), (x, y, d / 2), 0.0)
            knob = ball(0.02, 12).translate([x, y, d / 2 + 0.03]) if m.chance(0.5) else box(0.25 * wide, 0.02, 0.03).translate([x, y, d / 2 + 0.025])
            parts.append(m.stamp(knob, second))
        if foot > 0.05:
            legs(w, d, foot)
    elif kind == 4:
        w, d, h, head = m.u(0.7, 1.4), m.u(1.3, 1.8), m.u(0.15, 0.4), m.u(0.2, 0.6)
        block(main, (w, h, d), (0, h / 2, 0))
        block(m.cloth("white", "pastel"), (0.96 * w, 0.2, 0.96 * d), (0, h + 0.07, 0), 0.06)
        block(main, (w, h + head, 0.06), (0, (h + head) / 2, -d / 2))
        parts.append(m.stamp(superquadric([0.25 * w, 0.07, 0.15], 0.7, 0.5).translate([0.22 * w, h + 0.2, -d / 2 + 0.25]), third))
        block(m.cloth(), (0.99 * w, 0.1, 0.6 * d), (0, h + 0.14, 0.2 * d), 0.04)
    else:
        w, h, d = m.u(0.8, 1.6), m.u(0.25, 0.4), m.u(0.5, 0.7)
        puff, cloth = m.u(0.04, 0.09), m.cloth("earth", "any", "dark")
        block(cloth, (w, h, d), (0, h / 2, 0), puff * 0.5)
        count = m.n(1, 3)
        for i in range(count):
            block(cloth, (w / count * 0.97, 0.18, d * 0.9), ((i + 0.5) * w / count - w / 2, h + 0.05, 0.03), puff)
            block(cloth, (w / count * 0.97, 0.4, 0.2), ((i + 0.5) * w / count - w / 2, h + 0.25, -d / 2 + 0.12), puff)
        for side in (-1, 1):
            block(cloth, (0.16, h + m.u(0.1, 0.25), d), (side * (w / 2 + 0.05), (h + 0.15) / 2, 0), puff)
        if m.chance(0.4):
            parts.append(m.stamp(superquadric([0.16, 0.16, 0.06], 0.5, 0.8).rotate([-20, 0, m.u(-20, 20)]).translate([m.u(-0.3, 0.3), h + 0.25, 0.05]), third))
    if m.chance(0.3):
        return [joined(parts).rotate([0, m.u(-60, 60), 0])]
    return parts


HOUSEHOLD = (
    *((mug, 3.0), (teapot, 1.5), (bottle, 5.0), (bowl, 3.0), (food, 2.5), (carton, 7.0)),
    *((pouch, 2.0), (plant, 2.5), (lamp, 1.2), (furniture, 5.0)),
)
