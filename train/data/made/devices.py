"""Tools, devices, instruments, ornaments."""

from __future__ import annotations

import math

import numpy as np
from manifold3d import Manifold

from .composition import shape
from .details import bow, handle, outline
from .looks import Maker, Parts
from .solids import (
    Blend,
    ball,
    bend,
    box,
    extent,
    joined,
    lathe,
    ring,
    ring_of,
    rod,
    slab,
    spline,
    superquadric,
    taper,
    tube,
)
from .textures import package, screen


def tool(m: Maker) -> list[Manifold]:
    """Something with a handle: hammer, screwdriver, brush, spoon, spanner, axe, torch, saw."""
    grip, head = m.pick(m.wood(), m.surface("toy dark")), m.pick(m.metal(), m.surface())
    long, r = m.u(0.6, 1.0), m.u(0.035, 0.09)
    swell = m.rng.uniform(0.7, 1.25, 5) * r
    bent = np.cumsum(m.rng.normal(0, 0.01, 5))
    line = np.stack([np.zeros(5), np.linspace(-long / 2, long / 2, 5), bent], 1)
    shaft = tube(line, swell, m.pick(16, 16, ring_of(4, 16), 6), 26, flat=(1, m.u(0.6, 1)))
    parts = Parts(m)
    parts.add(shaft, grip)
    if m.chance(0.4):
        for y in np.linspace(-long * 0.4, -long * 0.1, m.n(2, 6)):
            parts.add(ring(r * 1.05, 0.012, 24, 8), head, at=(0, y, 0))
    top = long / 2
    kind = m.n(0, 9)
    if kind == 0:  # hammer
        w = m.u(0.12, 0.22)
        poll = rod(m.u(0.06, 0.12), w, 20, 0.02).rotate([0, 0, 90])
        line = [(0, 0, 0), (w, 0.02, 0), (w * 1.8, -m.u(0, 0.15), 0)]
        claw = tube(line, [0.07, 0.06, 0.015], 12, 16, flat=(1, 1.2))
        parts.add(joined([poll, box(0.14, 0.12, 0.12, 0.02), claw]), head, at=(0, top, 0))
    elif kind == 1:  # screwdriver
        blade = lathe([(0.025, 0), (0.025, m.u(0.3, 0.7)), (0.0, 0.75)], 12)
        parts.add(blade, head, at=(0, top - 0.02, 0))
    elif kind == 2:  # spanner
        jaw = slab(ring_of(2.5, 28) * m.u(0.1, 0.16), 0.06, 0.01, 2) - box(
            m.u(0.06, 0.1), 0.2, 0.5
        ).translate([0, 0.1, 0]).rotate([0, 0, m.u(-20, 20)])
        parts.clear()
        parts.add(box(2 * r, long, 0.05, 0.015), head)
        parts.add(jaw, head, at=(0, top, 0))
        if m.chance(0.6):
            part = slab(ring_of(2, 28) * 0.1, 0.06, 0.01, 2) - rod(0.06, 0.3, 6).rotate(
                [90, 0, 0]
            ).translate([0, 0, -0.15])
            parts.add(part, head, at=(0, -top, 0))
    elif kind == 3:  # spoon or ladle
        size = m.u(0.1, 0.22)
        scoop = ball([size, size * 1.3, size * m.u(0.3, 0.9)]) - ball(
            [size * 0.9, size * 1.2, size * 0.8]
        ).translate([0, 0, size * 0.35])
        parts.add(scoop, m.pick(grip, head), turn=(m.u(-10, 30), 0, 0), at=(0, top + size, 0))
    elif kind == 4:  # spatula, oar, paddle
        w, h = m.u(0.12, 0.25), m.u(0.2, 0.4)
        blade = box(w * 2, h, m.u(0.015, 0.05), 0.01)
        if m.chance(0.4):
            slot = box(0.03, h * 0.6, 1)
            blade -= joined([slot.translate([x, 0, 0]) for x in np.linspace(-w * 0.6, w * 0.6, 4)])
        parts.add(blade, m.pick(grip, head), turn=(m.u(-15, 15), 0, 0), at=(0, top + h * 0.45, 0))
    elif kind == 5:  # brush
        w = m.u(0.1, 0.3)
        parts.add(box(w, 0.1, 0.08, 0.02), head, at=(0, top, 0))
        tuft = m.pattern("furry brushed", "earth dark white", repeats=4)
        part = taper(box(w * 0.95, m.u(0.12, 0.3), 0.07, 0.01), m.u(0.7, 1.3))
        parts.add(part, tuft, at=(0, top + 0.13, 0))
    elif kind == 6:  # axe, cleaver, knife
        form = [(-0.02, -0.1), (0.2, -0.16), (m.u(0.25, 0.4), 0.0), (0.2, 0.18), (-0.02, 0.1)]
        blade = slab(form, m.u(0.02, 0.07), 0.01, 2)
        if m.chance(0.5):
            form = [(-0.05, 0), (0.06, 0), (0.06, 0.5), (0.0, 0.7), (-0.05, 0.5)]
            blade = slab(form, 0.02, 0.006, 2)
        parts.add(blade, head, at=(0, top - 0.03, 0))
    elif kind == 7:  # torch
        cone = lathe([*((r, 0), (r * 1.9, 0.12), (r * 1.9, 0.25), (r * 1.7, 0.25), (r * 1.5, 0.2))])
        parts.add(cone, m.pick(grip, head), at=(0, top - 0.02, 0))
        parts.add(rod(r * 1.5, 0.02), m.plain("white pastel"), at=(0, top + 0.18, 0))
    elif kind == 8:  # pliers, scissors
        parts.clear()
        a = m.u(8, 25)
        line = [(0.14, -0.6, 0), (0.16, -0.35, 0), (0.0, 0.0, 0), (-0.06, 0.3, 0)]
        arm = tube(line, [0.04, 0.04, 0.04, 0.015], 10, 22, flat=(1, 1))
        loop = ring(m.u(0.08, 0.13), 0.028, 28, 10).rotate([90, 0, 0]).scale([1, 1.4, 1])
        loops = [m.stamp(loop.translate([0.16, -0.62, 0]), grip)] if m.chance(0.5) else []
        for side, z in ((1, 0.02), (-1, -0.02)):
            blade = m.stamp(arm.trim_by_plane([0, 1, 0], -0.1), head)
            lower = m.stamp(arm.trim_by_plane([0, -1, 0], 0.09), grip)
            whole = joined([blade, lower, *loops]).rotate([0, 0, a])
            parts.append((whole if side > 0 else whole.mirror([1, 0, 0])).translate([0, 0, z]))
        parts.add(rod(0.05, 0.12, 20), head, turn=(90, 0, 0), at=(0, 0, -0.06))
    else:  # a rake, a fork
        count, w = m.n(3, 6), m.u(0.15, 0.35)
        parts.add(box(w, 0.05, 0.04, 0.01), head, at=(0, top, 0))
        for x in np.linspace(-w / 2 + 0.02, w / 2 - 0.02, count):
            line = [(x, top, 0), (x, top + 0.15, 0.02), (x, top + m.u(0.22, 0.3), 0.06)]
            parts.add(tube(line, [0.02, 0.018, 0.008], 8, 10), head)
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
    case, dark = m.surface("dark white metal any"), m.plain("dark")
    accent = m.plain("toy metal white")
    return _DEVICES[m.n(0, len(_DEVICES) - 1)](m, case, dark, accent)


