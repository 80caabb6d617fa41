"""Mesh files to flat arrays: one list of triangles with their corners' normals, UVs and materials.

trimesh reads the files; this module flattens its scenes, unifies materials and turns what is wrong
with a file into one line. The data are z-up; ``.obj``, ``.glb`` and ``.gltf`` files are y-up by
convention and are turned by ``normalized`` (front +z becomes front -y, as in Blender).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..errors import UserError, first_line
from .headers import check_counts, open_shape
from .materials import GREY, Budget, Material, make_material, side_files, to_linear
from .ply_data import PlyData, PlyList, read_ply, triangles

SUFFIXES = (".obj", ".glb", ".gltf", ".ply", ".stl", ".off")
Y_UP = (".obj", ".glb", ".gltf")
MAX_MATERIALS = 2000  # of an .obj file; trimesh's time grows with their square
MAX_REACH = 1e18  # the squares of larger coordinates overflow float32
MAX_PARTS = 40_000_000  # vertices and faces; their arrays take 4 GB
CREASE = np.cos(np.radians(40))  # a vertex normal farther than this from its face's is not used

# Digits, and blanks between numbers, can be read in one way only: the time is linear in the line.
_EXPONENT = rb"(?:[eE][-+]?\d+)?"
_FINITE = rb"(?:\d+(?:\.\d*)?|\.\d+)" + _EXPONENT
_NUMBER = rb"[-+]?(?:" + _FINITE + rb"|[nN][aA][nN]|[iI][nN][fF])(?=[ \t\r]|$)"
_CORNER = rb"-?0{0,9}[1-9]\d{0,14}(?:/-?\d{0,15}){0,2}(?=[ \t\r]|$)"
_BAD_OBJ = re.compile(
    rb"(?m)^(?:v[ \t](?!(?:[ \t]*" + _NUMBER + rb"){3,}[ \t\r]*$)"
    rb"|f[ \t](?!(?:[ \t]*" + _CORNER + rb"){3,}[ \t\r]*$)).*"
)
# Faces of one or two corners, which many a modeller leaves behind: they have no area.
_THIN = re.compile(rb"(?m)^[ \t]*f(?:[ \t]+" + _CORNER + rb"){1,2}[ \t\r]*$")
# A texture coordinate of one number, which OBJ allows; trimesh would cut all others to one.
_FLAT = re.compile(rb"(?m)^(vt[ \t]+" + _NUMBER + rb")[ \t]*$")

Y_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@dataclass
class TexturedMesh:
    """All F triangles and V vertices of a file, in one frame.

    Attributes:
        vertices: ``[V, 3]`` float64.
        faces: ``[F, 3]`` int64.
        normals: ``[F, 3, 3]`` float32, unit, on the side of the face's own normal.
        uvs: ``[F, 3, 2]`` float32, v upwards; 0 where a face has none.
        colors: ``[F, 3, 4]`` uint8 display RGBA; white where a face has none.
        material_ids: ``[F]`` int64 into ``materials``.
        materials: at least one.
        warnings: what was missing and replaced, one line each.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    colors: np.ndarray
    material_ids: np.ndarray
    materials: list[Material]
    warnings: list[str] = field(default_factory=list)

    def normalized(
        self, up: str = "z", rotation: ArrayLike | None = None
    ) -> tuple[TexturedMesh, np.ndarray, float]:
        """The mesh turned to z-up, with its bounding box centred and its longest side 1.

        Args:
            up: the axis that points up in the file, "y" or "z".
            rotation: ``[3, 3]``, applied first, for files whose object lies on its side, or
                to stretch it; or None.

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


def to_display(linear: np.ndarray) -> np.ndarray:
    """Linear light in [0, 1] to sRGB display values, any shape, float32."""
    x = np.asarray(linear, dtype=np.float32)
    curve = 1.055 * np.maximum(x, 1e-8) ** (1 / 2.4) - 0.055
    return np.where(x <= 0.0031308, 12.92 * x, curve).astype(np.float32)


def default_up(path: str | Path) -> str:
    """The axis that points up in a file of this suffix, by convention: "y" or "z"."""
    return "y" if Path(path).suffix.lower() in Y_UP else "z"


def load_mesh(path: str | Path, normals: bool = True) -> TexturedMesh:
    """Reads a mesh file: .obj (with .mtl), .glb, .gltf, .ply, .stl or .off.

    A missing texture is replaced by its material's plain colour, a missing material by grey, a
    texture without UV coordinates by its mean colour; ``warnings`` names each.

    Args:
        path: the file.
        normals: whether they are made; without them, which are much of the time, they are 0.

    Raises:
        UserError: missing, unreadable, no faces, vertices not finite, or no extent.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise UserError(f"{path}: not a mesh file ({', '.join(SUFFIXES)})")
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    check_counts(path)
    warnings: list[str] = []
    parts, materials, budget, count = [], [], Budget(), 0
    for mesh, matrix in _read_parts(path, warnings):
        count += len(mesh.faces) + len(mesh.vertices)  # a scene may hold one part many times
        if count > MAX_PARTS:
            raise UserError(f"{path}: over {MAX_PARTS} vertices and faces, the limit for a mesh")
        part, material = _flatten(mesh, matrix, warnings, path, budget, normals)
        part["material_ids"] = np.full(len(part["faces"]), len(materials))
        parts.append(part)
        materials.append(material)
    if not parts:
        raise UserError(f"{path}: no faces")
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
    return TexturedMesh(**joined, materials=materials, warnings=list(dict.fromkeys(warnings)))


