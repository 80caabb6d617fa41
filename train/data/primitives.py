"""Objects made of simple solids with made-up textures: more to train on, free of anybody's rights.

Each object is drawn from its seed and number alone. Seven in ten follow a plan (table, chair,
shelf, lamp, vase, cabinet, bed, bottle), the others are solids put together at random, most of them
the same on the left and on the right. y is up, as in every ``.glb``; the front looks along z.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

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
    entries = [_entry(seed, number) for number in range(count)]
    ours = all(path.name.startswith("primitive-") for path in out.glob("*.glb"))
    if (out / CATALOGUE).exists() and not ours:
        raise UserError(f"{out / CATALOGUE}: there are other objects; choose another --out")
    for number, entry in enumerate(progress_bar(entries, unit="object")):
        path = out / entry["model"]
        if path.exists():
            continue
        scene = make_object(np.random.default_rng([seed, number]))
        with atomic_path(path) as temporary:
            temporary.write_bytes(export_glb(scene))
    write_json(out / CATALOGUE, {"objects": entries})


def _entry(seed: int, number: int) -> dict[str, Any]:
    uid = f"primitive-{seed}-{number:05d}"
    return {
        "model": f"{uid}.glb",
        "uid": uid,
        "name": uid.replace("-", " "),
        "group": GROUP,
        "attribution": ATTRIBUTION,
    }


def make_object(rng: np.random.Generator) -> trimesh.Scene:
    """Draws one object.

    Args:
        rng: source of chance.

    Returns:
        The object, y up, of any size and place.
    """
    plan = PLANS[rng.integers(len(PLANS))] if rng.random() < 0.7 else _composition
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
    axis = np.abs(normals).argmax(1)
    across = np.array([[2, 1], [0, 2], [0, 1]])[axis]
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


def _grid(size: int = TEXTURE) -> tuple[np.ndarray, np.ndarray]:
    places = (np.arange(size) + 0.5) / size
    u, v = np.meshgrid(places, places)
    return u, v


def _flat(rng: np.random.Generator) -> np.ndarray:
    return np.zeros((TEXTURE, TEXTURE))


def _checked(rng: np.random.Generator) -> np.ndarray:
    u, v = _grid()
    count = rng.integers(1, 5)
    return ((np.floor(2 * count * u) + np.floor(2 * count * v)) % 2).astype(float)


def _striped(rng: np.random.Generator) -> np.ndarray:
    u, v = _grid()
    across = u if rng.random() < 0.5 else v
    share = rng.uniform(0.1, 0.6)
    return ((across * rng.integers(1, 9)) % 1 < share).astype(float)


def _dotted(rng: np.random.Generator) -> np.ndarray:
    u, v = _grid()
    count = rng.integers(1, 6)
    x, y = (u * count) % 1 - 0.5, (v * count) % 1 - 0.5
    return (x**2 + y**2 < rng.uniform(0.02, 0.16)).astype(float)


def _clouded(rng: np.random.Generator, stretch: int = 1) -> np.ndarray:
    """Smooth noise in [0, 1], the sum of four sizes of waves, without a seam."""
    total = np.zeros((TEXTURE, TEXTURE))
    for level in range(2, 6):
        coarse = rng.random((2**level, max(1, 2**level // stretch)), dtype=np.float32)
        wrapped = np.pad(coarse, 2, mode="wrap")
        picture = Image.fromarray(wrapped)
        box = (2, 2, wrapped.shape[1] - 2, wrapped.shape[0] - 2)
        finer = picture.resize((TEXTURE, TEXTURE), Image.Resampling.BICUBIC, box)
        total += np.asarray(finer) / 2**level
    return (total - total.min()) / np.ptp(total)


def _grained(rng: np.random.Generator) -> np.ndarray:
    return _clouded(rng, 8)


def _bricked(rng: np.random.Generator) -> np.ndarray:
    u, v = _grid()
    rows = rng.integers(2, 7)
    shifted = u * rows / 2 + 0.5 * (np.floor(v * rows) % 2)
    return np.maximum((v * rows) % 1 < 0.12, shifted % 1 < 0.06).astype(float)


PATTERNS = [_flat, _flat, _checked, _striped, _dotted, _clouded, _grained, _grained, _bricked]


def _box(size: tuple[float, float, float], at: tuple[float, float, float]) -> trimesh.Trimesh:
    """A box by its sides and its centre."""
    solid = trimesh.creation.box(extents=size)
    solid.apply_translation(at)
    return solid


def _turned(
    profile: list[tuple[float, float]], at: tuple[float, float, float], sides: int = 24
) -> trimesh.Trimesh:
    """A solid of revolution about y, by points (radius, height) from below; ``at`` is its foot."""
    points = np.maximum(np.array(profile, dtype=float), [1e-4, -np.inf])
    solid = trimesh.creation.revolve(points, sections=sides)
    solid.apply_transform(trimesh.transformations.rotation_matrix(-math.pi / 2, [1, 0, 0]))
    solid.apply_translation(at)
    return solid


def _post(
    radius: float, height: float, at: tuple[float, float, float], sides: int
) -> trimesh.Trimesh:
    return _turned([(0, 0), (radius, 0), (radius, height), (0, height)], at, sides)


def _legs(rng: np.random.Generator, width: float, deep: float, height: float) -> list[Part]:
    """Four legs below a rectangle in the plane y = height."""
    radius, sides = rng.uniform(0.02, 0.05), int(rng.choice([4, 16]))
    x, z = width / 2 - radius, deep / 2 - radius
    places = [(sx * x, 0.0, sz * z) for sx in (-1, 1) for sz in (-1, 1)]
    return [(_post(radius, height, place, sides), 1) for place in places]


def _table(rng: np.random.Generator) -> list[Part]:
    width, deep, height = rng.uniform(0.5, 1.4), rng.uniform(0.4, 1.0), rng.uniform(0.3, 0.9)
    thick = rng.uniform(0.02, 0.08)
    if rng.random() < 0.4:  # a round one, on one foot
        foot = [(0, 0), (0.25, 0), (0.25, 0.03), (0.04, 0.06), (0.04, height), (0, height)]
        top = _post(width / 2, thick, (0, height, 0), 32)
        return [(_turned(foot, (0, 0, 0)), 1), (top, 0)]
    top = _box((width, thick, deep), (0, height + thick / 2, 0))
    return [(top, 0), *_legs(rng, width, deep, height)]


def _chair(rng: np.random.Generator) -> list[Part]:
    width, deep, height = rng.uniform(0.4, 0.9), rng.uniform(0.4, 0.7), rng.uniform(0.25, 0.5)
    thick, back = rng.uniform(0.04, 0.2), rng.uniform(0.25, 0.6)
    parts = [(_box((width, thick, deep), (0, height + thick / 2, 0)), 0)]
    parts += _legs(rng, width, deep, height)
    depth = rng.uniform(0.03, 0.15)
    if rng.random() < 0.5:
        place = (0.0, height + thick + back / 2, -deep / 2 + depth / 2)
        parts.append((_box((width, back, depth), place), 0))
    else:
        for x in np.linspace(-width / 2 + 0.03, width / 2 - 0.03, rng.integers(2, 6)):
            place = (float(x), height + thick + back / 2, -deep / 2 + depth / 2)
            parts.append((_box((0.04, back, 0.04), place), 1))
        place = (0.0, height + thick + back, -deep / 2 + depth / 2)
        parts.append((_box((width, 0.08, 0.05), place), 0))
    if rng.random() < 0.4:
        arm = rng.uniform(0.12, 0.25)
        for side in (-1, 1):
            place = (side * width / 2, height + thick + arm / 2, 0.0)
            parts.append((_box((0.06, arm, deep), place), 2))
    return parts


def _shelf(rng: np.random.Generator) -> list[Part]:
    width, height, deep = rng.uniform(0.4, 1.2), rng.uniform(0.5, 1.8), rng.uniform(0.2, 0.4)
    thick = rng.uniform(0.02, 0.05)
    parts = [
        (_box((thick, height, deep), (side * width / 2, height / 2, 0)), 0) for side in (-1, 1)
    ]
    if rng.random() < 0.7:
        parts.append((_box((width, height, 0.02), (0, height / 2, -deep / 2)), 1))
    levels = np.linspace(thick / 2, height - thick / 2, rng.integers(2, 7))
    for low, high in zip(levels, [*levels[1:], height]):
        parts.append((_box((width, thick, deep), (0, float(low), 0)), 0))
        if high - low > 0.15 and rng.random() < 0.6:  # something on the board
            tall = float(rng.uniform(0.4, 0.9) * (high - low))
            place = (rng.uniform(-0.25, 0.25) * width, low + thick / 2 + tall / 2, 0.0)
            parts.append((_box((rng.uniform(0.1, 0.4) * width, tall, 0.7 * deep), place), 2))
    return parts


def _lamp(rng: np.random.Generator) -> list[Part]:
    height, foot = rng.uniform(0.3, 1.6), rng.uniform(0.08, 0.2)
    low, high, tall = rng.uniform(0.12, 0.3), rng.uniform(0.04, 0.2), rng.uniform(0.12, 0.3)
    stand = [(0, 0), (foot, 0), (foot, 0.03), (0.02, 0.05), (0.015, height), (0, height)]
    shade = [(0, 0), (low, 0), (high, tall), (0, tall)]
    return [
        (_turned(stand, (0, 0, 0)), 1),
        (_turned(shade, (0, height - tall / 2, 0)), 0),
    ]


def _vase(rng: np.random.Generator) -> list[Part]:
    heights = np.linspace(0, rng.uniform(0.5, 1.5), 12)
    bend = np.interp(np.arange(12), np.linspace(0, 11, 5), rng.uniform(0.08, 0.45, 5))
    profile = [(0.0, 0.0), *zip(bend, heights), (0.0, float(heights[-1]))]
    parts = [(_turned(profile, (0, 0, 0), 32), 0)]
    if rng.random() < 0.4:  # a ball of leaves
        ball = trimesh.creation.icosphere(subdivisions=2, radius=rng.uniform(0.2, 0.5))
        ball.vertices *= 1 + 0.15 * rng.standard_normal((len(ball.vertices), 1))
        ball.apply_translation((0, heights[-1] + 0.2, 0))
        parts.append((ball, 2))
    return parts


def _cabinet(rng: np.random.Generator) -> list[Part]:
    width, height, deep = rng.uniform(0.4, 1.4), rng.uniform(0.3, 1.6), rng.uniform(0.3, 0.6)
    foot = rng.uniform(0, 0.15)
    parts = [(_box((width, height, deep), (0, foot + height / 2, 0)), 0)]
    columns, rows = int(rng.integers(1, 4)), int(rng.integers(1, 5))
    wide, tall = width / columns, height / rows
    for i in range(columns):
        for j in range(rows):
            x, y = (i + 0.5) * wide - width / 2, foot + (j + 0.5) * tall
            parts.append((_box((0.9 * wide, 0.9 * tall, 0.03), (x, y, deep / 2)), 1))
            parts.append((_box((0.2 * wide, 0.02, 0.03), (x, y, deep / 2 + 0.02)), 2))
    return parts + (_legs(rng, width, deep, foot) if foot > 0.05 else [])


def _bed(rng: np.random.Generator) -> list[Part]:
    width, deep, height = rng.uniform(0.7, 1.6), rng.uniform(1.6, 2.0), rng.uniform(0.2, 0.5)
    head = rng.uniform(0.3, 0.8)
    return [
        (_box((width, height, deep), (0, height / 2, 0)), 1),
        (_box((0.96 * width, 0.15, 0.96 * deep), (0, height + 0.07, 0)), 0),
        (_box((width, height + head, 0.06), (0, (height + head) / 2, -deep / 2)), 1),
        (_box((0.7 * width, 0.12, 0.3), (0, height + 0.2, -deep / 2 + 0.25)), 2),
    ]


def _bottle(rng: np.random.Generator) -> list[Part]:
    radius, neck, height = rng.uniform(0.1, 0.35), rng.uniform(0.03, 0.08), rng.uniform(0.5, 1.0)
    shoulder = rng.uniform(0.5, 0.8) * height
    body = [(0, 0), (radius, 0), (radius, shoulder), (neck, 0.9 * height), (neck, height)]
    band = _post(1.02 * radius, 0.4 * shoulder, (0, 0.3 * shoulder, 0), 24)
    return [(_turned([*body, (0, height)], (0, 0, 0)), 0), (band, 2)]


def _composition(rng: np.random.Generator) -> list[Part]:
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
        return _box((2 * a, 2 * b, 2 * c), (0, 0, 0))
    if kind == 1:
        return _post(a, 2 * b, (0, -b, 0), int(rng.choice([3, 6, 24])))
    if kind == 2:
        return _turned([(0, 0), (a, 0), (0, 2 * b)], (0, -b, 0))
    if kind == 3:
        ball = trimesh.creation.icosphere(subdivisions=3)
        ball.vertices *= [a, b, c]
        return ball
    return trimesh.creation.torus(a + b, min(a, b) / 2, major_sections=24, minor_sections=10)


PLANS: list[Callable[[np.random.Generator], list[Part]]] = [
    _table,
    _chair,
    _shelf,
    _lamp,
    _vase,
    _cabinet,
    _bed,
    _bottle,
]
