"""Meshes of glTF: primitives of the default scene, placed by nodes, skins and morph targets.

Unsupported content that changes shape or colours is a warning that names it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated
from urllib.parse import unquote

import msgspec
import numpy as np
from PIL import Image

from ..color_spaces import to_display
from ..errors import UserError
from .gltf_file import INSTANCING, MAX_PRIMITIVES, PACKED, Entry, GltfFile, Index, normalised
from .materials import Material, SideFiles, plain
from .parts import Part, strip_faces, to_rgba8

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_OTHERS = {0: "points", 1: "lines", 2: "a line loop", 3: "a line strip"}
_REPEAT = 10497
_FREE_PRIMITIVES, _PRIMITIVE = 1000, 500  # in any file; bytes of each further one and its accessors
_GLOSSY = 4 << 20  # largest image of an older material in memory, bytes
_EACH = 3  # numbers that a vertex or a face of the scene counts as
_Weights = tuple[float, ...]
_SomeWeights = Annotated[_Weights, msgspec.Meta(min_length=1)]
_WHITE = (1.0, 1.0, 1.0, 1.0)
_GLOSS = "KHR_materials_pbrSpecularGlossiness"
_IMAGES = ("EXT_texture_avif", "KHR_texture_basisu", "MSFT_texture_dds")
# Extensions that are read, change neither shape nor colours, or are warned of where they are used.
_KNOWN = {
    *("EXT_lights_image_based", "EXT_texture_webp", "FB_ngon_encoding", "KHR_lights_punctual"),
    *("KHR_animation_pointer", "KHR_materials_emissive_strength", "KHR_materials_ior"),
    *(_GLOSS, INSTANCING, "KHR_materials_unlit", "KHR_materials_variants"),
    *("KHR_mesh_quantization", "KHR_texture_transform", "KHR_xmp", "KHR_xmp_json_ld"),
    *(*_IMAGES, *PACKED),
}


def gltf_parts(file: GltfFile, sides: SideFiles) -> Iterator[Part]:
    """Yield the triangles of the default scene of a ``.glb`` or ``.gltf`` file.

    Raises:
        UserError: the file is malformed.
    """
    path = file.path
    for name in file.extensions:
        if name not in _KNOWN:
            warn = sides.warnings.append if name.startswith("KHR_materials") else sides.omit
            warn(f"the extension {name[:60]} is not supported")
    least = file.document.entry("asset").get("minVersion", str, "2.0")
    if least > "2.0":
        sides.omit(f"the file needs a reader of glTF {least[:9]}, and is read as 2.0")
    scenes = len(file.document.entries("scenes"))
    if scenes > 1:
        sides.omit(f"one of {scenes} scenes is read")
    reader, nodes = _Reader(file, sides), file.placed_nodes()
    matrices = {index: matrix for _, index, matrix in nodes}
    poses: dict[tuple[int, int | None, _Weights], list[np.ndarray]] = {}  # of meshes
    for node, _, matrix in nodes:
        if (index := node.get("mesh", Index)) is None:
            continue
        skin, placed = node.get("skin", Index), matrix[None]
        if "extensions" in node.values:  # not of most nodes, of which a file may have many
            placed = matrix @ file.instances(node)
        if skin is not None and len(placed) > 1:
            sides.omit(f"instances of a skinned mesh ({INSTANCING}) are not supported")
        key = index, skin, node.get("weights", _SomeWeights, ())
        poses.setdefault(key, []).append(placed)
    meshes = {index: file.item("meshes", index) for index, _, _ in poses}
    primitives = {index: mesh.entries("primitives") for index, mesh in meshes.items()}
    most = min(MAX_PRIMITIVES, _FREE_PRIMITIVES + file.size // _PRIMITIVE)
    if sum(len(primitives[index]) for index, _, _ in poses) > most:
        raise UserError(f"{path}: over {most} primitives, too many for its {file.size} bytes")
    for (index, skin, weights), placed in poses.items():
        for primitive in primitives[index]:
            weights = weights or meshes[index].get("weights", _SomeWeights, ())
            part, used = reader.triangles(primitive, weights)
            if part is None or used is None:
                continue
            at = np.concatenate(placed)
            if skin is not None and "JOINTS_0" in primitive.entry("attributes").values:
                at = reader.pose(skin, primitive, matrices, used)[None]
            file.count(len(at) * _EACH * (len(part.vertices) + len(part.faces)))
            yield _placed(part, at)


class _Reader:
    def __init__(self, file: GltfFile, sides: SideFiles) -> None:
        self.file, self.sides, self.warn = file, sides, sides.warnings.append
        self._looks: dict[int, tuple[Material, Entry]] = {}
        self._images: dict[int, np.ndarray | None] = {}

    def triangles(
        self, primitive: Entry, weights: _Weights
    ) -> tuple[Part, np.ndarray] | tuple[None, None]:
        """Return a primitive with its morph targets in its own frame, attributes by vertex.

        Beside it a mask of the vertices of its accessors that it has; both None, and a warning,
        without triangles.
        """
        mode, attributes = primitive.get("mode", int, _TRIANGLES), primitive.entry("attributes")
        if mode in _OTHERS:
            self.sides.omit(f"only triangles are read, not {_OTHERS[mode]}")
            return None, None
        if "POSITION" not in attributes.values:
            self.sides.omit("a primitive without POSITION is ignored")
            return None, None
        count = len(self.file.values(attributes.need("POSITION", Index)))
        indices = np.arange(count)
        if "indices" in primitive.values:
            indices = self.file.values(primitive.need("indices", Index))[:, 0].astype(np.int64)
        if len(indices) and not 0 <= indices.min() <= indices.max() < count:
            raise UserError(f"{self.file.path}: a face names vertex {indices.max()} of {count}")
        faces = _faces(self.file.path, indices, mode)
        used = np.zeros(count, bool)  # primitives may share the vertices of a large mesh
        used[faces] = True
        faces = (np.cumsum(used) - 1)[faces]

        def attribute(name: str, *widths: int) -> np.ndarray | None:
            if name not in attributes.values:
                return None
            base = self.file.values(attributes.need(name, Index))
            if base.shape[1] not in widths or len(base) != count:
                self.warn(f"{name} of {len(base)} x {base.shape[1]} numbers is ignored")
                return None
            shape, base = base.shape, base[used]
            for weight, target in zip(weights, primitive.entries("targets")):
                if weight and name in target.values:
                    moves = self.file.values(target.need(name, Index))
                    if moves.shape != shape:
                        raise UserError(f"{self.file.path}: a morph target has a different shape")
                    self.file.count(base.size)
                    base = base + weight * moves[used].astype(np.float64)
            return base

        vertices = attribute("POSITION", 3)
        if vertices is None:
            raise UserError(f"{self.file.path}: vertices do not have 3 coordinates")
        material, opaque, uvs = None, True, None
        if (index := primitive.get("material", Index)) is not None:
            look = self.file.item("materials", index)
            opaque = look.get("alphaMode", str, "OPAQUE") == "OPAQUE"
            if index not in self._looks:
                self._looks[index] = self.material(look)
            material, info = self._looks[index]
            uvs = None if material.texture is None else self.uvs(attribute, info)
        colors = attribute("COLOR_0", 3, 4)
        if colors is not None:
            colors = np.clip(np.nan_to_num(normalised(colors)), 0, 1)
            alpha = colors[:, :0] if opaque else colors[:, 3:]
            colors = to_rgba8(np.hstack([to_display(colors[:, :3]), alpha]))
        normals = attribute("NORMAL", 3)
        return Part(vertices.astype(np.float64), faces, material, normals, uvs, colors), used

    def uvs(self, attribute, info: Entry) -> np.ndarray | None:
        """Return the coordinates ``[V, 2]`` of a texture, v upwards; None without any."""
        change = info.entry("extensions").entry("KHR_texture_transform")
        number = change.get("texCoord", Index, info.get("texCoord", Index, 0))
        uvs = attribute(f"TEXCOORD_{number}", 2)
        if uvs is None:
            return None
        rotation = change.get("rotation", float, 0.0)
        cos, sin = np.cos(rotation), np.sin(rotation)
        turn = np.array([[cos, -sin], [sin, cos]])  # of rows
        uvs = (uvs.astype(np.float64) * change.vector("scale", (1, 1))) @ turn
        uvs += change.vector("offset", (0, 0))
        sampler = self.file.item("textures", info.need("index", Index)).get("sampler", Index)
        if sampler is not None:
            sampler = self.file.item("samplers", sampler)
            wraps = np.array([sampler.get(name, int, _REPEAT) for name in ("wrapS", "wrapT")])
            outside = (np.abs(uvs - 0.5) > 0.5 + 1e-4).any(0)
            if any(outside & (wraps != _REPEAT)):
                self.warn("a clamped or mirrored texture is drawn as a repeating one")
        return uvs * [1, -1] + [0, 1]

    def material(self, look: Entry) -> tuple[Material, Entry]:
        """Return a material, and the entry that names its texture."""
        base, more = look.entry("pbrMetallicRoughness"), look.entry("extensions")
        for name in ("normalTexture", "occlusionTexture", "metallicRoughnessTexture"):
            if name in look.values or name in base.values:
                self.warn(f"{name} is not drawn")
        if "KHR_materials_unlit" in more.values:
            self.warn("an unlit surface is drawn shaded")
        if _GLOSS in more.values:
            color, texture, info = self.glossy(more.entry(_GLOSS))
        else:
            color, info = base.vector("baseColorFactor", _WHITE), base.entry("baseColorTexture")
            texture = self.texture(info)
        light = look.vector("emissiveFactor", (0, 0, 0))
        if light.any():
            if color[:3].any() and (texture is None or texture[..., :3].any()):
                self.warn("emission of a surface with a base colour is not drawn")
            else:
                strength = more.entry("KHR_materials_emissive_strength")
                self.warn("emission of a surface is drawn as its base colour, shaded")
                color[:3] = light * strength.get("emissiveStrength", float, 1.0)
                info = look.entry("emissiveTexture")
                texture = self.texture(info)
        mode = look.get("alphaMode", str, "OPAQUE")
        if mode != "BLEND":
            alpha = color[3] if texture is None else color[3] * texture[..., 3] / 255
            shown = (alpha >= look.get("alphaCutoff", float, 0.5)) | (mode == "OPAQUE")
            if texture is None:
                color[3] = shown
            else:
                color[3], alpha = 1.0, np.where(shown, 255, 0).astype(np.uint8)
                if (alpha != texture[..., 3]).any():
                    claimed = self.sides.claim(texture.nbytes, "an image without its transparency")
                    texture = np.dstack([texture[..., :3], alpha]) if claimed else None
        return Material(plain(color), texture), info

    def glossy(self, gloss: Entry) -> tuple[np.ndarray, np.ndarray | None, Entry]:
        """Return colour, texture and its entry of an older material, diffuse and specular."""
        from trimesh.visual.gloss import specular_to_pbr

        names = ("diffuseTexture", "specularGlossinessTexture")
        images = [(name, self.texture(gloss.entry(name))) for name in names]
        # Some .7 s for two images of 1,024 pixels: they are made smaller, and count more.
        size = sum(min(x.nbytes, _GLOSSY) for _, x in images if x is not None)
        if not self.sides.claim(6 * size, "glossy images"):
            images = [(name, None) for name in names]
        small = {name: x if x is None else Image.fromarray(x) for name, x in images}
        for name, image in small.items():
            while image is not None and 4 * image.width * image.height > _GLOSSY:
                small[name] = image = image.reduce(2)
        pbr = specular_to_pbr(
            diffuseFactor=gloss.vector("diffuseFactor", _WHITE),
            specularFactor=gloss.vector("specularFactor", _WHITE[:3]),
            glossinessFactor=gloss.get("glossinessFactor", float, 1.0),
            **small,
        )
        texture = pbr.get("baseColorTexture")
        texture = None if texture is None else np.array(texture.convert("RGBA"))
        info = gloss.entry(names["diffuseTexture" not in gloss.values])
        return np.array(pbr.get("baseColorFactor", _WHITE)), texture, info

    def texture(self, info: Entry) -> np.ndarray | None:
        """Return the image of a texture; None, and a warning, if it cannot be read."""
        if not info.values:
            return None
        try:
            texture = self.file.item("textures", info.need("index", Index))
            webp = texture.entry("extensions").entry("EXT_texture_webp")
            source = webp.get("source", Index, texture.get("source", Index))
            if source is None:
                names = ", ".join(x for x in self.file.extensions if x in _IMAGES) or "nothing"
                raise UserError(f"a texture's image is named by {names}, which is not supported")
            if source not in self._images:
                self._images[source] = None
                self._images[source] = self.image(source)
            return self._images[source]
        except UserError as error:
            self.warn(str(error))
            return None

    def image(self, source: int) -> np.ndarray | None:
        """Return an image as ``SideFiles.texture`` does."""
        entry, name = self.file.item("images", source), f"image {source}"
        if (view := entry.get("bufferView", Index)) is not None:
            return self.sides.texture(self.file.view(view), name)
        uri = entry.get("uri", str, "")
        name = name if uri.startswith("data:") else unquote(uri[:100])
        return self.sides.texture(self.file.content(uri), name)

    def pose(
        self, index: int, primitive: Entry, matrices: dict[int, np.ndarray], used: np.ndarray
    ) -> np.ndarray:
        """Return ``[V, 4, 4]``, matrices of a skinned primitive's used vertices in the scene."""
        skin, path = self.file.item("skins", index), self.file.path
        chain, attributes = skin.need("joints", list[Index]), primitive.entry("attributes")
        if not chain or not matrices.keys() >= {*chain}:
            self.sides.omit("a skin with joints outside of the scene is not applied")
            return np.eye(4)
        joints = np.stack([matrices[joint] for joint in chain])
        if "inverseBindMatrices" in skin.values:
            inverse = self.file.values(skin.need("inverseBindMatrices", Index))
            if inverse.shape[1] != 16 or len(inverse) < len(joints):
                raise UserError(f"{path}: skin {index} has no matrix for each joint")
            joints = joints @ inverse[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1)
        count = np.count_nonzero(used)
        total, sums, number = np.zeros((count, 4, 4)), np.zeros((count, 1, 1)), 0
        while f"JOINTS_{number}" in attributes.values:
            chosen, weights = (
                self.file.values(attributes.need(f"{name}_{number}", Index))
                for name in ("JOINTS", "WEIGHTS")
            )
            same = chosen.shape == weights.shape == (len(used), 4)
            if not same or chosen.max(initial=0) >= len(joints):
                raise UserError(f"{path}: JOINTS_{number} or WEIGHTS_{number} is invalid")
            chosen, weights = chosen[used], weights[used]
            for column in range(4):
                weight = weights[:, column, None, None]
                total += weight * joints[chosen[:, column].astype(np.int64)]
                sums += weight
            number += 1
        return np.where(sums == 0, joints[0], total / np.where(sums == 0, 1, sums))


