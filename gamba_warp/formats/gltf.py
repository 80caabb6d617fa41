"""Meshes of glTF: each primitive of the default scene where its nodes, skins and targets put it.

What changes shape or colours and is not read is a warning that names it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import msgspec
import numpy as np
from PIL import Image

from ..errors import UserError
from .gltf_file import (
    PACKED,
    GltfFile,
    Index,
    Mesh,
    Node,
    Primitive,
    Sampler,
    Texture,
    Vec2,
    Vec3,
    Vec4,
    normalised,
    open_gltf,
    pose_matrix,
)
from .headers import MAX_FILE, open_shape
from .materials import Material, SideFiles, plain, to_display
from .parts import Part, to_rgba8

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_OTHERS = {0: "points", 1: "lines", 2: "a line loop", 3: "a line strip"}
_REPEAT = 10497
_GLOSS, _INSTANCES = "KHR_materials_pbrSpecularGlossiness", "EXT_mesh_gpu_instancing"
# Extensions that are read, or change neither shape nor colours. Those that name a texture are
# spoken of where it is used.
_KNOWN = {
    *("EXT_lights_image_based", "EXT_texture_avif", "EXT_texture_webp", "FB_ngon_encoding"),
    *("KHR_animation_pointer", "KHR_lights_punctual", "KHR_materials_emissive_strength"),
    *("KHR_materials_ior", "KHR_materials_unlit", "KHR_materials_variants"),
    *("KHR_mesh_quantization", "KHR_texture_basisu", "KHR_texture_transform", "KHR_xmp"),
    *("KHR_xmp_json_ld", "MSFT_texture_dds", _GLOSS, _INSTANCES, *PACKED),
}


class _Transform(msgspec.Struct):
    offset: Vec2 = (0.0, 0.0)
    rotation: float = 0.0
    scale: Vec2 = (1.0, 1.0)
    texCoord: Index | None = None


class _TextureInfo(msgspec.Struct):
    index: Index
    texCoord: Index = 0
    extensions: dict[str, Any] = {}


class _Roughness(msgspec.Struct):
    baseColorFactor: Vec4 = (1.0, 1.0, 1.0, 1.0)
    baseColorTexture: _TextureInfo | None = None
    metallicRoughnessTexture: _TextureInfo | None = None


class _Gloss(msgspec.Struct):
    diffuseFactor: Vec4 = (1.0, 1.0, 1.0, 1.0)
    diffuseTexture: _TextureInfo | None = None
    specularFactor: Vec3 = (1.0, 1.0, 1.0)
    glossinessFactor: float = 1.0
    specularGlossinessTexture: _TextureInfo | None = None


class _Strength(msgspec.Struct):
    emissiveStrength: float = 1.0


class _Look(msgspec.Struct):
    """A material of the document."""

    pbrMetallicRoughness: _Roughness = msgspec.field(default_factory=_Roughness)
    emissiveFactor: Vec3 = (0.0, 0.0, 0.0)
    emissiveTexture: _TextureInfo | None = None
    normalTexture: _TextureInfo | None = None
    occlusionTexture: _TextureInfo | None = None
    alphaMode: str = "OPAQUE"
    alphaCutoff: float = 0.5
    extensions: dict[str, Any] = {}


class _Instances(msgspec.Struct):
    attributes: dict[str, Index]


@dataclass
class _Surface:
    """A material, and where its texture's coordinates are."""

    material: Material | None
    opaque: bool = True
    info: _TextureInfo | None = None


@dataclass
class _Triangles:
    """A primitive in its own frame; all arrays but ``faces`` have a row for each vertex."""

    vertices: np.ndarray
    faces: np.ndarray
    surface: _Surface
    normals: np.ndarray | None
    uvs: np.ndarray | None
    colors: np.ndarray | None


def read_gltf(path: Path, sides: SideFiles) -> Iterator[Part]:
    """Yields the triangles of the default scene.

    Args:
        path: a ``.glb`` or ``.gltf`` file.
        sides: reads what lies beside it, and takes the warnings.

    Raises:
        UserError: it is not what it says.
    """
    with open_shape(path) as (stream, size):
        file = open_gltf(path, stream, size, lambda uri: sides.read(unquote(uri), uri))
    yield from _Reader(file, sides).parts()