def _telephone(m: Maker, case: int, dark: int, accent: int) -> list[Manifold]:
    """A telephone, tablet or frame."""
    parts = Parts(m)
    w, h, t = m.u(0.4, 0.9), m.u(0.6, 1.1), m.u(0.03, 0.1)
    edge = m.u(0.02, 0.08)
    parts.add(box(w, h, t, m.u(0.1, 0.45) * t), case)
    pane = box(w - 2 * edge, h - 2 * edge - m.u(0, 0.1), 0.02).translate([0, 0, t / 2])
    picture = m.faced(screen(m.rng), np.zeros(3))
    parts.add(pane, picture)
    if m.chance(0.4):
        part = rod(0.05, 0.03, 20)
        parts.add(part, accent, turn=(90, 0, 0), at=(0, -h / 2 + edge / 2 + 0.03, t / 2 - 0.01))
    whole = joined(parts).rotate([m.pick(0, -m.u(10, 35), -80), 0, 0])
    if m.chance(0.4):
        whole = joined(
            [whole, m.stamp(box(w * 0.5, 0.05, 0.4, 0.02).translate([0, -h / 2, -0.1]), case)]
        )
    return [whole.rotate([0, m.u(-50, 50), 0])]


def _mouse(m: Maker, case: int, dark: int, accent: int) -> list[Manifold]:
    """A computer mouse, with or without its cable."""
    parts = Parts(m)
    body = superquadric(
        [m.u(0.28, 0.38), m.u(0.16, 0.28), 0.55], m.u(0.7, 1), m.u(0.6, 0.95), 40
    ).trim_by_plane([0, 1, 0], -0.04)
    body = body.warp_batch(lambda p: p * (1 + p[:, 2:] * [0.15, -0.35, 0]))
    seam = m.stamp(box(0.015, 1, 0.6).translate([0, 0, 0.4]), dark)
    parts.append(m.stamp(body, case) - seam)
    parts.add(rod(0.07, 0.06, 20), accent, turn=(0, 0, 90), at=(0.03, 0.14, 0.27))
    if m.chance(0.6):
        line = [
            *((0, 0, 0.5), (m.u(-0.1, 0.1), 0, 0.8), (m.u(-0.4, 0.4), 0, 1.0)),
            (m.u(-0.6, 0.6), 0, 0.7),
        ]
        parts.add(tube(line, 0.018, 8, 40), dark)
    return parts.turned(0, m.u(90, 270) if m.chance(0.5) else m.u(-90, 90))


