"""Shoes, bags, hats, glasses and the like."""

from __future__ import annotations

import math

import numpy as np
from manifold3d import Manifold

from .details import bow, handle, outline
from .looks import Maker, Parts
from .solids import (
    ball,
    both,
    box,
    joined,
    lathe,
    loft,
    ring,
    ring_of,
    ripple,
    rod,
    rounded,
    slab,
    superquadric,
    taper,
    tube,
)
from .textures import screen


def _sole(width: float, long: float, count: int = 40) -> np.ndarray:
    """The outline ``[count, 2]`` of a foot, along y, its toe up."""
    t = np.arange(count) * (2 * math.pi / count)
    y = -np.cos(t) * long / 2
    share = y / long + 0.5
    half = (
        np.interp(share, [0, 0.15, 0.4, 0.7, 0.9, 1], [0.6, 0.8, 0.72, 1.0, 0.85, 0.5]) * width / 2
    )
    x = np.sin(t) * half + 0.06 * width * (share - 0.3)
    return np.stack([x, y], -1)


def _lifted(solid: Manifold, heel: float) -> Manifold:
    """A part of a shoe whose heel stands higher than its toes."""

    def move(p: np.ndarray) -> np.ndarray:
        up = heel * np.clip((0.2 - p[:, 2]) / 0.6, 0, 1) ** 1.3
        return np.stack([p[:, 0], p[:, 1] + up, p[:, 2]], -1)

    return solid.refine_to_length(0.12).warp_batch(move)


