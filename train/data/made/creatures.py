"""Animals, dolls and figures."""

from __future__ import annotations

import math

import numpy as np
from manifold3d import Manifold

from .composition import turned_to
from .looks import Maker, Parts
from .solids import (
    Blend,
    ball,
    box,
    extent,
    joined,
    lathe,
    loft,
    ring,
    ring_of,
    ripple,
    rod,
    slab,
    spline,
    tube,
)

Vec = np.ndarray


def xyz(x: float, y: float, z: float) -> Vec:
    """A point or direction ``[3]``."""
    return np.array([x, y, z])


def _eyes(m: Maker, center: Vec, radii: Vec, size: float) -> list[Manifold]:
    """Two eyes on an egg that looks along z, and sometimes a nose."""
    side, up = m.u(0.35, 0.9), m.u(0.05, 0.5)
    ahead = math.sqrt(max(1 - side**2 - 0.8 * up**2, 0.05))
    toward = xyz(side, up, ahead)
    place = center + 0.98 * radii * toward / math.sqrt(toward @ toward)
    dark = m.painted(np.full(3, m.u(0.02, 0.15)) if m.chance(0.8) else m.color("toy"))
    eyes = Parts(m)
    if m.chance(0.4):  # the white of the eye, and its pupil before it
        white = m.painted(np.full(3, m.u(0.85, 0.97)))
        eyes.pair(ball(size * 1.5, 20), white, at=place)
        ahead_of = place + xyz(0.15, 0.1, 1.0) * size * 0.85
        eyes.pair(ball(size * 0.8, 16), dark, at=ahead_of)
    else:
        eyes.pair(ball([size, size * m.u(1, 1.5), size], 20), dark, at=place)
    if m.chance(0.35):  # a mouth
        mouth = center + radii * xyz(0, -0.42, 0.88)
        line = mouth + size * np.array([(-2.2, 0.5, -0.3), (0, 0, 0), (2.2, 0.5, -0.3)])
        bow = tube(line, 0.45 * size, 8, 12)
        eyes.add(bow, m.painted(xyz(m.u(0.1, 0.7), 0.05, 0.08)))
    return eyes


def _ears(m: Maker, blend: Blend, center: Vec, radii: Vec, look: int) -> None:
    """Ears of a kind into a blend: round, pointed, long or hanging; or none."""
    kind = m.n(0, 5)
    r = float(radii.mean())
    base = center + radii * xyz(m.u(0.5, 0.8), m.u(0.6, 0.8), 0)
    if kind == 0:
        blend.egg(base + [0.15 * r, 0.2 * r, 0], (0.42 * r, 0.42 * r, 0.16 * r), look)
    elif kind == 1:
        blend.limb([base, base + xyz(0.2, 0.7, 0) * r], [0.28 * r, 0.04 * r], look)
    elif kind == 2:
        tall = m.u(0.8, 2.0)
        tip = base + xyz(m.u(0.1, 0.6), tall, -0.1) * r
        line = [base, base + xyz(0.15, 0.5 * tall, -0.05) * r, tip]
        blend.limb(line, [0.18 * r, 0.26 * r, 0.12 * r], look)
    elif kind == 3:
        line = [base, base + np.array([0.4, 0.05, 0]) * r, base + xyz(0.6, -m.u(0.5, 1.1), 0.1) * r]
        blend.limb(line, [0.15 * r, 0.2 * r, 0.25 * r], look)
    elif kind == 4:
        blend.egg(
            base + [0.5 * r, -0.2 * r, -0.1 * r],
            (m.u(0.6, 1.0) * r, m.u(0.6, 0.9) * r, 0.12 * r),
            look,
        )


def _turned(m: Maker, parts: list[Manifold]) -> list[Manifold]:
    """Turn an animal to the front, to the side or between."""
    angle = m.pick(0.0, m.u(-60, 60), 90.0, -90.0, m.u(40, 110), m.u(-110, -40))
    return [part.rotate([0, angle, 0]) for part in parts]


def _knobbly(m: Maker, part: Manifold) -> Manifold:
    size = float((extent(part)[1] - extent(part)[0]).max())
    if m.chance(0.3):
        length = size * m.u(0.06, 0.2)
        return ripple(part, m.rng, length * m.u(0.02, 0.07), length, True)
    return part