def _camera(m: Maker, case: int, dark: int, accent: int) -> list[Manifold]:
    """A camera."""
    parts = Parts(m)
    w, h, t = m.u(0.6, 0.9), m.u(0.4, 0.6), m.u(0.2, 0.35)
    parts.add(box(w, h, t, 0.05), case)
    r, long = m.u(0.14, 0.22), m.u(0.1, 0.5)
    profile = [
        *((r, 0), (r, long * 0.6), (r * 1.08, long * 0.65), (r * 1.08, long)),
        *((r * 0.9, long), (r * 0.75, long * 0.85)),
    ]
    lens = lathe(profile, 36)
    parts.add(lens, dark, turn=(90, 0, 0), at=(m.u(-0.1, 0.1), -0.02, t / 2 - 0.01))
    parts.add(ball([r * 0.7, r * 0.7, 0.05]), accent, at=(0, -0.02, t / 2 + long * 0.83))
    parts.add(box(w * 0.3, 0.12, t * 0.9, 0.04), case, at=(0, h / 2 + 0.03, 0))
    for x in (-0.3, 0.3):
        part = rod(m.u(0.04, 0.07), 0.06, 20, 0.01)
        parts.add(part, m.pick(accent, dark), at=(x * w, h / 2 - 0.01, 0))
    if m.chance(0.3):
        half = [(-w / 2, h * 0.3, 0), (-w * 0.6, h, -0.1), (0, h * 1.4, -0.2)]
        parts.add(bow(half, 0.02, flat=2), dark)
    return parts.turned(0, m.pick(0, m.u(-45, 45)))