def shoe(m: Maker) -> list[Manifold]:
    """A trainer, a boot, a slipper, a clog or a shoe with a heel; one or a pair."""
    upper = m.pick(m.surface(), m.cloth("any"), m.pattern("plain clouded", "leather dark"))
    lower, trim = m.surface("white dark earth any"), m.surface("any")
    long, wide = 1.0, m.u(0.3, 0.4)
    collar = m.pick(m.u(0.25, 0.36), m.u(0.3, 0.42))
    tall = m.u(0.4, 1.0) if m.chance(0.22) else 0.0  # of a boot's shaft
    heel = m.pick(0.0, 0.0, 0.0, m.u(0.03, 0.1), m.u(0.1, 0.35))
    thick = m.u(0.03, 0.11)
    count, sides = 30, 28
    t = np.linspace(0, 1, count)  # from the heel to the toe
    toe = m.u(0.11, 0.2)
    tongue = 0.55 * collar + 0.5 * toe
    levels = [0.75 * collar, collar, collar * 0.98, tongue, toe * 1.1, toe * 0.85, toe * 0.3]
    instep = np.interp(t, [0, 0.08, 0.35, 0.55, 0.8, 0.93, 1], levels)
    point = m.u(0.25, 0.75)
    places = [0, 0.04, 0.15, 0.4, 0.7, 0.9, 0.97, 1]
    widths = [0.35, 0.6, 0.8, 0.72, 1.0, 0.85 - 0.3 * (point < 0.4), point, 0.5 * point]
    half = np.interp(t, places, widths) * wide / 2
    shift = 0.05 * wide * (t - 0.3)
    blur = [0.1, 0.2, 0.4, 0.2, 0.1]
    instep, half = (np.convolve(np.pad(v, 2, mode="edge"), blur, "valid") for v in (instep, half))
    angle = np.arange(sides) * (2 * math.pi / sides)
    narrow = m.u(0.5, 0.85)  # how much of its width is left at the top of a high place
    rings = np.empty((count, sides, 3))
    for i in range(count):
        s, c = np.sin(angle), np.cos(angle)
        k = 3.0
        r = (np.abs(s) ** k + np.abs(c) ** k) ** (-1 / k)
        up = (r * s + 1) / 2
        tall_here = np.clip(instep[i] / collar, 0, 1)
        tight = 1 - 1.3 * (1 - narrow) * np.clip(up - 0.25, 0, 1) * tall_here
        rings[i, :, 0] = r * c * half[i] * tight + shift[i]
        rings[i, :, 1] = up * instep[i]
        rings[i, :, 2] = (t[i] - 0.5) * long
    body = m.stamp(loft(rings), upper)
    # The foot goes in at the top.
    inner = rings.copy()
    keep = t < m.u(0.5, 0.62)
    inner[:, :, 0] = (inner[:, :, 0] - shift[:, None]) * 0.86 + shift[:, None]
    inner[:, :, 1] = inner[:, :, 1] * 1.3 + 0.05
    inner[:, :, 2] = inner[:, :, 2] * 0.95
    inside = m.surface("dark white any")
    hole = m.stamp(loft(inner[keep][1:]), inside)
    if tall:
        wide_top, lean = m.u(0.3, 0.42), m.u(-0.08, 0.08)
        heights = np.linspace(0.1, tall, 9)
        form = ring_of(2.3, 26)
        places = [0.1, 0.3, 0.5 * tall + 0.2, tall]
        widths = np.interp(heights, places, [0.36, 0.32, 0.36, wide_top])[:, None]
        widths = widths * wide * m.u(0.95, 1.1)
        x, y = form[:, 0] * widths, np.repeat(heights[:, None], 26, 1)
        z = form[:, 1] * widths * m.u(1.2, 1.5) - 0.27 + lean * (y - 0.1)
        shaft = np.stack([x, y, z], -1)
        core = (shaft - [0, 0, -0.27]) * [0.86, 1, 0.86] + [0, 0.04, -0.27]
        core[..., 1] = (core[..., 1] - 0.1) * 1.1 + 0.06
        hole = m.stamp(loft(core), inside)
        body = body + m.stamp(loft(shaft), m.pick(upper, upper, trim))
    body = body - hole
    if heel > 0.12:  # the foot stands on its toes
        body = _lifted(body, heel)
    spread = m.u(1.02, 1.1)
    base = slab(_sole(wide * spread, long * 1.02), thick, 0.25 * thick, 2)
    base = base.rotate([90, 0, 0]).mirror([0, 0, 1])
    base = base.translate([0, 0.015 - thick / 2, 0])
    parts = Parts(m)
    parts.append(body)
    if heel > 0.12:
        base = _lifted(base, heel)
        post = lathe([(m.u(0.03, 0.1), 0), (0.11, heel + 0.02)], 16).translate([0, -thick, -0.38])
        parts.add(post, lower)
    elif heel > 0:
        block = slab(_sole(wide, long), heel).rotate([90, 0, 0]).mirror([0, 0, 1])
        block = block.trim_by_plane([0, 0, -1], m.u(0.15, 0.25))
        parts.add(block, lower, at=(0, -thick - heel / 2 + 0.02, 0))
    elif m.chance(0.4):  # a profile below
        groove = box(wide * 1.4, 0.03, 0.03)
        for z in np.linspace(-0.45, 0.45, m.n(7, 13)):
            base -= groove.translate([0, -thick, z])
    parts.add(base, lower)
    if m.chance(0.65) and not tall:  # laces, or a strap
        rows = m.n(1, 6)
        for z in np.linspace(0.02, 0.24, rows):
            y = float(np.interp(z + 0.5, t, instep))
            w = float(np.interp(z + 0.5, t, half)) * 0.75
            line = [(-w, y - 0.03, z), (0, y + 0.012, z - 0.01), (w, y - 0.03, z)]
            lace = tube(line, 0.013 if rows > 1 else 0.03, 8, 12, flat=(1, 1.5))
            parts.add(lace, trim)
    if m.chance(0.45):  # a mark on the sides, a cap on the toe
        mark = slab(outline(m) * [0.25, 0.12], 0.5).rotate([0, 90, 0])
        shell = loft(rings * [1.03, 1.0, 1.0]) ^ both(mark.translate([0.25, collar * 0.45, 0]))
        parts.append(m.stamp(shell, trim) - hole)
    if m.chance(0.35):
        cap = loft(rings * [1.04, 1.04, 1.01]).trim_by_plane([0, 0, 1], m.u(0.25, 0.36))
        parts.add(cap, m.pick(lower, trim))
    if tall and not heel > 0.12 and m.chance(0.5):  # fur or a roll at the top of a boot
        roll = tube(shaft[-1][::2] * [1.03, 1, 1], m.u(0.03, 0.06), 10, 30, True)
        parts.append(m.stamp(roll, m.fur()) - hole)
    whole = joined(parts)
    if m.chance(0.12):
        other = whole.mirror([1, 0, 0]).translate([wide * 1.24, 0, m.u(-0.1, 0.1)])
        return [(whole + other).rotate([0, m.u(-40, 40), 0])]
    return [whole.rotate([0, m.pick(90, -90, m.u(-90, 90), m.u(-180, 180)), 0])]


