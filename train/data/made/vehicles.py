"""Cars, lorries, aeroplanes, boats, trains."""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold

from .details import wheel
from .looks import Maker, Parts
from .solids import ball, both, box, joined, lathe, loft, ring_of, ripple, rod, slab, tube

SLOPE = np.array([1.05, 0.95, 0.75])  # heights of a car's bonnet, to its front


def vehicle(m: Maker) -> list[Manifold]:
    """A car, bus, lorry, tractor or digger."""
    paint, dark = m.surface("toy toy any pastel metal"), m.plain("dark")
    glass = m.painted(np.array([0.1, 0.14, 0.18]) * m.u(0.3, 4))
    accent = m.surface("toy metal white dark")
    kind = m.n(0, 4)
    long, w = m.u(0.9, 1.4), m.u(0.4, 0.55)
    r = m.u(0.09, 0.2)
    h = m.u(0.15, 0.3)
    floor = r * 0.9
    parts = Parts(m)
    axles = [-long * m.u(0.28, 0.36), long * m.u(0.28, 0.36)]
    if kind <= 1:  # a car: the side's outline, drawn out and rounded
        ends, hood, boot = floor + h * 0.15, floor + h * m.u(0.75, 1.1), floor + h * m.u(0.75, 1.3)
        roof = floor + h + m.u(0.15, 0.35)
        z = (
            *(-0.5, -0.49, -0.42, -0.3 + m.u(-0.1, 0.06), -0.22 + m.u(-0.15, 0.05)),
            *(0.1 + m.u(-0.05, 0.08), 0.25 + m.u(-0.05, 0.05), 0.44, 0.5, 0.5),
        )
        side = np.array([ends, boot * 0.8, boot, boot * 1.02, roof, roof, *(hood * SLOPE), ends])
        rings = []
        for x, s in ((-0.5, 0.75), (-0.42, 0.95), (-0.2, 1), (0.2, 1), (0.42, 0.95), (0.5, 0.75)):
            y = np.where(side > hood, hood + (side - hood) * s, side)
            # The cabin is narrower than the body below it.
            wide = x * w * (1 - 0.5 * np.clip(y - hood, 0, 1))
            rings.append(np.stack([wide, y, np.array(z) * long * (0.97 + 0.03 * s)], -1))
        body = loft(np.stack(rings))
        arch = rod(r * 1.15, 3, 24).rotate([0, 0, 90]).translate([1.5, r, 0])
        arches = joined([arch.translate([0, 0, a]) for a in axles]) - box(w * 0.6, 5, 5)
        shell = m.stamp(body, paint) - m.stamp(arches, dark)
        low, high = hood + 0.02, roof - 0.03
        panes = box(2, max(high - low, 0.02), long * 0.62).translate(
            [0, (low + high) / 2, -0.04 * long]
        )
        window = m.stamp(body.scale([1.012, 1, 1]) ^ panes, glass)
        level = box(2, max(high - low, 0.02), 9).translate([0, (low + high) / 2, 0])
        shield = m.stamp(body.scale([0.9, 1.004, 1.01]) ^ level, glass)
        parts += [shell, window, shield]
        for x in (-0.33, 0.33):
            part = ball([0.06, 0.04, 0.03], 14)
            parts.add(part, m.plain("white pastel"), at=(x * w, hood * 0.82, long * 0.49))
        parts.add(box(w * 0.96, 0.05, 0.06, 0.02), accent, at=(0, floor + h * 0.25, long * 0.5))
        if m.chance(0.25):
            part = box(w * 0.8, 0.03, 0.1).translate([0, boot + 0.1, -long * 0.45]) + both(
                box(0.03, 0.12, 0.05).translate([w * 0.3, boot + 0.04, -long * 0.45])
            )
            parts.add(part, accent)
    elif kind == 2:  # bus or van
        tall = m.u(0.4, 0.6)
        body = box(w, tall, long, 0.06).translate([0, floor + tall / 2, 0])
        parts.add(body, paint)
        count = m.n(2, 6)
        for z in np.linspace(-long * 0.4, long * 0.4, count):
            part = box(w * 1.015, tall * 0.3, long * 0.65 / count, 0)
            parts.add(part, glass, at=(0, floor + tall * 0.65, z))
        part = box(w * 0.85, tall * 0.35, 0.05)
        parts.add(part, glass, at=(0, floor + tall * 0.62, long / 2 - 0.015))
        parts.add(box(w * 1.01, 0.04, long * 1.005), accent, at=(0, floor + tall * 0.35, 0))
    else:  # a lorry: chassis, cabin, load
        cab = m.u(0.3, 0.42)
        parts.add(box(w * 0.8, 0.08, long, 0.02), dark, at=(0, floor + 0.05, 0))
        part = box(w, cab, long * 0.27, m.u(0.02, 0.08))
        parts.add(part, paint, at=(0, floor + cab / 2 + 0.05, long * 0.36))
        part = box(w * 1.02, cab * 0.35, long * 0.16)
        parts.add(part, glass, at=(0, floor + cab * 0.75, long * 0.37))
        parts.add(box(w * 0.8, cab * 0.35, 0.05), glass, at=(0, floor + cab * 0.75, long * 0.49))
        load = m.n(0, 4)
        z, deep = -long * 0.15, long * 0.66
        if load == 0:
            side = m.pick(accent, m.printed("front", m.color("white any")))
            parts.add(box(w, m.u(0.3, 0.6), deep, 0.02), side, at=(0, floor + 0.35, z))
        elif load == 1:
            tub = box(w, 0.3, deep, 0.0) - box(w * 0.9, 0.3, deep * 0.93).translate([0, 0.04, 0])
            parts.add(tub, accent, turn=(m.pick(0, 0, 20), 0, 0), at=(0, floor + 0.27, z))
            if m.chance(0.5):
                heap = ripple(ball([w * 0.42, 0.2, deep * 0.42], 32), m.rng, 0.02, 0.15, False)
                parts.add(heap, m.pattern("speckled", "earth"), at=(0, floor + 0.3, z))
        elif load == 2:
            path = [(0, 0, -deep / 2 + 0.1), (0, 0, 0), (0, 0, deep / 2 - 0.1)]
            tank = tube(path, m.u(0.18, 0.24), 24, 12)
            parts.add(tank, m.pick(accent, m.metal()), at=(0, floor + 0.3, z))
        elif load == 3:  # a ladder or crane
            path = [
                (0, floor + 0.2, z - 0.1),
                (0, floor + 0.5, z),
                (0, floor + m.u(0.4, 0.9), long * m.u(0.2, 0.6)),
            ]
            arm = tube(path, [0.08, 0.06, 0.04], ring_of(6, 12), 20)
            parts.add(arm, accent)
            parts.add(rod(0.15, 0.15), paint, at=(0, floor + 0.05, z))
            part = box(0.25, 0.18, 0.2, 0.02) - box(0.2, 0.2, 0.2).translate([0, 0.06, 0.06])
            parts.add(part, accent, at=(0, floor + 0.4, long * 0.55))
        else:
            log = rod(0.09, deep, 16).rotate([90, 0, 0]).translate([0, floor + 0.18, z - deep / 2])
            part = joined([log.translate([x, 0, 0]) for x in (-0.19, 0, 0.19)])
            parts.add(part, m.wood())
        axles = [long * 0.36, -long * 0.2, *([-long * 0.38] if m.chance(0.6) else [])]
        if m.chance(0.15):
            r *= 1.3
    hub = m.surface("metal white toy")
    thick = m.u(0.08, 0.16)
    tire = wheel(r, thick)
    for a in axles:
        at = [w / 2 - thick * 0.3, r, float(a)]
        parts.pair(tire, dark, at=at)
        parts.pair(wheel(r * m.u(0.4, 0.65), thick * 1.15), hub, at=at)
    return parts.turned(0, m.pick(0, 90, -90, m.u(-180, 180), m.u(20, 70), m.u(-70, -20)))