def quadruped(m: Maker) -> list[Manifold]:
    """Dog, cat, horse, cow, elephant, bear, long-necked dinosaur: a body on four legs."""
    coat, second, third = m.fur(), m.fur(), m.surface("dark fur earth")
    stout, high = m.u(0.13, 0.32), m.u(0.12, 0.55)
    long = m.u(0.4, 0.65)
    blend = Blend(m.u(0.04, 0.12))
    hip = xyz(0, high + stout, -long / 2)
    chest = xyz(0, high + stout + m.u(-0.05, 0.08), long / 2)
    arch = (hip + chest) / 2 + [0, m.u(-0.06, 0.08), 0]
    line = [hip, arch, chest]
    blend.limb(line, [stout * m.u(0.8, 1.1), stout * m.u(0.85, 1.15), stout * m.u(0.9, 1.2)], 0)
    neck = m.u(0.1, 0.75) ** 1.5 * m.pick(1, 1, 1.8)
    r = m.u(0.11, 0.26) if neck < 0.5 else m.u(0.08, 0.14)
    lean = m.u(0.1, 1.2)
    head = chest + np.array(
        [0, stout * 0.6 + neck * math.cos(lean), stout * 0.5 + neck * math.sin(lean) + 0.4 * r]
    )
    thick = min(r * m.u(0.6, 0.95), stout)
    line = [chest, (chest + head) / 2 + [0, m.u(-0.02, 0.05), m.u(-0.04, 0.04)], head]
    blend.limb(line, [stout * 0.7, thick, thick], 0)
    radii = xyz(r, r * m.u(0.8, 1.05), r * m.u(0.9, 1.2))
    blend.egg(head, radii, 0)
    kind = m.n(0, 3)
    snout = m.u(0.4, 1.4) * r
    tip = head + xyz(0, -0.35 * r, 0.6 * r + snout)
    blend.limb([head + [0, -0.25 * r, 0.4 * r], tip], [0.6 * r, r * m.u(0.25, 0.5)], m.pick(0, 1))
    if kind == 0 and m.chance(0.4):  # a trunk
        line = [tip, tip + [0, -2 * r, 0.5 * r], tip + [0, -2.6 * r, 1.2 * r]]
        blend.limb(line, [0.35 * r, 0.22 * r, 0.15 * r], 0)
    _ears(m, blend, head, radii, m.pick(0, 1))
    leg, paw = stout * m.u(0.28, 0.5), m.u(0.9, 1.5)
    wide = stout * m.u(0.5, 0.8)
    stride = m.u(-0.12, 0.12)
    walking = m.chance(0.3)
    sides = (1, -1) if walking else (1,)
    blend.symmetric = not walking
    for base, reach in ((hip, 1.0), (chest, -1.0)):
        for side in sides:
            swing = stride * reach * (side if walking else 1)
            top = base + [side * wide, -0.3 * stout, 0]
            bent = base[2] + swing * 0.6 + m.u(-0.04, 0.04)
            knee = xyz(side * wide * 1.05, high * 0.5, bent)
            foot = np.array([side * wide * 1.05, leg * paw * 0.8, base[2] + swing])
            blend.limb([top, knee, foot], [leg * 1.4, leg, leg * m.u(0.8, 1.0)], 0)
            blend.egg(
                foot + [0, -0.1 * leg, 0.35 * leg],
                (leg * paw, leg * paw * 0.8, leg * paw * 1.3),
                m.pick(1, 2) if m.chance(0.5) else 0,
            )
    blend.symmetric = True
    tail = m.u(0.08, 0.8)
    up = m.u(-0.7, 1.2)
    end = hip + xyz(0, tail * math.sin(up), -stout * 0.7 - tail * math.cos(up))
    fat = m.u(0.02, 0.09)
    line = [hip + [0, 0.2 * stout, -0.6 * stout], (hip + end) / 2 + [0, m.u(-0.05, 0.1), -0.1], end]
    blend.limb(line, [fat * 1.5, fat, fat * m.u(0.3, 1.8)], m.pick(0, 0, 1))
    parts = Parts(m)
    parts.append(_knobbly(m, m.blended(blend, (coat, second, third))))
    parts += _eyes(m, head, radii, r * m.u(0.09, 0.16))
    nose = m.painted(np.full(3, m.u(0.02, 0.2)))
    if m.chance(0.6):
        parts.add(ball([0.2 * r, 0.15 * r, 0.15 * r], 16), nose, at=tip + [0, 0.1 * r, 0.35 * r])
    if m.chance(0.25):
        _horns(m, parts, head, r)
    if m.chance(0.2):
        _crest(m, parts, [hip, arch, chest], stout)
    if m.chance(0.15):  # a collar
        at = chest * 0.5 + head * 0.5
        collar = ring(thick * 1.15, 0.02, 28, 8, 2)
        parts.add(turned_to(collar, head - chest, at), m.plain("toy"))
    return _turned(m, parts)


