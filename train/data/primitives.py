"""Objects made of simple solids with made-up textures: more to train on, free of anybody's rights.

Each object is drawn from its seed and number alone. Seven in ten follow a plan (table, chair,
shelf, lamp, vase, cabinet, bed, bottle), the others are solids put together at random, most of them
the same on the left and on the right. y is up, as in every ``.glb``; the front looks along z.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from gamba_warp.batch import progress_bar
from gamba_warp.data.dataset import split_of
from gamba_warp.errors import UserError
from gamba_warp.files import atomic_path, output_folder, write_json
from gamba_warp.formats.catalogue import CATALOGUE

TEXTURE = 128  # pixels a side of a texture
GROUP = "primitives"  # all are of one group, so that all lie in one part of a split: train
ATTRIBUTION = {"creator": "made by gamba data primitives", "licence": "CC0 1.0", "source": ""}
assert split_of(GROUP) == "train"

# A solid and the number of its material.
Part = tuple[trimesh.Trimesh, int]
Point = tuple[float, float, float]
# Of the mix of two colours, ``[TEXTURE, TEXTURE]`` in [0, 1].
Pattern = Callable[[np.random.Generator], np.ndarray]
_U, _V = np.meshgrid(*[(np.arange(TEXTURE) + 0.5) / TEXTURE] * 2)


def make_primitives(out: Path, count: int, seed: int) -> None:
    """Writes the objects as ``.glb`` files, with their ``catalogue.json``.

    Args:
        out: folder for the files; one with another catalogue is refused.
        count: number of objects.
        seed: seed of all of them.

    Raises:
        UserError: the folder has a catalogue of other objects, or cannot be written.
    """
    out = output_folder(out)
    ours = all(path.name.startswith("primitive-") for path in out.glob("*.glb"))
    if (out / CATALOGUE).exists() and not ours:
        raise UserError(f"{out / CATALOGUE}: there are other objects; choose another --out")
    entries = []
    for number in progress_bar(range(count), unit="object"):
        uid = f"primitive-{seed}-{number:05d}"
        entry = {"model": f"{uid}.glb", "uid": uid, "name": uid.replace("-", " ")}
        entries.append({**entry, "group": GROUP, "attribution": ATTRIBUTION})
        if (out / f"{uid}.glb").exists():
            continue
        scene = make_object(np.random.default_rng([seed, number]))
        with atomic_path(out / f"{uid}.glb") as temporary:
            temporary.write_bytes(export_glb(scene))
    write_json(out / CATALOGUE, {"objects": entries})


def make_object(rng: np.random.Generator) -> trimesh.Scene:
    """Draws one object.

    Args:
        rng: source of chance.

    Returns:
        The object, y up, of any size and place.
    """
    plan = PLANS[rng.integers(len(PLANS))] if rng.random() < 0.7 else composition
    materials = [_material(rng) for _ in range(3)]
    scene = trimesh.Scene()
    for solid, number in plan(rng):
        scene.add_geometry(_dressed(solid, materials[number], float(rng.uniform(0.7, 2.5))))
    return scene


def _dressed(solid: trimesh.Trimesh, material: PBRMaterial, repeats: float) -> trimesh.Trimesh:
    """The solid with a texture laid on from the side that each face looks to."""
    normals = np.repeat(solid.face_normals, 3, axis=0)
    smooth = solid.vertex_normals[solid.faces].reshape(-1, 3)
    points = solid.vertices[solid.faces].reshape(-1, 3)
    across = np.array([[2, 1], [0, 2], [0, 1]])[np.abs(normals).argmax(1)]
    uv = np.take_along_axis(points, across, 1) * repeats
    edged = (normals * smooth).sum(1) < 0.8  # an edge of a box stays one
    made = trimesh.Trimesh(
        vertices=points,
        faces=np.arange(len(points)).reshape(-1, 3),
        vertex_normals=np.where(edged[:, None], normals, smooth),
        process=False,
    )
    made.visual = TextureVisuals(uv=uv, material=material)
    return made


def _material(rng: np.random.Generator) -> PBRMaterial:
    """A texture of two colours, or one colour."""
    first, second = _color(rng), _color(rng)
    if rng.random() < 0.5:  # most things are shades of one colour
        second = np.clip(first * rng.uniform(0.5, 1.5), 0, 1)
    mix = PATTERNS[rng.integers(len(PATTERNS))](rng)[..., None]
    pixels = np.rint(255 * (first * (1 - mix) + second * mix)).astype(np.uint8)
    return PBRMaterial(baseColorTexture=Image.fromarray(pixels), metallicFactor=0.0)


def _color(rng: np.random.Generator) -> np.ndarray:
    """A display colour ``[3]``: brown or grey as often as any other."""
    if rng.random() < 0.5:
        base = np.array([0.55, 0.38, 0.24]) if rng.random() < 0.5 else np.full(3, 0.6)
        return np.clip(base * rng.uniform(0.3, 1.5) + rng.uniform(-0.05, 0.05, 3), 0, 1)
    return rng.uniform(0.05, 0.95, 3)


def flat(rng: np.random.Generator) -> np.ndarray:
    """The first colour alone."""
    return np.zeros_like(_U)


def checked(rng: np.random.Generator) -> np.ndarray:
    """A chessboard."""
    count = 2 * rng.integers(1, 5)
    return (np.floor(count * _U) + np.floor(count * _V)) % 2


def striped(rng: np.random.Generator) -> np.ndarray:
    """Stripes along one side."""
    across, share = _U if rng.random() < 0.5 else _V, rng.uniform(0.1, 0.6)
    return ((across * rng.integers(1, 9)) % 1 < share).astype(float)


def dotted(rng: np.random.Generator) -> np.ndarray:
    """Dots in rows."""
    count = rng.integers(1, 6)
    x, y = (_U * count) % 1 - 0.5, (_V * count) % 1 - 0.5
    return (x**2 + y**2 < rng.uniform(0.02, 0.16)).astype(float)


def clouded(rng: np.random.Generator, stretch: int = 1) -> np.ndarray:
    """Smooth noise, the sum of four sizes of waves, without a seam."""
    total = np.zeros((TEXTURE, TEXTURE))
    for level in range(2, 6):
        coarse = rng.random((2**level, max(1, 2**level // stretch)), dtype=np.float32)
        wrapped = np.pad(coarse, 2, mode="wrap")
        box = (2, 2, wrapped.shape[1] - 2, wrapped.shape[0] - 2)
        bicubic = Image.Resampling.BICUBIC
        finer = Image.fromarray(wrapped).resize((TEXTURE, TEXTURE), bicubic, box)
        total += np.asarray(finer) / 2**level
    return (total - total.min()) / np.ptp(total)


def grained(rng: np.random.Generator) -> np.ndarray:
    """The grain of wood."""
    return clouded(rng, 8)


def bricked(rng: np.random.Generator) -> np.ndarray:
    """A wall."""
    rows = rng.integers(2, 7)
    shifted = _U * rows / 2 + 0.5 * (np.floor(_V * rows) % 2)
    return np.maximum((_V * rows) % 1 < 0.12, shifted % 1 < 0.06).astype(float)


PATTERNS: list[Pattern] = [
    *(flat, flat, checked, striped, dotted, clouded, grained, grained, bricked)
]


def _box(material: int, size: Point, at: Point) -> Part:
    """A box by its sides and its centre."""
    solid = trimesh.creation.box(extents=size)
    solid.apply_translation(at)
    return solid, material


def _turned(material: int, profile: list[tuple[float, float]], at: Point, sides: int = 24) -> Part:
    """A solid of revolution about y, by points (radius, height) from below; ``at`` is its foot."""
    points = np.maximum(np.array(profile, dtype=float), [1e-4, -np.inf])
    solid = trimesh.creation.revolve(points, sections=sides)
    solid.apply_transform(trimesh.transformations.rotation_matrix(-math.pi / 2, [1, 0, 0]))
    solid.apply_translation(at)
    return solid, material


def _post(material: int, radius: float, height: float, at: Point, sides: int) -> Part:
    return _turned(material, [(0, 0), (radius, 0), (radius, height), (0, height)], at, sides)


def _legs(rng: np.random.Generator, width: float, deep: float, height: float) -> list[Part]:
    """Four legs below a rectangle in the plane y = height."""
    radius, sides = rng.uniform(0.02, 0.05), int(rng.choice([4, 16]))
    x, z = width / 2 - radius, deep / 2 - radius
    places = [(sx * x, 0.0, sz * z) for sx in (-1, 1) for sz in (-1, 1)]
    return [_post(1, radius, height, place, sides) for place in places]


def _sizes(rng: np.random.Generator, *ranges: tuple[float, float]) -> list[float]:
    return [rng.uniform(*limits) for limits in ranges]


def table(rng: np.random.Generator) -> list[Part]:
    """A table with four legs, or round on one foot."""
    width, deep, height, thick = _sizes(rng, (0.5, 1.4), (0.4, 1.0), (0.3, 0.9), (0.02, 0.08))
    if rng.random() < 0.4:  # a round one, on one foot
        foot = [(0, 0), (0.25, 0), (0.25, 0.03), (0.04, 0.06), (0.04, height), (0, height)]
        return [_turned(1, foot, (0, 0, 0)), _post(0, width / 2, thick, (0, height, 0), 32)]
    top = _box(0, (width, thick, deep), (0, height + thick / 2, 0))
    return [top, *_legs(rng, width, deep, height)]


def chair(rng: np.random.Generator) -> list[Part]:
    """A chair, a bench or an armchair."""
    width, deep, height = _sizes(rng, (0.4, 0.9), (0.4, 0.7), (0.25, 0.5))
    thick, back = _sizes(rng, (0.04, 0.2), (0.25, 0.6))
    parts = [_box(0, (width, thick, deep), (0, height + thick / 2, 0))]
    parts += _legs(rng, width, deep, height)
    depth = rng.uniform(0.03, 0.15)
    seat, rear = height + thick, -deep / 2 + depth / 2
    if rng.random() < 0.5:
        parts.append(_box(0, (width, back, depth), (0.0, seat + back / 2, rear)))
    else:
        for x in np.linspace(-width / 2 + 0.03, width / 2 - 0.03, rng.integers(2, 6)):
            parts.append(_box(1, (0.04, back, 0.04), (float(x), seat + back / 2, rear)))
        parts.append(_box(0, (width, 0.08, 0.05), (0.0, seat + back, rear)))
    if rng.random() < 0.4:
        arm = rng.uniform(0.12, 0.25)
        for side in (-1, 1):
            parts.append(_box(2, (0.06, arm, deep), (side * width / 2, seat + arm / 2, 0.0)))
    return parts


def shelf(rng: np.random.Generator) -> list[Part]:
    """Boards between two sides, with things on them."""
    width, height, deep, thick = _sizes(rng, (0.4, 1.2), (0.5, 1.8), (0.2, 0.4), (0.02, 0.05))
    sides = [(side * width / 2, height / 2, 0) for side in (-1, 1)]
    parts = [_box(0, (thick, height, deep), place) for place in sides]
    if rng.random() < 0.7:
        parts.append(_box(1, (width, height, 0.02), (0, height / 2, -deep / 2)))
    levels = np.linspace(thick / 2, height - thick / 2, rng.integers(2, 7))
    for low, high in zip(levels, [*levels[1:], height]):
        parts.append(_box(0, (width, thick, deep), (0, float(low), 0)))
        if high - low > 0.15 and rng.random() < 0.6:  # something on the board
            tall = float(rng.uniform(0.4, 0.9) * (high - low))
            place = (rng.uniform(-0.25, 0.25) * width, low + thick / 2 + tall / 2, 0.0)
            parts.append(_box(2, (rng.uniform(0.1, 0.4) * width, tall, 0.7 * deep), place))
    return parts


def lamp(rng: np.random.Generator) -> list[Part]:
    """A shade on a stand."""
    height, foot = _sizes(rng, (0.3, 1.6), (0.08, 0.2))
    low, high, tall = _sizes(rng, (0.12, 0.3), (0.04, 0.2), (0.12, 0.3))
    stand = [(0, 0), (foot, 0), (foot, 0.03), (0.02, 0.05), (0.015, height), (0, height)]
    shade = [(0, 0), (low, 0), (high, tall), (0, tall)]
    return [_turned(1, stand, (0, 0, 0)), _turned(0, shade, (0, height - tall / 2, 0))]


def vase(rng: np.random.Generator) -> list[Part]:
    """A vase, sometimes with a ball of leaves."""
    heights = np.linspace(0, rng.uniform(0.5, 1.5), 12)
    bend = np.interp(np.arange(12), np.linspace(0, 11, 5), rng.uniform(0.08, 0.45, 5))
    profile = [(0.0, 0.0), *zip(bend, heights), (0.0, float(heights[-1]))]
    parts = [_turned(0, profile, (0, 0, 0), 32)]
    if rng.random() < 0.4:
        ball = trimesh.creation.icosphere(subdivisions=2, radius=rng.uniform(0.2, 0.5))
        ball.vertices *= 1 + 0.15 * rng.standard_normal((len(ball.vertices), 1))
        ball.apply_translation((0, heights[-1] + 0.2, 0))
        parts.append((ball, 2))
    return parts


def cabinet(rng: np.random.Generator) -> list[Part]:
    """A box with doors or drawers and their handles."""
    width, height, deep, foot = _sizes(rng, (0.4, 1.4), (0.3, 1.6), (0.3, 0.6), (0, 0.15))
    parts = [_box(0, (width, height, deep), (0, foot + height / 2, 0))]
    columns, rows = int(rng.integers(1, 4)), int(rng.integers(1, 5))
    wide, tall = width / columns, height / rows
    for i, j in np.ndindex(columns, rows):
        x, y = (i + 0.5) * wide - width / 2, foot + (j + 0.5) * tall
        parts.append(_box(1, (0.9 * wide, 0.9 * tall, 0.03), (x, y, deep / 2)))
        parts.append(_box(2, (0.2 * wide, 0.02, 0.03), (x, y, deep / 2 + 0.02)))
    return parts + (_legs(rng, width, deep, foot) if foot > 0.05 else [])


def bed(rng: np.random.Generator) -> list[Part]:
    """A bed with mattress, head and pillow."""
    width, deep, height, head = _sizes(rng, (0.7, 1.6), (1.6, 2.0), (0.2, 0.5), (0.3, 0.8))
    return [
        _box(1, (width, height, deep), (0, height / 2, 0)),
        _box(0, (0.96 * width, 0.15, 0.96 * deep), (0, height + 0.07, 0)),
        _box(1, (width, height + head, 0.06), (0, (height + head) / 2, -deep / 2)),
        _box(2, (0.7 * width, 0.12, 0.3), (0, height + 0.2, -deep / 2 + 0.25)),
    ]


def bottle(rng: np.random.Generator) -> list[Part]:
    """A bottle with a label."""
    radius, neck, height = _sizes(rng, (0.1, 0.35), (0.03, 0.08), (0.5, 1.0))
    shoulder = rng.uniform(0.5, 0.8) * height
    body = [(0, 0), (radius, 0), (radius, shoulder), (neck, 0.9 * height), (neck, height)]
    band = _post(2, 1.02 * radius, 0.4 * shoulder, (0, 0.3 * shoulder, 0), 24)
    return [_turned(0, [*body, (0, height)], (0, 0, 0)), band]


PLANS = [table, chair, shelf, lamp, vase, cabinet, bed, bottle]


def composition(rng: np.random.Generator) -> list[Part]:
    """Three to eight solids round the middle; most compositions mirror what is beside it."""
    mirrored = rng.random() < 0.8
    parts: list[Part] = []
    for _ in range(rng.integers(3, 9)):
        solid = _solid(rng)
        turns = rng.choice([0, 0.5, 1, rng.uniform(0, 2)]) * math.pi
        axis = np.eye(3)[rng.integers(3)]
        solid.apply_transform(trimesh.transformations.rotation_matrix(turns, axis))
        place = rng.uniform(-0.3, 0.3, 3)
        if parts:  # so that it touches what is there
            place = rng.choice(parts[rng.integers(len(parts))][0].vertices)
        number = int(rng.integers(3))
        if mirrored and rng.random() < 0.4:
            place[0] = 0.0
        solid.apply_translation(place)
        parts.append((solid, number))
        if mirrored and place[0] != 0:
            twin = solid.copy()
            twin.apply_transform(np.diag([-1.0, 1.0, 1.0, 1.0]))
            parts.append((twin, number))
    return parts


def _solid(rng: np.random.Generator) -> trimesh.Trimesh:
    """A box, a rod, a cone, an egg or a ring, about the origin."""
    a, b, c = np.exp(rng.uniform(np.log(0.05), np.log(0.5), 3))
    kind = rng.choice([0, 0, 0, 1, 1, 2, 3, 3, 4])
    if kind == 0:
        return _box(0, (2 * a, 2 * b, 2 * c), (0, 0, 0))[0]
    if kind == 1:
        return _post(0, a, 2 * b, (0, -b, 0), int(rng.choice([3, 6, 24])))[0]
    if kind == 2:
        return _turned(0, [(0, 0), (a, 0), (0, 2 * b)], (0, -b, 0))[0]
    if kind == 3:
        ball = trimesh.creation.icosphere(subdivisions=3)
        ball.vertices *= [a, b, c]
        return ball
    return trimesh.creation.torus(a + b, min(a, b) / 2, major_sections=24, minor_sections=10)