def _faces(path: Path, indices: np.ndarray, mode: int) -> np.ndarray:
    """Return ``[F, 3]`` triangles of a list, a strip or a fan, with one orientation."""
    if mode == _TRIANGLES:
        if len(indices) % 3:
            raise UserError(f"{path}: {len(indices)} corners are not whole triangles")
        return indices.reshape(-1, 3)
    if mode == _STRIP:
        return strip_faces(indices)
    if mode != _FAN:
        raise UserError(f"{path}: a primitive has the invalid mode {mode}")
    at = np.arange(max(len(indices) - 2, 0))
    faces = indices[np.stack([0 * at, at + 1, at + 2], 1)]
    return faces[(faces != np.roll(faces, 1, 1)).all(1)]


def _placed(part: Part, poses: np.ndarray) -> Part:
    """Place a part at each of ``poses [N, 4, 4]``, or once by its vertices' own ``[1, V, 4, 4]``.

    The attributes become per-corner.
    """
    turns, moves, normals = poses[..., :3, :3], poses[..., :3, 3], part.normals
    if poses.ndim == 3:
        vertices = part.vertices @ turns.transpose(0, 2, 1) + moves[:, None]
        if normals is not None:
            finite = np.isfinite(turns).all((1, 2), keepdims=True)
            normals = normals @ np.linalg.pinv(np.where(finite, turns, np.eye(3)))
    else:
        vertices = (turns @ part.vertices[..., None])[..., 0] + moves
        if normals is not None:
            normals = (turns @ normals[..., None])[..., 0]
    signs = np.linalg.det(turns)
    mirrored = (np.nansum(signs.reshape(len(signs), -1), 1) < 0)[:, None, None]
    local = np.where(mirrored, part.faces[:, ::-1], part.faces)  # its front would be its back
    faces = (local + len(part.vertices) * np.arange(len(poses))[:, None, None]).reshape(-1, 3)
    uvs, colors = (None if x is None else x[local.reshape(-1, 3)] for x in (part.uvs, part.colors))
    if normals is not None:
        normals = normals.reshape(-1, 3)[faces]
    vertices = vertices.reshape(-1, 3)
    return replace(part, vertices=vertices, faces=faces, normals=normals, uvs=uvs, colors=colors)
