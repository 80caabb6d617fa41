"""Shoes, bags, hats, tools, devices, vehicles, toys."""

from __future__ import annotations

import math

import numpy as np
from manifold3d import CrossSection, Manifold

from .composition import handle, letter, outline, shape, wheel
from .household import laid
from .looks import Look, Maker, material, plain_material
from .solids import (
    Blend, ball, bend, both, box, extent, joined, lathe, loft, plate, ring, ring_of, ripple, rod,
    rounded, slab, spline, superquadric, taper, tube,
)
from .textures import package, screen


def _sole(width: float, long: float, count: int = 40) -> np.ndarray:
    """The outline ``[count, 2]`` of a foot, along y, its toe up."""
    t = np.arange(count) * (2 * math.pi / count)
    y = -np.cos(t) * long / 2
    share = y / long + 0.5
    half = np.interp(share, [0, 0.15, 0.4, 0.7, 0.9, 1], [0.6, 0.8, 0.72, 1.0, 0.85, 0.5]) * width / 2
    x = np.sin(t) * half + 0.06 * width * (share - 0.3)
    return np.stack([x, y], -1)


def shoe(m: Maker) -> list[Manifold]:
    """A trainer, a boot, a slipper, a clog or a shoe with a heel; one or a pair."""
    upper, lower, trim = m.pick(m.surface(), m.cloth("any"), m.pattern(("plain", "clouded"), "leather", "dark")), m.surface("white", "dark", "earth", "any"), m.surface("any")
    long, wide = 1.0, m.u(0.3, 0.4)
    collar = m.pick(m.u(0.25, 0.36), m.u(0.3, 0.42), m.u(0.5, 0.95))
    heel = m.pick(0.0, 0.0, 0.0, m.u(0.03, 0.1), m.u(0.1, 0.35))
    thick = m.u(0.03, 0.11)
    count, sides = 30, 28
    t = np.linspace(0, 1, count)  # from the heel to the toe
    toe = m.u(0.11, 0.2)
    instep = np.interp(t, [0, 0.08, 0.35, 0.55, 0.8, 0.93, 1], [0.75 * collar, collar, collar * 0.98, 0.55 * collar + 0.5 * toe, toe * 1.1, toe * 0.85, toe * 0.3])
    point = m.u(0.25, 0.75)
    half = np.interp(t, [0, 0.04, 0.15, 0.4, 0.7, 0.9, 0.97, 1], [0.35, 0.6, 0.8, 0.72, 1.0, 0.85 - 0.3 * (point < 0.4), point, 0.5 * point]) * wide / 2
    shift = 0.05 * wide * (t - 0.3)
    smooth = lambda v: np.convolve(np.pad(v, 2, mode="edge"), [0.1, 0.2, 0.4, 0.2, 0.1], "valid")  # noqa: E731
    instep, half = smooth(instep), smooth(half)
    angle = np.arange(sides) * (2 * math.pi / sides)
    narrow = m.u(0.5, 0.85)  # how much of its width is left at the top of a high place
    rings = np.empty((count, sides, 3))
    for i in range(count):
        s, c = np.sin(angle), np.cos(angle)
        k = 3.0
        r = (np.abs(s) ** k + np.abs(c) ** k) ** (-1 / k)
        up = (r * s + 1) / 2
        tight = 1 - (1 - narrow) * np.clip(up - 0.25, 0, 1) * np.clip(instep[i] / max(collar, 0.01), 0, 1) * 1.3
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
    hole = m.stamp(loft(inner[keep][1:]), m.surface("dark", "white", "any"))
    body = body - hole
    if heel > 0.12:  # the foot stands on its toes
        lift = lambda p: np.stack([p[:, 0], p[:, 1] + heel * np.clip((0.2 - p[:, 2]) / 0.6, 0, 1) ** 1.3, p[:, 2]], -1)  # noqa: E731
        body = body.refine_to_length(0.12).warp_batch(lift)
    spread = m.u(1.02, 1.1)
    base = slab(_sole(wide * spread, long * 1.02), thick, 0.25 * thick, 2).rotate([90, 0, 0]).mirror([0, 0, 1])
    base = base.translate([0, 0.015 - thick / 2, 0])
    parts = [body]
    if heel > 0.12:
        base = base.refine_to_length(0.1).warp_batch(lift)
        post = lathe([(0, 0), (m.u(0.03, 0.1), 0), (0.11, heel + 0.02), (0, heel + 0.02)], 16).translate([0, -thick, -0.38])
        parts.append(m.stamp(post, lower))
    elif heel > 0:
        block = slab(_sole(wide, long)[:], heel, 0).rotate([90, 0, 0]).mirror([0, 0, 1]).trim_by_plane([0, 0, -1], m.u(0.15, 0.25))
        parts.append(m.stamp(block.translate([0, -thick - heel / 2 + 0.02, 0]), lower))
    elif m.chance(0.4):  # a profile below
        teeth = joined([box(wide * 1.4, 0.03, 0.03).translate([0, -thick, z]) for z in np.linspace(-0.45, 0.45, m.n(7, 13))])
        base = base - teeth
    parts.append(m.stamp(base, lower))
    if m.chance(0.65):  # laces, or a strap
        rows = m.n(1, 6)
        for z in np.linspace(0.02, 0.24, rows):
            y = float(np.interp(z + 0.5, t, instep))
            w = float(np.interp(z + 0.5, t, half)) * 0.75
            lace = tube([(-w, y - 0.03, z), (0, y + 0.012, z - 0.01), (w, y - 0.03, z)], 0.013 if rows > 1 else 0.03, 8, 12, flat=(1, 1.5))
            parts.append(m.stamp(lace, trim))
    if m.chance(0.45):  # a mark on the sides, a cap on the toe
        mark = slab(outline(m) * [0.25, 0.12], 0.5).rotate([0, 90, 0]).translate([0.25, collar * 0.45, 0.0])
        shell = loft(rings * [1.03, 1.0, 1.0]) ^ joined([mark, mark.mirror([1, 0, 0])])
        parts.append(m.stamp(shell, trim) - hole)
    if m.chance(0.35):
        cap = loft(rings * [1.04, 1.04, 1.01]).trim_by_plane([0, 0, 1], m.u(0.25, 0.36))
        parts.append(m.stamp(cap, m.pick(lower, trim)))
    if collar > 0.5 and m.chance(0.5):  # fur or a roll at the top of a boot
        roll = tube([(math.sin(a) * wide * 0.33, collar * 0.98, math.cos(a) * 0.22 - 0.27) for a in np.linspace(0, 2 * math.pi, 9)[:-1]], m.u(0.03, 0.06), 10, 28, True)
        parts.append(m.stamp(roll, m.fur()))
    whole = joined(parts)
    if m.chance(0.12):
        return [joined([whole.translate([-wide * 0.62, 0, 0]), whole.mirror([1, 0, 0]).translate([wide * 0.62, 0, m.u(-0.1, 0.1)])]).rotate([0, m.u(-40, 40), 0])]
    return [whole.rotate([0, m.pick(90, -90, m.u(-90, 90), m.u(-180, 180)), 0])]


