"""Animals, dolls and figures."""

from __future__ import annotations

import math

import numpy as np
from manifold3d import Manifold

from .composition import turned_to
from .looks import Maker
from .solids import Blend, ball, both, extent, lathe, ripple, ring_of, slab, tube

Vec = np.ndarray


def _eyes(m: Maker, center: Vec, radii: Vec, size: float) -> list[Manifold]:
    """Two eyes on an egg that looks along z, and sometimes a nose."""
    side, up = m.u(0.35, 0.9), m.u(0.05, 0.5)
    ahead = math.sqrt(max(1 - side**2 - 0.8 * up**2, 0.05))
    place = center + radii * np.array([side, up, ahead]) / math.sqrt(side**2 + up**2 + ahead**2) * 0.98
    dark = m.painted(np.full(3, m.u(0.02, 0.15)) if m.chance(0.8) else m.color("toy"))
    eyes = []
    if m.chance(0.4):  # the white of the eye, and its pupil before it
        white = m.painted(np.full(3, m.u(0.85, 0.97)))
        eyes.append(both(m.stamp(ball(size * 1.5, 20).translate(place.tolist()), white)))
        ahead_of = place + np.array([0.15, 0.1, 1.0]) * size * 0.85
        eyes.append(both(m.stamp(ball(size * 0.8, 16).translate(ahead_of.tolist()), dark)))
    else:
        eyes.append(both(m.stamp(ball([size, size * m.u(1, 1.5), size], 20).translate(place.tolist()), dark)))
    return eyes


def _ears(m: Maker, blend: Blend, center: Vec, radii: Vec, look: int) -> None:
    """Ears of a kind into a blend: round, pointed, long or hanging; or none."""
    kind = m.n(0, 5)
    r = float(radii.mean())
    base = center + radii * np.array([m.u(0.5, 0.8), m.u(0.6, 0.8), 0])
    if kind == 0:
        blend.egg(base + [0.15 * r, 0.2 * r, 0], (0.42 * r, 0.42 * r, 0.16 * r), look)
    elif kind == 1:
        blend.limb([base, base + np.array([0.2, 0.7, 0]) * r], [0.28 * r, 0.04 * r], look)
    elif kind == 2:
        tall = m.u(0.8, 2.0)
        blend.limb([base, base + np.array([0.15, 0.5 * tall, -0.05]) * r, base + np.array([m.u(0.1, 0.6), tall, -0.1]) * r], [0.18 * r, 0.26 * r, 0.12 * r], look)
    elif kind == 3:
        blend.limb([base, base + np.array([0.4, 0.05, 0]) * r, base + np.array([0.6, -m.u(0.5, 1.1), 0.1]) * r], [0.15 * r, 0.2 * r, 0.25 * r], look)
    elif kind == 4:
        blend.egg(base + [0.5 * r, -0.2 * r, -0.1 * r], (m.u(0.6, 1.0) * r, m.u(0.6, 0.9) * r, 0.12 * r), look)