def _horns(m: Maker, parts: Parts, head: Vec, r: float) -> None:
    base = head + xyz(0.45, 0.75, 0) * r
    middle = base + xyz(m.u(0.1, 0.7), m.u(0.3, 0.7), 0) * r
    tip = base + xyz(m.u(0, 0.9), m.u(0.6, 1.5), m.u(-0.5, 0.6)) * r
    horn = tube([base, middle, tip], [0.16 * r, 0.12 * r, 0.02 * r], 10, 16)
    parts.pair(horn, m.plain("white earth dark"))


def _crest(m: Maker, parts: Parts, spine: list[Vec], stout: float) -> None:
    """Plates along the back."""
    look, size = m.surface("toy earth"), m.u(0.3, 0.7) * stout
    for t in np.linspace(0, 1, m.n(5, 11)):
        h = size * (0.5 + math.sin(math.pi * t))
        plate = slab(ring_of(1.2, 16) * [h * 0.6, h], 0.25 * size, 0.1 * size, 2)
        at = [np.interp(t, np.linspace(0, 1, len(spine)), axis) for axis in np.transpose(spine)]
        parts.add(plate, look, turn=(0, 90, 0), at=xyz(*at) + [0, stout + 0.3 * h, 0])


def plush(m: Maker) -> list[Manifold]:
    """A stuffed animal or doll that sits, with a large head."""
    coat, second, third = m.fur(), m.fur(), m.fur()
    blend = Blend(m.u(0.02, 0.07))
    w, h = m.u(0.2, 0.36), m.u(0.24, 0.45)
    blend.egg((0, h, 0), (w, h, w * m.u(0.75, 1)), 0)
    if m.chance(0.6):  # a belly of another colour
        blend.egg((0, h * 0.9, w * 0.25), (w * 0.75, h * 0.75, w * 0.78), 1)
    r = m.u(0.2, 0.38)
    radii = xyz(r * m.u(0.95, 1.25), r * m.u(0.8, 1), r * m.u(0.8, 1))
    head = np.array([0, 2 * h + radii[1] * 0.65, m.u(0, 0.08)])
    blend.egg(head, radii, 0)
    blend.egg(
        head + [0, -0.3 * r, radii[2] * 0.75],
        (r * m.u(0.3, 0.55), r * m.u(0.25, 0.4), r * m.u(0.25, 0.6)),
        m.pick(0, 1, 1),
    )
    _ears(m, blend, head, radii, m.pick(0, 1))
    a = m.u(0.07, 0.14)
    down, out, ahead = m.u(-0.3, 0.15), m.u(0.1, 0.4), m.u(-0.02, 0.3)
    shoulder = xyz(w * 0.75, 1.55 * h, 0)
    blend.limb(
        [shoulder, shoulder + [out * 0.6, down * 0.4, ahead * 0.4], shoulder + [out, down, ahead]],
        [a, a * 0.95, a * m.u(0.8, 1.3)],
        m.pick(0, 2),
    )
    leg = m.u(0.09, 0.16)
    if m.chance(0.6):
        foot = xyz(w * m.u(0.7, 1.3), leg, w + m.u(0.1, 0.35))
    else:
        foot = xyz(w * m.u(0.5, 0.8), -m.u(0.1, 0.5), 0.05)
    blend.limb([(w * 0.55, 0.35 * h, 0.1), tuple(foot)], [leg * 1.1, leg], 0)
    blend.egg(
        foot + [0, 0.25 * leg, 0.25 * leg],
        (leg * 1.15, leg * m.u(1.1, 1.6), leg * 0.8),
        m.pick(0, 1, 2),
    )
    if m.chance(0.5):
        tail = xyz(0, 0.3 * h, -w)
        line = [tail, tail + [0, m.u(-0.1, 0.4), -m.u(0.05, 0.3)]]
        blend.limb(line, [m.u(0.04, 0.1), m.u(0.03, 0.12)], m.pick(0, 1))
    parts = Parts(m)
    parts.append(m.blended(blend, (coat, second, third)))
    parts += _eyes(m, head, radii, r * m.u(0.07, 0.13))
    nose = head + [0, -0.15 * r, radii[2] + 0.15 * r]
    parts.add(ball([0.16 * r, 0.12 * r, 0.12 * r], 16), m.plain("dark toy"), at=nose)
    if m.chance(0.3):  # a bow tie or a scarf
        scarf = ring(w * 0.75, m.u(0.03, 0.06), 28, 10)
        parts.add(scarf, m.cloth("toy any"), at=(0, 2 * h - 0.02, 0))
    if m.chance(0.6):
        return parts
    return _turned(m, parts)