def _read_parts(path: Path, warnings: list[str]) -> list[tuple]:
    """Every part that has faces: trimesh's mesh and the 4x4 matrix of its pose in the scene."""
    import trimesh

    suffix = path.suffix.lower()
    if suffix == ".ply":
        data = read_ply(path)
        # trimesh does not read a binary file whose faces differ in length.
        lists = [x for x in data.elements.get("face", {}).values() if isinstance(x, PlyList)]
        uneven = any(len(x.lengths) and np.ptp(x.lengths) > 0 for x in lists)
        if uneven and data.header.format != "ascii":
            return [(_mixed_mesh(path, data), np.eye(4))]
    with open_shape(path) as (file, _):
        text = file.read()
    if suffix == ".obj":
        text = _absolute_indices(path, _checked_obj(path, text))
    try:
        scene = trimesh.load_scene(
            trimesh.util.wrap_as_stream(text),
            file_type=suffix[1:],
            resolver=side_files(path, warnings),
            process=False,
        )
        parts = []
        for node in scene.graph.nodes_geometry:
            matrix, name = scene.graph[node]
            mesh = scene.geometry[name]
            if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
                parts.append((mesh, matrix))
        return parts
    except Exception as error:  # trimesh raises whatever its parsers run into
        raise UserError(f"{path}: cannot be read as a mesh ({first_line(error)})") from error


def _mixed_mesh(path: Path, data: PlyData):
    """The mesh of a ``.ply``: triangles, and the vertices' normals and colours."""
    import trimesh

    vertices = data.numbers("vertex", ("x", "y", "z"))
    corners = [data.elements["face"].get(name) for name in ("vertex_indices", "vertex_index")]
    lists = [item for item in corners if isinstance(item, PlyList)]
    if vertices is None or not lists:
        raise UserError(f"{path}: its vertices have no x, y and z, or its faces no indices")
    faces = triangles(path, lists[0], len(vertices))
    if not len(faces):
        raise UserError(f"{path}: no faces")
    colors = [data.elements["vertex"].get(name) for name in ("red", "green", "blue")]
    known = all(isinstance(item, np.ndarray) and item.dtype == np.uint8 for item in colors)
    return trimesh.Trimesh(
        vertices,
        faces,
        vertex_normals=data.numbers("vertex", ("nx", "ny", "nz")),
        vertex_colors=np.stack(colors, 1) if known else None,  # pyright: ignore[reportArgumentType, reportCallIssue]
        process=False,
    )


def _checked_obj(path: Path, text: bytes) -> bytes:
    """An OBJ file whose lines of vertices and faces are numbers; trimesh stops at what is none.

    A texture coordinate of one number gets its second, 0.

    Raises:
        UserError: one is not.
    """
    text = text.replace(b"\r\n", b"\n").replace(b"\\\n", b"")
    text = _THIN.sub(b"", text)
    if b"vt" in text:
        text = _FLAT.sub(rb"\1 0", text)
    bad = _BAD_OBJ.search(text)
    if bad:
        line = " ".join(bad[0][:60].decode("ascii", "replace").split())
        number = text.count(b"\n", 0, bad.start()) + 1
        raise UserError(f"{path}: line {number}, '{line}', is no vertex or face")
    used = set(re.findall(rb"(?m)^[ \t]*usemtl[ \t]+(.*)$", text))
    if len(used) > MAX_MATERIALS:
        raise UserError(f"{path}: uses {len(used)} materials, over the limit of {MAX_MATERIALS}")
    return text


