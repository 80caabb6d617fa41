"""Mesh files as flat arrays: one list of triangles with their corners' normals, UVs and materials.

The readers of the formats yield parts, which are joined without unused vertices; missing normals
are computed. The data are z-up; ``.obj``, ``.glb`` and ``.gltf`` files are y-up by convention and
are turned by ``normalized`` (front +z becomes front -y, as in Blender).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..errors import UserError
from .gltf import read_gltf
from .materials import GREY, Material, SideFiles, to_linear
from .obj import read_obj
from .off import read_off
from .parts import Part
from .ply_mesh import read_ply_mesh
from .stl import read_stl

_READERS: dict[str, Callable[[Path, SideFiles], Iterator[Part]]] = {
    ".obj": read_obj,
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".ply": read_ply_mesh,
    ".stl": read_stl,
    ".off": read_off,
}
SUFFIXES = tuple(_READERS)
Y_UP = (".obj", ".glb", ".gltf")
MAX_REACH = 1e18  # the squares of larger coordinates overflow float32
MAX_PARTS = 40_000_000  # vertices and faces; their arrays take 4 GB
CREASE = np.cos(np.radians(40))  # a vertex normal farther than this from its face's is not used

Y_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@dataclass
class TexturedMesh:
    """All F triangles and V vertices of a file, in one frame.

    Attributes:
        vertices: ``[V, 3]`` float64.
        faces: ``[F, 3]`` int64.
        normals: ``[F, 3, 3]`` float32, unit, on the side of the face's own normal.
        uvs: ``[F, 3, 2]`` float32, v upwards; 0 if missing.
        colors: ``[F, 3, 4]`` uint8 display RGBA; white if missing.
        material_ids: ``[F]`` int64 into ``materials``.
        materials: at least one.
        warnings: missing content that was replaced, or unread content, one line each.
        omitted: the warnings that concern the shape.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    colors: np.ndarray
    material_ids: np.ndarray
    materials: list[Material]
    warnings: list[str] = field(default_factory=list)
    omitted: list[str] = field(default_factory=list)

    def normalized(
        self, up: str = "z", rotation: ArrayLike | None = None
    ) -> tuple[TexturedMesh, np.ndarray, float]:
        """Return the mesh turned to z-up, with its bounding box centred and its longest side 1.

        Args:
            up: upward axis of the file, "y" or "z".
            rotation: ``[3, 3]``, applied first, to turn an object upright or to stretch it.

        Returns:
            The mesh, ``transform [3, 4]`` and ``scale``: x_new = scale · (transform · [x, 1]).
        """
        turn = Y_TO_Z_UP if up == "y" else np.eye(3)
        if rotation is not None:
            turn = turn @ np.asarray(rotation, dtype=np.float64)
        points = self.vertices @ turn.T
        low, high = points.min(0), points.max(0)
        center, scale = (low + high) / 2, 1.0 / (high - low).max()
        normals = self.normals @ np.linalg.inv(turn).astype(np.float32)
        mesh = replace(
            self,
            vertices=(points - center) * scale,
            normals=normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12),
        )
        return mesh, np.hstack([turn, -center[:, None]]), float(scale)


def default_up(path: str | Path) -> str:
    """Return the upward axis of a file of this suffix by convention, "y" or "z"."""
    return "y" if Path(path).suffix.lower() in Y_UP else "z"