def _turned(m: Maker, parts: list[Manifold]) -> list[Manifold]:
    """Animals are shown from the front, from the side and between."""
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
    coat, second, third = m.fur(), m.fur(), m.surface("dark", "fur", "earth")
    stout, high = m.u(0.13, 0.32), m.u(0.12, 0.55)
    long = m.u(0.4, 0.65)
    blend = Blend(m.u(0.04, 0.12))
    hip, chest = np.array([0, high + stout, -long / 2]), np.array([0, high + stout + m.u(-0.05, 0.08), long / 2])
    arch = (hip + chest) / 2 + [0, m.u(-0.06, 0.08), 0]
    blend.limb([hip, arch, chest], [stout * m.u(0.8, 1.1), stout * m.u(0.85, 1.15), stout * m.u(0.9, 1.2)], 0)
    neck = m.u(0.1, 0.75) ** 1.5 * m.pick(1, 1, 1.8)
    r = m.u(0.11, 0.26) if neck < 0.5 else m.u(0.08, 0.14)
    lean = m.u(0.1, 1.2)
    head = chest + np.array([0, stout * 0.6 + neck * math.cos(lean), stout * 0.5 + neck * math.sin(lean) + 0.4 * r])
    thick = min(r * m.u(0.6, 0.95), stout)
    blend.limb([chest, (chest + head) / 2 + [0, m.u(-0.02, 0.05), m.u(-0.04, 0.04)], head], [stout * 0.7, thick, thick], 0)
    radii = np.array([r, r * m.u(0.8, 1.05), r * m.u(0.9, 1.2)])
    blend.egg(head, radii, 0)
    kind = m.n(0, 3)
    snout = m.u(0.4, 1.4) * r
    tip = head + np.array([0, -0.35 * r, 0.6 * r + snout])
    blend.limb([head + [0, -0.25 * r, 0.4 * r], tip], [0.6 * r, r * m.u(0.25, 0.5)], m.pick(0, 1))
    if kind == 0 and m.chance(0.4):  # a trunk
        blend.limb([tip, tip + [0, -2 * r, 0.5 * r], tip + [0, -2.6 * r, 1.2 * r]], [0.35 * r, 0.22 * r, 0.15 * r], 0)
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
            knee = np.array([side * wide * 1.05, high * 0.5, base[2] + swing * 0.6 + m.u(-0.04, 0.04)])
            foot = np.array([side * wide * 1.05, leg * paw * 0.8, base[2] + swing])
            blend.limb([top, knee, foot], [leg * 1.4, leg, leg * m.u(0.8, 1.0)], 0)
            blend.egg(foot + [0, -0.1 * leg, 0.35 * leg], (leg * paw, leg * paw * 0.8, leg * paw * 1.3), m.pick(1, 2) if m.chance(0.5) else 0)
    blend.symmetric = True
    tail = m.u(0.08, 0.8)
    up = m.u(-0.7, 1.2)
    end = hip + np.array([0, tail * math.sin(up), -stout * 0.7 - tail * math.cos(up)])
    fat = m.u(0.02, 0.09)
    blend.limb([hip + [0, 0.2 * stout, -0.6 * stout], (hip + end) / 2 + [0, m.u(-0.05, 0.1), -0.1], end], [fat * 1.5, fat, fat * m.u(0.3, 1.8)], m.pick(0, 0, 1))
    parts = [_knobbly(m, m.blended(blend, (coat, second, third)))]
    parts += _eyes(m, head, radii, r * m.u(0.09, 0.16))
    nose = m.painted(np.full(3, m.u(0.02, 0.2)))
    if m.chance(0.6):
        parts.append(m.stamp(ball([0.2 * r, 0.15 * r, 0.15 * r], 16).translate((tip + [0, 0.1 * r, 0.35 * r]).tolist()), nose))
    if m.chance(0.25):
        parts.append(_horns(m, head, r))
    if m.chance(0.2):
        parts.append(_crest(m, [hip, arch, chest], stout))
    if m.chance(0.15):  # a collar
        at = chest * 0.5 + head * 0.5
        collar = tube([(math.sin(a) * thick * 1.15, 0, math.cos(a) * thick * 1.15) for a in np.linspace(0, 2 * math.pi, 9)[:-1]], 0.02, 8, 28, True, flat=(1, 2))
        parts.append(m.stamp(turned_to(collar, head - chest, at), m.plain("toy")))
    return _turned(m, parts)


def _horns(m: Maker, head: Vec, r: float) -> Manifold:
    base = head + np.array([0.45, 0.75, 0]) * r
    curve = [base, base + np.array([m.u(0.1, 0.7), m.u(0.3, 0.7), 0]) * r, base + np.array([m.u(0, 0.9), m.u(0.6, 1.5), m.u(-0.5, 0.6)]) * r]
    return both(m.stamp(tube(curve, [0.16 * r, 0.12 * r, 0.02 * r], 10, 16), m.plain("white", "earth", "dark")))


def _crest(m: Maker, spine: list[Vec], stout: float) -> Manifold:
    """Plates along the back."""
    look, count, size = m.surface("toy", "earth"), m.n(5, 11), m.u(0.3, 0.7) * stout
    line = np.array(spine)
    plates = []
    for i, t in enumerate(np.linspace(0, 1, count)):
        at = np.array([np.interp(t, np.linspace(0, 1, len(line)), line[:, k]) for k in range(3)])
        h = size * (0.5 + math.sin(math.pi * t))
        form = ring_of(1.2, 16) * [h * 0.6, h]
        plate = slab(form, 0.25 * size, 0.1 * size, 2).rotate([0, 90, 0]).translate((at + [0, stout + 0.3 * h, 0]).tolist())
        plates.append(plate)
    made = plates[0]
    for plate in plates[1:]:
        made = made + plate
    return m.stamp(made, look)