def _loudspeaker(m: Maker, case: int, dark: int, accent: int) -> list[Manifold]:
    """A loudspeaker or a radio."""
    parts = Parts(m)
    w, h, t = m.u(0.4, 1.2), m.u(0.4, 1.1), m.u(0.25, 0.5)
    parts.add(box(w, h, t, m.u(0.01, 0.12)), m.pick(case, m.wood()))
    small = min(w, h)
    rows = [(-0.27 * w, 0, 0.2 * small + 0.06), (0.27 * w, 0, 0.2 * small + 0.06)]
    if h > w:
        rows = [(0, -0.2 * h, 0.38 * small), (0, 0.28 * h, 0.18 * small)]
    for x, y, r in rows:
        profile = [
            *((r, 0), (r, 0.05), (r * 0.85, 0.05), (r * 0.4, 0.015), (r * 0.3, 0.035)),
            (0, 0.045),
        ]
        cone = lathe(profile, 32)
        parts.add(cone, m.pick(dark, accent), turn=(90, 0, 0), at=(x, y, t / 2 - 0.01))
    if m.chance(0.4):
        path = [(w * 0.4, h / 2, 0), (w * 0.45, h / 2 + 0.4, 0), (w * 0.6, h / 2 + 0.9, -0.1)]
        parts.add(tube(path, 0.015, 8, 14), accent)
    return parts.turned(0, m.pick(0, m.u(-45, 45)))


def _remote(m: Maker, case: int, dark: int, accent: int) -> list[Manifold]:
    """A remote control or a handset."""
    parts = Parts(m)
    w, h, t = m.u(0.2, 0.4), m.u(0.7, 1.1), m.u(0.07, 0.15)
    parts.add(bend(box(w, h, t, 0.4 * t).refine_to_length(0.1), m.u(-0.3, 0.3)), case)
    columns, rows = m.n(2, 3), m.n(4, 8)
    for i, j in np.ndindex(columns, rows):
        x, y = (i - (columns - 1) / 2) * w * 0.7 / columns, (j / rows - 0.45) * h * 0.7
        key = ball([w * 0.09, w * 0.09, 0.04], 12) if rows % 2 else box(w * 0.2, w * 0.12, 0.05)
        parts.add(key, accent if j == rows - 1 else dark, at=(x, y, t / 2))
    whole = joined(parts)
    return [whole.rotate([m.pick(0, -60, -85), 0, 0]).rotate([0, m.u(-60, 60), 0])]


def _keyboard(m: Maker, case: int, dark: int, accent: int) -> list[Manifold]:
    """A keyboard or a piano."""
    parts = Parts(m)
    w, d, t = m.u(0.8, 1.4), m.u(0.3, 0.5), m.u(0.05, 0.12)
    parts.add(box(w, t, d, 0.3 * t), case)
    rows, columns = m.pick(1, 3, 4), m.n(8, 14)
    wide, deep = w * 0.93 / columns, d * 0.85 / rows
    key = box(w * 0.85 / columns, 0.06, d * 0.68 / rows)
    key = key.translate([(1 - columns) / 2 * wide, t / 2, (1 - rows) / 2 * deep])
    keys = [key.translate([i * wide, 0, j * deep]) for i, j in np.ndindex(columns, rows)]
    parts.add(Manifold.compose(keys), m.pick(dark, accent, m.plain("white")))
    return parts.turned(m.u(0, 25), m.u(-40, 40))


def _controller(m: Maker, case: int, dark: int, accent: int) -> list[Manifold]:
    """A game controller."""
    parts = Parts(m)
    blend = Blend(0.12)
    blend.limb([(0, 0, 0), (0.3, 0.02, 0)], [0.16, 0.17], 0)
    blend.limb([(0.3, 0.02, 0), (0.45, -0.1, m.u(0.2, 0.45))], [0.16, 0.11], 0)
    body = m.blended(blend, (case,)).scale([1, 0.7, 1])
    parts.append(body)
    stick = joined([rod(0.03, 0.16, 12), ball([0.07, 0.03, 0.07], 20).translate([0, 0.17, 0])])
    parts.pair(stick, dark, at=(0.16, 0.05, 0.05))
    for a in range(4):
        x, z = 0.06 * math.sin(a * 1.57), 0.06 * math.cos(a * 1.57)
        parts.add(ball(0.03, 12), m.plain("toy"), at=(0.34 + x, 0.12, z - 0.02))
    part = box(0.15, 0.03, 0.05).translate([-0.34, 0.12, 0]) + box(0.05, 0.03, 0.15).translate(
        [-0.34, 0.12, 0]
    )
    parts.add(part, dark)
    return parts.turned(m.u(20, 80), m.u(-30, 30))