def bag(m: Maker) -> list[Manifold]:
    """A backpack, handbag, purse, tote or case with straps and pockets."""
    w, h, d = m.u(0.4, 0.9), m.u(0.4, 1.0), m.u(0.15, 0.4)
    cloth, trim = m.pick(m.cloth("any"), m.pattern(("plain", "clouded"), "leather"), m.surface()), m.surface("dark", "leather", "any")
    body = superquadric([w / 2, h / 2, d / 2], m.u(0.2, 0.6), m.u(0.25, 0.7), 36)
    body = taper(body, m.u(0.65, 1.1))
    body = ripple(body, m.rng, m.u(0.0, 0.012), 0.5, True)
    parts = [m.stamp(body, cloth)]
    kind = m.n(0, 2)
    if kind == 0:  # a backpack
        for _ in range(m.n(1, 2)):
            ph, pw = h * m.u(0.25, 0.5), w * m.u(0.5, 0.85)
            pocket = superquadric([pw / 2, ph / 2, d * 0.3], 0.4, 0.5)
            parts.append(m.stamp(pocket.translate([0, -h / 2 + ph / 2 + m.u(0.02, 0.12) * h, d / 2 - 0.02]), m.pick(cloth, trim)))
        strap = tube([(w * 0.2, h * 0.45, -d * 0.35), (w * 0.25, h * 0.3, -d * 0.5 - 0.15), (w * 0.3, -h * 0.1, -d * 0.5 - 0.15), (w * 0.35, -h * 0.4, -d * 0.35)], 0.025, 10, 24, flat=(1, 2))
        parts.append(both(m.stamp(strap, trim)))
        parts.append(m.stamp(handle(m, 0.12, w * 0.3, 0.018).rotate([0, 0, 90]).translate([0, h * 0.47, -d * 0.2]), trim))
        side = box(0.05, h * 0.3, d * 0.5, 0.02).translate([w * 0.47, -h * 0.25, 0])
        parts.append(both(m.stamp(side, trim)))
    elif kind == 1:  # a handbag with one or two bows
        tall = m.u(0.2, 0.6)
        for z in (0.25 * d, -0.25 * d) if m.chance(0.6) else (0.0,):
            bow = tube([(-w * 0.25, h * 0.42, z), (-w * 0.22, h * 0.5 + tall * 0.7, z), (0, h * 0.5 + tall, z), (w * 0.22, h * 0.5 + tall * 0.7, z), (w * 0.25, h * 0.42, z)], m.u(0.012, 0.03), 10, 32)
            parts.append(m.stamp(bow, trim))
        flap = superquadric([w * 0.48, h * m.u(0.2, 0.35), d * 0.5], 0.4, 0.5).translate([0, h * 0.25, 0.04])
        if m.chance(0.6):
            parts.append(m.stamp(flap, m.pick(trim, cloth)))
            parts.append(m.stamp(ball(0.03, 14).translate([0, h * 0.1, d * 0.52]), m.metal()))
    else:  # a tote: open at its top
        inner = m.stamp(body.scale([0.93, 0.95, 0.88]).translate([0, 0.2, 0]), m.plain("dark", "white"))
        cutter = m.stamp(box(5, h, 5).translate([0, h * 0.88, 0]), trim)
        parts = [parts[0] - inner - cutter]
        if m.chance(0.6):
            front = m.printed("front", m.color("white", "any"), sides=True)
            parts = [m.stamp(body, front) - inner - cutter]
        for z in (0.4 * d, -0.4 * d):
            bow = tube([(-w * 0.2, h * 0.2, z), (-w * 0.2, h * 0.6, z * 0.8), (0, h * 0.75, z * 0.6), (w * 0.2, h * 0.6, z * 0.8), (w * 0.2, h * 0.2, z)], 0.02, 10, 32, flat=(1, 1.6))
            parts.append(m.stamp(bow, trim))
    return [joined(parts).rotate([0, m.pick(0, m.u(-50, 50), m.u(-180, 180)), 0])]


def hat(m: Maker) -> list[Manifold]:
    """A cap, a hat, a helmet or a woollen cap."""
    r, h = m.u(0.35, 0.45), m.u(0.25, 0.55)
    cloth, trim = m.pick(m.cloth("any"), m.surface()), m.surface()
    dome = superquadric([r, h, r * m.u(1, 1.2)], m.u(0.5, 1), m.u(0.8, 1)).trim_by_plane([0, 1, 0], 0)
    hollow = m.stamp(superquadric([r * 0.93, h * 0.93, r * 0.95], 0.8, 0.9), m.plain("dark", "any"))
    parts = [m.stamp(dome, cloth) - hollow]
    kind = m.n(0, 3)
    if kind == 0:  # a peak
        peak = slab(ring_of(2.5, 36) * [r * 0.85, r * m.u(0.8, 1.1)], 0.03, 0.01, 2).rotate([90 + m.u(0, 15), 0, 0]).translate([0, 0.01, r * 0.75])
        cutter = superquadric([r * 0.93, h * 0.93, r * 0.95], 0.8, 0.9)
        parts.append(m.stamp(peak - cutter, m.pick(cloth, trim)))
        parts.append(m.stamp(ball(0.03, 12).translate([0, h, 0]), trim))
    elif kind == 1:  # a brim
        reach = r * m.u(1.3, 1.9)
        up = m.u(-0.05, 0.12)
        brim = lathe([(0, -0.01), (r, -0.01), (reach, up), (reach, up + 0.025), (r * 0.95, 0.03), (0, 0.03)], 40) - rod(r * 0.9, 1).translate([0, -0.5, 0])
        parts.append(m.stamp(brim, cloth))
        parts.append(m.stamp((superquadric([r * 1.03, h, r * 1.03], 0.7, 0.9) ^ box(5, 0.08, 5).translate([0, 0.06, 0])) - rod(r * 0.85, 1).translate([0, -0.5, 0]), trim))
    elif kind == 2:  # a roll and a bobble
        parts.append(m.stamp(ring(r * 0.97, 0.06, 40, 12, 1.6).translate([0, 0.05, 0]), trim))
        parts.append(m.stamp(ripple(ball(m.u(0.08, 0.15), 28), m.rng, 0.01, 0.06, False).translate([0, h + 0.05, 0]), m.fur()))
    else:  # a helmet with ridges
        for x in np.linspace(0, r * 0.7, m.n(1, 4)):
            ridge = tube([(x, 0.1, r * 0.95), (x * 0.9, h * 0.95, r * 0.4), (x * 0.9, h * 1.0, -r * 0.3), (x, 0.1, -r * 0.95)], 0.035, 10, 24)
            parts.append(both(m.stamp(ridge, trim)))
    return [joined(parts).rotate([m.u(-15, 10), m.u(-60, 60), 0])]