def plush(m: Maker) -> list[Manifold]:
    """A stuffed animal or doll that sits, with a large head."""
    coat, second, third = m.fur(), m.fur(), m.fur()
    blend = Blend(m.u(0.02, 0.07))
    w, h = m.u(0.2, 0.36), m.u(0.24, 0.45)
    blend.egg((0, h, 0), (w, h, w * m.u(0.75, 1)), 0)
    if m.chance(0.6):  # a belly of another colour
        blend.egg((0, h * 0.9, w * 0.25), (w * 0.75, h * 0.75, w * 0.78), 1)
    r = m.u(0.2, 0.38)
    radii = np.array([r * m.u(0.95, 1.25), r * m.u(0.8, 1), r * m.u(0.8, 1)])
    head = np.array([0, 2 * h + radii[1] * 0.65, m.u(0, 0.08)])
    blend.egg(head, radii, 0)
    blend.egg(head + [0, -0.3 * r, radii[2] * 0.75], (r * m.u(0.3, 0.55), r * m.u(0.25, 0.4), r * m.u(0.25, 0.6)), m.pick(0, 1, 1))
    _ears(m, blend, head, radii, m.pick(0, 1))
    a = m.u(0.07, 0.14)
    down, out, ahead = m.u(-0.3, 0.15), m.u(0.1, 0.4), m.u(-0.02, 0.3)
    shoulder = np.array([w * 0.75, 1.55 * h, 0])
    blend.limb([shoulder, shoulder + [out * 0.6, down * 0.4, ahead * 0.4], shoulder + [out, down, ahead]], [a, a * 0.95, a * m.u(0.8, 1.3)], m.pick(0, 2))
    leg = m.u(0.09, 0.16)
    if m.chance(0.6):
        foot = np.array([w * m.u(0.7, 1.3), leg, w + m.u(0.1, 0.35)])
    else:
        foot = np.array([w * m.u(0.5, 0.8), -m.u(0.1, 0.5), 0.05])
    blend.limb([[w * 0.55, 0.35 * h, 0.1], foot], [leg * 1.1, leg], 0)
    blend.egg(foot + [0, 0.25 * leg, 0.25 * leg], (leg * 1.15, leg * m.u(1.1, 1.6), leg * 0.8), m.pick(0, 1, 2))
    if m.chance(0.5):
        tail = np.array([0, 0.3 * h, -w])
        blend.limb([tail, tail + [0, m.u(-0.1, 0.4), -m.u(0.05, 0.3)]], [m.u(0.04, 0.1), m.u(0.03, 0.12)], m.pick(0, 1))
    parts = [m.blended(blend, (coat, second, third))]
    parts += _eyes(m, head, radii, r * m.u(0.07, 0.13))
    nose = head + [0, -0.15 * r, radii[2] + 0.15 * r]
    parts.append(m.stamp(ball([0.16 * r, 0.12 * r, 0.12 * r], 16).translate(nose.tolist()), m.plain("dark", "toy")))
    if m.chance(0.3):  # a bow tie or a scarf
        y = 2 * h - 0.02
        loop = tube([(math.sin(t) * w * 0.75, y, math.cos(t) * w * 0.75) for t in np.linspace(0, 2 * math.pi, 9)[:-1]], m.u(0.03, 0.06), 10, 28, True)
        parts.append(m.stamp(loop, m.cloth("toy", "any")))
    if m.chance(0.6):
        return parts
    return _turned(m, parts)