def biped(m: Maker) -> list[Manifold]:
    """A dinosaur, kangaroo or dragon on two legs, with a long tail."""
    skin = m.pattern("spotted clouded striped speckled plain", "toy earth leaf", contrast=0.4)
    second, third = m.surface("earth toy"), m.surface("dark white")
    blend = Blend(m.u(0.04, 0.1))
    hip = xyz(0, m.u(0.35, 0.6), 0.0)
    stout, lean = m.u(0.14, 0.24), m.u(0.2, 1.1)
    chest = hip + xyz(0, 0.4 * math.cos(lean), 0.4 * math.sin(lean))
    blend.limb([hip, chest], [stout, stout * m.u(0.7, 1)], 0)
    blend.egg((hip + chest) / 2 + [0, -0.03, 0.06], (stout * 0.8, stout, stout * 0.9), 1)
    neck = chest + xyz(0, m.u(0.1, 0.35), m.u(0.05, 0.2))
    blend.limb([chest, neck], [stout * 0.7, stout * 0.5], 0)
    r = m.u(0.1, 0.18)
    radii = xyz(r * 0.85, r * 0.9, r)
    blend.egg(neck + [0, 0.3 * r, 0.3 * r], radii, 0)
    head = neck + xyz(0, 0.3 * r, 0.3 * r)
    jaw = m.u(1.0, 2.4) * r
    line = [head + [0, -0.1 * r, 0.4 * r], head + [0, -0.25 * r, jaw]]
    blend.limb(line, [0.6 * r, m.u(0.25, 0.45) * r], 0)
    if m.chance(0.6):
        line = [head + [0, -0.55 * r, 0.2 * r], head + [0, -m.u(0.6, 1.1) * r, jaw * 0.9]]
        blend.limb(line, [0.35 * r, 0.22 * r], 1)
    tail = m.u(0.5, 1.2)
    line = [hip, hip + [0, -0.1, -0.45 * tail], hip + [0, m.u(-0.3, 0.2), -tail]]
    blend.limb(line, [stout * 0.85, stout * 0.45, 0.02], 0)
    leg = stout * m.u(0.5, 0.75)
    knee = np.array([stout * 0.8, hip[1] * 0.55, m.u(0.05, 0.2)])
    ankle = np.array([stout * 0.85, hip[1] * 0.22, -0.06])
    blend.limb([hip + [stout * 0.6, 0, 0], knee, ankle], [leg, leg * 0.75, leg * 0.4], 0)
    line = [tuple(ankle), (stout * 0.9, 0.04, m.u(0.08, 0.2))]
    blend.limb(line, [leg * 0.4, leg * m.u(0.4, 0.6)], 2)
    arm = chest + xyz(stout * 0.7, -0.02, 0.08)
    line = [arm, arm + [0.05, -0.13, 0.08], arm + [0.02, -m.u(0.1, 0.25), 0.2]]
    blend.limb(line, [0.05, 0.035, 0.03], 0)
    parts = Parts(m)
    parts.append(_knobbly(m, m.blended(blend, (skin, second, third))))
    parts += _eyes(m, head, radii, r * m.u(0.1, 0.18))
    if m.chance(0.4):
        _crest(m, parts, [hip + [0, -0.05, -0.45 * tail], hip, chest], stout * 0.9)
    if m.chance(0.2):
        _wings(m, parts, chest, stout)
    return _turned(m, parts)


def _wings(m: Maker, parts: Parts, at: Vec, size: float) -> None:
    long, deep = m.u(2.0, 4.0) * size, m.u(1, 2) * size
    form = [(0, -0.3), (0.5, -0.5), (1, -0.35), (1.05, 0.0), (0.6, 0.5), (0, 0.45)]
    wing = slab(np.array(form) * [long, deep], 0.15 * size, 0.03 * size, 2).rotate([90, 0, 0])
    place = at + [0.3 * size, 0.3 * size, -0.3 * size]
    parts.pair(wing, m.surface("toy any"), turn=(0, 0, m.u(-20, 50)), at=place)


