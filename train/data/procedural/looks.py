"""Looks of surfaces, and textured meshes from solids.

A *stamped* solid stores the rest position of each vertex (its *skin*) and the number of its look.
Both survive booleans, turns and bends, so textures follow the parts as they were made.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from manifold3d import Manifold, Mesh

from gamba_warp.color_spaces import to_linear
from gamba_warp.formats.materials import Material
from gamba_warp.formats.meshes import CREASE, TexturedMesh

from . import textures
from .solids import extent, joined

SHARP = 40.0  # degrees; sharper edges are not shaded smoothly
MAX_FACES = 60_000
THINNEST = 2e-4  # least volume, as a fraction of a cube of the longest side
# Of a skin, for faces that look along x, y and z: the axes of u and v, and the signs of u and v
# where the face looks to the positive side, so that print is never mirrored.
_ACROSS = np.array([[2, 1], [0, 2], [0, 1]])
_SIGNS = np.array([[-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])


@dataclass
class Look:
    """Look of some of an object's parts.

    Attributes:
        material: its material; its texture is projected from the side that a face looks to.
        repeats: of the texture over a unit of the skin; 0: once over the skin's extent.
        low: least coordinates ``[3]`` of the skins stamped with it.
        high: greatest coordinates ``[3]``.
    """

    material: Material
    repeats: float = 1.0
    low: np.ndarray = field(default_factory=lambda: np.full(3, np.inf))
    high: np.ndarray = field(default_factory=lambda: np.full(3, -np.inf))


def material(pixels: np.ndarray) -> Material:
    """A material with an image ``[h, w, 3]`` uint8."""
    full = np.full((*pixels.shape[:2], 4), 255, np.uint8)
    full[..., :3] = pixels
    return Material(np.ones(4, np.float32), full)


class Maker:
    """Source of random numbers and of looks.

    Args:
        rng: random generator.

    Attributes:
        rng: the same.
        looks: all looks made so far.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.looks: list[Look] = []

    def u(self, low: float, high: float) -> float:
        """Draw a number between two."""
        return float(self.rng.uniform(low, high))

    def chance(self, fraction: float) -> bool:
        """True with this probability."""
        return bool(self.rng.random() < fraction)

    def n(self, low: int, high: int) -> int:
        """Draw an integer, bounds included."""
        return int(self.rng.integers(low, high + 1))

    def pick(self, *options):
        """Choose one of the options."""
        return options[self.rng.integers(len(options))]

    def color(self, kinds: str = "any") -> np.ndarray:
        """Draw a colour of one of the kinds, separated by spaces; see ``textures.color``."""
        return textures.color(self.rng, self.pick(*kinds.split()))

    def add(self, look: Look) -> int:
        """Add a look; return its number."""
        self.looks.append(look)
        return len(self.looks) - 1

    def pattern(self, patterns: str, kinds: str, contrast: float) -> int:
        """A look of a pattern of two colours.

        Args:
            patterns: names in ``textures.PATTERNS`` to choose from, separated by spaces.
            kinds: of the first colour.
            contrast: probability that the second is another colour, not a shade.
        """
        name = self.pick(*patterns.split())
        first = self.color(kinds)
        second = self.color() if self.chance(contrast) else first * self.u(0.45, 0.85)
        image = textures.mixed(textures.PATTERNS[name](self.rng), first, second)
        return self.add(Look(material(image), repeats=self.u(0.8, 2.5)))

    def surface(self, kinds: str = "any") -> int:
        """A look for anything: mostly one colour, sometimes a pattern."""
        if self.chance(0.42):
            shade = np.append(to_linear(self.color(kinds)), 1)
            return self.add(Look(Material(shade.astype(np.float32))))
        names = "clouded speckled grained" if self.chance(0.6) else " ".join(textures.PATTERNS)
        return self.pattern(names, kinds, contrast=0.3)

    def fur(self, kinds: str) -> int:
        """Fur or plush, of one colour or in patches."""
        return self.pattern("furry furry speckled spotted", kinds, contrast=0.35)

    def printed(self, kinds: str) -> int:
        """A look of printed matter on paper of one of some kinds of colours."""
        inks = [self.color("toy blue dark white any") for _ in range(3)]
        return self.add(Look(material(textures.package(self.rng, self.color(kinds), inks)), 0.0))

    def stamp(self, solid: Manifold, look: int) -> Manifold:
        """Stamp a solid at its current position with one look."""
        mesh = solid.to_mesh()
        vertices, faces = np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts)
        if not len(faces):
            return Manifold()
        stamped = self.looks[look]
        stamped.low = np.minimum(stamped.low, vertices.min(0))
        stamped.high = np.maximum(stamped.high, vertices.max(0))
        points = np.concatenate([vertices, np.zeros_like(vertices), vertices], 1)
        return Manifold(
            Mesh(
                np.ascontiguousarray(points, np.float32),
                np.ascontiguousarray(faces, np.uint32),
                run_index=np.array([0, 3 * len(faces)], np.uint32),
                run_original_id=np.array([look], np.uint32),
            )
        )