def biped(m: Maker) -> list[Manifold]:
    """A dinosaur, kangaroo or dragon on two legs, with a long tail."""
    skin, second, third = m.pattern(("spotted", "clouded", "striped", "speckled", "plain"), "toy", "earth", "leaf", contrast=0.4), m.surface("earth", "toy"), m.surface("dark", "white")
    blend = Blend(m.u(0.04, 0.1))
    hip = np.array([0, m.u(0.35, 0.6), 0.0])
    stout, lean = m.u(0.14, 0.24), m.u(0.2, 1.1)
    chest = hip + np.array([0, 0.4 * math.cos(lean), 0.4 * math.sin(lean)])
    blend.limb([hip, chest], [stout, stout * m.u(0.7, 1)], 0)
    blend.egg((hip + chest) / 2 + [0, -0.03, 0.06], (stout * 0.8, stout, stout * 0.9), 1)
    neck = chest + np.array([0, m.u(0.1, 0.35), m.u(0.05, 0.2)])
    blend.limb([chest, neck], [stout * 0.7, stout * 0.5], 0)
    r = m.u(0.1, 0.18)
    radii = np.array([r * 0.85, r * 0.9, r])
    blend.egg(neck + [0, 0.3 * r, 0.3 * r], radii, 0)
    head = neck + np.array([0, 0.3 * r, 0.3 * r])
    jaw = m.u(1.0, 2.4) * r
    blend.limb([head + [0, -0.1 * r, 0.4 * r], head + [0, -0.25 * r, jaw]], [0.6 * r, m.u(0.25, 0.45) * r], 0)
    if m.chance(0.6):
        blend.limb([head + [0, -0.55 * r, 0.2 * r], head + [0, -m.u(0.6, 1.1) * r, jaw * 0.9]], [0.35 * r, 0.22 * r], 1)
    tail = m.u(0.5, 1.2)
    blend.limb([hip, hip + [0, -0.1, -0.45 * tail], hip + [0, m.u(-0.3, 0.2), -tail]], [stout * 0.85, stout * 0.45, 0.02], 0)
    leg = stout * m.u(0.5, 0.75)
    knee = np.array([stout * 0.8, hip[1] * 0.55, m.u(0.05, 0.2)])
    ankle = np.array([stout * 0.85, hip[1] * 0.22, -0.06])
    blend.limb([hip + [stout * 0.6, 0, 0], knee, ankle], [leg, leg * 0.75, leg * 0.4], 0)
    blend.limb([ankle, [stout * 0.9, 0.04, m.u(0.08, 0.2)]], [leg * 0.4, leg * m.u(0.4, 0.6)], 2)
    arm = chest + np.array([stout * 0.7, -0.02, 0.08])
    blend.limb([arm, arm + [0.05, -0.13, 0.08], arm + [0.02, -m.u(0.1, 0.25), 0.2]], [0.05, 0.035, 0.03], 0)
    parts = [_knobbly(m, m.blended(blend, (skin, second, third)))]
    parts += _eyes(m, head, radii, r * m.u(0.1, 0.18))
    if m.chance(0.4):
        parts.append(_crest(m, [hip + [0, -0.05, -0.45 * tail], hip, chest], stout * 0.9))
    if m.chance(0.2):
        parts.append(_wings(m, chest, stout))
    return _turned(m, parts)


def _wings(m: Maker, at: Vec, size: float) -> Manifold:
    long, deep = m.u(2.0, 4.0) * size, m.u(1, 2) * size
    form = np.array([(0, -0.3), (0.5, -0.5), (1, -0.35), (1.05, 0.0), (0.6, 0.5), (0, 0.45)]) * [long, deep]
    wing = slab(form, 0.15 * size, 0.03 * size, 2).rotate([90, 0, 0]).rotate([0, 0, m.u(-20, 50)])
    return both(m.stamp(wing.translate((at + [0.3 * size, 0.3 * size, -0.3 * size]).tolist()), m.surface("toy", "any")))


