"""Printed boxes and bags."""

from __future__ import annotations

import math

import numpy as np
from manifold3d import Manifold

from .composition import shape
from .details import laid
from .looks import Look, Maker, Parts, material, plain_material
from .solids import box, extent, loft, ring_of, ripple, rod, slab, tube
from .textures import package


def carton(m: Maker) -> list[Manifold]:
    """A printed box that stands or lies, closed or open; a book, a case, a present."""
    w, h = m.u(0.3, 1.0), m.u(0.3, 1.0)
    d = m.pick(m.u(0.06, 0.2), m.u(0.15, 0.45), m.u(0.3, 1.0))
    body = box(w, h, d, m.pick(0.0, 0.0, m.u(0.004, 0.03)))
    ground = m.color("white toy dark any wood")
    inks = m.inks(4)
    look = _carton_look(m, w, h, d, ground, inks)
    if m.chance(0.12):
        body = ripple(body.refine_to_length(0.1), m.rng, 0.006, 0.4, False)
    parts = Parts(m)
    parts.add(body, look)
    kind = m.n(0, 9)
    if kind == 0:  # open, with flaps
        inner = m.stamp(box(w - 0.03, h, d - 0.03).translate([0, 0.03, 0]), m.plain("wood white"))
        parts[0] -= inner
        flap = m.painted(ground * 0.95)
        sheet = box(0.012, w * 0.45, d * 0.96).translate([0, w * 0.22, 0])
        parts.pair(sheet, flap, turn=(0, 0, -m.u(10, 130)), at=(w / 2 - 0.006, h / 2 - 0.005, 0))
    elif kind == 1:  # ribbon
        ribbon = m.plain("toy")
        parts.add(box(w * 0.14, h * 1.01, d * 1.02), ribbon)
        parts.add(box(w * 1.01, h * 1.011, d * 0.14), ribbon)
        line = [(0, 0, 0), (0.18, 0.14, 0), (0.25, 0.02, 0), (0, 0, 0)]
        bow = tube(line, 0.03, 10, 24, flat=(1, 2))
        parts.pair(bow, ribbon, at=(0, h / 2, 0))
    elif kind == 2:  # a window with the thing behind it
        pane = box(w * m.u(0.5, 0.8), h * m.u(0.4, 0.7), 0.1).translate([0, -0.05 * h, d / 2])
        pane = m.stamp(pane, m.plain("dark white"))
        thing = shape(m)
        low, high = extent(thing)
        thing = thing.translate((-(low + high) / 2).tolist()).scale(
            [0.4 * min(w, h) / float((high - low).max())] * 3
        )
        thing = thing.scale([1, 1, min(1, 0.15 / max(float(np.ptp(extent(thing)[:, 2])), 0.01))])
        parts[0] -= pane
        parts.add(thing, m.surface("toy any"), at=(0, -0.05 * h, d / 2 - 0.04))
    elif kind == 3:  # a carry handle
        x, low, high = 0.15 * w, h / 2 - 0.02, h / 2 + 0.12
        line = [(-x, low, 0), (-x, high, 0), (x, high, 0), (x, low, 0)]
        parts.add(tube(line, 0.02, 10, 24, flat=(1, 1.5)), m.plain())
    elif kind == 4:  # a gable top, as milk has
        roof = slab([(-w / 2, 0), (w / 2, 0), (0.0, 0.5 * w)], d).translate([0, h / 2, 0])
        parts.add(roof, m.painted(inks[0]))
        parts.add(box(0.03, 0.12, d), m.painted(ground), at=(0, h / 2 + 0.5 * w, 0))
    elif kind == 5:  # a stack of them
        for i in range(1, m.n(2, 4)):
            moved = parts[0].translate([m.u(-0.08, 0.08), i * h * 0.999, 0])
            parts.append(moved.rotate([0, m.u(-15, 15), 0]))
    elif kind == 6:  # a sleeve or lid of another colour
        part = box(w * 1.02, h * m.u(0.15, 0.5), d * 1.02)
        parts.add(part, m.surface(), at=(0, h * m.u(-0.2, 0.35), 0))
    return laid(m, parts, 0.25)


def _carton_look(
    m: Maker, w: float, h: float, d: float, ground: np.ndarray, inks: list[np.ndarray]
) -> int:
    if m.chance(0.1):
        return m.pattern("plain striped dotted flowered checked", contrast=0.7)

    def side(kind: str, wide: float, tall: float):
        scale = 256 / max(wide, tall)
        pixels = (max(48, int(length * scale)) for length in (wide, tall))
        return material(package(m.rng, ground, inks, kind, *pixels))

    front = side("front", w, h)
    back = front if m.chance(0.3) else side("back", w, h)
    if min(d / w, d / h) < 0.12 or m.chance(0.15):
        edge = top = plain_material(m.pick(ground, inks[0]))
    else:
        edge = side(m.pick("back", "front"), d, h)
        top = side("front", w, d) if m.chance(0.5) else plain_material(m.pick(ground, inks[1]))
    return m.add(Look([edge, edge, top, top, front, back], "fit"))


def pouch(m: Maker) -> list[Manifold]:
    """A bag of crisps, a sachet, a pillow or a sack."""
    w, h, d = m.u(0.5, 0.9), m.u(0.6, 1.2), m.u(0.15, 0.4)
    count, sides = 26, 36
    t = np.linspace(0, 1, count)
    flat_foot = m.chance(0.4)
    swell = np.sin(math.pi * (t * 0.85 + 0.15 if flat_foot else t)).clip(0, 1)
    depth = d / 2 * swell ** m.u(0.5, 0.9) + 0.008
    pinch = 1 - m.u(0.0, 0.18) * np.sin(math.pi * t)
    form = ring_of(m.u(2, 3.5), sides)
    rings = np.empty((count, sides, 3))
    rings[..., 0] = form[None, :, 0] * (w / 2 * pinch)[:, None]
    rings[..., 1] = h * t[:, None]
    rings[..., 2] = form[None, :, 1] * depth[:, None]
    body = ripple(loft(rings), m.rng, m.u(0.003, 0.015), m.u(0.15, 0.5), False)
    cloth = m.chance(0.25)
    look = m.cloth() if cloth else m.printed("front", m.color("toy white dark any metal"))
    parts = Parts(m)
    parts.add(body, look)
    if m.chance(0.5):  # seams
        for y in (0.0, h):
            parts.add(box(w, 0.06, 0.015), m.plain("metal any"), at=(0, y, 0))
    elif m.chance(0.4):
        parts.add(rod(0.08, 0.12), m.plain(), at=(m.u(-0.2, 0.2), h - 0.03, 0))
    return laid(m, parts, 0.3)
