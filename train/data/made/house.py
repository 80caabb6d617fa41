"""Lamps, furniture, racks, trays, cushions."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
from manifold3d import CrossSection, FillRule, Manifold

from .details import bar, bow, produce
from .looks import Maker, Parts
from .solids import (
    ball,
    box,
    joined,
    lathe,
    loft,
    ring_of,
    ripple,
    rod,
    rounded,
    spline,
    superquadric,
    tube,
)


def lamp(m: Maker) -> list[Manifold]:
    """A lamp, a lantern or a candlestick on a stand."""
    height, foot = m.u(0.4, 1.4), m.u(0.12, 0.3)
    metal = m.pick(m.metal(), m.wood(), m.surface())
    shade = m.pick(m.plain("white pastel any"), m.cloth())
    bulge = np.abs(m.rng.normal(0, 0.08, 8)) * (m.rng.random() < 0.6) + m.u(0.015, 0.05)
    heights = np.linspace(0.05, height, 8)
    line = spline(np.stack([bulge, heights], 1), 24)
    stand = lathe([(foot, 0), (foot, 0.03), *np.maximum(line, [0.01, 0]).tolist(), (0, height)], 28)
    low, high, tall = m.u(0.15, 0.4), m.u(0.06, 0.35), m.u(0.15, 0.5)
    sides = m.pick(36, 36, 4, 6)
    profile = [*((high - 0.02, tall - 0.03), (low - 0.02, 0), (low, 0), (high, tall))]
    bell = lathe(profile, sides)
    if m.chance(0.2):
        bell = ball([low, low * m.u(0.8, 1.2), low])
    tilt = [m.pick(0, 0, 0, m.u(20, 80)), 0, 0]
    parts = Parts(m)
    parts.add(stand, metal)
    parts.add(bell.rotate(tilt), shade, at=(0, height - tall * 0.3, 0))
    if m.chance(0.2):
        for a in range(m.n(2, 4)):
            rail = tube([(low, height + 0.3, 0), (low, 0.1, 0), (low * 0.9, 0.0, 0)], 0.015, 8, 12)
            parts.add(rail, metal, turn=(0, 90 * a, 0))
    return parts


def furniture(m: Maker) -> list[Manifold]:
    """A table, chair, sofa, shelf, cabinet or bed."""
    wood, cloth = m.wood(), m.cloth("earth any")
    main, second, third = (
        m.pick(wood, m.wood(), m.surface("white dark wood"), cloth) for _ in "abc"
    )
    w, d, h = m.u(0.5, 1.4), m.u(0.35, 0.9), m.u(0.2, 0.8)
    kind = m.n(0, 5)
    parts = Parts(m)
    soft = m.pick(0.0, m.u(0.01, 0.05))

    def block(look: int, size: tuple, at: tuple, radius: float | None = None) -> None:
        w, h, d = size
        solid = box(w, h, d, soft if radius is None else radius)
        parts.add(solid, look, at=list(at))

    def legs(wide: float, deep: float, high: float) -> None:
        r = m.u(0.02, 0.05)
        splay, square = m.u(0, 0.08), m.chance(0.5)
        leg = lathe([(r * 0.7, 0), (r, high * 0.7), (r * 1.1, high + 0.01)], 14)
        if square:
            leg = box(2 * r, high + 0.01, 2 * r).translate([0, high / 2, 0])
        turn = (math.degrees(-splay), 0, math.degrees(splay))
        parts.pair(leg, second, turn=turn, at=(wide / 2 - 1.3 * r, 0, deep / 2 - 1.3 * r))
        parts[-1] += parts[-1].mirror([0, 0, 1])

    if kind == 0:
        thick = m.u(0.02, 0.08)
        if m.chance(0.35):
            parts.add(rod(w / 2, thick, 40, 0.3 * thick), main, at=(0, h, 0))
            profile = [
                *((w * 0.3, 0), (w * 0.28, 0.03), (0.04, 0.08), (m.u(0.03, 0.08), h * 0.6)),
                (0.05, h + 0.01),
            ]
            parts.add(lathe(profile), second)
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
            parts.add(rest, main, at=(0, seat + back / 2 - 0.02, -d / 2 + deep / 2))
        else:
            for x in np.linspace(-w / 2 + 0.03, w / 2 - 0.03, m.n(3, 6)):
                block(second, (0.035, back, 0.035), (float(x), seat + back / 2, -d / 2 + 0.03), 0.0)
            block(second, (w, 0.08, 0.045), (0, seat + back, -d / 2 + 0.03))
        if m.chance(0.4):
            arm = m.u(0.12, 0.25)
            parts.pair(box(0.07, arm, d, soft), third, at=(w / 2 - 0.02, seat + arm / 2, 0))
    elif kind == 2:
        h, w, d, t = m.u(0.5, 1.6), m.u(0.4, 1.1), m.u(0.2, 0.4), m.u(0.02, 0.05)
        parts.pair(box(t, h, d), main, at=(w / 2, h / 2, 0))
        if m.chance(0.7):
            block(second, (w, h, 0.02), (0, h / 2, -d / 2 + 0.01), 0.0)
        levels = np.linspace(t / 2, h - t / 2, m.n(2, 6))
        for low, high in zip(levels, [*levels[1:], h]):
            block(main, (w, t, d), (0, float(low), 0), 0.0)
            x = -w / 2 + 0.05
            while high - low > 0.15 and x < w / 2 - 0.1 and m.chance(0.75):
                wide, tall = m.u(0.03, 0.2), m.u(0.5, 0.9) * float(high - low)
                at = (x + wide / 2, float(low) + t / 2 + tall / 2 - 0.005, 0)
                block(m.plain(), (wide, tall, 0.7 * d), at, 0.0)
                x += wide + m.u(0.003, 0.1)
    elif kind == 3:
        h, foot = m.u(0.3, 1.4), m.u(0, 0.15)
        block(main, (w, h, d), (0, foot + h / 2, 0))
        columns, rows = m.n(1, 3), m.n(1, 4)
        wide, tall = w / columns, h / rows
        for i, j in np.ndindex(columns, rows):
            x, y = (i + 0.5) * wide - w / 2, foot + (j + 0.5) * tall
            block(third, (0.9 * wide, 0.9 * tall, 0.03), (x, y, d / 2), 0.0)
            knob = ball(0.02, 12) if m.chance(0.5) else box(0.25 * wide, 0.02, 0.03)
            parts.add(knob, second, at=(x, y, d / 2 + 0.027))
        if foot > 0.05:
            legs(w, d, foot)
    elif kind == 4:
        w, d, h, head = m.u(0.7, 1.4), m.u(1.3, 1.8), m.u(0.15, 0.4), m.u(0.2, 0.6)
        block(main, (w, h, d), (0, h / 2, 0))
        block(m.cloth("white pastel"), (0.96 * w, 0.2, 0.96 * d), (0, h + 0.07, 0), 0.06)
        block(main, (w, h + head, 0.06), (0, (h + head) / 2, -d / 2))
        part = superquadric([0.25 * w, 0.07, 0.15], 0.7, 0.5)
        parts.add(part, third, at=(0.22 * w, h + 0.2, -d / 2 + 0.25))
        block(m.cloth(), (0.99 * w, 0.1, 0.6 * d), (0, h + 0.14, 0.2 * d), 0.04)
    else:
        w, h, d = m.u(0.8, 1.6), m.u(0.25, 0.4), m.u(0.5, 0.7)
        puff, cloth = m.u(0.04, 0.09), m.cloth("earth any dark")
        block(cloth, (w, h, d), (0, h / 2, 0), puff * 0.5)
        count = m.n(1, 3)
        for i in range(count):
            x, wide = (i + 0.5) * w / count - w / 2, w / count * 0.97
            block(cloth, (wide, 0.18, d * 0.9), (x, h + 0.05, 0.03), puff)
            block(cloth, (wide, 0.4, 0.2), (x, h + 0.25, -d / 2 + 0.12), puff)
        arm = box(0.16, h + m.u(0.1, 0.25), d, puff)
        parts.pair(arm, cloth, at=(w / 2 + 0.05, (h + 0.15) / 2, 0))
        if m.chance(0.4):
            part = superquadric([0.16, 0.16, 0.06], 0.5, 0.8)
            parts.add(part, third, turn=(-20, 0, m.u(-20, 20)), at=(m.u(-0.3, 0.3), h + 0.25, 0.05))
    if m.chance(0.3):
        return parts.turned(0, m.u(-60, 60))
    return parts


def rack(m: Maker) -> list[Manifold]:
    """Wires and slats: a basket, a rack, a cage, a crate, a stand, a hanger."""
    look, second = m.pick(m.metal(), m.plain("white dark toy"), m.wood()), m.surface()
    w, h, d, r = m.u(0.5, 1.0), m.u(0.2, 0.7), m.u(0.3, 0.7), m.u(0.01, 0.022)
    solids, parts = Parts(m), []
    kind = m.n(0, 3)
    flare = m.u(0.6, 1.0)

    def hoop(scale: float, y: float, thick: float) -> Manifold:
        corners = rounded(w * scale, d * scale, m_corner, 3)
        return tube([(x, y, z) for x, z in corners], thick, 6, 32, True)

    m_corner = m.u(0.03, 0.15)
    if kind <= 1:  # a basket of wires or slats
        for y in np.linspace(0, h, m.n(2, 4)):
            parts.append(hoop(flare + (1 - flare) * y / h, float(y), r))
        slat = m.pick(1.0, 1.0, m.u(1.5, 3))
        xs = np.linspace(-w / 2, w / 2, m.n(4, 7)) * 0.92
        zs = np.linspace(-d / 2, d / 2, m.n(3, 5)) * 0.92
        feet = [(x, z) for x in xs for z in (-d / 2, d / 2)]
        feet += [(x, z) for z in zs for x in (-w / 2, w / 2)]
        parts += [bar((x * flare, 0, z * flare), (x, h, z), r) for x, z in feet]
        for x in xs * flare:
            parts.append(bar((x, 0, -d / 2 * flare), (x, 0, d / 2 * flare), r * slat))
        solids.add(joined(parts), look)
        if m.chance(0.4):
            solids.add(hoop(1.01, h, r * 2), second)
        if m.chance(0.4):
            half = [(-w / 2, h, 0), (-w * 0.4, h + 0.35, 0), (0, h + 0.5, 0)]
            solids.add(bow(half, r * 1.5, 28), m.pick(look, second))
        if m.chance(0.3):
            solids.add(box(w * flare, r * 1.5, d * flare), second)
    elif kind == 2:  # plates or shelves on posts
        post = rod(r * 1.5, h * 1.5, 10)
        places = product((-w * 0.46, w * 0.46), (-d * 0.46, d * 0.46))
        posts = [post.translate([x, 0, z]) for x, z in places]
        solids.add(joined(posts), look)
        for y in np.linspace(0.05, h * 1.4, m.n(2, 4)):
            if m.chance(0.5):
                solids.add(box(w, 0.03, d, 0.01), second, at=(0, y, 0))
            else:
                xs = np.linspace(-w / 2, w / 2, m.n(5, 9))
                rods = [bar((x, y, -d / 2), (x, y, d / 2), r * 0.8) for x in xs]
                rods += [bar((-w / 2, y, z), (w / 2, y, z), r) for z in (-d / 2, d / 2)]
                solids.add(joined(rods), look)
    else:  # a crate of boards
        t, boards = m.u(0.015, 0.03), m.n(2, 4)
        tall = h / boards
        for i in range(boards):
            y = (i + 0.5) * tall
            parts += [box(w, tall * 0.8, t).translate([0, y, z]) for z in (-d / 2, d / 2)]
            parts += [box(t, tall * 0.8, d).translate([x, y, 0]) for x in (-w / 2, w / 2)]
        for x, z in product((w / 2 - 0.02, 0.02 - w / 2), (d / 2 - 0.02, 0.02 - d / 2)):
            parts.append(box(0.05, h, 0.05).translate([x, h / 2, z]))
        parts.append(box(w, t, d).translate([0, t, 0]))
        solids.add(joined(parts), m.pick(m.wood(), look))
        for i in range(m.n(0, 5)):
            s = m.u(0.08, 0.14)
            at = (m.u(-0.3, 0.3) * w, h * 0.6, m.u(-0.3, 0.3) * d)
            solids.add(produce(m, s), second if i % 2 else m.plain("toy leaf"), at=at)
    return solids.turned(0, m.u(-50, 50), 0)


def organiser(m: Maker) -> list[Manifold]:
    """A tray, drawer or stand with places for things, and some of these."""
    w, h, d, t = m.u(0.5, 1.0), m.u(0.1, 0.5), m.u(0.3, 0.7), m.u(0.015, 0.04)
    look, inside = m.pick(m.surface(), m.wood()), m.surface("white dark any")
    body = m.stamp(box(w, h, d, m.pick(0.0, 0.02, 0.06)), look)
    columns, rows = m.n(1, 4), m.n(1, 3)
    xs = np.sort(m.rng.uniform(-0.5, 0.5, columns - 1))
    zs = np.sort(m.rng.uniform(-0.5, 0.5, rows - 1))
    xs, zs = np.array([-0.5, *xs, 0.5]) * w, np.array([-0.5, *zs, 0.5]) * d
    parts, cuts = Parts(m), []
    for left, right in zip(xs, xs[1:]):
        for back, front in zip(zs, zs[1:]):
            wide, deep = float(right - left) - 2 * t, float(front - back) - 2 * t
            if min(wide, deep) < 0.04:
                continue
            x, z = float(left + right) / 2, float(back + front) / 2
            round_one = m.chance(0.2)
            pit = box(wide, h, deep, m.pick(0.0, 0.02))
            if round_one:
                pit = rod(min(wide, deep) / 2, h, 24).translate([0, -h / 2, 0])
            cuts.append(pit.translate([x, m.u(0.05, 0.4) * h, z]))
            if m.chance(0.5):
                tall = h * m.u(0.6, 2.2)
                item = m.pick(
                    box(wide * m.u(0.3, 0.9), tall, deep * m.u(0.3, 0.9), 0.01),
                    rod(min(wide, deep) * m.u(0.1, 0.45), tall, 16).translate([0, -tall / 2, 0]),
                )
                lean = (m.u(-6, 6), 0, m.u(-6, 6))
                parts.add(item, m.surface(), turn=lean, at=(x, tall / 2 - h * 0.4, z))
    if cuts:
        body = body - m.stamp(joined(cuts), inside)
    return [joined([body, *parts]).rotate([m.pick(0, m.u(0, 60)), m.u(-50, 50), 0])]


def cushion(m: Maker) -> list[Manifold]:
    """A cushion, a folded towel or blanket, a roll, a rug."""
    parts = Parts(m)
    look = m.pick(
        m.cloth("any"), m.printed("front", m.color("white any toy"), sides=m.chance(0.5)), m.fur()
    )
    trim = m.cloth()
    kind = m.n(0, 3)
    if kind <= 1:
        w, h, d = m.u(0.4, 0.7), m.u(0.3, 0.6), m.u(0.12, 0.25)
        body = superquadric([w, h, d], m.u(0.5, 1), m.u(0.5, 0.9), 40)
        p = m.u(2.5, 6)
        form = ring_of(p, 40) * [w, h]
        heights = np.linspace(-1, 1, 15)
        rings = [np.column_stack([form * (1 - abs(z) ** 3 * 0.9), [z * d] * 40]) for z in heights]
        body = m.pick(body, loft(np.stack(rings)))
        parts.add(ripple(body, m.rng, m.u(0.004, 0.02), m.u(0.2, 0.6), False), look)
        if m.chance(0.4):
            rim = tube([(x, y, 0) for x, y in form[::3]], 0.02, 8, 56, True)
            parts.add(rim, trim)
        return parts.turned(m.u(-40, 0), m.u(-40, 40), m.pick(0, m.u(-45, 45)))
    if kind == 2:  # folded
        y = 0.0
        for i in range(m.n(1, 5)):
            w, d, t = m.u(0.7, 0.9), m.u(0.5, 0.65), m.u(0.08, 0.15)
            one = box(w, t, d, 0.45 * t)
            one = ripple(one.refine_to_length(0.15), m.rng, 0.006, 0.3, False)
            parts.add(one, look if i % 2 else trim, at=(0, y + t / 2, 0))
            y += t * 0.97
        return parts.turned(0, m.u(-60, 60))
    r, long = m.u(0.12, 0.3), m.u(0.6, 1.2)
    turns = np.linspace(0.15, 1, 60)
    a = turns * m.u(2.5, 5) * 2 * math.pi
    spiral = np.stack([turns * r * np.cos(a), turns * r * np.sin(a)], -1)
    sheet = r / 14
    normal = spiral / np.linalg.norm(spiral, axis=1, keepdims=True)
    outline_ = np.concatenate([spiral + sheet * normal, (spiral - sheet * normal)[::-1]])
    roll = CrossSection([outline_], FillRule.NonZero).extrude(long).translate([0, 0, -long / 2])
    return [m.stamp(roll, look).rotate([m.pick(0, -90), m.u(-60, 60), 0])]