def bag(m: Maker) -> list[Manifold]:
    """A backpack, handbag, purse, tote or case with straps and pockets."""
    w, h, d = m.u(0.4, 0.9), m.u(0.4, 1.0), m.u(0.15, 0.4)
    cloth = m.pick(m.cloth("any"), m.pattern("plain clouded", "leather"), m.surface())
    trim = m.surface("dark leather any")
    body = superquadric([w / 2, h / 2, d / 2], m.u(0.2, 0.6), m.u(0.25, 0.7), 36)
    body = taper(body, m.u(0.65, 1.1))
    body = ripple(body, m.rng, m.u(0.0, 0.012), 0.5, True)
    parts = Parts(m)
    parts.add(body, cloth)
    kind = m.n(0, 2)
    if kind == 0:  # a backpack
        for _ in range(m.n(1, 2)):
            ph, pw = h * m.u(0.25, 0.5), w * m.u(0.5, 0.85)
            pocket = superquadric([pw / 2, ph / 2, d * 0.3], 0.4, 0.5)
            y = -h / 2 + ph / 2 + m.u(0.02, 0.12) * h
            parts.add(pocket, m.pick(cloth, trim), at=(0, y, d / 2 - 0.02))
        line = [
            *((w * 0.2, h * 0.45, -d * 0.35), (w * 0.25, h * 0.3, -d * 0.5 - 0.15)),
            *((w * 0.3, -h * 0.1, -d * 0.5 - 0.15), (w * 0.35, -h * 0.4, -d * 0.35)),
        ]
        strap = tube(line, 0.025, 10, 24, flat=(1, 2))
        parts.pair(strap, trim)
        part = handle(m, 0.12, w * 0.3, 0.018)
        parts.add(part, trim, turn=(0, 0, 90), at=(0, h * 0.47, -d * 0.2))
        side = box(0.05, h * 0.3, d * 0.5, 0.02).translate([w * 0.47, -h * 0.25, 0])
        parts.pair(side, trim)
    elif kind == 1:  # a handbag with one or two bows
        tall = m.u(0.2, 0.6)
        for z in (0.25 * d, -0.25 * d) if m.chance(0.6) else (0.0,):
            top = h * 0.5 + tall
            half = [(-w * 0.25, h * 0.42, z), (-w * 0.22, top - tall * 0.3, z), (0, top, z)]
            parts.add(bow(half, m.u(0.012, 0.03)), trim)
        flap = superquadric([w * 0.48, h * m.u(0.2, 0.35), d * 0.5], 0.4, 0.5).translate(
            [0, h * 0.25, 0.04]
        )
        if m.chance(0.6):
            parts.add(flap, m.pick(trim, cloth))
            parts.add(ball(0.03, 14), m.metal(), at=(0, h * 0.1, d * 0.52))
    else:  # a tote: open at its top
        inner = m.stamp(
            body.scale([0.93, 0.95, 0.88]).translate([0, 0.2, 0]), m.plain("dark white")
        )
        cutter = m.stamp(box(5, h, 5).translate([0, h * 0.88, 0]), trim)
        parts[0] = parts[0] - inner - cutter
        if m.chance(0.6):
            front = m.printed("front", m.color("white any"), sides=True)
            parts[0] = m.stamp(body, front) - inner - cutter
        for z in (0.4 * d, -0.4 * d):
            half = [(-w * 0.2, h * 0.2, z), (-w * 0.2, h * 0.6, z * 0.8), (0, h * 0.75, z * 0.6)]
            parts.add(bow(half, 0.02, flat=1.6), trim)
    return parts.turned(0, m.pick(0, m.u(-50, 50), m.u(-180, 180)))