def tool(m: Maker) -> list[Manifold]:
    """Something with a handle: hammer, screwdriver, brush, spoon, spanner, axe, torch, saw."""
    grip, head = m.pick(m.wood(), m.surface("toy", "dark")), m.pick(m.metal(), m.surface())
    long, r = m.u(0.6, 1.0), m.u(0.035, 0.09)
    swell = m.rng.uniform(0.7, 1.25, 5) * r
    shaft = tube(np.stack([np.zeros(5), np.linspace(-long / 2, long / 2, 5), np.cumsum(m.rng.normal(0, 0.01, 5))], 1), swell, m.pick(16, 16, ring_of(4, 16), 6), 26, flat=(1, m.u(0.6, 1)))
    parts = [m.stamp(shaft, grip)]
    if m.chance(0.4):
        for y in np.linspace(-long * 0.4, -long * 0.1, m.n(2, 6)):
            parts.append(m.stamp(ring(r * 1.05, 0.012, 24, 8).translate([0, float(y), 0]), head))
    top = long / 2
    kind = m.n(0, 9)
    if kind == 0:  # hammer
        w = m.u(0.12, 0.22)
        poll = rod(m.u(0.06, 0.12), w, 20, 0.02).rotate([0, 0, 90])
        claw = tube([(0, 0, 0), (w, 0.02, 0), (w * 1.8, -m.u(0, 0.15), 0)], [0.07, 0.06, 0.015], 12, 16, flat=(1, 1.2))
        parts.append(m.stamp(joined([poll, box(0.14, 0.12, 0.12, 0.02), claw]).translate([0, top, 0]), head))
    elif kind == 1:  # screwdriver
        blade = lathe([(0, 0), (0.025, 0), (0.025, m.u(0.3, 0.7)), (0.0, 0.75)], 12)
        parts.append(m.stamp(blade.translate([0, top - 0.02, 0]), head))
    elif kind == 2:  # spanner
        jaw = slab(ring_of(2.5, 28) * m.u(0.1, 0.16), 0.06, 0.01, 2) - box(m.u(0.06, 0.1), 0.2, 0.5).translate([0, 0.1, 0]).rotate([0, 0, m.u(-20, 20)])
        parts = [m.stamp(box(2 * r, long, 0.05, 0.015), head), m.stamp(jaw.translate([0, top, 0]), head)]
        if m.chance(0.6):
            parts.append(m.stamp((slab(ring_of(2, 28) * 0.1, 0.06, 0.01, 2) - rod(0.06, 0.3, 6).rotate([90, 0, 0]).translate([0, 0, -0.15])).translate([0, -top, 0]), head))
    elif kind == 3:  # spoon or ladle
        size = m.u(0.1, 0.22)
        scoop = ball([size, size * 1.3, size * m.u(0.3, 0.9)]) - ball([size * 0.9, size * 1.2, size * 0.8]).translate([0, 0, size * 0.35])
        parts.append(m.stamp(scoop.rotate([m.u(-10, 30), 0, 0]).translate([0, top + size, 0]), m.pick(grip, head)))
    elif kind == 4:  # spatula, oar, paddle
        w, h = m.u(0.12, 0.25), m.u(0.2, 0.4)
        blade = box(w * 2, h, m.u(0.015, 0.05), 0.01)
        if m.chance(0.4):
            blade = blade - joined([box(0.03, h * 0.6, 1).translate([x, 0, 0]) for x in np.linspace(-w * 0.6, w * 0.6, 4)])
        parts.append(m.stamp(blade.rotate([m.u(-15, 15), 0, 0]).translate([0, top + h * 0.45, 0]), m.pick(grip, head)))
    elif kind == 5:  # brush
        w = m.u(0.1, 0.3)
        parts.append(m.stamp(box(w, 0.1, 0.08, 0.02).translate([0, top, 0]), head))
        tuft = m.pattern(("furry", "brushed"), "earth", "dark", "white", repeats=4)
        parts.append(m.stamp(taper(box(w * 0.95, m.u(0.12, 0.3), 0.07, 0.01), m.u(0.7, 1.3)).translate([0, top + 0.13, 0]), tuft))
    elif kind == 6:  # axe, cleaver, knife
        form = np.array([(-0.02, -0.1), (0.2, -0.16), (m.u(0.25, 0.4), 0.0), (0.2, 0.18), (-0.02, 0.1)])
        blade = slab(form, m.u(0.02, 0.07), 0.01, 2)
        if m.chance(0.5):
            blade = slab(np.array([(-0.05, 0), (0.06, 0), (0.06, 0.5), (0.0, 0.7), (-0.05, 0.5)]), 0.02, 0.006, 2)
        parts.append(m.stamp(blade.translate([0, top - 0.03, 0]), head))
    elif kind == 7:  # torch
        cone = lathe([(0, 0), (r, 0), (r * 1.9, 0.12), (r * 1.9, 0.25), (r * 1.7, 0.25), (r * 1.5, 0.2), (0, 0.2)])
        parts.append(m.stamp(cone.translate([0, top - 0.02, 0]), m.pick(grip, head)))
        parts.append(m.stamp(rod(r * 1.5, 0.02).translate([0, top + 0.18, 0]), m.plain("white", "pastel")))
    elif kind == 8:  # pliers, scissors
        parts = []
        a = m.u(8, 25)
        arm = tube([(0.14, -0.6, 0), (0.16, -0.35, 0), (0.0, 0.0, 0), (-0.06, 0.3, 0)], [0.04, 0.04, 0.04, 0.015], 10, 22, flat=(1, 1))
        bow = ring(m.u(0.08, 0.13), 0.028, 28, 10).rotate([90, 0, 0]).scale([1, 1.4, 1]).translate([0.16, -0.62, 0])
        loop = m.chance(0.5)
        for side, z in ((1, 0.02), (-1, -0.02)):
            one = [m.stamp(arm.trim_by_plane([0, 1, 0], -0.1), head), m.stamp(arm.trim_by_plane([0, -1, 0], 0.09), grip)]
            one += [m.stamp(bow, grip)] if loop else []
            whole = joined(one).rotate([0, 0, a])
            parts.append((whole if side > 0 else whole.mirror([1, 0, 0])).translate([0, 0, z]))
        parts.append(m.stamp(rod(0.05, 0.12, 20).rotate([90, 0, 0]).translate([0, 0, -0.06]), head))
    else:  # a rake, a fork
        count, w = m.n(3, 6), m.u(0.15, 0.35)
        parts.append(m.stamp(box(w, 0.05, 0.04, 0.01).translate([0, top, 0]), head))
        for x in np.linspace(-w / 2 + 0.02, w / 2 - 0.02, count):
            parts.append(m.stamp(tube([(x, top, 0), (x, top + 0.15, 0.02), (x, top + m.u(0.22, 0.3), 0.06)], [0.02, 0.018, 0.008], 8, 10), head))
    pose = m.n(0, 3)
    whole = joined(parts)
    if pose == 0:
        return [whole]
    if pose == 1:
        return [whole.rotate([0, 0, m.u(-75, 75)])]
    if pose == 2:
        return [whole.rotate([0, 0, m.u(60, 120)]).rotate([0, m.u(-50, 50), 0])]
    return [whole.rotate([-90 + m.u(0, 15), 0, 0]).rotate([0, m.u(-120, 120), 0])]


