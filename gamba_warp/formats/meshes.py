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
from PIL import Image

from ..errors import UserError

SUFFIXES = (".obj", ".glb", ".gltf", ".ply", ".stl", ".off")
Y_UP = (".obj", ".glb", ".gltf")
GREY = 0.6  # display value of a surface whose colour is not known
MAX_TEXTURE = 2048  # pixels a side; larger ones are halved until they fit
CREASE = np.cos(np.radians(40))  # a vertex normal farther than this from its face's is not used

Y_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@dataclass
class Material:
    """How a surface looks.

    Attributes:
        color: ``[4]`` float32 RGBA, linear light, multiplies the texture.
        texture: ``[h, w, 4]`` uint8 RGBA, display (sRGB) values, not premultiplied; or None.
    """

    color: np.ndarray
    texture: np.ndarray | None = None


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
            rotation: ``[3, 3]``, applied first, for files whose object lies on its side; or None.

        Returns:
            The mesh, ``transform [3, 4]`` and ``scale``: x_new = scale · (transform · [x, 1]).
        """
        turn = Y_TO_Z_UP if up == "y" else np.eye(3)
        if rotation is not None:
            turn = turn @ np.asarray(rotation, dtype=np.float64)
        points = self.vertices @ turn.T
        low, high = points.min(0), points.max(0)
        center, scale = (low + high) / 2, 1.0 / (high - low).max()
        mesh = replace(
            self,
            vertices=(points - center) * scale,
            normals=self.normals @ turn.T.astype(np.float32),
        )
        return mesh, np.hstack([turn, -center[:, None]]), float(scale)


def to_linear(display: np.ndarray | float) -> np.ndarray:
    """SRGB display values in [0, 1] to linear light (IEC 61966-2-1), any shape, float32."""
    x = np.asarray(display, dtype=np.float32)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)


def to_display(linear: np.ndarray) -> np.ndarray:
    """Linear light in [0, 1] to sRGB display values, any shape, float32."""
    x = np.asarray(linear, dtype=np.float32)
    curve = 1.055 * np.maximum(x, 1e-8) ** (1 / 2.4) - 0.055
    return np.where(x <= 0.0031308, 12.92 * x, curve).astype(np.float32)


def default_up(path: str | Path) -> str:
    """The axis that points up in a file of this suffix, by convention: "y" or "z"."""
    return "y" if Path(path).suffix.lower() in Y_UP else "z"


def load_mesh(path: str | Path) -> TexturedMesh:
    """Reads a mesh file: .obj (with .mtl), .glb, .gltf, .ply, .stl or .off.

    A missing texture is replaced by its material's plain colour, a missing material by grey, a
    texture without UV coordinates by its mean colour; ``warnings`` names each.

    Raises:
        UserError: missing, unreadable, no faces, vertices not finite, or no extent.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise UserError(f"{path}: not a mesh file ({', '.join(SUFFIXES)})")
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    if path.stat().st_size == 0:
        raise UserError(f"{path}: the file is empty")
    warnings: list[str] = []
    parts, materials = [], []
    for mesh, matrix in _read_parts(path, warnings):
        part, material = _flatten(mesh, matrix, warnings, path)
        part["material_ids"] = np.full(len(part["faces"]), len(materials))
        parts.append(part)
        materials.append(material)
    if not parts:
        raise UserError(f"{path}: no faces")
    offsets = np.cumsum([0] + [len(part["vertices"]) for part in parts])
    for part, offset in zip(parts, offsets):
        part["faces"] = part["faces"] + offset
    joined = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    if np.ptp(joined["vertices"], axis=0).max() <= 0:
        raise UserError(f"{path}: all vertices are one point")
    return TexturedMesh(**joined, materials=materials, warnings=list(dict.fromkeys(warnings)))