def _toaster(m: Maker, case: int, dark: int, accent: int) -> list[Manifold]:
    """A toaster, iron or coffee machine."""
    parts = Parts(m)
    w, h, t = m.u(0.5, 0.9), m.u(0.4, 1.0), m.u(0.35, 0.6)
    body = superquadric([w / 2, h / 2, t / 2], m.u(0.15, 0.5), m.u(0.15, 0.5), 40)
    if h > 0.7:  # a niche for the jug
        niche = m.stamp(box(w * 0.7, h * 0.5, t).translate([0, -h * 0.05, t * 0.3]), dark)
        parts.append(m.stamp(body, m.pick(case, m.metal())) - niche)
        part = _jug(m, 0.2 * w, 0.4 * h)
        parts.add(part, m.plain("dark metal pastel"), at=(0, -h * 0.29, t * 0.25))
    else:
        slots = joined([box(w * 0.7, 0.3, 0.06).translate([0, h / 2, z]) for z in (-0.1, 0.1)])
        parts.append(m.stamp(body, m.pick(case, m.metal())) - m.stamp(slots, dark))
    parts.add(box(0.08, 0.04, 0.06, 0.01), dark, at=(w / 2, 0.1, 0))
    for x in np.linspace(-0.2, 0.2, m.n(1, 4)):
        part = rod(0.04, 0.05, 18, 0.01)
        parts.add(part, accent, turn=(90, 0, 0), at=(x * w, -h * 0.38, t / 2 - 0.02))
    return parts.turned(0, m.pick(0, m.u(-45, 45)))


def _dryer(m: Maker, case: int, dark: int, accent: int) -> list[Manifold]:
    """A hair dryer, drill or water pistol."""
    parts = Parts(m)
    long, r = m.u(0.5, 0.9), m.u(0.12, 0.2)
    path = [(0, 0, -long / 2), (0, 0.01, 0), (0, 0, long / 2)]
    barrel = tube(path, [r, r * m.u(0.9, 1.2), r * m.u(0.4, 0.9)], 20, 24)
    path = [(0, 0, -0.05), (0, -0.3, -0.08), (0, -m.u(0.45, 0.65), -m.u(0.05, 0.2))]
    grip = tube(path, [0.08, 0.075, 0.09], 14, 18, flat=(1, 1.2))
    parts.add(barrel, case)
    parts.add(grip, m.pick(case, dark))
    parts.add(box(0.05, 0.1, 0.06, 0.015), accent, at=(0, -0.17, 0.04))
    nozzle = rod(r * m.u(0.2, 0.7), m.u(0.05, 0.35), 20).rotate([90, 0, 0])
    nozzle = nozzle.translate([0, 0, long / 2])
    parts.add(nozzle, m.pick(dark, accent))
    if m.chance(0.5):
        parts.add(box(0.22, 0.14, 0.25, 0.03), dark, at=(0, -0.6, -0.1))
    return parts.turned(0, m.pick(90, -90, m.u(-180, 180)))


def _clock(m: Maker, case: int, dark: int, accent: int) -> list[Manifold]:
    """A clock or a scale."""
    parts = Parts(m)
    r, t = m.u(0.4, 0.55), m.u(0.08, 0.25)
    face = screen(m.rng) if m.chance(0.3) else package(m.rng, m.color("white"), m.inks(), "label")
    dial = m.faced(face, m.color("white any"))
    form = ring_of(m.pick(2, 2, 5), 48)
    part = slab(form * r, t, 0.03) - slab(form * r * 0.88, t).translate([0, 0, t * 0.8])
    parts.add(part, case)
    parts.add(slab(form * r * 0.87, 0.02), dial, at=(0, 0, t * 0.3))
    for a, long in ((m.u(0, 360), 0.6), (m.u(0, 360), 0.4)):
        part = box(0.02, long * r, 0.02).translate([0, long * r / 2, t * 0.33])
        parts.add(part, dark, turn=(0, 0, a))
    if m.chance(0.4):
        parts.pair(ball([0.12, 0.1, 0.08]), accent, at=(0.25, r + 0.02, 0))
        parts.pair(rod(0.03, 0.2, 12), accent, turn=(0, 0, 20), at=(0.25, -r - 0.1, 0))
    return parts.turned(m.pick(0, -20, -85), m.u(-30, 30))