def device(m: Maker) -> list[Manifold]:
    """A telephone, mouse, camera, loudspeaker, console, remote, clock, toaster, hair dryer."""
    case, dark, accent = m.surface("dark", "white", "metal", "any"), m.plain("dark"), m.plain("toy", "metal", "white")
    kind = m.n(0, 10)
    parts: list[Manifold] = []
    if kind == 0:  # a telephone, tablet or frame
        w, h, t = m.u(0.4, 0.9), m.u(0.6, 1.1), m.u(0.03, 0.1)
        edge = m.u(0.02, 0.08)
        parts = [m.stamp(box(w, h, t, m.u(0.1, 0.45) * t), case)]
        pane = box(w - 2 * edge, h - 2 * edge - m.u(0, 0.1), 0.02).translate([0, 0, t / 2])
        picture = m.add(Look([plain_material(np.zeros(3))] * 4 + [material(screen(m.rng))] * 2, "fit"))
        parts.append(m.stamp(pane, picture))
        if m.chance(0.4):
            parts.append(m.stamp(rod(0.05, 0.03, 20).rotate([90, 0, 0]).translate([0, -h / 2 + edge / 2 + 0.03, t / 2 - 0.01]), accent))
        whole = joined(parts).rotate([m.pick(0, -m.u(10, 35), -80), 0, 0])
        if m.chance(0.4):
            whole = joined([whole, m.stamp(box(w * 0.5, 0.05, 0.4, 0.02).translate([0, -h / 2, -0.1]), case)])
        return [whole.rotate([0, m.u(-50, 50), 0])]
    if kind == 1:  # a mouse
        body = superquadric([m.u(0.28, 0.38), m.u(0.16, 0.28), 0.55], m.u(0.7, 1), m.u(0.6, 0.95), 40).trim_by_plane([0, 1, 0], -0.04)
        body = body.warp_batch(lambda p: np.stack([p[:, 0] * (1 + 0.15 * p[:, 2]), p[:, 1] * (1 - 0.35 * p[:, 2]), p[:, 2]], -1))
        seam = m.stamp(box(0.015, 1, 0.6).translate([0, 0, 0.4]), dark)
        parts = [m.stamp(body, case) - seam, m.stamp(rod(0.07, 0.06, 20).rotate([0, 0, 90]).translate([0.03, 0.14, 0.27]), accent)]
        if m.chance(0.6):
            line = [(0, 0, 0.5), (m.u(-0.1, 0.1), 0, 0.8), (m.u(-0.4, 0.4), 0, 1.0), (m.u(-0.6, 0.6), 0, 0.7)]
            parts.append(m.stamp(tube(line, 0.018, 8, 40), dark))
        return [joined(parts).rotate([0, m.u(90, 270) if m.chance(0.5) else m.u(-90, 90), 0])]
    if kind == 2:  # a camera
        w, h, t = m.u(0.6, 0.9), m.u(0.4, 0.6), m.u(0.2, 0.35)
        parts = [m.stamp(box(w, h, t, 0.05), case)]
        r, long = m.u(0.14, 0.22), m.u(0.1, 0.5)
        lens = lathe([(0, 0), (r, 0), (r, long * 0.6), (r * 1.08, long * 0.65), (r * 1.08, long), (r * 0.9, long), (r * 0.75, long * 0.85), (0, long * 0.85)], 36)
        parts.append(m.stamp(lens.rotate([90, 0, 0]).translate([m.u(-0.1, 0.1), -0.02, t / 2 - 0.01]), dark))
        parts.append(m.stamp(ball([r * 0.7, r * 0.7, 0.05]).translate([0, -0.02, t / 2 + long * 0.83]), accent))
        parts.append(m.stamp(box(w * 0.3, 0.12, t * 0.9, 0.04).translate([0, h / 2 + 0.03, 0]), case))
        for x in (-0.3, 0.3):
            parts.append(m.stamp(rod(m.u(0.04, 0.07), 0.06, 20, 0.01).translate([x * w, h / 2 - 0.01, 0]), m.pick(accent, dark)))
        if m.chance(0.3):
            parts.append(m.stamp(tube([(-w / 2, h * 0.3, 0), (-w * 0.6, h, -0.1), (0, h * 1.4, -0.2), (w * 0.6, h, -0.1), (w / 2, h * 0.3, 0)], 0.02, 8, 32, flat=(1, 2)), dark))
    elif kind == 3:  # a loudspeaker or radio
        w, h, t = m.u(0.4, 1.2), m.u(0.4, 1.1), m.u(0.25, 0.5)
        parts = [m.stamp(box(w, h, t, m.u(0.01, 0.12)), m.pick(case, m.wood()))]
        rows = [(0.0, -0.2 * h, 0.38 * min(w, h)), (0.0, 0.28 * h, 0.18 * min(w, h))] if h > w else [(-0.27 * w, 0, 0.2 * min(w, h) + 0.06), (0.27 * w, 0, 0.2 * min(w, h) + 0.06)]
        for x, y, r in rows:
            cone = lathe([(0, 0), (r, 0), (r, 0.05), (r * 0.85, 0.05), (r * 0.4, 0.015), (r * 0.3, 0.035), (0, 0.045)], 32)
            parts.append(m.stamp(cone.rotate([90, 0, 0]).translate([x, y, t / 2 - 0.01]), m.pick(dark, accent)))
        if m.chance(0.4):
            parts.append(m.stamp(tube([(w * 0.4, h / 2, 0), (w * 0.45, h / 2 + 0.4, 0), (w * 0.6, h / 2 + 0.9, -0.1)], 0.015, 8, 14), accent))
    elif kind == 4:  # a remote, a handset
        w, h, t = m.u(0.2, 0.4), m.u(0.7, 1.1), m.u(0.07, 0.15)
        parts = [m.stamp(bend(box(w, h, t, 0.4 * t).refine_to_length(0.1), m.u(-0.3, 0.3)), case)]
        columns, rows = m.n(2, 3), m.n(4, 8)
        for i, j in np.ndindex(columns, rows):
            x, y = (i - (columns - 1) / 2) * w * 0.7 / columns, (j / rows - 0.45) * h * 0.7
            key = ball([w * 0.09, w * 0.09, 0.04], 12) if rows % 2 else box(w * 0.2, w * 0.12, 0.05)
            parts.append(m.stamp(key.translate([x, y, t / 2]), accent if j == rows - 1 else dark))
        whole = joined(parts)
        return [whole.rotate([m.pick(0, -60, -85), 0, 0]).rotate([0, m.u(-60, 60), 0])]
    elif kind == 5:  # a keyboard or a piano
        w, d, t = m.u(0.8, 1.4), m.u(0.3, 0.5), m.u(0.05, 0.12)
        parts = [m.stamp(box(w, t, d, 0.3 * t), case)]
        rows, columns = m.pick(1, 3, 4), m.n(8, 14)
        keys = [box(w * 0.85 / columns, 0.06, d * 0.8 / rows * 0.85).translate([(i - (columns - 1) / 2) * w * 0.93 / columns, t / 2, (j - (rows - 1) / 2) * d * 0.85 / rows]) for i, j in np.ndindex(columns, rows)]
        parts.append(m.stamp(Manifold.compose(keys), m.pick(dark, accent, m.plain("white"))))
        return [joined(parts).rotate([m.u(0, 25), m.u(-40, 40), 0])]
    elif kind == 6:  # a game controller
        blend = Blend(0.12)
        blend.limb([(0, 0, 0), (0.3, 0.02, 0)], [0.16, 0.17], 0)
        blend.limb([(0.3, 0.02, 0), (0.45, -0.1, m.u(0.2, 0.45))], [0.16, 0.11], 0)
        body = m.blended(blend, (case,)).scale([1, 0.7, 1])
        parts = [body]
        stick = joined([rod(0.03, 0.16, 12), ball([0.07, 0.03, 0.07], 20).translate([0, 0.17, 0])])
        parts.append(both(m.stamp(stick.translate([0.16, 0.05, 0.05]), dark)))
        for a in range(4):
            parts.append(m.stamp(ball([0.03, 0.03, 0.03], 12).translate([0.34 + 0.06 * math.sin(a * 1.57), 0.12, -0.02 + 0.06 * math.cos(a * 1.57)]), m.plain("toy")))
        parts.append(m.stamp(box(0.15, 0.03, 0.05).translate([-0.34, 0.12, 0]) + box(0.05, 0.03, 0.15).translate([-0.34, 0.12, 0]), dark))
        return [joined(parts).rotate([m.u(20, 80), m.u(-30, 30), 0])]
    elif kind == 7:  # a toaster, iron or coffee machine
        w, h, t = m.u(0.5, 0.9), m.u(0.4, 1.0), m.u(0.35, 0.6)
        body = superquadric([w / 2, h / 2, t / 2], m.u(0.15, 0.5), m.u(0.15, 0.5), 40)
        if h > 0.7:  # a niche for the jug
            niche = m.stamp(box(w * 0.7, h * 0.5, t).translate([0, -h * 0.05, t * 0.3]), dark)
            parts = [m.stamp(body, m.pick(case, m.metal())) - niche, m.stamp(_jug(m, 0.2 * w, 0.4 * h).translate([0, -h * 0.29, t * 0.25]), m.plain("dark", "metal", "pastel"))]
        else:
            slots = joined([box(w * 0.7, 0.3, 0.06).translate([0, h / 2, z]) for z in (-0.1, 0.1)])
            parts = [m.stamp(body, m.pick(case, m.metal())) - m.stamp(slots, dark)]
        parts.append(m.stamp(box(0.08, 0.04, 0.06, 0.01).translate([w / 2, 0.1, 0]), dark))
        for x in np.linspace(-0.2, 0.2, m.n(1, 4)):
            parts.append(m.stamp(rod(0.04, 0.05, 18, 0.01).rotate([90, 0, 0]).translate([x * w, -h * 0.38, t / 2 - 0.02]), accent))
    elif kind == 8:  # a hair dryer, drill, water pistol
        long, r = m.u(0.5, 0.9), m.u(0.12, 0.2)
        barrel = tube([(0, 0, -long / 2), (0, 0.01, 0), (0, 0, long / 2)], [r, r * m.u(0.9, 1.2), r * m.u(0.4, 0.9)], 20, 24)
        grip = tube([(0, 0, -0.05), (0, -0.3, -0.08), (0, -m.u(0.45, 0.65), -m.u(0.05, 0.2))], [0.08, 0.075, 0.09], 14, 18, flat=(1, 1.2))
        parts = [m.stamp(barrel, case), m.stamp(grip, m.pick(case, dark))]
        parts.append(m.stamp(box(0.05, 0.1, 0.06, 0.015).translate([0, -0.17, 0.04]), accent))
        nozzle = rod(r * m.u(0.2, 0.7), m.u(0.05, 0.35), 20).rotate([90, 0, 0]).translate([0, 0, long / 2])
        parts.append(m.stamp(nozzle, m.pick(dark, accent)))
        if m.chance(0.5):
            parts.append(m.stamp(box(0.22, 0.14, 0.25, 0.03).translate([0, -0.6, -0.1]), dark))
        return [joined(parts).rotate([0, m.pick(90, -90, m.u(-180, 180)), 0])]
    elif kind == 9:  # a clock, or a scale
        r, t = m.u(0.4, 0.55), m.u(0.08, 0.25)
        face = m.add(Look([plain_material(m.color("white", "any"))] * 4 + [material(screen(m.rng) if m.chance(0.3) else package(m.rng, m.color("white"), m.inks(), "label"))] * 2, "fit"))
        form = ring_of(m.pick(2, 2, 5), 48)
        parts = [m.stamp(slab(form * r, t, 0.03) - slab(form * r * 0.88, t).translate([0, 0, t * 0.8]), case)]
        parts.append(m.stamp(slab(form * r * 0.87, 0.02).translate([0, 0, t * 0.3]), face))
        for a, long in ((m.u(0, 360), 0.6), (m.u(0, 360), 0.4)):
            parts.append(m.stamp(box(0.02, long * r, 0.02).translate([0, long * r / 2, t * 0.33]).rotate([0, 0, a]), dark))
        if m.chance(0.4):
            parts.append(both(m.stamp(ball([0.12, 0.1, 0.08]).translate([0.25, r + 0.02, 0]), accent)))
            parts.append(both(m.stamp(rod(0.03, 0.2, 12).rotate([0, 0, 20]).translate([0.25, -r - 0.1, 0]), accent)))
        return [joined(parts).rotate([m.pick(0, -20, -85), m.u(-30, 30), 0])]
    else:  # a router, hub, plug: a slab with aerials and cables
        w, t, d = m.u(0.5, 0.9), m.u(0.08, 0.2), m.u(0.3, 0.6)
        parts = [m.stamp(slab(outline(m) * [w / 1.2, d / 1.2], t, 0.3 * t).rotate([90, 0, 0]) if m.chance(0.3) else box(w, t, d, 0.3 * t), case)]
        for x in np.linspace(-0.4, 0.4, m.n(1, 4)):
            parts.append(m.stamp(tube([(x * w, 0, -d * 0.4), (x * w, 0.3, -d * 0.45), (x * w * m.u(0.8, 1.4), m.u(0.4, 0.7), -d * 0.5)], [0.03, 0.025, 0.02], 10, 14), dark))
        if m.chance(0.5):
            parts.append(m.stamp(tube([(0, 0, -d * 0.45), (0.2, 0, -d), (m.u(-0.8, 0.8), 0, -d * 0.9), (m.u(-0.6, 0.9), 0, 0.2)], 0.02, 8, 44), dark))
        for x in np.linspace(-0.3, 0.3, m.n(2, 5)):
            parts.append(m.stamp(ball(0.02, 10).translate([x * w, t * 0.1, d / 2]), accent))
    return [joined(parts).rotate([0, m.pick(0, m.u(-45, 45)), 0])]