def _read_parts(path: Path, warnings: list[str]) -> list[tuple]:
    """Every part that has faces: trimesh's mesh and the 4x4 matrix of its pose in the scene."""
    import trimesh

    try:
        with path.open("rb") as file:
            text = _absolute_indices(file.read()) if path.suffix.lower() == ".obj" else file.read()
        scene = trimesh.load_scene(
            trimesh.util.wrap_as_stream(text),
            file_type=path.suffix.lower()[1:],
            resolver=_resolver(path, warnings),
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
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise UserError(f"{path}: cannot be read as a mesh ({reason[0]})") from error


def _absolute_indices(text: bytes) -> bytes:
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
            lines[i] = b" ".join([b"f", *corners])
    return b"\n".join(lines)


def _resolver(path: Path, warnings: list[str]):
    """Finds side files whatever their case, slashes or options before the name.

    What is not found goes into ``warnings``.
    """
    from trimesh.resolvers import FilePathResolver

    class Resolver(FilePathResolver):
        def get(self, name: str) -> bytes:
            file = _find_file(path.parent, name)
            if file is None:
                warnings.append(f"{name}: not found")
                raise OSError(f"{name}: not found")
            if file.suffix.lower() in Image.registered_extensions():
                try:
                    Image.open(file).close()
                except OSError:  # trimesh would go on and not say so
                    warnings.append(f"{name}: not a picture")
            return file.read_bytes()

    return Resolver(str(path))


def _find_file(folder: Path, name: str) -> Path | None:
    # Options of MTL stand before the name: "-s 1 1 1 -clamp on wood.jpg".
    bare = re.sub(r"^(-\w+\s+(([-+.\d]+|on|off|[rgbmlz])\s+)+)+", "", name.strip())
    for candidate in (name, bare, Path(bare.replace("\\", "/")).name):
        place = folder
        for part in candidate.strip().strip('"').replace("\\", "/").split("/"):
            if part in ("", "."):
                continue
            exact = place / part
            if not exact.exists() and place.is_dir():
                same = [p for p in place.iterdir() if p.name.lower() == part.lower()]
                exact = same[0] if same else exact
            place = exact
        if place.is_file():
            return place
    return None


def _flatten(mesh, matrix: np.ndarray, warnings: list[str], path: Path) -> tuple[dict, Material]:
    """The arrays of one part, moved to the scene's frame, and its material."""
    vertices = np.asarray(mesh.vertices, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    faces = np.asarray(mesh.faces, dtype=np.int64)
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
        material = _material(visual.material, path, warnings)
        if visual.uv is not None and len(visual.uv) == len(vertices):
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
        "normals": _corner_normals(vertices, faces, mesh.vertex_normals, matrix),
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


def _material(source, path: Path, warnings: list[str]) -> Material:
    """Makes our material of one of trimesh's."""
    from trimesh.visual.material import PBRMaterial, SimpleMaterial

    if isinstance(source, PBRMaterial):
        texture = _texture(source.baseColorTexture, warnings)
        factor = source.baseColorFactor
        color = np.ones(4) if factor is None else np.asarray(factor, np.float64) / 255
        if source.alphaMode in (None, "OPAQUE"):
            color[3] = 1.0
            if texture is not None:
                texture[..., 3] = 255
        elif source.alphaMode == "MASK" and texture is not None:
            cut = 0.5 if source.alphaCutoff is None else source.alphaCutoff
            texture[..., 3] = np.where(texture[..., 3] >= 255 * cut, 255, 0)
        return Material(color.astype(np.float32), texture)
    grey = Material(np.array([*[to_linear(GREY)] * 3, 1], np.float32))
    # trimesh invents a material where there is none; one from an MTL file has kwargs.
    made_up = path.suffix.lower() == ".obj" and not source.kwargs
    if not isinstance(source, SimpleMaterial) or made_up:
        warnings.append("a part has no material: grey")
        return grey
    texture = _texture(source.image, warnings)
    mask = source.kwargs.get("map_d")
    if texture is not None and mask:
        texture = _with_mask(texture, path.parent, " ".join(mask), warnings)
    color = np.ones(4, np.float32)
    if texture is None:
        if "kd" in source.kwargs:
            color[:3] = to_linear(np.asarray(source.diffuse[:3], np.float32) / 255)
        else:
            color[:3] = grey.color[:3]
    color[3] = _opacity(source.kwargs)
    return Material(color, texture)


def _opacity(options: dict) -> float:
    """MTL's ``d`` (1 is opaque) or ``Tr`` (0 is opaque)."""
    for key, sign in (("d", 1), ("tr", -1)):
        try:
            value = float(options[key][-1])
        except (KeyError, IndexError, TypeError, ValueError):
            continue
        return float(np.clip(value if sign > 0 else 1 - value, 0, 1))
    return 1.0


def _texture(image: Image.Image | None, warnings: list[str]) -> np.ndarray | None:
    if image is None:
        return None
    try:
        image = image.convert("RGBA")
    except (OSError, SyntaxError, ValueError) as error:
        warnings.append(f"{image.info.get('file_path', 'a texture')}: cannot be decoded ({error})")
        return None
    while max(image.size) > MAX_TEXTURE:
        image = image.reduce(2)
    texture = np.array(image)
    if texture[..., 3].max() < 8:  # the alpha channel is unused, the object is not invisible
        texture[..., 3] = 255
    return texture


def _with_mask(texture: np.ndarray, folder: Path, name: str, warnings: list[str]) -> np.ndarray:
    """The texture with its alpha from MTL's ``map_d``: that picture's alpha, or its grey."""
    file = _find_file(folder, name)
    if file is None:
        warnings.append(f"{name}: not found")
        return texture
    try:
        with Image.open(file) as image:
            alpha = image.convert("RGBA").getchannel("A")
            if alpha.getextrema()[0] == 255:
                alpha = image.convert("L")
            alpha = alpha.resize((texture.shape[1], texture.shape[0]))
    except (OSError, SyntaxError, ValueError) as error:
        warnings.append(f"{name}: cannot be decoded ({error})")
        return texture
    texture[..., 3] = np.asarray(alpha)
    return texture