def bird(m: Maker) -> list[Manifold]:
    """Duck, penguin, parrot, chick or owl."""
    coat, second, third = m.fur("toy", "fur", "pastel", "dark"), m.fur("white", "any"), m.surface("toy", "earth")
    upright = m.u(0, 1.3)
    blend = Blend(m.u(0.03, 0.1))
    r = m.u(0.22, 0.35)
    body = np.array([0, r + 0.05, 0])
    blend.egg(body, (r * m.u(0.7, 1), r * m.u(0.75, 1), r * m.u(1.0, 1.5)), 0, -upright)
    blend.egg(body + [0, -0.03, 0.12 * r], (r * 0.75, r * 0.8, r * 1.05), 1, -upright)
    h = r * m.u(0.45, 0.8)
    head = body + np.array([0, r * m.u(0.9, 1.5), r * m.u(0.2, 0.8)])
    blend.limb([body + [0, 0.3 * r, 0.3 * r], head], [0.6 * r, h * 0.75], 0)
    radii = np.array([h, h, h])
    blend.egg(head, radii, m.pick(0, 0, 1))
    wing = body + np.array([r * 0.8, 0.15 * r, -0.1 * r])
    blend.egg(wing, (0.12 * r, 0.5 * r, m.u(0.7, 1.1) * r), m.pick(0, 2), m.u(-1, 0.2))
    tail = body + np.array([0, m.u(-0.5, 0.5) * r, -r * m.u(1.3, 2)])
    blend.limb([body + [0, 0, -0.6 * r], tail], [0.4 * r, 0.08 * r], 0)
    parts = [m.blended(blend, (coat, second, third))]
    parts += _eyes(m, head, radii, h * m.u(0.1, 0.2))
    beak = lathe([(0, 0), (h * m.u(0.25, 0.5), 0), (h * 0.25, h * 0.3), (0.02 * h, h * m.u(0.5, 1.2)), (0, h * 1.2)], 16).scale([1, 1, m.u(0.4, 1)])
    parts.append(m.stamp(beak.rotate([90 + m.u(-5, 25), 0, 0]).translate((head + [0, -0.1 * h, 0.85 * h]).tolist()), third))
    if m.chance(0.7):
        foot = tube([(0.3 * r, 0.1, 0), (0.32 * r, 0.0, 0.0), (0.36 * r, -0.06, 0.15 * r), (0.4 * r, -0.06, 0.5 * r)], [0.03, 0.03, 0.05, 0.06], 8, 14, flat=(1, 1))
        parts.append(both(m.stamp(foot, third)))
    return _turned(m, parts)


def swimmer(m: Maker) -> list[Manifold]:
    """Fish, shark, whale or dolphin."""
    skin, fin = m.pattern(("spotted", "striped", "plain", "clouded", "shaded"), "toy", "metal", "pastel", contrast=0.5), m.surface("toy", "any")
    tall, wide = m.u(0.15, 0.4), m.u(0.1, 0.28)
    blend = Blend(0.05)
    z = np.linspace(-0.5, 0.5, 6)
    size = np.array([0.18, 0.5, 0.85, 1.0, m.u(0.8, 1), m.u(0.3, 0.7)])
    bow = m.u(-0.12, 0.12)
    for a, s in zip(z, size):
        blend.egg((0, bow * (a * 4) ** 2 * 0.3, a), (wide * s, tall * s, 0.2), 0)
    parts = [m.blended(blend, (skin,))]
    tip = np.array([0, bow * 1.2, -0.55])
    form = np.array([(0.12, 0), (-0.1, 0.34), (-0.28, 0.38), (-0.16, 0), (-0.28, -0.38), (-0.1, -0.34)]) * m.u(0.6, 1.1)
    level = m.chance(0.4)
    tail = slab(form[::1], 0.04, 0.015, 2).rotate([0, -90, 0])
    tail = tail.rotate([0, 0, 90]) if level else tail
    parts.append(m.stamp(tail.translate(tip.tolist()), fin))
    blade = np.array([(-0.15, 0), (0.2, 0), (0.02, 0.2), (-0.12, 0.26)]) * m.u(0.6, 1.3)
    top = slab(blade, 0.03, 0.01, 2).rotate([0, -90, 0]).translate([0, 0.85 * tall, m.u(-0.1, 0.15)])
    parts.append(m.stamp(top, fin))
    side = slab(blade, 0.03, 0.01, 2).rotate([0, -90, 0]).rotate([0, 0, -m.u(70, 120)]).translate([0.8 * wide, -0.2 * tall, 0.15])
    parts.append(both(m.stamp(side, fin)))
    parts += _eyes(m, np.array([0, 0.0, 0.45]), np.array([wide * 0.75, tall * 0.6, 0.2]), m.u(0.02, 0.045))
    return [p.rotate([0, m.pick(90, -90, m.u(-90, 90)), 0]) for p in [joined_parts(parts)]]


def joined_parts(parts: list[Manifold]) -> Manifold:
    """The union of parts, to be turned as one."""
    from .solids import joined

    return joined(parts)