def _jug(m: Maker, r: float, h: float) -> Manifold:
    body = lathe([(0, 0), (r, 0), (r * 1.1, h * 0.4), (r * 0.8, h), (0, h)], 28)
    return body + handle(m, r * 0.9, h * 0.6, 0.03 * r / 0.2).translate([r * 0.9, h * 0.5, 0])


def vehicle(m: Maker) -> list[Manifold]:
    """A car, bus, lorry, tractor or digger."""
    paint, dark, glass, accent = m.surface("toy", "toy", "any", "pastel", "metal"), m.plain("dark"), m.painted(np.array([0.1, 0.14, 0.18]) * m.u(0.3, 4)), m.surface("toy", "metal", "white", "dark")
    kind = m.n(0, 4)
    long, w = m.u(0.9, 1.4), m.u(0.4, 0.55)
    r = m.u(0.09, 0.2)
    h = m.u(0.15, 0.3)
    floor = r * 0.9
    parts: list[Manifold] = []
    axles = [-long * m.u(0.28, 0.36), long * m.u(0.28, 0.36)]
    if kind <= 1:  # a car: the side's outline, drawn out and rounded
        ends, hood, boot, roof = floor + h * 0.15, floor + h * m.u(0.75, 1.1), floor + h * m.u(0.75, 1.3), floor + h + m.u(0.15, 0.35)
        z = np.array([-0.5, -0.49, -0.42, -0.3 + m.u(-0.1, 0.06), -0.22 + m.u(-0.15, 0.05), 0.1 + m.u(-0.05, 0.08), 0.25 + m.u(-0.05, 0.05), 0.44, 0.5, 0.5])
        y = np.array([ends, boot * 0.8, boot, boot * 1.02, roof, roof, hood * 1.05, hood * 0.95, hood * 0.75, ends])
        line = np.stack([z * long, y], 1)
        body = loft(np.stack([np.column_stack([np.full(10, x), np.where(line[:, 1] > hood, hood + (line[:, 1] - hood) * s, line[:, 1]), line[:, 0] * (0.97 + 0.03 * s)]) for x, s in ((-w / 2, 0.75), (-w * 0.42, 0.95), (-w * 0.2, 1.0), (w * 0.2, 1.0), (w * 0.42, 0.95), (w / 2, 0.75))]))
        # A loft in x: the cabin is narrower than what is below it.
        pinch = lambda p: np.stack([p[:, 0] * (1 - 0.5 * np.clip(p[:, 1] - hood, 0, 1)), p[:, 1], p[:, 2]], -1)  # noqa: E731
        body = body.warp_batch(pinch)
        arches = joined([rod(r * 1.15, 3, 24).translate([0, -1.5, 0]).rotate([0, 0, 90]).translate([0, r, a]) for a in axles]) - box(w * 0.6, 5, 5)
        shell = m.stamp(body, paint) - m.stamp(arches, dark)
        low, high = hood + 0.02, roof - 0.03
        panes = box(2, max(high - low, 0.02), long * 0.62).translate([0, (low + high) / 2, -0.04 * long])
        window = m.stamp(body.scale([1.012, 1, 1]) ^ panes, glass)
        shield = m.stamp(body.scale([0.9, 1, 1]).translate([0, 0.0, 0.0]).scale([1, 1.004, 1.01]) ^ box(2, max(high - low, 0.02), 9).translate([0, (low + high) / 2, 0]), glass)
        parts = [shell, window, shield]
        for x in (-0.33, 0.33):
            parts.append(m.stamp(ball([0.06, 0.04, 0.03], 14).translate([x * w, hood * 0.82, long * 0.49]), m.plain("white", "pastel")))
        parts.append(m.stamp(box(w * 0.96, 0.05, 0.06, 0.02).translate([0, floor + h * 0.25, long * 0.5]), accent))
        if m.chance(0.25):
            parts.append(m.stamp(box(w * 0.8, 0.03, 0.1).translate([0, boot + 0.1, -long * 0.45]) + both(box(0.03, 0.12, 0.05).translate([w * 0.3, boot + 0.04, -long * 0.45])), accent))
    elif kind == 2:  # bus or van
        tall = m.u(0.4, 0.6)
        body = box(w, tall, long, 0.06).translate([0, floor + tall / 2, 0])
        parts = [m.stamp(body, paint)]
        count = m.n(2, 6)
        for z in np.linspace(-long * 0.4, long * 0.4, count):
            parts.append(m.stamp(box(w * 1.015, tall * 0.3, long * 0.65 / count, 0).translate([0, floor + tall * 0.65, float(z)]), glass))
        parts.append(m.stamp(box(w * 0.85, tall * 0.35, 0.05).translate([0, floor + tall * 0.62, long / 2 - 0.015]), glass))
        parts.append(m.stamp(box(w * 1.01, 0.04, long * 1.005).translate([0, floor + tall * 0.35, 0]), accent))
    else:  # a lorry: chassis, cabin, load
        cab = m.u(0.3, 0.42)
        parts = [m.stamp(box(w * 0.8, 0.08, long, 0.02).translate([0, floor + 0.05, 0]), dark)]
        parts.append(m.stamp(box(w, cab, long * 0.27, m.u(0.02, 0.08)).translate([0, floor + cab / 2 + 0.05, long * 0.36]), paint))
        parts.append(m.stamp(box(w * 1.02, cab * 0.35, long * 0.16).translate([0, floor + cab * 0.75, long * 0.37]), glass))
        parts.append(m.stamp(box(w * 0.8, cab * 0.35, 0.05).translate([0, floor + cab * 0.75, long * 0.49]), glass))
        load = m.n(0, 4)
        z, deep = -long * 0.15, long * 0.66
        if load == 0:
            parts.append(m.stamp(box(w, m.u(0.3, 0.6), deep, 0.02).translate([0, floor + 0.35, z]), m.pick(accent, m.printed("front", m.color("white", "any")))))
        elif load == 1:
            tub = box(w, 0.3, deep, 0.0) - box(w * 0.9, 0.3, deep * 0.93).translate([0, 0.04, 0])
            parts.append(m.stamp(tub.rotate([m.pick(0, 0, 20), 0, 0]).translate([0, floor + 0.27, z]), accent))
            if m.chance(0.5):
                heap = ripple(ball([w * 0.42, 0.2, deep * 0.42], 32), m.rng, 0.02, 0.15, False)
                parts.append(m.stamp(heap.translate([0, floor + 0.3, z]), m.pattern("speckled", "earth")))
        elif load == 2:
            tank = tube([(0, 0, -deep / 2 + 0.1), (0, 0, 0), (0, 0, deep / 2 - 0.1)], m.u(0.18, 0.24), 24, 12)
            parts.append(m.stamp(tank.translate([0, floor + 0.3, z]), m.pick(accent, m.metal())))
        elif load == 3:  # a ladder or crane
            arm = tube([(0, floor + 0.2, z - 0.1), (0, floor + 0.5, z), (0, floor + m.u(0.4, 0.9), long * m.u(0.2, 0.6))], [0.08, 0.06, 0.04], ring_of(6, 12), 20)
            parts += [m.stamp(arm, accent), m.stamp(rod(0.15, 0.15).translate([0, floor + 0.05, z]), paint)]
            parts.append(m.stamp((box(0.25, 0.18, 0.2, 0.02) - box(0.2, 0.2, 0.2).translate([0, 0.06, 0.06])).translate([0, floor + 0.4, long * 0.55]), accent))
        else:
            parts.append(m.stamp(Manifold.compose([rod(0.09, deep, 16).rotate([90, 0, 0]).translate([x, floor + 0.18, z - deep / 2]) for x in (-0.19, 0.0, 0.19)]), m.wood()))
        axles = [long * 0.36, -long * 0.2, *([-long * 0.38] if m.chance(0.6) else [])]
        if m.chance(0.15):
            r *= 1.3
    hub = m.surface("metal", "white", "toy")
    thick = m.u(0.08, 0.16)
    tire = wheel(r, thick)
    for a in axles:
        at = [w / 2 - thick * 0.3, r, float(a)]
        parts.append(both(m.stamp(tire.translate(at), dark)))
        parts.append(both(m.stamp(wheel(r * m.u(0.4, 0.65), thick * 1.15).translate(at), hub)))
    return [joined(parts).rotate([0, m.pick(0, 90, -90, m.u(-180, 180), m.u(20, 70), m.u(-70, -20)), 0])]