def hat(m: Maker) -> list[Manifold]:
    """A cap, a hat, a helmet or a woollen cap."""
    r, h = m.u(0.35, 0.45), m.u(0.25, 0.55)
    cloth, trim = m.pick(m.cloth("any"), m.surface()), m.surface()
    dome = superquadric([r, h, r * m.u(1, 1.2)], m.u(0.5, 1), m.u(0.8, 1)).trim_by_plane(
        [0, 1, 0], 0
    )
    hollow = m.stamp(superquadric([r * 0.93, h * 0.93, r * 0.95], 0.8, 0.9), m.plain("dark any"))
    parts = Parts(m)
    parts.append(m.stamp(dome, cloth) - hollow)
    kind = m.n(0, 3)
    if kind == 0:  # a peak
        peak = slab(ring_of(2.5, 36) * [r * 0.85, r * m.u(0.8, 1.1)], 0.03, 0.01, 2)
        peak = peak.rotate([90 + m.u(0, 15), 0, 0]).translate([0, 0.01, r * 0.75])
        cutter = superquadric([r * 0.93, h * 0.93, r * 0.95], 0.8, 0.9)
        parts.add(peak - cutter, m.pick(cloth, trim))
        parts.add(ball(0.03, 12), trim, at=(0, h, 0))
    elif kind == 1:  # a brim
        reach = r * m.u(1.3, 1.9)
        up = m.u(-0.05, 0.12)
        profile = [(r, -0.01), (reach, up), (reach, up + 0.025), (r * 0.95, 0.03)]
        brim = lathe(profile, 40) - rod(r * 0.9, 1).translate([0, -0.5, 0])
        parts.add(brim, cloth)
        band = box(5, 0.08, 5).translate([0, 0.06, 0]) - rod(r * 0.85, 1).translate([0, -0.5, 0])
        part = superquadric([r * 1.03, h, r * 1.03], 0.7, 0.9) ^ band
        parts.add(part, trim)
    elif kind == 2:  # a roll and a bobble
        parts.add(ring(r * 0.97, 0.06, 40, 12, 1.6), trim, at=(0, 0.05, 0))
        part = ripple(ball(m.u(0.08, 0.15), 28), m.rng, 0.01, 0.06, False)
        parts.add(part, m.fur(), at=(0, h + 0.05, 0))
    else:  # a helmet with ridges
        for x in np.linspace(0, r * 0.7, m.n(1, 4)):
            line = [
                *((x, 0.1, r * 0.95), (x * 0.9, h * 0.95, r * 0.4), (x * 0.9, h * 1.0, -r * 0.3)),
                (x, 0.1, -r * 0.95),
            ]
            ridge = tube(line, 0.035, 10, 24)
            parts.pair(ridge, trim)
    return parts.turned(m.u(-15, 10), m.u(-60, 60))