def bird(m: Maker) -> list[Manifold]:
    """Duck, penguin, parrot, chick or owl."""
    coat, second = m.fur("toy fur pastel dark"), m.fur("white any")
    third = m.surface("toy earth")
    upright = m.u(0, 1.3)
    blend = Blend(m.u(0.03, 0.1))
    r = m.u(0.22, 0.35)
    body = xyz(0, r + 0.05, 0)
    blend.egg(body, (r * m.u(0.7, 1), r * m.u(0.75, 1), r * m.u(1.0, 1.5)), 0, -upright)
    blend.egg(body + [0, -0.03, 0.12 * r], (r * 0.75, r * 0.8, r * 1.05), 1, -upright)
    h = r * m.u(0.45, 0.8)
    head = body + xyz(0, r * m.u(0.9, 1.5), r * m.u(0.2, 0.8))
    blend.limb([body + [0, 0.3 * r, 0.3 * r], head], [0.6 * r, h * 0.75], 0)
    radii = xyz(h, h, h)
    blend.egg(head, radii, m.pick(0, 0, 1))
    wing = body + xyz(r * 0.8, 0.15 * r, -0.1 * r)
    blend.egg(wing, (0.12 * r, 0.5 * r, m.u(0.7, 1.1) * r), m.pick(0, 2), m.u(-1, 0.2))
    tail = body + xyz(0, m.u(-0.5, 0.5) * r, -r * m.u(1.3, 2))
    blend.limb([body + [0, 0, -0.6 * r], tail], [0.4 * r, 0.08 * r], 0)
    parts = Parts(m)
    parts.append(m.blended(blend, (coat, second, third)))
    parts += _eyes(m, head, radii, h * m.u(0.1, 0.2))
    profile = [
        *((h * m.u(0.25, 0.5), 0), (h * 0.25, h * 0.3), (0.02 * h, h * m.u(0.5, 1.2))),
        (0, h * 1.2),
    ]
    beak = lathe(profile, 16).scale([1, 1, m.u(0.4, 1)])
    parts.add(beak, third, turn=(90 + m.u(-5, 25), 0, 0), at=head + [0, -0.1 * h, 0.85 * h])
    if m.chance(0.7):
        line = [
            *((0.3 * r, 0.1, 0), (0.32 * r, 0.0, 0.0), (0.36 * r, -0.06, 0.15 * r)),
            (0.4 * r, -0.06, 0.5 * r),
        ]
        foot = tube(line, [0.03, 0.03, 0.05, 0.06], 8, 14, flat=(1, 1))
        parts.pair(foot, third)
    return _turned(m, parts)


def swimmer(m: Maker) -> list[Manifold]:
    """Fish, shark, whale or dolphin."""
    skin = m.pattern("spotted striped plain clouded shaded", "toy metal pastel", contrast=0.5)
    fin = m.surface("toy any")
    tall, wide = m.u(0.15, 0.4), m.u(0.1, 0.28)
    bow, count, sides = m.u(-0.12, 0.12), 26, 24
    z = np.linspace(-0.55, 0.5, count)
    blunt, waist = m.u(0.25, 0.9), m.u(0.08, 0.3)
    points = [
        *([waist], [waist * 1.2], [m.u(0.5, 0.8)], [1.0], [m.u(0.85, 1.05)], [blunt]),
        [blunt * 0.35],
    ]
    size = spline(points, count)[:, 0]
    form = ring_of(m.u(1.7, 2.5), sides)
    rings = np.empty((count, sides, 3))
    rings[..., 0] = form[None, :, 0] * wide * size[:, None] ** 1.2
    rings[..., 1] = form[None, :, 1] * tall * size[:, None] + (bow * (2 * z) ** 2 * 0.3)[:, None]
    rings[..., 2] = z[:, None]
    parts = Parts(m)
    parts.add(loft(rings), skin)
    tip = xyz(0, bow * 1.2, -0.55)
    form = [(0.12, 0), (-0.1, 0.34), (-0.28, 0.38), (-0.16, 0), (-0.28, -0.38), (-0.1, -0.34)]
    form = np.array(form) * m.u(0.6, 1.1)
    level = m.chance(0.4)
    tail = slab(form[::1], 0.04, 0.015, 2).rotate([0, -90, 0])
    tail = tail.rotate([0, 0, 90]) if level else tail
    parts.add(tail, fin, at=tip)
    blade = np.array([(-0.15, 0), (0.2, 0), (0.02, 0.2), (-0.12, 0.26)]) * m.u(0.6, 1.3)
    top = (
        slab(blade, 0.03, 0.01, 2).rotate([0, -90, 0]).translate([0, 0.85 * tall, m.u(-0.1, 0.15)])
    )
    parts.add(top, fin)
    side = slab(blade, 0.03, 0.01, 2).rotate([0, -90, 0])
    parts.pair(side, fin, turn=(0, 0, -m.u(70, 120)), at=(0.8 * wide, -0.2 * tall, 0.15))
    radii = xyz(wide * 0.9 * blunt**0.5, tall * 0.5, 0.16)
    parts += _eyes(m, xyz(0, 0, 0.3), radii, m.u(0.02, 0.045))
    return [p.rotate([0, m.pick(90, -90, m.u(-90, 90)), 0]) for p in [joined(parts)]]