def crawler(m: Maker) -> list[Manifold]:
    """Turtle, ladybird, beetle, crab or spider: a shell on many legs."""
    shell, skin = m.pattern(("spotted", "checked", "dotted", "plain", "striped", "bricked"), "toy", "leaf", "earth", "dark", contrast=0.6), m.surface("leaf", "earth", "dark", "toy")
    wide, tall, long = m.u(0.25, 0.45), m.u(0.12, 0.35), m.u(0.3, 0.55)
    dome = ball([wide, tall, long], 40).trim_by_plane([0, 1, 0], -0.25 * tall)
    parts = [m.stamp(dome, shell)]
    if m.chance(0.5):
        rim = tube([(math.sin(t) * wide, 0, math.cos(t) * long) for t in np.linspace(0, 2 * math.pi, 13)[:-1]], 0.04, 10, 36, True)
        parts.append(m.stamp(rim, skin))
    r = m.u(0.1, 0.2)
    head = np.array([0, m.u(-0.02, 0.15), long + 0.6 * r])
    blend = Blend(0.04)
    radii = np.array([r, r * 0.9, r])
    blend.egg(head, radii, 0)
    blend.limb([[0, 0, long * 0.6], head], [r * 0.7, r * 0.6], 0)
    pairs = m.pick(2, 3, 3, 4)
    leg = m.u(0.025, 0.09)
    for z in np.linspace(-0.6, 0.65, pairs) * long:
        a = np.array([wide * 0.7, 0, z])
        out, bow = m.u(0.1, 0.3), m.u(0, 0.2)
        blend.limb([a, a + [0.6 * out, bow, 0.3 * z], a + [out, -0.18, 0.5 * z]], [leg, leg, leg * 0.8], 0)
    if m.chance(0.5):
        blend.limb([[0, 0, -long * 0.8], [0, m.u(-0.1, 0.1), -long - m.u(0.05, 0.3)]], [0.06, 0.015], 0)
    parts.append(m.blended(blend, (skin,)))
    parts += _eyes(m, head, radii, r * m.u(0.12, 0.25))
    if m.chance(0.3):
        feeler = tube([head + [0.05, 0.7 * r, 0.3 * r], head + [0.1, 1.5 * r, 0.8 * r], head + [0.2, 1.8 * r, 1.5 * r]], [0.015, 0.012, 0.025], 8, 12)
        parts.append(both(m.stamp(feeler, skin)))
    return _turned(m, parts)


def snake(m: Maker) -> list[Manifold]:
    """A snake, worm or caterpillar."""
    skin = m.pattern(("striped", "spotted", "checked", "furry", "dotted"), "toy", "leaf", "earth", contrast=0.6)
    turns, count = m.u(0.5, 2), 7
    t = np.linspace(0, 1, count)
    path = np.stack([m.u(0.15, 0.35) * np.sin(2 * math.pi * turns * t + m.u(0, 6)), 0.12 * t**6, t * m.u(0.6, 1.4)], -1)
    r = m.u(0.05, 0.13)
    body = tube(path, [0.015, r * 0.8, r, r, r * 0.8, r * m.u(0.9, 1.4), r * 0.7], 16, 60)
    head = path[-1]
    return [joined_parts([m.stamp(body, skin), *[e.translate([float(head[0]), 0, 0]) for e in _eyes(m, head * [0, 1, 1], np.array([r, r, r]), 0.02)]]).rotate([0, m.u(-90, 90), 0])]