def plane(m: Maker) -> list[Manifold]:
    """An aeroplane, helicopter, rocket or boat."""
    paint, second, dark = m.surface("toy", "white", "metal", "any"), m.surface("toy", "any"), m.plain("dark")
    kind = m.n(0, 3)
    parts: list[Manifold] = []
    if kind <= 1:
        long, r = m.u(1.0, 1.4), m.u(0.09, 0.2)
        hull = tube([(0, m.u(0, 0.08), -long / 2), (0, 0, 0), (0, 0, long / 2)], [r * 0.3, r, r * m.u(0.6, 1)], 22, 28)
        parts = [m.stamp(hull, paint)]
        parts.append(m.stamp(ball([r * 0.7, r * 0.6, r * 1.3], 24).translate([0, r * 0.7, long * 0.22]), m.plain("dark", "pastel", "metal")))
        if kind == 0 or m.chance(0.4):
            sweep, chord, span = m.u(-0.05, 0.4), m.u(0.15, 0.35), m.u(0.5, 0.8)
            form = np.array([(0, -chord / 2), (span, -sweep - chord * 0.3), (span, -sweep + chord * 0.2), (0, chord / 2)])
            wing = slab(form, 0.05, 0.02, 2).rotate([90, 0, 0]).mirror([0, 0, 1])
            levels = (m.u(-0.6, 0.8) * r,) if m.chance(0.75) else (-0.7 * r, 1.8 * r)
            for y in levels:
                parts.append(both(m.stamp(wing.translate([0, y, 0.08]), m.pick(paint, second))))
            if len(levels) > 1:
                parts.append(both(m.stamp(rod(0.02, 2.6 * r, 10).translate([span * 0.6, -0.7 * r, 0.0]), dark)))
            if m.chance(0.5):
                parts.append(both(m.stamp(tube([(0, 0, -0.12), (0, 0, 0.15)], [0.05, 0.06], 16, 10).translate([span * 0.45, levels[0] - 0.05, 0.12]), m.metal())))
        else:
            parts.append(m.stamp(joined([box(1.3, 0.015, 0.08).rotate([0, 90 * i + 20, 0]) for i in range(2)] + [rod(0.04, 0.15, 12).translate([0, -0.12, 0])]).translate([0, r + 0.12, 0.1]), dark))
            parts.append(both(m.stamp(tube([(r, -r - 0.12, -0.3), (r, -r - 0.12, 0.3)], 0.025, 8, 8) + rod(0.02, 0.2, 8).translate([r, -r - 0.12, 0]), dark)))
        fin = slab(np.array([(-0.02, 0), (0.18, 0), (0.06, 0.3), (-0.06, 0.3)]), 0.03, 0.01, 2).rotate([0, -90, 0]).mirror([0, 0, 0])
        parts.append(m.stamp(fin.translate([0, r * 0.4, -long / 2 + 0.02]), second))
        flat = slab(np.array([(0, -0.1), (0.28, -0.14), (0.28, 0.0), (0, 0.1)]), 0.025, 0.008, 2).rotate([90, 0, 0]).mirror([0, 0, 1])
        parts.append(both(m.stamp(flat.translate([0, 0.05, -long / 2 + 0.08]), second)))
        if m.chance(0.4):
            parts.append(m.stamp(joined([box(0.5, 0.05, 0.015).rotate([0, 0, 60 * i]) for i in range(m.pick(2, 3))]).translate([0, 0, long / 2 + r * 0.8]), dark))
    elif kind == 2:  # a rocket that stands
        r = m.u(0.12, 0.25)
        hull = lathe([(0, 0), (r * 0.7, 0), (r, 0.3), (r, 0.7), (r * 0.7, 1.0), (r * 0.2, 1.2), (0, 1.25)], 32)
        parts = [m.stamp(hull, m.pick(paint, m.pattern("striped", "white", "toy", contrast=1, mapping="round")))]
        fin = slab(np.array([(0, 0.1), (0.25, -0.15), (0.25, 0.05), (0.0, 0.45)]), 0.04, 0.01, 2).translate([r * 0.8, 0, 0])
        parts += [m.stamp(fin, second).rotate([0, 360 * i / n, 0]) for n in (m.pick(3, 4),) for i in range(n)]
        parts.append(m.stamp(ball([0.1, 0.1, 0.05], 20).translate([0, 0.7, r * 0.95]), dark))
        return parts
    else:  # a boat
        long, w, h = m.u(0.9, 1.4), m.u(0.35, 0.5), m.u(0.2, 0.35)
        count, sides = 16, 24
        t = np.linspace(0, 1, count)
        half = w / 2 * np.clip(np.interp(t, [0, 0.3, 0.65, 1], [m.u(0.5, 0.9), 1, 0.9, 0.05]), 0.02, 1)
        form = ring_of(3, sides)
        rings = np.empty((count, sides, 3))
        rings[..., 0] = form[None, :, 0] * half[:, None] * (0.75 + 0.25 * form[None, :, 1])
        rings[..., 1] = form[None, :, 1] * h / 2 + 0.15 * t[:, None] ** 3
        rings[..., 2] = (t[:, None] - 0.5) * long
        hull = loft(rings)
        well = m.stamp(hull.scale([0.85, 1, 0.85]).translate([0, h * 0.6, 0]), m.wood())
        parts = [m.stamp(hull, paint) - well]
        if m.chance(0.5):
            parts.append(m.stamp(rod(0.025, 1.0, 10), m.wood()))
            sail = slab(np.array([(0.03, 0.25), (0.5, 0.25), (0.03, 0.95)]), 0.02).rotate([0, m.u(60, 120), 0])
            parts.append(m.stamp(sail, m.cloth("white", "toy")))
            if m.chance(0.5):
                parts.append(m.stamp(slab(np.array([(0.03, 0.25), (0.4, 0.25), (0.03, 0.8)]), 0.02).rotate([0, -m.u(60, 120), 0]), m.cloth("white", "toy")))
        else:
            parts.append(m.stamp(box(w * 0.55, 0.25, long * 0.3, 0.03).translate([0, h * 0.4, -0.05 * long]), second))
            parts.append(m.stamp(box(w * 0.4, 0.15, long * 0.15, 0.02).translate([0, h * 0.4 + 0.19, 0]), m.pick(paint, second)))
            for z in np.linspace(-0.2, 0.0, m.n(1, 3)):
                parts.append(m.stamp(rod(0.05, 0.3, 16).translate([0, h * 0.4, z * long]), m.surface("toy", "dark")))
    return [joined(parts).rotate([0, m.pick(0, 90, -90, m.u(-180, 180)), 0])]