def crawler(m: Maker) -> list[Manifold]:
    """Turtle, ladybird, beetle, crab or spider: a shell on many legs."""
    shell = m.pattern(
        "spotted checked dotted plain striped bricked", "toy leaf earth dark", contrast=0.6
    )
    skin = m.surface("leaf earth dark toy")
    wide, tall, long = m.u(0.25, 0.45), m.u(0.12, 0.35), m.u(0.3, 0.55)
    dome = ball([wide, tall, long], 40).trim_by_plane([0, 1, 0], -0.25 * tall)
    parts = Parts(m)
    parts.add(dome, shell)
    if m.chance(0.5):
        circle = ring_of(2, 12) * [wide, long]
        rim = tube(np.insert(circle, 1, 0, axis=1), 0.04, 10, 36, True)
        parts.add(rim, skin)
    r = m.u(0.1, 0.2)
    head = xyz(0, m.u(-0.02, 0.15), long + 0.6 * r)
    blend = Blend(0.04)
    radii = xyz(r, r * 0.9, r)
    blend.egg(head, radii, 0)
    blend.limb([[0, 0, long * 0.6], head], [r * 0.7, r * 0.6], 0)
    pairs = m.pick(2, 3, 3, 4)
    leg = m.u(0.025, 0.09)
    for z in np.linspace(-0.6, 0.65, pairs) * long:
        a = xyz(wide * 0.7, 0, z)
        out, bow = m.u(0.1, 0.3), m.u(0, 0.2)
        line = [a, a + [0.6 * out, bow, 0.3 * z], a + [out, -0.18, 0.5 * z]]
        blend.limb(line, [leg, leg, leg * 0.8], 0)
    if m.chance(0.5):
        line = [[0, 0, -long * 0.8], [0, m.u(-0.1, 0.1), -long - m.u(0.05, 0.3)]]
        blend.limb(line, [0.06, 0.015], 0)
    parts.append(m.blended(blend, (skin,)))
    parts += _eyes(m, head, radii, r * m.u(0.12, 0.25))
    if m.chance(0.3):
        line = head + [(0.05, 0.7 * r, 0.3 * r), (0.1, 1.5 * r, 0.8 * r), (0.2, 1.8 * r, 1.5 * r)]
        feeler = tube(line, [0.015, 0.012, 0.025], 8, 12)
        parts.pair(feeler, skin)
    return _turned(m, parts)


def snake(m: Maker) -> list[Manifold]:
    """A snake, worm or caterpillar."""
    skin = m.pattern("striped spotted checked furry dotted", "toy leaf earth", contrast=0.6)
    turns, count = m.u(0.5, 2), 7
    t = np.linspace(0, 1, count)
    side = m.u(0.15, 0.35) * np.sin(2 * math.pi * turns * t + m.u(0, 6))
    path = np.stack([side, 0.12 * t**6, t * m.u(0.6, 1.4)], -1)
    r = m.u(0.05, 0.13)
    body = tube(path, [0.015, r * 0.8, r, r, r * 0.8, r * m.u(0.9, 1.4), r * 0.7], 16, 60)
    head = path[-1]
    parts = Parts(m)
    parts.add(body, skin)
    for eye in _eyes(m, head * [0, 1, 1], xyz(r, r, r), 0.02):
        parts.append(eye.translate([float(head[0]), 0, 0]))
    return parts.turned(0, m.u(-90, 90))