def plane(m: Maker) -> list[Manifold]:
    """An aeroplane, helicopter, rocket or boat."""
    paint, second = m.surface("toy white metal any"), m.surface("toy any")
    dark = m.plain("dark")
    kind = m.n(0, 3)
    parts = Parts(m)
    if kind <= 1:
        long, r = m.u(1.0, 1.4), m.u(0.09, 0.2)
        line = [(0, m.u(0, 0.08), -long / 2), (0, 0, 0), (0, 0, long / 2)]
        hull = tube(line, [r * 0.3, r, r * m.u(0.6, 1)], 22, 28)
        parts.add(hull, paint)
        part = ball([r * 0.7, r * 0.6, r * 1.3], 24)
        parts.add(part, m.plain("dark pastel metal"), at=(0, r * 0.7, long * 0.22))
        if kind == 0 or m.chance(0.4):
            sweep, chord, span = m.u(-0.05, 0.45), m.u(0.25, 0.5), m.u(0.55, 0.9)
            form = [
                *((0, -chord / 2), (span, -sweep - chord * 0.3), (span, -sweep + chord * 0.2)),
                (0, chord / 2),
            ]
            wing = slab(form, 0.05, 0.02, 2).rotate([90, 0, 0]).mirror([0, 0, 1])
            levels = (m.u(-0.6, 0.8) * r,) if m.chance(0.75) else (-0.7 * r, 1.8 * r)
            for y in levels:
                parts.pair(wing, m.pick(paint, second), at=(0, y, 0.08))
            if len(levels) > 1:
                parts.pair(rod(0.02, 2.6 * r, 10), dark, at=(span * 0.6, -0.7 * r, 0.0))
            if m.chance(0.5):
                part = tube([(0, 0, -0.12), (0, 0, 0.15)], [0.05, 0.06], 16, 10)
                parts.pair(part, m.metal(), at=(span * 0.45, levels[0] - 0.05, 0.12))
        else:
            blades = [box(1.3, 0.015, 0.08).rotate([0, 90 * i + 20, 0]) for i in range(2)]
            part = joined([*blades, rod(0.04, 0.15, 12).translate([0, -0.12, 0])])
            parts.add(part, dark, at=(0, r + 0.12, 0.1))
            line = [(r, -r - 0.12, -0.3), (r, -r - 0.12, 0.3)]
            part = tube(line, 0.025, 8, 8) + rod(0.02, 0.2, 8).translate([r, -r - 0.12, 0])
            parts.pair(part, dark)
        form = [(-0.02, 0), (0.18, 0), (0.06, 0.3), (-0.06, 0.3)]
        fin = slab(form, 0.03, 0.01, 2).rotate([0, -90, 0])
        parts.add(fin, second, at=(0, r * 0.4, -long / 2 + 0.02))
        form = [(0, -0.1), (0.28, -0.14), (0.28, 0.0), (0, 0.1)]
        flat = slab(form, 0.025, 0.008, 2).rotate([90, 0, 0]).mirror([0, 0, 1])
        parts.pair(flat, second, at=(0, 0.05, -long / 2 + 0.08))
        if m.chance(0.4):
            part = joined(
                [box(0.5, 0.05, 0.015).rotate([0, 0, 60 * i]) for i in range(m.pick(2, 3))]
            )
            parts.add(part, dark, at=(0, 0, long / 2 + r * 0.8))
    elif kind == 2:  # a rocket that stands
        r = m.u(0.12, 0.25)
        profile = [(r * 0.7, 0), (r, 0.3), (r, 0.7), (r * 0.7, 1.0), (r * 0.2, 1.2), (0, 1.25)]
        hull = lathe(profile, 32)
        parts.add(
            hull, m.pick(paint, m.pattern("striped", "white toy", contrast=1, mapping="round"))
        )
        form = [(0, 0.1), (0.25, -0.15), (0.25, 0.05), (0.0, 0.45)]
        fin = slab(form, 0.04, 0.01, 2).translate([r * 0.8, 0, 0])
        fin, count = m.stamp(fin, second), m.pick(3, 4)
        parts += [fin.rotate([0, 360 * i / count, 0]) for i in range(count)]
        parts.add(ball([0.1, 0.1, 0.05], 20), dark, at=(0, 0.7, r * 0.95))
        return parts
    else:  # a boat
        long, w, h = m.u(0.9, 1.4), m.u(0.35, 0.5), m.u(0.2, 0.35)
        count, sides = 16, 24
        t = np.linspace(0, 1, count)
        half = (
            w / 2 * np.clip(np.interp(t, [0, 0.3, 0.65, 1], [m.u(0.5, 0.9), 1, 0.9, 0.05]), 0.02, 1)
        )
        form = ring_of(3, sides)
        rings = np.empty((count, sides, 3))
        rings[..., 0] = form[None, :, 0] * half[:, None] * (0.75 + 0.25 * form[None, :, 1])
        rings[..., 1] = form[None, :, 1] * h / 2 + 0.15 * t[:, None] ** 3
        rings[..., 2] = (t[:, None] - 0.5) * long
        hull = loft(rings)
        well = m.stamp(hull.scale([0.85, 1, 0.85]).translate([0, h * 0.6, 0]), m.wood())
        parts.append(m.stamp(hull, paint) - well)
        if m.chance(0.5):
            parts.add(rod(0.025, 1.0, 10), m.wood())
            form = [(0.03, 0.25), (0.5, 0.25), (0.03, 0.95)]
            sail = slab(form, 0.02).rotate([0, m.u(60, 120), 0])
            parts.add(sail, m.cloth("white toy"))
            if m.chance(0.5):
                part = slab([(0.03, 0.25), (0.4, 0.25), (0.03, 0.8)], 0.02)
                parts.add(part, m.cloth("white toy"), turn=(0, -m.u(60, 120), 0))
        else:
            parts.add(box(w * 0.55, 0.25, long * 0.3, 0.03), second, at=(0, h * 0.4, -0.05 * long))
            part = box(w * 0.4, 0.15, long * 0.15, 0.02)
            parts.add(part, m.pick(paint, second), at=(0, h * 0.4 + 0.19, 0))
            for z in np.linspace(-0.2, 0.0, m.n(1, 3)):
                parts.add(rod(0.05, 0.3, 16), m.surface("toy dark"), at=(0, h * 0.4, z * long))
    return parts.turned(0, m.pick(0, 90, -90, m.u(-180, 180)))