def _router(m: Maker, case: int, dark: int, accent: int) -> list[Manifold]:
    """A router, hub or plug: a slab with aerials and cables."""
    parts = Parts(m)
    w, t, d = m.u(0.5, 0.9), m.u(0.08, 0.2), m.u(0.3, 0.6)
    body = box(w, t, d, 0.3 * t)
    if m.chance(0.3):
        body = slab(outline(m) * [w / 1.2, d / 1.2], t, 0.3 * t).rotate([90, 0, 0])
    parts.add(body, case)
    for x in np.linspace(-0.4, 0.4, m.n(1, 4)):
        path = [
            (x * w, 0, -d * 0.4),
            (x * w, 0.3, -d * 0.45),
            (x * w * m.u(0.8, 1.4), m.u(0.4, 0.7), -d * 0.5),
        ]
        parts.add(tube(path, [0.03, 0.025, 0.02], 10, 14), dark)
    if m.chance(0.5):
        path = [
            *((0, 0, -d * 0.45), (0.2, 0, -d), (m.u(-0.8, 0.8), 0, -d * 0.9)),
            (m.u(-0.6, 0.9), 0, 0.2),
        ]
        parts.add(tube(path, 0.02, 8, 44), dark)
    for x in np.linspace(-0.3, 0.3, m.n(2, 5)):
        parts.add(ball(0.02, 10), accent, at=(x * w, t * 0.1, d / 2))
    return parts.turned(0, m.pick(0, m.u(-45, 45)))


_DEVICES = (
    *(_telephone, _mouse, _camera, _loudspeaker, _remote, _keyboard),
    *(_controller, _toaster, _dryer, _clock, _router),
)


def _jug(m: Maker, r: float, h: float) -> Manifold:
    body = lathe([(r, 0), (r * 1.1, h * 0.4), (r * 0.8, h)], 28)
    return body + handle(m, r * 0.9, h * 0.6, 0.03 * r / 0.2).translate([r * 0.9, h * 0.5, 0])