def train_of(m: Maker) -> list[Manifold]:
    """A wooden or plastic train: an engine and waggons, or one of them."""
    looks = [m.surface("toy") for _ in range(3)]
    dark = m.surface("dark", "wood", "toy")
    parts: list[Manifold] = []
    count = m.n(1, 3)
    w, long, r = m.u(0.3, 0.4), m.u(0.5, 0.7), m.u(0.07, 0.11)
    for i in range(count):
        z = -i * (long + 0.1)
        main, second = m.pick(*looks), m.pick(*looks)
        car = [m.stamp(box(w, 0.08, long, 0.015).translate([0, r + 0.04, 0]), m.pick(dark, second))]
        if i == 0:
            car.append(m.stamp(tube([(0, 0, -long * 0.1), (0, 0, long * 0.38)], m.u(0.11, 0.15), 24, 8, round_ends=m.chance(0.5)).translate([0, r + 0.2, 0]), main))
            car.append(m.stamp(box(w * 0.95, m.u(0.3, 0.42), long * 0.3, 0.01).translate([0, r + 0.25, -long * 0.3]), second))
            car.append(m.stamp(box(w * 1.1, 0.04, long * 0.36, 0.015).translate([0, r + 0.46, -long * 0.3]), main))
            car.append(m.stamp(lathe([(0, 0), (0.04, 0), (m.u(0.03, 0.08), 0.15), (0, 0.15)], 20).translate([0, r + 0.3, long * 0.3]), dark))
            car.append(m.stamp(ball(0.06, 18).translate([0, r + 0.34, 0.05]), second))
        else:
            load = m.n(0, 3)
            if load == 0:
                car.append(m.stamp(box(w * 0.95, 0.22, long * 0.9, 0.02) - box(w * 0.8, 0.22, long * 0.8).translate([0, 0.05, 0]), main).translate([0, r + 0.18, 0]))
            elif load == 1:
                car.append(m.stamp(tube([(0, 0, -long * 0.3), (0, 0, long * 0.3)], 0.15, 24, 8), main).translate([0, r + 0.2, 0]))
            elif load == 2:
                car += [m.stamp(rod(0.05, long * 0.85, 14).rotate([90, 0, 0]).translate([x, r + 0.12, -long * 0.42]), second) for x in (-0.1, 0.0, 0.1)]
            else:
                for k in range(m.n(1, 3)):
                    car.append(m.stamp(box(0.2, 0.2, 0.2, 0.01).translate([0, r + 0.18, (k - 1) * 0.21]), m.pick(*looks)))
        for a in (-long * 0.3, long * 0.3):
            car.append(both(m.stamp(wheel(r, 0.05).translate([w / 2, r, a]), m.pick(dark, second) if i % 2 else dark)))
        car.append(m.stamp(box(0.05, 0.04, long + 0.15).translate([0, r + 0.04, 0]), dark))
        parts.append(joined(car).translate([0, 0, z]))
    return [joined(parts).rotate([0, m.pick(90, -90, m.u(-180, 180), m.u(30, 70)), 0])]


def blocks(m: Maker) -> list[Manifold]:
    """Building blocks, stacked rings, letters, a puzzle; loose on the ground or on one another."""
    kind = m.n(0, 4)
    looks = [m.pick(m.plain("toy"), m.plain("toy"), m.plain("pastel"), m.wood()) for _ in range(m.n(2, 5))]
    parts: list[Manifold] = []
    if kind == 0:  # stacked rings on a rod
        y, r, count = 0.06, m.u(0.35, 0.5), m.n(3, 7)
        parts = [m.stamp(lathe([(0, 0), (r, 0), (r * 0.9, 0.07), (0, 0.07)]), looks[0])]
        for i in range(count):
            t = m.u(0.06, 0.09)
            one = ring(r * 0.6, t * 1.4, 36, 14, 0.75) if r * 0.6 > t * 1.5 else ball([t * 1.5, t, t * 1.5])
            parts.append(m.stamp(one.translate([0, y + t, 0]), looks[i % len(looks)]))
            y += 1.9 * t
            r *= m.u(0.8, 0.95)
        parts.append(m.stamp(joined([rod(0.05, y, 16), ball(0.09).translate([0, y + 0.05, 0])]), looks[-1]))
    elif kind == 1:  # a tower or a castle
        y = 0.0
        for _ in range(m.n(2, 5)):
            h, count = m.u(0.12, 0.35), m.n(1, 3)
            for x in (np.arange(count) - (count - 1) / 2) * 0.42:
                solid = m.pick(box(m.u(0.25, 0.4), h, m.u(0.2, 0.4), 0.015), rod(m.u(0.1, 0.19), h, 28, 0.01).translate([0, -h / 2, 0]))
                parts.append(m.stamp(solid.translate([float(x), y + h / 2, 0]), m.pick(*looks)))
            if m.chance(0.3):
                parts.append(m.stamp(box(0.42 * count, 0.06, 0.4, 0.01).translate([0, y + h + 0.03, 0]), m.pick(*looks)))
                h += 0.06
            y += h
        if m.chance(0.6):
            top = m.pick(slab(np.array([(-0.25, 0), (0.25, 0), (0, 0.3)]), 0.3), lathe([(0, 0), (0.22, 0), (0.01, 0.35), (0, 0.36)]))
            parts.append(m.stamp(top.translate([0, y - 0.001, 0]), m.pick(*looks)))
    elif kind == 2:  # loose pieces on the ground
        for i in range(m.n(3, 9)):
            piece = m.pick(box, None, None)
            solid = box(m.u(0.15, 0.3), m.u(0.12, 0.3), m.u(0.15, 0.3), 0.015) if piece else shape(m).scale([m.u(0.12, 0.25)] * 3)
            low, _ = extent(solid)
            a, d = 2.4 * i, 0.22 * math.sqrt(i)
            solid = solid.translate([0, -float(low[1]), 0]).rotate([0, m.u(0, 360), 0])
            parts.append(m.stamp(solid, m.pick(*looks)).translate([d * 1.5 * math.sin(a), 0, d * 1.5 * math.cos(a)]))
    elif kind == 3:  # studded bricks
        for i in range(m.n(1, 6)):
            nx, nz, h = m.n(1, 4), m.n(1, 2), 0.12
            brick = box(nx * 0.16 - 0.004, h, nz * 0.16 - 0.004)
            studs = [rod(0.048, 0.04, 14).translate([(a - (nx - 1) / 2) * 0.16, h / 2 - 0.005, (b - (nz - 1) / 2) * 0.16]) for a, b in np.ndindex(nx, nz)]
            parts.append(m.stamp(joined([brick, *studs]), m.pick(*looks)).translate([m.n(-1, 1) * 0.16, i * h, m.n(0, 1) * 0.08]))
    else:  # letters or figures, standing or lying
        for i in range(m.n(1, 4)):
            parts.append(m.stamp(plate(letter(m), m.u(0.12, 0.4)), looks[i % len(looks)]).translate([i * 1.1, 0, 0]))
        if m.chance(0.4):
            parts.append(m.stamp(box(1.1 * len(parts) + 0.2, 0.12, 0.5, 0.02).translate([(len(parts) - 1) * 0.55, -0.6, 0]), m.wood()))
    return [joined(parts).rotate([0, m.u(-50, 50), 0])]