def train_of(m: Maker) -> list[Manifold]:
    """A wooden or plastic train: an engine and waggons, or one of them."""
    looks = [m.surface("toy") for _ in range(3)]
    dark = m.surface("dark wood toy")
    parts = Parts(m)
    count = m.n(1, 3)
    w, long, r = m.u(0.3, 0.4), m.u(0.5, 0.7), m.u(0.07, 0.11)
    for i in range(count):
        z = -i * (long + 0.1)
        main, second = m.pick(*looks), m.pick(*looks)
        car = Parts(m)
        car.add(box(w, 0.08, long, 0.015), m.pick(dark, second), at=(0, r + 0.04, 0))
        if i == 0:
            line = [(0, 0, -long * 0.1), (0, 0, long * 0.38)]
            part = tube(line, m.u(0.11, 0.15), 24, 8, round_ends=m.chance(0.5))
            car.add(part, main, at=(0, r + 0.2, 0))
            part = box(w * 0.95, m.u(0.3, 0.42), long * 0.3, 0.01)
            car.add(part, second, at=(0, r + 0.25, -long * 0.3))
            car.add(box(w * 1.1, 0.04, long * 0.36, 0.015), main, at=(0, r + 0.46, -long * 0.3))
            part = lathe([(0.04, 0), (m.u(0.03, 0.08), 0.15)], 20)
            car.add(part, dark, at=(0, r + 0.3, long * 0.3))
            car.add(ball(0.06, 18), second, at=(0, r + 0.34, 0.05))
        else:
            load = m.n(0, 3)
            if load == 0:
                hole = box(w * 0.8, 0.22, long * 0.8).translate([0, 0.05, 0])
                part = box(w * 0.95, 0.22, long * 0.9, 0.02) - hole
                part = m.stamp(part, main).translate([0, r + 0.18, 0])
                car.append(part)
            elif load == 1:
                line = [(0, 0, -long * 0.3), (0, 0, long * 0.3)]
                car.append(m.stamp(tube(line, 0.15, 24, 8), main).translate([0, r + 0.2, 0]))
            elif load == 2:
                log = rod(0.05, long * 0.85, 14).rotate([90, 0, 0])
                for x in (-0.1, 0.0, 0.1):
                    car.add(log, second, at=(x, r + 0.12, -long * 0.42))
            else:
                for k in range(m.n(1, 3)):
                    part = box(0.2, 0.2, 0.2, 0.01)
                    car.add(part, m.pick(*looks), at=(0, r + 0.18, (k - 1) * 0.21))
        for a in (-long * 0.3, long * 0.3):
            car.pair(wheel(r, 0.05), m.pick(dark, second) if i % 2 else dark, at=(w / 2, r, a))
        car.add(box(0.05, 0.04, long + 0.15), dark, at=(0, r + 0.04, 0))
        parts.append(joined(car).translate([0, 0, z]))
    return parts.turned(0, m.pick(90, -90, m.u(-180, 180), m.u(30, 70)))