def instrument(m: Maker) -> list[Manifold]:
    """A guitar, a trumpet, a racket, a bat, a chess piece, a cup, a statuette on its base."""
    a, b, dark = m.pick(m.wood(), m.surface()), m.surface("wood dark metal"), m.plain("dark")
    kind = m.n(0, 4)
    parts = Parts(m)
    if kind == 0:
        t = np.arange(60) * (2 * math.pi / 60)
        r = (
            0.34
            + m.u(0.02, 0.06) * np.cos(t - math.pi / 2)
            - m.u(0.06, 0.11) * np.cos(2 * t) * np.abs(np.sin(t))
            + m.u(0.0, 0.05) * np.sin(3 * t)
        )
        form = np.stack([r * np.cos(t) * 0.9, r * np.sin(t) * 1.25], -1)
        thick = m.u(0.05, 0.16)
        part = slab(form, thick, 0.02) - rod(0.1, 1, 28).rotate([90, 0, 0]).translate(
            [0, 0.05, thick / 2 - 0.03]
        )
        parts.add(part, a)
        parts.add(box(0.08, 0.8, 0.05, 0.01), b, at=(0, 0.7, thick / 2))
        parts.add(box(0.14, 0.2, 0.04, 0.01), b, at=(0, 1.17, thick / 2 - 0.01))
        parts.add(box(0.2, 0.04, 0.04), dark, at=(0, -0.22, thick / 2 + 0.01))
        peg = rod(0.015, 0.26, 8).rotate([0, 0, 90]).translate([0.13, 1.1, thick / 2 - 0.01])
        pegs = [peg.translate([0, 0.06 * i, 0]) for i in range(3)]
        parts.add(joined(pegs), m.metal())
        return parts.turned(m.u(-20, 0), m.u(-50, 50), m.pick(0, m.u(-80, 80)))
    if kind == 1:
        contour = [
            (0, 0),
            *[(0.03 + 0.25 * s**4, s * 0.9) for s in np.linspace(0, 1, 12)],
            *[(0.015 + 0.25 * s**4, s * 0.9 + 0.015) for s in np.linspace(1, 0.5, 6)],
            (0, 0.4),
        ]
        flare = lathe(contour, 32)
        parts.add(flare, m.pick(m.metal(), m.surface("toy")), turn=(0, 0, -90))
        line = [
            *((0.1, 0, 0), (-0.1, -0.08, 0), (0.1, -0.2, 0), (0.5, -0.2, 0), (0.6, -0.08, 0)),
            (0.5, 0, 0),
        ]
        parts.add(tube(line, 0.028, 10, 44), m.metal())
        part = joined([rod(0.03, 0.25, 14).translate([x, -0.22, 0]) for x in (0.2, 0.3, 0.4)])
        parts.add(part, b)
        return parts.turned(0, m.u(-60, 60), m.u(-20, 20))
    if kind == 2:
        grip = tube([(0, -0.6, 0), (0, -0.3, 0), (0, 0.0, 0)], [0.05, 0.04, 0.035], 14, 14)
        parts.add(grip, b)
        if m.chance(0.5):  # a racket with its strings, or a paddle
            wide, tall = m.u(0.22, 0.3), m.u(0.28, 0.4)
            circle = np.column_stack([ring_of(2, 12) * [wide, tall], np.zeros(12)])
            rim = tube(circle + [0, tall, 0], 0.028, 10, 40, True)
            down, across = box(0.012, 2 * tall, 0.012), box(2 * wide, 0.012, 0.012)
            xs, ys = np.linspace(-wide, wide, 9)[1:-1], np.linspace(0, 2 * tall, 11)[1:-1]
            strings = [down.translate([x, tall, 0]) for x in xs]
            strings += [across.translate([0, y, 0]) for y in ys]
            net = joined(strings) ^ (ball([wide, tall, 1]).translate([0, tall, 0]))
            parts.add(rim, a)
            parts.add(net, m.plain("white toy"))
        elif m.chance(0.5):
            parts.add(slab(ring_of(2.2, 36) * [0.26, 0.3], 0.05, 0.01), a, at=(0, 0.26, 0))
        else:
            parts.add(tube([(0, 0, 0), (0, 0.3, 0), (0, 0.8, 0)], [0.04, 0.07, 0.085], 18, 20), a)
        return parts.turned(m.pick(0, -70), m.u(-40, 40), m.pick(0, m.u(-80, 80)))
    if kind == 3:  # a turned piece: chess, a candlestick, a cup
        count = m.n(5, 9)
        r = np.abs(m.rng.normal(0.14, 0.09, count)) + 0.03
        r[0] = m.u(0.2, 0.32)
        profile = spline(np.stack([r, np.linspace(0.05, 1, count)], 1), 40)
        body = lathe([(r[0] * 1.05, 0), *np.maximum(profile, [0.03, 0]).tolist(), (0, 1.02)], 32)
        parts.add(body, a)
        contour = [(0.08, 0), (0.17, 0.15), (0.12, 0.16), (0.08, 0.1), (0, 0.08)]
        top = m.pick(
            ball(m.u(0.06, 0.14)), box(0.08, 0.2, 0.06) + box(0.18, 0.07, 0.06), lathe(contour, 24)
        )
        parts.add(top, m.pick(a, b), at=(0, 1.04, 0))
        if m.chance(0.35):
            reach = np.interp(0.7, profile[:, 1], profile[:, 0]) - 0.03
            parts.pair(handle(m, 0.2, 0.3, 0.025), m.pick(a, b), at=(reach, 0.7, 0))
        return parts
    base = m.pick(box(0.6, 0.2, 0.5, 0.01), rod(0.32, 0.2, 36, 0.02).translate([0, -0.1, 0]))
    h = 0.1
    thing = shape(m, True)
    low, high = extent(thing)
    thing = thing.scale([0.8 / float((high - low).max())] * 3)
    low, high = extent(thing)
    thing = thing.translate([0, h - float(low[1]) - 0.03, 0])
    return [m.stamp(base, b), m.stamp(thing, a)]