class _Reader:
    def __init__(self, file: GltfFile, sides: SideFiles) -> None:
        self.file, self.sides, self.warn = file, sides, sides.warnings.append
        self._surfaces: dict[int | None, _Surface] = {}
        self._known: dict[tuple, _Triangles | None] = {}
        self.note([*file.document.extensionsUsed, *file.document.extensionsRequired])
        self.nodes = file.placed_nodes()
        self.matrices = {index: matrix for _, index, matrix in self.nodes}
        if len(file.document.scenes) > 1:
            self.warn(f"one of {len(file.document.scenes)} scenes is read")

    def note(self, extensions: Iterable[str]) -> None:
        """Names the extensions that are not read."""
        for name in extensions:
            if name not in _KNOWN:
                self.warn(f"the extension {name[:60]} is not read")

    def parts(self) -> Iterator[Part]:
        for node, _, matrix in self.nodes:
            self.note(node.extensions)
            if node.mesh is None:
                continue
            mesh: Mesh = self.file.item("meshes", node.mesh)
            weights = tuple(node.weights or mesh.weights)
            for number, primitive in enumerate(mesh.primitives):
                key = node.mesh, number, weights
                if key not in self._known:
                    self._known[key] = self.triangles(primitive, weights)
                found = self._known[key]
                if found is None:
                    continue
                if node.skin is not None and "JOINTS_0" in primitive.attributes:
                    yield _moved(found, self.pose(node.skin, primitive, len(found.vertices)))
                elif _INSTANCES in node.extensions:
                    for instance in self.instances(node):
                        yield _moved(found, matrix @ instance)
                else:
                    yield _moved(found, matrix)

    def triangles(self, primitive: Primitive, weights: tuple[float, ...]) -> _Triangles | None:
        """A primitive with its morph targets; None, and a warning, without triangles."""
        self.note(primitive.extensions)
        if primitive.mode in _OTHERS:
            self.warn(f"{_OTHERS[primitive.mode]} beside the triangles are left out")
            return None
        if "POSITION" not in primitive.attributes:
            self.warn("a primitive without POSITION is left out")
            return None
        position = self.file.item("accessors", primitive.attributes["POSITION"])
        packed = [name for name in PACKED if name in primitive.extensions]
        if packed and position.bufferView is None and position.sparse is None:
            raise UserError(
                f"{self.file.path}: packed by {packed[0]}, which is not read; unpack it first"
            )
        count = position.count

        def attribute(name: str, *widths: int) -> np.ndarray | None:
            if name not in primitive.attributes:
                return None
            base = self.file.values(primitive.attributes[name])
            if base.shape[1] not in widths or len(base) != count:
                self.warn(f"{name} of {len(base)} x {base.shape[1]} numbers is left out")
                return None
            for weight, target in zip(weights, primitive.targets):
                if weight and name in target:
                    at = self.file.declared(target[name], Index, "a morph target")
                    moves = self.file.values(at)
                    if moves.shape != base.shape:
                        raise UserError(f"{self.file.path}: a morph target of another shape")
                    base = base + weight * moves.astype(np.float64)
            return base

        vertices = attribute("POSITION", 3)
        if vertices is None:
            raise UserError(f"{self.file.path}: vertices are not of 3 numbers")
        indices = np.arange(count)
        if primitive.indices is not None:
            indices = self.file.values(primitive.indices)[:, 0].astype(np.int64)
        if len(indices) and not 0 <= indices.min() <= indices.max() < count:
            raise UserError(f"{self.file.path}: a face names vertex {indices.max()} of {count}")
        surface = self.surface(primitive.material)
        colors = attribute("COLOR_0", 3, 4)
        if colors is not None:
            colors = normalised(colors)
            light = to_display(np.clip(np.nan_to_num(colors[:, :3]), 0, 1))
            alpha = colors[:, 3:] if not surface.opaque else colors[:, :0]
            colors = to_rgba8(np.hstack([light, np.clip(alpha, 0, 1)]))
        return _Triangles(
            vertices.astype(np.float64),
            _faces(self.file.path, indices, primitive.mode),
            surface,
            attribute("NORMAL", 3),
            self.uvs(attribute, surface),
            colors,
        )

    def uvs(self, attribute, surface: _Surface) -> np.ndarray | None:
        """The texture coordinates ``[V, 2]`` of a surface, v upwards; None without any."""
        if surface.info is None or surface.material is None or surface.material.texture is None:
            return None
        change = self.file.declared(
            surface.info.extensions.get("KHR_texture_transform", {}), _Transform, "a texture"
        )
        number = surface.info.texCoord if change.texCoord is None else change.texCoord
        uvs = attribute(f"TEXCOORD_{number}", 2)
        if uvs is None:
            return None
        cos, sin = np.cos(change.rotation), np.sin(change.rotation)
        turn = np.array([[cos, -sin], [sin, cos]])  # of rows
        uvs = (uvs.astype(np.float64) * change.scale) @ turn + change.offset
        texture = self.file.item("textures", surface.info.index)
        if texture.sampler is not None:
            sampler: Sampler = self.file.item("samplers", texture.sampler)
            outside = (np.abs(uvs - 0.5) > 0.5 + 1e-4).any(0)
            if any(outside & (np.array([sampler.wrapS, sampler.wrapT]) != _REPEAT)):
                self.warn("a texture that does not repeat is drawn as one that does")
        return uvs * [1, -1] + [0, 1]

    def surface(self, index: int | None) -> _Surface:
        """A material of the document; without one a grey or the vertices' colours."""
        if index not in self._surfaces:
            if index is None:
                self._surfaces[index] = _Surface(None)
            else:
                try:
                    look = msgspec.json.decode(self.file.item("materials", index), type=_Look)
                    self._surfaces[index] = self.made(look)
                except msgspec.ValidationError as error:
                    self.warn(f"material {index}: {error}")
                    self._surfaces[index] = _Surface(None)
        return self._surfaces[index]

    def made(self, look: _Look) -> _Surface:
        """What a material of the document looks like."""
        self.note(look.extensions)
        base = look.pbrMetallicRoughness
        for name, unread in (
            ("metallicRoughnessTexture", base.metallicRoughnessTexture),
            ("normalTexture", look.normalTexture),
            ("occlusionTexture", look.occlusionTexture),
        ):
            if unread is not None:
                self.warn(f"{name} is not drawn")
        color, info = np.array(base.baseColorFactor), base.baseColorTexture
        if _GLOSS in look.extensions:
            gloss = msgspec.convert(look.extensions[_GLOSS], _Gloss)
            color, texture = self.glossy(gloss)
            info = gloss.diffuseTexture or gloss.specularGlossinessTexture
        else:
            texture = self.texture(info)
        dark = not color[:3].any() or (texture is not None and not texture[..., :3].any())
        if any(look.emissiveFactor):
            if dark:
                strong = look.extensions.get("KHR_materials_emissive_strength", {})
                strength = msgspec.convert(strong, _Strength).emissiveStrength
                color[:3] = np.array(look.emissiveFactor) * strength
                info, texture = look.emissiveTexture, self.texture(look.emissiveTexture)
            else:
                self.warn("light of a surface beside its base colour is not drawn")
        if look.alphaMode == "OPAQUE":
            color[3] = 1.0
            if texture is not None:
                texture[..., 3] = 255
        elif look.alphaMode == "MASK":
            cut = 255 * look.alphaCutoff
            if texture is not None:
                texture[..., 3] = np.where(texture[..., 3] * color[3] >= cut, 255, 0)
                color[3] = 1.0
            else:
                color[3] = float(255 * color[3] >= cut)
        return _Surface(Material(plain(color), texture), look.alphaMode == "OPAQUE", info)

    def glossy(self, gloss: _Gloss) -> tuple[np.ndarray, np.ndarray | None]:
        """Colour and texture of a material of the older kind, diffuse and specular."""
        from trimesh.visual.gloss import specular_to_pbr

        textures = {
            name: None if texture is None else Image.fromarray(texture)
            for name, texture in (
                ("diffuseTexture", self.texture(gloss.diffuseTexture)),
                ("specularGlossinessTexture", self.texture(gloss.specularGlossinessTexture)),
            )
        }
        found = specular_to_pbr(
            diffuseFactor=gloss.diffuseFactor,
            specularFactor=gloss.specularFactor,
            glossinessFactor=gloss.glossinessFactor,
            **textures,
        )
        picture = found.get("baseColorTexture")
        texture = None if picture is None else np.array(picture.convert("RGBA"))
        return np.array(found.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0))), texture

    def texture(self, info: _TextureInfo | None) -> np.ndarray | None:
        """The picture of a texture; None, and a warning, where it cannot be had."""
        if info is None:
            return None
        try:
            texture = self.file.item("textures", info.index)
            webp = texture.extensions.get("EXT_texture_webp", {})
            webp = self.file.declared(webp, Texture, "a texture")
            source = texture.source if webp.source is None else webp.source
            if source is None:
                names = ", ".join(texture.extensions)[:80] or "nothing"
                raise UserError(f"a texture's picture is named by {names}, which is not read")
            image = self.file.item("images", source)
            if image.bufferView is not None:
                return self.sides.texture(self.file.view(image.bufferView), f"image {source}")
            uri = image.uri or ""
            name = f"image {source}" if uri.startswith("data:") else unquote(uri[:100])
            return self.sides.texture(self.file.content(uri), name)
        except UserError as error:
            self.warn(str(error))
            return None

    def pose(self, index: int, primitive: Primitive, count: int) -> np.ndarray:
        """``[V, 4, 4]`` the matrices of a skinned primitive's vertices in the scene."""
        skin = self.file.item("skins", index)
        missing = [joint for joint in skin.joints if joint not in self.matrices]
        if missing or not skin.joints:
            self.warn("a skin with joints outside of the scene is not applied")
            return np.broadcast_to(np.eye(4), (count, 4, 4))
        joints = np.stack([self.matrices[joint] for joint in skin.joints])
        if skin.inverseBindMatrices is not None:
            inverse = self.file.values(skin.inverseBindMatrices)
            if inverse.shape[1] != 16 or len(inverse) < len(joints):
                raise UserError(f"{self.file.path}: skin {index} has no matrix for each joint")
            joints = joints @ inverse[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1)
        total, sums, number = np.zeros((count, 4, 4)), np.zeros(count), 0
        while f"JOINTS_{number}" in primitive.attributes:
            chosen, weights = (
                self.file.values(primitive.attributes.get(f"{name}_{number}", MAX_FILE))
                for name in ("JOINTS", "WEIGHTS")
            )
            if not chosen.shape == weights.shape == (count, 4) or chosen.max(initial=0) >= len(
                joints
            ):
                raise UserError(f"{self.file.path}: JOINTS_{number} or WEIGHTS_{number} is false")
            for column in range(4):
                total += weights[:, column, None, None] * joints[chosen[:, column].astype(int)]
                sums += weights[:, column]
            number += 1
        total[sums == 0], sums[sums == 0] = joints[0], 1.0
        return total / sums[:, None, None]

    def instances(self, node: Node) -> Iterator[np.ndarray]:
        """The matrices ``[4, 4]`` of a mesh's copies within a node."""
        given = self.file.declared(node.extensions[_INSTANCES], _Instances, _INSTANCES).attributes
        still = {
            "TRANSLATION": (0.0, 0.0, 0.0),
            "ROTATION": (0.0, 0.0, 0.0, 1.0),
            "SCALE": (1.0, 1.0, 1.0),
        }
        rows = {name: self.file.values(given[name]) for name in still if name in given}
        count = min(map(len, rows.values()), default=1)
        for name, values in still.items():
            rows.setdefault(name, np.tile(values, (count, 1)))
            if rows[name].shape != (count, len(values)):
                raise UserError(f"{self.file.path}: {_INSTANCES}: {name} is false")
        for pose in zip(*(rows[name] for name in still)):
            yield pose_matrix(*pose)