def wearable(m: Maker) -> list[Manifold]:
    """Headphones, glasses, a watch, a mask, a crown, a ring."""
    a, b, dark = m.surface(), m.surface("dark metal toy"), m.plain("dark")
    kind = m.n(0, 4)
    parts = Parts(m)
    if kind == 0:
        r, thick = m.u(0.4, 0.5), m.u(0.02, 0.06)
        line = [(r * math.cos(t), r * 1.1 * math.sin(t), 0) for t in np.linspace(0, math.pi, 7)]
        arc = tube(line, thick, 12, 36, flat=(1, m.u(1, 2.5)))
        parts.add(arc, a)
        cup, deep = m.u(0.14, 0.24), m.u(0.08, 0.16)
        shell = rod(cup, deep, 28, 0.03).rotate([0, 0, 90])
        parts.pair(shell, b, at=(r + deep * 0.8, -0.05, 0))
        part = ring(cup * 0.8, 0.045, 28, 10)
        parts.pair(part, dark, turn=(0, 0, 90), at=(r - 0.02 - deep * 0.2, -0.05, 0))
        if m.chance(0.3):
            line = [(r, -0.15, 0.05), (r * 0.8, -0.35, 0.25), (r * 0.3, -0.4, 0.4)]
            parts.add(tube(line, 0.015, 8, 16), dark)
    elif kind == 1:
        form = m.pick(ring_of(2, 36), ring_of(4, 36), rounded(1.9, 1.5, 0.5, 9))
        form = form * [m.u(0.2, 0.26), m.u(0.13, 0.22)]
        frame = slab(form, 0.05, 0.015, 2) - slab(form * 0.82, 0.2)
        parts.pair(frame, a, at=(0.27, 0, 0))
        parts.pair(slab(form * 0.86, 0.015), m.plain("dark pastel"), at=(0.27, 0, 0))
        parts.add(tube([(-0.08, 0.03, 0), (0, 0.07, 0.02), (0.08, 0.03, 0)], 0.022, 8, 12), a)
        line = [(0.47, 0.05, 0), (0.5, 0.05, -0.3), (0.47, 0.02, -0.55), (0.45, -0.12, -0.68)]
        parts.pair(tube(line, 0.02, 8, 22, flat=(1, 1.4)), b)
    elif kind == 2:
        band = ring(0.4, m.u(0.02, 0.035), 44, 12, m.u(2.5, 5)).rotate([90, 0, 90])
        parts.add(band, a)
        face = m.pick(rod(m.u(0.16, 0.24), 0.1, 36, 0.02), box(0.34, 0.1, 0.4, 0.03))
        parts.add(face, b, turn=(90, 0, 0), at=(0, 0, 0.39))
        picture = m.faced(screen(m.rng), np.zeros(3))
        parts.add(rod(0.14, 0.03, 30), picture, turn=(90, 0, 0), at=(0, 0, 0.47))
        return parts.turned(m.u(-40, 0), m.u(-40, 40))
    elif kind == 3:
        shell = superquadric([0.4, m.u(0.45, 0.6), 0.3], m.u(0.7, 1), 0.9, 36).trim_by_plane(
            [0, 0, 1], 0.0
        )
        shell = shell - superquadric([0.36, 0.45, 0.26], 0.8, 0.9)
        eye = ball([0.09, m.u(0.04, 0.07), 0.5]).rotate([0, 0, m.u(-20, 20)])
        mouth = box(m.u(0.1, 0.25), 0.05, 1).translate([0, -0.22, 0.2])
        holes = eye.translate([0.15, 0.1, 0.2]) + mouth
        parts.add(shell - both(holes), a)
        part = tube([(0, 0.12, 0.28), (0, 0.0, 0.38), (0, -0.1, 0.3)], [0.03, 0.06, 0.04], 10, 12)
        parts.add(part, m.pick(a, b))
        if m.chance(0.5):
            part = lathe([(0.1, 0), (m.u(0.01, 0.08), 0.3)], 16)
            parts.pair(part, b, turn=(0, 0, -25), at=(0.2, 0.4, 0.1))
    else:
        r, count = m.u(0.35, 0.45), m.pick(5, 6, 8, 12)
        band = lathe([(r, 0), (r * 1.05, 0.2)], 44) - rod(r * 0.93, 1).translate([0, -0.5, 0])
        parts.add(band, a)
        profile = [(0.08, 0), (0.01, m.u(0.15, 0.35)), (0, 0.35)]
        spike = m.pick(
            lathe(profile, 12), ball(0.06, 14).translate([0, 0.05, 0]), box(0.1, 0.2, 0.04, 0.01)
        )
        parts += [
            m.stamp(spike.translate([0, 0.17, r]), m.pick(a, b)).rotate([0, 360 * i / count, 0])
            for i in range(count)
        ]
    return parts.turned(m.u(-25, 10), m.u(-50, 50))