def figure(m: Maker) -> list[Manifold]:
    """A doll, a hero, a soldier or a person, posed."""
    skin = m.painted(m.color("skin", "skin", "skin", "toy", "metal"))
    shirt, trousers, boots = m.cloth("any"), m.cloth("dark", "any", "toy"), m.surface("dark", "leather", "toy")
    looks = (skin, shirt, trousers, boots)
    big = m.pick(m.u(0.09, 0.13), m.u(0.13, 0.22))
    broad, slim = m.u(0.1, 0.2), m.u(0.6, 1.2)
    leg, torso = m.u(0.3, 0.55), m.u(0.25, 0.38)
    bulk = m.u(0.045, 0.085)
    blend = Blend(m.u(0.015, 0.04))
    hip, neck = np.array([0, leg, 0]), np.array([0, leg + torso, 0.0])
    blend.limb([[0.25 * broad, leg + 0.03, 0], [0.5 * broad, leg + torso * 0.5, 0], [0.55 * broad, leg + torso * 0.8, 0]], [bulk * 1.4, bulk * 1.2 * slim, bulk * 1.4], 1)
    head = neck + np.array([0, big * 0.95 + 0.02, 0.01])
    radii = np.array([big * m.u(0.8, 1), big * m.u(0.95, 1.2), big * m.u(0.85, 1)])
    blend.limb([neck - [0, 0.03, 0], head], [bulk * 0.8, bulk * 0.8], 0)
    blend.egg(head, radii, 0)
    blend.egg(head + [0, -0.05 * big, radii[2]], (0.13 * big, 0.15 * big, 0.15 * big), 0)
    blend.symmetric = m.chance(0.4)
    for side in (1,) if blend.symmetric else (1, -1):
        flip = np.array([side, 1, 1])
        spread, swing = m.u(0.02, 0.16), m.u(-0.22, 0.22)
        knee = hip + np.array([0.5 * broad + spread * 0.5, -leg * 0.5, max(swing, 0) * 0.8 + 0.02])
        foot = np.array([0.5 * broad + spread, 0.05, swing * (1 if swing > 0 else 1.2)])
        blend.limb([(hip + [0.45 * broad, 0, 0]) * flip, knee * flip, foot * flip], [bulk * 1.3, bulk * 1.05, bulk * 0.8], 2)
        blend.limb([foot * flip, (foot + [0.02, -0.02, m.u(0.07, 0.12)]) * flip], [bulk * 0.9, bulk * 0.8], 3)
        shoulder = neck + np.array([broad * 0.75 + bulk * 0.5, -0.06, 0])
        reach = m.u(0.15, 0.24)
        lift, ahead = m.u(-1.3, 1.1), m.u(-0.6, 1.2)
        elbow = shoulder + reach * np.array([math.cos(lift) * 0.9, math.sin(lift), 0.3 * math.sin(ahead)])
        hand = elbow + reach * np.array([0.4 * math.cos(lift), math.sin(lift + m.u(-0.5, 1.2)) * 0.8, math.sin(ahead)])
        blend.limb([shoulder * flip, elbow * flip], [bulk, bulk * 0.8], 1)
        blend.limb([elbow * flip, hand * flip], [bulk * 0.75, bulk * 0.65], m.pick(0, 1))
        blend.egg(hand * flip, (bulk * 0.9, bulk * 0.9, bulk * 0.9), 0)
    blend.symmetric = True
    parts = [m.blended(blend, looks)]
    parts += _eyes(m, head, radii, big * m.u(0.08, 0.16))
    top = m.n(0, 4)
    hair = m.surface("fur", "dark", "toy")
    if top <= 1:
        cut = ball((radii * m.u(1.06, 1.2)).tolist(), 32).translate((head + [0, 0.05 * big, -0.12 * big]).tolist())
        cut = cut.trim_by_plane([0, 0.75, -0.65], float((head + [0, 0.15 * big, 0.2 * big]) @ [0, 0.75, -0.65]))
        parts.append(m.stamp(cut, hair))
    elif top == 2:
        brim = m.u(1.1, 1.9)
        hat = lathe([(0, 0), (big * brim, 0), (big * brim, 0.08 * big), (big * 0.95, 0.1 * big), (big * m.u(0.5, 1), big * m.u(0.5, 1.4)), (0, big * 1.1)], 28)
        parts.append(m.stamp(hat.translate((head + [0, 0.55 * big, 0]).tolist()), hair))
    elif top == 3:
        helmet = ball((radii * 1.15).tolist(), 32).trim_by_plane([0, 1, -0.4], float(head @ [0, 1, -0.4]))
        parts.append(m.stamp(helmet, m.surface("metal", "toy", "dark")))
    if m.chance(0.2):  # a skirt or a robe
        robe = lathe([(0, 0), (m.u(0.15, 0.3), 0), (broad * 0.8, leg * m.u(0.6, 0.9)), (0, leg * 0.9)], 28).translate([0, leg - leg * m.u(0.4, 0.9), 0])
        parts.append(m.stamp(robe, m.cloth("any")))
    if m.chance(0.3):  # a stand
        base = lathe([(0, 0), (0.25, 0), (0.25, 0.03), (0, 0.03)], 32).translate([0, -0.02, 0])
        parts.append(m.stamp(base, m.surface("dark", "earth", "white")))
    return parts


CREATURES = (
    *((quadruped, 4.0), (plush, 4.0), (biped, 2.0), (bird, 1.5), (swimmer, 1.2), (crawler, 1.2)),
    *((snake, 0.5), (figure, 4.0)),
)