def _faces(path: Path, indices: np.ndarray, mode: int) -> np.ndarray:
    """``[F, 3]`` triangles of a list, a strip or a fan, all turned alike."""
    if mode == _TRIANGLES:
        if len(indices) % 3:
            raise UserError(f"{path}: {len(indices)} corners, which are no whole triangles")
        return indices.reshape(-1, 3)
    if mode not in (_STRIP, _FAN):
        raise UserError(f"{path}: a primitive of mode {mode}")
    at = np.arange(max(len(indices) - 2, 0))
    odd = at % 2
    corners = (at, at + 1 + odd, at + 2 - odd) if mode == _STRIP else (0 * at, at + 1, at + 2)
    faces = indices[np.stack(corners, 1)]
    return faces[(faces != np.roll(faces, 1, 1)).all(1)]  # strips are joined by faces without area


def _moved(found: _Triangles, matrix: np.ndarray) -> Part:
    """The part where a matrix ``[4, 4]``, or one for each vertex, puts it."""
    turn = matrix[..., :3, :3]
    if matrix.ndim == 2:
        vertices = found.vertices @ turn.T + matrix[:3, 3]
        inverse = np.linalg.pinv(turn) if np.isfinite(turn).all() else turn
        normals = None if found.normals is None else found.normals @ inverse
    else:
        vertices = np.einsum("vij,vj->vi", turn, found.vertices) + matrix[:, :3, 3]
        normals = None if found.normals is None else np.einsum("vij,vj->vi", turn, found.normals)
    faces = found.faces
    if np.nansum(np.linalg.det(turn)) < 0:  # mirrored: what was in front is behind
        faces = faces[:, ::-1]

    def corners(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else values[faces]

    material, colors = found.surface.material, corners(found.colors)
    return Part(vertices, faces, material, corners(normals), corners(found.uvs), colors)
