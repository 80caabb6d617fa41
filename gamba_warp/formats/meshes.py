"""Mesh files as flat arrays: one list of triangles with their corners' normals, UVs and materials.

The readers of the formats yield parts, which are joined without unused vertices, and without faces
of no area that would set the bounding box; normals are computed when they are asked for.
The data are z-up; ``.obj``, ``.glb`` and ``.gltf`` files are y-up by convention and are turned by
``normalized`` (front +z becomes front -y, as in Blender).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..color_spaces import to_linear
from ..errors import UserError
from .gltf import gltf_parts
from .gltf_file import open_gltf
from .headers import Source, open_shape
from .materials import GREY, Material, SideFiles
from .mesh_files import ply_parts, read_off, read_stl
from .names import MESH_SUFFIXES
from .obj import read_obj
from .parts import Part
from .ply_data import parse_ply

_READERS: dict[str, Callable[[Source, SideFiles], Iterator[Part]]] = {
    **dict.fromkeys(
        (".glb", ".gltf"), lambda file, sides: gltf_parts(open_gltf(file, sides), sides)
    ),
    ".ply": lambda file, sides: ply_parts(parse_ply(file), sides),
    ".obj": read_obj,
    ".stl": read_stl,
    ".off": read_off,
}
Y_UP = (".obj", ".glb", ".gltf")
MAX_REACH = 1e18  # the squares of larger coordinates overflow float32
MAX_PARTS = 40_000_000  # vertices and faces; their arrays take 4 GB
CREASE = np.cos(np.radians(40))  # a vertex normal farther than this from its face's is not used
THIN = 1e-7  # height of a face over its longest side, below which float32 gives it no area

Y_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@dataclass
class TexturedMesh:
    """All F triangles and V vertices of a file, in one frame.

    Attributes:
        vertices: ``[V, 3]`` float64.
        faces: ``[F, 3]`` int64.
        uvs: ``[F, 3, 2]`` float32, v upwards; 0 if missing.
        colors: ``[F, 3, 4]`` uint8 display RGBA; white if missing.
        material_ids: ``[F]`` int64 into ``materials``.
        materials: at least one.
        given_normals: ``[F, 3, 3]`` of the file, of any length and side, not checked; or None.
        warnings: missing content that was replaced, or unread content, one line each.
        omitted: the warnings that concern the shape.
        flat: number of faces that are left out because they have no area.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uvs: np.ndarray
    colors: np.ndarray
    material_ids: np.ndarray
    materials: list[Material]
    given_normals: np.ndarray | None = None
    warnings: list[str] = field(default_factory=list)
    omitted: list[str] = field(default_factory=list)
    flat: int = 0

    @cached_property
    def normals(self) -> np.ndarray:
        """``[F, 3, 3]`` float32, unit, on the side of the face's own normal.

        A corner's is the file's, or without any its vertex's, if it agrees with the face.
        """
        first, second, third = (self.vertices[corner] for corner in self.faces.T)
        flat = np.cross(second - first, third - first)
        length = np.linalg.norm(flat, axis=1, keepdims=True)
        flat = np.where(length > 0, flat / np.maximum(length, 1e-300), [0.0, 0.0, 1.0])
        given_normals = self.given_normals
        if given_normals is None:
            smooth = _vertex_normals(self.vertices, self.faces)
        else:
            smooth = np.nan_to_num(given_normals)
            lengths = np.linalg.norm(smooth, axis=2, keepdims=True)
            smooth = (smooth / np.maximum(lengths, 1e-12)).astype(np.float32)
        flat = flat.astype(np.float32)
        agree = np.einsum("fci,fi->fc", smooth, flat)[..., None]
        smooth *= np.sign(agree)
        return np.where(np.abs(agree) > CREASE, smooth, flat[:, None])

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
        normals = self.given_normals
        if normals is not None:
            normals = normals @ np.linalg.inv(turn).astype(np.float32)
        mesh = replace(self, vertices=(points - center) * scale, given_normals=normals)
        return mesh, np.hstack([turn, -center[:, None]]), float(scale)


def default_up(path: str | Path) -> str:
    """Return the upward axis of a file of this suffix by convention, "y" or "z"."""
    return "y" if Path(path).suffix.lower() in Y_UP else "z"


def load_mesh(path: str | Path, root: Path | None = None) -> TexturedMesh:
    """Read a mesh file: .obj (with .mtl), .glb, .gltf, .ply, .stl or .off.

    A missing texture is replaced by its material's plain colour, a missing material by grey, a
    texture without UV coordinates by its mean colour, and the alpha of a mesh that would be
    invisible by 1; ``warnings`` names each. Faces of no area do not set the box.

    Args:
        path: the file.
        root: the folder above the file in which it may name other files; by default its own.

    Raises:
        UserError: missing, malformed, no faces, vertices not finite, or no extent.
    """
    path = Path(path)
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise UserError(f"{path}: not a mesh file ({', '.join(MESH_SUFFIXES)})")
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    with open_shape(path) as source:
        return read_mesh(source, SideFiles(path, root=root))


def read_mesh(source: Source, sides: SideFiles) -> TexturedMesh:
    """Read an open file by its suffix, one of ``MESH_SUFFIXES``; errors as for ``load_mesh``."""
    return mesh_of(_READERS[source.path.suffix.lower()](source, sides), sides)


def mesh_of(parts: Iterable[Part], sides: SideFiles) -> TexturedMesh:
    """Join the parts of a file to one mesh; errors as for ``load_mesh``."""
    meshes: list[TexturedMesh] = []
    count = 0
    for part in parts:
        if not len(part.faces):
            continue
        meshes.append(_complete(part, sides))
        count += len(part.faces) + len(meshes[-1].vertices)  # a scene may repeat one part
        if count > MAX_PARTS:
            limit = f"over {MAX_PARTS} vertices and faces, the limit for a mesh"
            raise UserError(f"{sides.path}: {limit}")
    if not meshes:
        raise UserError(f"{sides.path}: no faces")
    return _without_flat(_joined(meshes, sides))