def game(m: Maker) -> list[Manifold]:
    """A ball, top, skittles, dumb-bell, xylophone, rattle, drum, house, robot."""
    a, b, c = m.surface("toy"), m.surface("toy", "white"), m.surface("any", "dark")
    kind = m.n(0, 7)
    if kind == 0:
        return [m.stamp(ball(0.5, 48), m.pattern(("striped", "checked", "spotted", "dotted", "flowered", "bricked"), "toy", contrast=1.0, mapping=m.pick("box", "round")))]
    if kind == 1:
        profile = np.maximum(spline([(0.03, 0), (0.1, 0.1), (m.u(0.3, 0.5), 0.35), (0.12, 0.55), (0.05, 0.8)], 24), [0.02, 0])
        return [m.stamp(lathe([(0, 0), *profile.tolist(), (0, 0.8)], 36), m.pattern(("striped", "grained", "shaded"), "toy", "wood", contrast=0.8, mapping="round")).rotate([m.u(0, 25), 0, 0])]
    if kind == 2:
        profile = np.maximum(spline([(0.1, 0), (0.19, 0.3), (0.07, 0.62), (0.11, 0.76), (0.04, 0.88)], 22), [0.02, 0])
        pin = m.stamp(lathe([(0, 0), *profile.tolist(), (0, 0.88)], 24), m.pattern("striped", "white", "toy", contrast=1, mapping="round", repeats=1))
        rows = m.n(1, 3)
        pins = [pin.translate([(j - i / 2) * 0.5, 0, -i * 0.4]) for i in range(rows) for j in range(i + 1)]
        return [joined([*pins, m.stamp(ball(0.18).translate([m.u(-0.4, 0.4), 0.18, 0.5]), a)])]
    if kind == 3:
        sides = m.pick(6, 8, 32)
        bar = rod(0.06, 1.0, 20).rotate([0, 0, 90]).translate([0.5, 0, 0])
        plates = [rod(m.u(0.18, 0.35), 0.12, sides, 0.03).rotate([0, 0, 90]).translate([x, 0, 0]) for x in (-0.36, -0.25, 0.36 + 0.12, 0.25 + 0.12)]
        return [joined([m.stamp(bar, m.metal()), *[m.stamp(p, m.pick(a, c)) for p in plates]]).rotate([0, m.u(-60, 60), 0])]
    if kind == 4:  # a xylophone or abacus
        count = m.n(5, 9)
        parts = [both(m.stamp(box(0.06, 0.08, 0.12 * count, 0.01).rotate([0, 8, 0]).translate([0.22, 0, 0]), m.wood()))]
        for i in range(count):
            parts.append(m.stamp(box(0.75 - 0.06 * i, 0.04, 0.09, 0.01).translate([0, 0.06, (i - (count - 1) / 2) * 0.12]), m.plain("toy")))
        stick = joined([rod(0.015, 0.6, 8), ball(0.05, 14)]).rotate([70, 40, 0]).translate([-0.2, 0.14, 0.1])
        return [joined([*parts, m.stamp(stick, m.wood())]).rotate([m.u(0, 20), m.u(-60, 60), 0])]
    if kind == 5:  # a drum or a tin with a lid
        r, h = m.u(0.3, 0.5), m.u(0.25, 0.7)
        parts = [m.stamp(rod(r, h, 40), m.pick(a, m.printed("label", m.color("toy"), "round"))), m.stamp(ring(r, 0.03, 40, 8, 1.3), b), m.stamp(ring(r, 0.03, 40, 8, 1.3).translate([0, h, 0]), b), m.stamp(rod(r * 0.97, 0.02, 40).translate([0, h - 0.01, 0]), m.plain("white"))]
        return parts
    if kind == 6:  # a house
        w, h, d = m.u(0.5, 1), m.u(0.4, 0.9), m.u(0.4, 0.8)
        wall, roof, trim = m.pick(a, m.pattern(("bricked", "grained", "plain"), "any")), m.pattern(("bricked", "striped", "plain"), "toy", "earth"), m.plain("white", "dark")
        gable = m.u(0.2, 0.5)
        parts = [m.stamp(slab(np.array([(-w / 2, 0), (w / 2, 0), (w / 2, h), (0, h + gable), (-w / 2, h)]), d), wall)]
        lean = math.degrees(math.atan2(gable, w / 2))
        side = box(math.hypot(gable, w / 2) * 1.25, 0.05, d * 1.15).rotate([0, 0, -lean]).translate([w * 0.27, h + gable * 0.48, 0])
        parts.append(both(m.stamp(side, roof)))
        parts.append(m.stamp(box(w * 0.2, h * 0.5, 0.06).translate([m.u(-0.2, 0.2) * w, h * 0.25, d / 2]), trim))
        parts.append(both(m.stamp(box(w * 0.18, w * 0.18, 0.05).translate([w * 0.3, h * 0.65, d / 2]), m.plain("dark", "pastel"))))
        if m.chance(0.5):
            parts.append(m.stamp(box(0.1, 0.3, 0.1).translate([w * 0.25, h + gable * 0.7, -d * 0.2]), roof))
        return [joined(parts).rotate([0, m.u(-50, 50), 0])]
    # A robot: boxes and rods.
    metal, second, dark = m.pick(m.metal(), a), b, c
    w, h = m.u(0.3, 0.5), m.u(0.35, 0.55)
    parts = [m.stamp(box(w, h, w * 0.7, m.u(0.0, 0.08)).translate([0, h / 2 + 0.3, 0]), metal)]
    hw = w * m.u(0.5, 0.9)
    parts.append(m.stamp(box(hw, hw * 0.8, hw * 0.8, m.u(0, 0.1)).translate([0, h + 0.35 + hw * 0.4, 0]), m.pick(metal, second)))
    parts.append(m.stamp(rod(0.06, 0.1, 14).translate([0, h + 0.27, 0]), dark))
    parts.append(both(m.stamp(ball(hw * 0.14, 16).translate([hw * 0.25, h + 0.38 + hw * 0.4, hw * 0.4]), m.plain("toy", "white"))))
    arm = tube([(w / 2, h + 0.2, 0), (w / 2 + 0.15, h + m.u(-0.1, 0.2), 0), (w / 2 + m.u(0.1, 0.2), h - 0.1 + m.u(-0.2, 0.4), m.u(0, 0.25))], 0.055, m.pick(12, ring_of(8, 12)), 18)
    parts.append(both(m.stamp(arm, second)))
    parts.append(both(m.stamp(box(w * 0.3, 0.34, w * 0.35, 0.02).translate([w * 0.27, 0.15, 0]) + box(w * 0.36, 0.1, w * 0.6, 0.02).translate([w * 0.27, 0.02, 0.04]), dark)))
    panel = m.printed("label", m.color("dark", "white"), sides=True)
    parts.append(m.stamp(box(w * 0.7, h * 0.5, 0.05).translate([0, h * 0.55 + 0.3, w * 0.35]), panel))
    return [joined(parts).rotate([0, m.u(-40, 40), 0])]


def pieces(m: Maker) -> list[Manifold]:
    """Several things of one kind, or a set of different ones, side by side on the ground."""
    from .household import bottle, carton, food, mug

    plan = m.pick(bottle, carton, food, mug, game, shape)
    parts: list[Manifold] = []
    x = 0.0
    for _ in range(m.n(2, 4)):
        one = m.stamp(shape(m), m.surface()) if plan is shape else joined(plan(m))
        low, high = extent(one)
        scale = m.u(0.6, 1) / max(float((high - low).max()), 0.1)
        one = one.scale([scale] * 3)
        low, high = extent(one)
        one = one.translate([x - float(low[0]), -float(low[1]), m.u(-0.15, 0.15) - float(low[2] + high[2]) / 2])
        parts.append(one)
        x += float(high[0] - low[0]) + m.u(0.01, 0.15)
    return [joined(parts).rotate([0, m.u(-40, 40), 0])]


THINGS = (
    *((shoe, 8.0), (bag, 3.5), (hat, 1.8), (tool, 4.0), (device, 6.0), (vehicle, 4.5), (plane, 2.0)),
    *((train_of, 2.0), (blocks, 3.0), (game, 3.5), (pieces, 2.5)),
)