def figure(m: Maker) -> list[Manifold]:
    """A doll, a hero, a soldier or a person, posed."""
    skin = m.painted(m.color("skin skin skin toy metal"))
    shirt, trousers = m.cloth("any"), m.cloth("dark any toy")
    boots = m.surface("dark leather toy")
    looks = (skin, shirt, trousers, boots)
    big = m.pick(m.u(0.09, 0.13), m.u(0.13, 0.22))
    broad, slim = m.u(0.1, 0.2), m.u(0.6, 1.2)
    leg, torso = m.u(0.3, 0.55), m.u(0.25, 0.38)
    bulk = m.u(0.045, 0.085)
    blend = Blend(m.u(0.015, 0.04))
    hip, neck = xyz(0, leg, 0), xyz(0, leg + torso, 0.0)
    line = [
        [0.25 * broad, leg + 0.03, 0],
        [0.5 * broad, leg + torso * 0.5, 0],
        [0.55 * broad, leg + torso * 0.8, 0],
    ]
    blend.limb(line, [bulk * 1.4, bulk * 1.2 * slim, bulk * 1.4], 1)
    head = neck + xyz(0, big * 0.95 + 0.02, 0.01)
    radii = xyz(big * m.u(0.8, 1), big * m.u(0.95, 1.2), big * m.u(0.85, 1))
    blend.limb([neck - [0, 0.03, 0], head], [bulk * 0.8, bulk * 0.8], 0)
    blend.egg(head, radii, 0)
    blend.egg(head + [0, -0.05 * big, radii[2]], (0.13 * big, 0.15 * big, 0.15 * big), 0)
    blend.symmetric = m.chance(0.4)
    for side in (1,) if blend.symmetric else (1, -1):
        flip = xyz(side, 1, 1)
        spread, swing = m.u(0.02, 0.16), m.u(-0.22, 0.22)
        knee = hip + xyz(0.5 * broad + spread * 0.5, -leg * 0.5, max(swing, 0) * 0.8 + 0.02)
        foot = xyz(0.5 * broad + spread, 0.05, swing * (1 if swing > 0 else 1.2))
        line = [(hip + [0.45 * broad, 0, 0]) * flip, knee * flip, foot * flip]
        blend.limb(line, [bulk * 1.3, bulk * 1.05, bulk * 0.8], 2)
        line = [foot * flip, (foot + [0.02, -0.02, m.u(0.07, 0.12)]) * flip]
        blend.limb(line, [bulk * 0.9, bulk * 0.8], 3)
        shoulder = neck + xyz(broad * 0.75 + bulk * 0.5, -0.06, 0)
        reach = m.u(0.15, 0.24)
        lift, ahead = m.u(-1.3, 1.1), m.u(-0.6, 1.2)
        elbow = shoulder + reach * xyz(math.cos(lift) * 0.9, math.sin(lift), 0.3 * math.sin(ahead))
        up = math.sin(lift + m.u(-0.5, 1.2)) * 0.8
        hand = elbow + reach * xyz(0.4 * math.cos(lift), up, math.sin(ahead))
        blend.limb([shoulder * flip, elbow * flip], [bulk, bulk * 0.8], 1)
        blend.limb([elbow * flip, hand * flip], [bulk * 0.75, bulk * 0.65], m.pick(0, 1))
        blend.egg(hand * flip, (bulk * 0.9, bulk * 0.9, bulk * 0.9), 0)
    blend.symmetric = True
    if m.chance(0.5):  # chest, belly or muscles
        blend.egg(
            (0.4 * broad, leg + torso * m.u(0.4, 0.75), 0.02),
            (broad * m.u(0.5, 0.9), torso * m.u(0.2, 0.4), bulk * m.u(1.2, 2.2)),
            1,
        )
    parts = Parts(m)
    parts.append(m.blended(blend, looks))
    parts += _eyes(m, head, radii, big * m.u(0.08, 0.16))
    top = m.n(0, 5)
    hair = m.surface("fur dark toy")
    if top <= 1:
        cut = ball(radii * m.u(1.06, 1.2)).translate((head + [0, 0.05 * big, -0.12 * big]).tolist())
        plane = np.array([0, 0.75, -0.65])
        level = float((head + [0, 0.15 * big, 0.2 * big]) @ plane)
        parts.add(cut.trim_by_plane(plane.tolist(), level), hair)
    elif top == 2:
        brim = m.u(1.1, 1.9)
        profile = [
            *((big * brim, 0), (big * brim, 0.08 * big), (big * 0.95, 0.1 * big)),
            *((big * m.u(0.5, 1), big * m.u(0.5, 1.4)), (0, big * 1.1)),
        ]
        hat = lathe(profile, 28)
        parts.add(hat, hair, at=head + [0, 0.55 * big, 0])
    elif top == 3:
        helmet = ball(radii * 1.15).trim_by_plane([0, 1, -0.4], float(head @ [0, 1, -0.4]))
        parts.add(helmet, m.surface("metal toy dark"))
    elif top == 4:  # long hair
        long = m.u(0.8, 2.2) * big
        line = head + big * np.array([(0, 0.7, -0.1), (0, 0.2, -0.75), (0, -long / big, -0.7)])
        thick = [0.8 * big, 0.85 * big, m.u(0.3, 0.8) * big]
        mane = tube(line, thick, 18, 14, flat=(1, 0.6 if m.chance(0.5) else 1))
        face = ball(radii * 0.97, 24).translate((head + [0, -0.12 * big, 0.25 * big]).tolist())
        parts.add(mane - face, hair)
    if m.chance(0.2):  # a skirt or a robe
        profile = [(m.u(0.15, 0.3), 0), (broad * 0.8, leg * m.u(0.6, 0.9)), (0, leg * 0.9)]
        robe = lathe(profile, 28).translate([0, leg - leg * m.u(0.4, 0.9), 0])
        parts.add(robe, m.cloth("any"))
    if m.chance(0.3):  # something in one hand
        look, grip = m.surface("metal wood toy"), hand * [1, 1, 1]
        line = [(0, -0.1, 0), (0, 0.15, 0), (0, m.u(0.3, 0.6), 0)]
        item = m.pick(
            tube(line, [0.02, 0.018, m.u(0.008, 0.03)], 10, 10, flat=(1, m.u(0.4, 2))),
            slab(ring_of(m.u(1.5, 4), 24) * m.u(0.08, 0.18), 0.03, 0.01, 2),
            ball(m.u(0.05, 0.12), 20),
            box(m.u(0.08, 0.2), m.u(0.08, 0.2), 0.05, 0.01),
        )
        parts.add(item, look, turn=(m.u(-20, 80), 0, 0), at=np.array(grip) + [0, 0, bulk])
    if m.chance(0.2):  # a cape
        wide = broad + bulk
        cape = box(2 * wide, leg * 0.5 + torso * 0.9, 0.02).refine_to_length(0.06)
        cape = cape.translate([0, leg + torso * 0.95 - (leg * 0.5 + torso * 0.9) / 2, -bulk * 1.8])
        flow = m.u(0.05, 0.35)
        low_end = leg + torso

        def hang(p: np.ndarray) -> np.ndarray:
            x, y, z = p.T
            fold = 0.015 * np.sin(30 * x) - flow * (low_end - y) ** 1.5
            return np.stack([x * (0.8 + 0.6 * (low_end - y)), y, z + fold], -1)

        parts.add(cape.warp_batch(hang), m.cloth("toy any"))
    if m.chance(0.25):  # a rucksack, or wings
        part = box(1.5 * broad, torso * 0.7, 0.12, 0.03)
        parts.add(part, m.surface(), at=(0, leg + torso * 0.6, -bulk - 0.07))
    if m.chance(0.3):  # a stand
        base = lathe([(0.25, 0), (0.25, 0.03)], 32).translate([0, -0.02, 0])
        parts.add(base, m.surface("dark earth white"))
    return parts