def load_mesh(path: str | Path, normals: bool = True, root: Path | None = None) -> TexturedMesh:
    """Read a mesh file: .obj (with .mtl), .glb, .gltf, .ply, .stl or .off.

    A missing texture is replaced by its material's plain colour, a missing material by grey, a
    texture without UV coordinates by its mean colour, and the alpha of a mesh that would be
    invisible by 1; ``warnings`` names each.

    Args:
        path: the file.
        normals: compute normals, which takes much of the time; else they are 0.
        root: the folder above the file in which it may name other files; by default its own.

    Raises:
        UserError: missing, malformed, no faces, vertices not finite, or no extent.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise UserError(f"{path}: not a mesh file ({', '.join(SUFFIXES)})")
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    sides = SideFiles(path, root=root)
    parts, materials, ids, count = [], [], {}, 0
    try:
        for part in _READERS[path.suffix.lower()](path, sides):
            count += len(part.faces) + len(part.vertices)  # a scene may hold one part many times
            if count > MAX_PARTS:
                limit = f"over {MAX_PARTS} vertices and faces, the limit for a mesh"
                raise UserError(f"{path}: {limit}")
            if not len(part.faces):
                continue
            arrays, material = _flatten(part, sides, normals)
            number = ids.setdefault(id(material), len(materials))
            if number == len(materials):
                materials.append(material)
            arrays["material_ids"] = np.full(len(part.faces), number)
            parts.append(arrays)
    except MemoryError as error:
        raise UserError(f"{path}: not enough memory for it") from error
    if not parts:
        raise UserError(f"{path}: no faces")
    if not any(_is_visible(part["colors"], materials[part["material_ids"][0]]) for part in parts):
        sides.warnings.append("all its surfaces are transparent by their alpha: drawn opaque")
        for part in parts:
            part["colors"][..., 3] = 255
        for material in materials:
            material.color[3] = 1
            if material.texture is not None:
                rgb = material.texture[..., :3]
                material.texture = np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)])
    offsets = np.cumsum([0] + [len(part["vertices"]) for part in parts])
    for part, offset in zip(parts, offsets):
        part["faces"] = part["faces"] + offset
    joined = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    reach = np.abs(joined["vertices"]).max()
    if reach > MAX_REACH:
        raise UserError(f"{path}: coordinates reach {reach:.3g}, over {MAX_REACH:g}")
    extent = np.ptp(joined["vertices"], axis=0).max()
    if 0 < extent < 1 / MAX_REACH:
        raise UserError(f"{path}: its longest side is {extent:.3g}, below {1 / MAX_REACH:g}")
    if extent <= 0:
        raise UserError(f"{path}: all vertices are one point")
    warnings, omitted = (list(dict.fromkeys(x)) for x in (sides.warnings, sides.omitted))
    return TexturedMesh(**joined, materials=materials, warnings=warnings, omitted=omitted)


def _is_visible(colors: np.ndarray, material: Material) -> bool:
    """Return True if a part may have a pixel of an alpha of 1/255."""
    texture = 255 if material.texture is None else int(material.texture[..., 3].max(initial=0))
    return float(material.color[3]) * texture * int(colors[..., 3].max(initial=0)) >= 255


def _flatten(part: Part, sides: SideFiles, normals: bool) -> tuple[dict, Material]:
    """Return the arrays of one part, without unused vertices, and its material."""
    used = np.zeros(len(part.vertices), bool)
    used[part.faces] = True
    faces, vertices = part.faces, part.vertices
    if not used.all():
        faces, vertices = (np.cumsum(used) - 1)[faces], vertices[used]
    bad = len(vertices) - np.count_nonzero(np.isfinite(vertices).all(1))
    if bad:
        raise UserError(f"{sides.path}: {bad} of {len(vertices)} vertices are not finite")
    material, uvs = part.material, part.uvs
    if material is None:
        material = Material(np.ones(4, np.float32))
        if part.colors is None:
            material.color[:3] = to_linear(GREY)
            sides.warnings.append("a part has no material: grey")
    elif material.texture is not None and uvs is None:
        sides.warnings.append("a textured part has no UV coordinates")
        mean = material.texture.mean((0, 1), keepdims=True).astype(np.uint8)
        material = replace(material, texture=mean)
    corners, colors = faces.shape, part.colors
    arrays = {"vertices": vertices, "faces": faces}
    arrays["normals"] = np.zeros((*corners, 3), np.float32)
    if normals:
        arrays["normals"] = _corner_normals(vertices, faces, part.normals)
    uvs = np.zeros((*corners, 2)) if uvs is None else uvs
    arrays["uvs"] = np.nan_to_num(uvs.astype(np.float32))
    arrays["colors"] = np.full((*corners, 4), 255, np.uint8) if colors is None else colors
    return arrays, material


def _corner_normals(
    vertices: np.ndarray, faces: np.ndarray, given: np.ndarray | None
) -> np.ndarray:
    """Return normals ``[F, 3, 3]``: the corner's if it agrees with the face, else the face's."""
    if given is None:
        import trimesh

        mesh = trimesh.Trimesh(vertices, faces, process=False)
        given = np.asarray(mesh.vertex_normals)[faces]
    corners = vertices[faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(flat, axis=1, keepdims=True)
    flat = np.where(length > 0, flat / np.maximum(length, 1e-300), [0.0, 0.0, 1.0])[:, None]
    smooth = np.nan_to_num(given, copy=False)
    smooth /= np.maximum(np.linalg.norm(smooth, axis=2, keepdims=True), 1e-12)
    agree = (smooth * flat).sum(2, keepdims=True)
    smooth *= np.sign(agree)
    return np.where(np.abs(agree) > CREASE, smooth, flat).astype(np.float32)