def _complete(part: Part, sides: SideFiles) -> TexturedMesh:
    """Return a part as a mesh. Raises UserError if a vertex is not finite."""
    used, faces = np.unique(part.faces, return_inverse=True)
    faces, vertices = faces.reshape(-1, 3), part.vertices[used]
    if not np.isfinite(vertices).all():
        bad = len(vertices) - np.count_nonzero(np.isfinite(vertices).all(1))
        raise UserError(f"{sides.path}: {bad} of {len(vertices)} vertices are not finite")
    material, uvs, colors = part.material, part.uvs, part.colors
    if material is None:
        material = Material(np.ones(4, np.float32))
        if colors is None:
            material.color[:3] = to_linear(GREY)
            sides.warnings.append("a part has no material: grey")
    elif material.texture is not None and uvs is None:
        sides.warnings.append("a textured part has no UV coordinates")
        mean = material.texture.mean((0, 1), keepdims=True).astype(np.uint8)
        material = replace(material, texture=mean)
    zeros = np.zeros((*faces.shape, 2), np.float32)
    uvs = zeros if uvs is None else np.nan_to_num(uvs.astype(np.float32))
    colors = np.full((*faces.shape, 4), 255, np.uint8) if colors is None else colors
    ids = np.zeros(len(faces), np.int64)
    return TexturedMesh(vertices, faces, uvs, colors, ids, [material], part.normals)


def _joined(parts: list[TexturedMesh], sides: SideFiles) -> TexturedMesh:
    """Return meshes of one material each as one. Raises UserError if it has no usable extent."""

    def all_of(name: str) -> np.ndarray:
        arrays = [getattr(part, name) for part in parts]
        return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)

    vertices, colors = all_of("vertices").astype(np.float64, copy=False), all_of("colors")
    low, high = np.array([(axis.min(), axis.max()) for axis in vertices.T]).T
    reach, extent = np.abs([low, high]).max(), (high - low).max()
    if reach > MAX_REACH:
        raise UserError(f"{sides.path}: coordinates reach {reach:.3g}, over {MAX_REACH:g}")
    if 0 < extent < 1 / MAX_REACH:
        raise UserError(f"{sides.path}: its longest side is {extent:.3g}, below {1 / MAX_REACH:g}")
    if extent <= 0:
        raise UserError(f"{sides.path}: all vertices coincide")
    materials = list({id(part.materials[0]): part.materials[0] for part in parts}.values())
    indices = {id(material): index for index, material in enumerate(materials)}
    if not any(map(_is_visible, parts)):
        sides.warnings.append("all its surfaces are transparent by their alpha: drawn opaque")
        colors[..., 3] = 255
        for material in materials:
            material.color[3] = 1
            if material.texture is not None:
                rgb = material.texture[..., :3]
                material.texture = np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)])
    at, normals = 0, None
    if any(part.given_normals is not None for part in parts):
        for part in parts:
            if part.given_normals is None:
                part.given_normals = _vertex_normals(part.vertices, part.faces)
        normals = all_of("given_normals")
    for part in parts:
        part.material_ids += indices[id(part.materials[0])]
        part.faces = part.faces + at if at else part.faces
        at += len(part.vertices)
    warnings, omitted = (list(dict.fromkeys(x)) for x in (sides.warnings, sides.omitted))
    arrays = vertices, all_of("faces"), all_of("uvs"), colors, all_of("material_ids")
    return TexturedMesh(*arrays, materials, normals, warnings, omitted)


def _without_flat(mesh: TexturedMesh) -> TexturedMesh:
    """Return a mesh without its faces of no area, if one reaches the sides of the bounding box.

    If all faces are such, they stay, with a warning.
    """
    vertices, faces = mesh.vertices, mesh.faces
    outer = np.zeros(len(vertices), bool)
    for axis in vertices.T:
        outer |= (axis == axis.min()) | (axis == axis.max())
    first, second, third = (outer[corner] for corner in faces.T)
    if _have_area(vertices, faces[first | second | third]).all():
        return mesh
    solid = _have_area(vertices, faces)
    if not solid.any():
        mesh.warnings.append("no face has an area")
        return mesh
    used, faces = np.unique(mesh.faces[solid], return_inverse=True)
    normals = mesh.given_normals
    return replace(
        mesh,
        vertices=mesh.vertices[used],
        faces=faces.reshape(-1, 3),
        uvs=mesh.uvs[solid],
        colors=mesh.colors[solid],
        material_ids=mesh.material_ids[solid],
        given_normals=None if normals is None else normals[solid],
        flat=int((~solid).sum()),
    )


def _have_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return ``[F]`` bool, True for the faces with an area."""
    first, second, third = (vertices[corner] for corner in faces.T)
    one, two = second - first, third - first
    longest = np.maximum((one * one).sum(1), (two * two).sum(1))
    return (np.cross(one, two) ** 2).sum(1) > (THIN * longest) ** 2


def _is_visible(part: TexturedMesh) -> bool:
    """Return True if a mesh of one material may have a pixel of an alpha of 1/255."""
    (material,) = part.materials
    texture = 255 if material.texture is None else int(material.texture[..., 3].max(initial=0))
    return float(material.color[3]) * texture * int(part.colors[..., 3].max(initial=0)) >= 255


def _vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return ``[F, 3, 3]`` float32, at each corner the mean of its vertex's faces' normals."""
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return mesh.vertex_normals.astype(np.float32)[faces]