def block_figure(m: Maker) -> list[Manifold]:
    """A figure of blocks and rods, with a printed chest."""
    skin, second, dark = m.plain("skin toy"), m.surface("toy any"), m.plain("dark toy")
    w, h, d = m.u(0.22, 0.4), m.u(0.2, 0.4), m.u(0.12, 0.22)
    leg = m.u(0.12, 0.35)
    shirt = m.printed(m.pick("label", "front"), m.color("toy dark white"), sides=True)
    trunk = box(w, h, d, m.u(0, 0.03)).warp_batch(
        lambda p: np.stack([p[:, 0] * (1 - 0.4 * (p[:, 1] + h / 2)), p[:, 1], p[:, 2]], -1)
    )
    parts = Parts(m)
    parts.add(trunk, shirt, at=(0, leg + h / 2, 0))
    r = m.u(0.09, 0.17)
    head = m.pick(
        rod(r, 1.7 * r, 28, 0.3 * r),
        box(2 * r, 1.8 * r, 2 * r, m.u(0, 0.4) * r).translate([0, 0.9 * r, 0]),
        ball(r, 28).translate([0, 0.9 * r, 0]),
    )
    top = leg + h
    parts.add(head, skin, at=(0, top + 0.01, 0))
    parts.add(rod(0.5 * r, 0.05, 16), skin, at=(0, top - 0.02, 0))
    part = ball([0.12 * r, 0.16 * r, 0.1 * r], 12)
    parts.pair(part, m.painted(np.full(3, 0.04)), at=(0.4 * r, top + r * 1.1, r * 0.95))
    if m.chance(0.6):
        profile = [(1.6 * r, 0), (1.5 * r, 0.1 * r), (r, 0.2 * r), (0.8 * r, r)]
        hair = m.pick(
            rod(r * 1.08, 0.6 * r, 28, 0.2 * r),
            ball(r * 1.1, 28).trim_by_plane([0, 1, -0.3], 0.0),
            lathe(profile, 28),
        )
        parts.add(hair, m.surface("dark toy fur"), at=(0, top + 1.35 * r, 0))
    step = m.u(-40, 40) if m.chance(0.4) else 0.0
    for side in (1, -1):
        one = box(w * 0.44, leg, d * 0.9, m.u(0, 0.02)).translate([0, -leg / 2, 0]) + box(
            w * 0.44, 0.08, d * 1.3
        ).translate([0, -leg + 0.04, d * 0.2])
        parts.add(one, dark, turn=(step * side, 0, 0), at=(side * w * 0.24, leg + 0.01, 0))
        swing = m.u(-60, 120) if m.chance(0.5) else m.u(-10, 20)
        line = [(0, 0, 0), (side * 0.04, -h * 0.4, 0), (side * 0.05, -h * 0.75, 0.06)]
        arm = tube(line, 0.06, m.pick(12, ring_of(6, 12)), 12)
        hand = ring(0.04, 0.02, 16, 8).translate([side * 0.05, -h * 0.85, 0.08])
        hand += ball(0.045, 12).translate([side * 0.05, -h * 0.8, 0.07])
        whole = m.stamp(arm, second) + m.stamp(hand, skin)
        part = whole.rotate([-swing, 0, 0]).translate([side * (w * 0.45 + 0.03), top - 0.07, 0])
        parts.append(part)
    return parts.turned(0, m.u(-50, 50))