def _absolute_indices(path: Path, text: bytes) -> bytes:
    """Makes negative face indices of an OBJ positive; they count back from their own line."""
    if not re.search(rb"(?m)^f .*-\d", text):
        return text
    counts = {b"v": 0, b"vt": 0, b"vn": 0}
    lines = text.splitlines()
    for i, line in enumerate(lines):
        words = line.split()
        if not words:
            continue
        if words[0] in counts:
            counts[words[0]] += 1
        elif words[0] == b"f":
            totals = list(counts.values())
            corners = [
                b"/".join(
                    b"%d" % (total + 1 + int(index)) if index.startswith(b"-") else index
                    for index, total in zip(corner.split(b"/"), totals)
                )
                for corner in words[1:]
            ]
            if any(corner.startswith((b"-", b"0")) for corner in corners):
                raise UserError(f"{path}: a face names a vertex before the first")
            lines[i] = b" ".join([b"f", *corners])
    return b"\n".join(lines)


def _flatten(
    mesh, matrix: np.ndarray, warnings: list[str], path: Path, budget: Budget, normals: bool
) -> tuple[dict, Material]:
    """The arrays of one part, moved to the scene's frame, and its material."""
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    faces = np.asarray(mesh.faces, dtype=np.int64)
    for name, array in (("vertices", vertices), ("faces", faces)):  # glTF may state others
        if array.ndim != 2 or array.shape[1] != 3:
            raise UserError(f"{path}: {name} of {array.shape[1:]} numbers, expected 3")
    vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise UserError(f"{path}: a face names vertex {faces.max()} of {len(vertices)}")
    bad = ~np.isfinite(vertices).all(1)
    if bad.any():
        raise UserError(f"{path}: {bad.sum()} of {len(bad)} vertices are not finite")
    count = len(faces)
    uvs = np.zeros((count, 3, 2), np.float32)
    colors = np.full((count, 3, 4), 255, np.uint8)
    visual = mesh.visual
    if visual.kind == "texture":
        material = make_material(visual.material, path, warnings, budget)
        if np.shape(visual.uv) == (len(vertices), 2):
            uvs = np.nan_to_num(np.asarray(visual.uv, np.float32)[faces])
        elif material.texture is not None:
            warnings.append("a textured part has no UV coordinates")
            material.texture = material.texture.mean((0, 1), keepdims=True).astype(np.uint8)
        vertex_colors = visual.vertex_attributes.get("color")
    else:
        material = Material(np.ones(4, np.float32))
        vertex_colors = visual.vertex_colors if visual.kind == "vertex" else None
        if visual.kind == "face":
            colors = np.repeat(np.asarray(visual.face_colors, np.uint8)[:, None], 3, axis=1)
        elif visual.kind is None:
            material.color[:3] = to_linear(GREY)
            warnings.append("a part has no material: grey")
    if vertex_colors is not None and len(vertex_colors) == len(vertices):
        colors = _rgba8(vertex_colors)[faces]
    part = {
        "vertices": vertices,
        "faces": faces,
        "normals": _corner_normals(vertices, faces, mesh.vertex_normals, matrix)
        if normals
        else np.zeros((count, 3, 3), np.float32),
        "uvs": uvs,
        "colors": colors,
    }
    return part, material


def _rgba8(colors: np.ndarray) -> np.ndarray:
    colors = np.asarray(colors)
    if colors.dtype.kind == "f":
        colors = np.clip(colors, 0, 1) * 255 + 0.5
    out = np.full((len(colors), 4), 255, np.uint8)
    out[:, : colors.shape[1]] = colors
    return out


def _corner_normals(
    vertices: np.ndarray, faces: np.ndarray, vertex_normals: np.ndarray, matrix: np.ndarray
) -> np.ndarray:
    """Normals ``[F, 3, 3]``: the vertex's where it agrees with the face, else the face's."""
    corners = vertices[faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(flat, axis=1, keepdims=True)
    flat = np.where(length > 0, flat / np.maximum(length, 1e-300), [0.0, 0.0, 1.0])[:, None]
    to_normals = np.linalg.pinv(matrix[:3, :3])  # inverse transpose, on row vectors
    smooth = np.nan_to_num(np.asarray(vertex_normals) @ to_normals)[faces]
    smooth /= np.maximum(np.linalg.norm(smooth, axis=2, keepdims=True), 1e-12)
    agree = (smooth * flat).sum(2, keepdims=True)
    smooth = smooth * np.sign(agree)
    return np.where(np.abs(agree) > CREASE, smooth, flat).astype(np.float32)