def finished(solids: Sequence[Manifold], looks: Sequence[Look]) -> TexturedMesh | None:
    """Union of stamped solids as a textured mesh; None if it is empty or a sheet."""
    union = joined([s for s in solids if not s.is_empty()])
    if union.is_empty():
        return None
    low, high = extent(union)
    size = float((high - low).max())
    if not np.isfinite(size) or union.volume() < THINNEST * size**3:
        return None
    tolerance = 1e-4 * size
    while union.num_tri() > MAX_FACES:
        union = union.simplify(tolerance)
        tolerance *= 2
    mesh = union.calculate_normals(0, SHARP).to_mesh()
    points = np.asarray(mesh.vert_properties)
    corners = np.asarray(mesh.tri_verts).astype(np.int64)
    number = np.repeat(np.asarray(mesh.run_original_id), np.diff(mesh.run_index) // 3).astype(
        np.int64
    )
    merged = np.arange(len(points))
    merged[np.asarray(mesh.merge_from_vert, np.int64)] = np.asarray(mesh.merge_to_vert, np.int64)
    used, faces = np.unique(merged[corners], return_inverse=True)
    vertices = points[used, :3].astype(np.float64)
    faces = faces.reshape(-1, 3)
    normals = _normals(points[:, 3:6], merged, corners, vertices[faces])
    uvs, ids, materials = _mapped(points[corners, 6:9], number, looks)
    return TexturedMesh(
        vertices=vertices,
        faces=faces,
        given_normals=normals,
        uvs=uvs,
        colors=np.full((len(faces), 3, 4), 255, np.uint8),
        material_ids=ids,
        materials=materials,
    )


def _normals(
    rough: np.ndarray, merged: np.ndarray, corners: np.ndarray, places: np.ndarray
) -> np.ndarray:
    """Unit normals ``[F, 3, 3]`` of corners: area-weighted means over the faces of a smooth patch.

    A flat face at a rounded edge thus stays flat, and slivers left by a cut have little effect.

    Args:
        rough: ``[V, 3]`` normals, equal if a vertex's faces belong to one patch.
        merged: ``[V]`` the first of the vertices at one position.
        corners: ``[F, 3]`` vertices of faces.
        places: ``[F, 3, 3]`` positions of the corners.
    """
    steps = np.rint(500 * rough).astype(np.int64) + 512
    key = ((merged * 1024 + steps[:, 0]) * 1024 + steps[:, 1]) * 1024 + steps[:, 2]
    groups, group = np.unique(key, return_inverse=True)
    group = group[corners]
    across = np.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0])
    total = np.stack(
        [np.bincount(group.ravel(), np.repeat(across[:, k], 3), len(groups)) for k in range(3)], 1
    )
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
    size = np.linalg.norm(across, axis=1, keepdims=True)
    flat = np.where(size > 0, across / np.maximum(size, 1e-300), [0.0, 1.0, 0.0])[:, None]
    smooth = total[group]
    agree = (smooth * flat).sum(2, keepdims=True) > CREASE
    return np.where(agree, smooth, flat).astype(np.float32)


def _mapped(
    skin: np.ndarray, number: np.ndarray, looks: Sequence[Look]
) -> tuple[np.ndarray, np.ndarray, list[Material]]:
    """UVs ``[F, 3, 2]``, material numbers ``[F]`` and materials of faces.

    Args:
        skin: ``[F, 3, 3]``.
        number: ``[F]`` of looks.
        looks: all of them.
    """
    across = np.cross(skin[:, 1] - skin[:, 0], skin[:, 2] - skin[:, 0])
    axis = np.abs(across).argmax(1)
    positive = np.take_along_axis(across, axis[:, None], 1)[:, 0] > 0
    signs = _SIGNS[axis] * np.where(positive, 1, -1)[:, None]
    signs[axis != 1, 1] = 1  # v is upwards on all walls
    signs[(axis == 1), 0] = 1
    uv = np.take_along_axis(skin, np.repeat(_ACROSS[axis][:, None], 3, 1), 2)
    uvs = np.zeros((len(skin), 3, 2), np.float32)
    ids = np.zeros(len(skin), np.int64)
    materials: list[Material] = []
    for index in np.unique(number):
        look, faces = looks[index], np.flatnonzero(number == index)
        ids[faces] = len(materials)
        materials.append(look.material)
        sign = signs[faces][:, None]
        if look.repeats:
            uvs[faces] = uv[faces] * sign * look.repeats
            continue
        size, sides = np.maximum(look.high - look.low, 1e-6), _ACROSS[axis[faces]]
        fraction = (uv[faces] - look.low[sides][:, None]) / size[sides][:, None]
        uvs[faces] = np.where(sign > 0, fraction, 1 - fraction)
    return uvs, ids, materials
