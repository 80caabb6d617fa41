"""The document of a glTF file, the numbers that its accessors name, and its nodes.

An index, an offset or a length is checked where it is used: what nothing uses may be false.
"""

from __future__ import annotations

import base64
import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal
from urllib.parse import unquote_to_bytes

import msgspec
import numpy as np

from ..errors import UserError
from ..untrusted.documents import parse_document
from .headers import MAX_FILE, compare_sizes

MAX_ZEROS = 1 << 24  # bytes of an accessor that no bytes of the file stand behind
MAX_NODES = 200_000  # of a scene
# Extensions that pack triangles; a reader without them sees zeros.
PACKED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
_KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_EXTENSION = re.compile(rb'"([A-Z]{2,10}_[a-z]\w{1,60})"\s*:')  # some files do not list them

Index = Annotated[int, msgspec.Meta(ge=0, le=MAX_FILE)]
_Kind = Literal[5120, 5121, 5122, 5123, 5125, 5126]
_Vec2, _Vec3 = tuple[float, float], tuple[float, float, float]
_Vec4 = tuple[float, float, float, float]


class _Buffer(msgspec.Struct):
    byteLength: Index
    uri: str | None = None


class _View(msgspec.Struct):
    buffer: Index
    byteLength: Index
    byteOffset: Index = 0
    byteStride: Annotated[int, msgspec.Meta(ge=1, le=252)] | None = None


class _Rows(msgspec.Struct):
    bufferView: Index
    byteOffset: Index = 0
    componentType: Literal[5121, 5123, 5125] = 5121


class _Sparse(msgspec.Struct):
    count: Index
    indices: _Rows
    values: _Rows


class _Accessor(msgspec.Struct):
    count: Index
    componentType: _Kind
    type: Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"]
    bufferView: Index | None = None
    byteOffset: Index = 0
    sparse: _Sparse | None = None
    normalized: bool = False


class Primitive(msgspec.Struct):
    """Triangles, lines or points of one material."""

    attributes: dict[str, Index] = {}
    indices: Index | None = None
    material: Index | None = None
    mode: int = 4
    targets: list[dict[str, Index]] = []
    extensions: dict[str, Any] = {}


class _Mesh(msgspec.Struct):
    primitives: list[Primitive] = []
    weights: list[float] = []


class _Node(msgspec.Struct):
    mesh: Index | None = None
    skin: Index | None = None
    children: list[Index] = []
    weights: list[float] = []
    matrix: Annotated[list[float], msgspec.Meta(min_length=16, max_length=16)] | None = None
    translation: _Vec3 = (0.0, 0.0, 0.0)
    rotation: _Vec4 = (0.0, 0.0, 0.0, 1.0)
    scale: _Vec3 = (1.0, 1.0, 1.0)


class _Skin(msgspec.Struct):
    joints: list[Index]
    inverseBindMatrices: Index | None = None


class _Scene(msgspec.Struct):
    nodes: list[Index] = []


class _Webp(msgspec.Struct):
    source: Index | None = None


class _PictureExtensions(msgspec.Struct):
    EXT_texture_webp: _Webp = msgspec.field(default_factory=_Webp)


class _Texture(msgspec.Struct):
    source: Index | None = None
    sampler: Index | None = None
    extensions: _PictureExtensions = msgspec.field(default_factory=_PictureExtensions)


class _Picture(msgspec.Struct):
    bufferView: Index | None = None
    uri: str = ""


class _Sampler(msgspec.Struct):
    wrapS: int = 10497
    wrapT: int = 10497


class _Transform(msgspec.Struct):
    offset: _Vec2 = (0.0, 0.0)
    rotation: float = 0.0
    scale: _Vec2 = (1.0, 1.0)
    texCoord: Index | None = None


class _TextureExtensions(msgspec.Struct):
    KHR_texture_transform: _Transform = msgspec.field(default_factory=_Transform)


class TextureInfo(msgspec.Struct):
    """A texture of a material, and where its coordinates are."""

    index: Index
    texCoord: Index = 0
    extensions: _TextureExtensions = msgspec.field(default_factory=_TextureExtensions)


class _Roughness(msgspec.Struct):
    baseColorFactor: _Vec4 = (1.0, 1.0, 1.0, 1.0)
    baseColorTexture: TextureInfo | None = None
    metallicRoughnessTexture: TextureInfo | None = None


class _Gloss(msgspec.Struct):
    diffuseFactor: _Vec4 = (1.0, 1.0, 1.0, 1.0)
    diffuseTexture: TextureInfo | None = None
    specularFactor: _Vec3 = (1.0, 1.0, 1.0)
    glossinessFactor: float = 1.0
    specularGlossinessTexture: TextureInfo | None = None


class _Strength(msgspec.Struct):
    emissiveStrength: float = 1.0


class _LookExtensions(msgspec.Struct):
    KHR_materials_pbrSpecularGlossiness: _Gloss | None = None
    KHR_materials_emissive_strength: _Strength = msgspec.field(default_factory=_Strength)


class Look(msgspec.Struct):
    """A material of the document."""

    pbrMetallicRoughness: _Roughness = msgspec.field(default_factory=_Roughness)
    emissiveFactor: _Vec3 = (0.0, 0.0, 0.0)
    emissiveTexture: TextureInfo | None = None
    normalTexture: TextureInfo | None = None
    occlusionTexture: TextureInfo | None = None
    alphaMode: str = "OPAQUE"
    alphaCutoff: float = 0.5
    extensions: _LookExtensions = msgspec.field(default_factory=_LookExtensions)


class _Document(msgspec.Struct):
    buffers: list[_Buffer] = []
    bufferViews: list[_View] = []
    accessors: list[_Accessor] = []
    meshes: list[_Mesh] = []
    nodes: list[_Node] = []
    skins: list[_Skin] = []
    scenes: list[_Scene] = []
    scene: Index = 0
    materials: list[Look] = []
    textures: list[_Texture] = []
    images: list[_Picture] = []
    samplers: list[_Sampler] = []
    extensionsUsed: list[str] = []
    extensionsRequired: list[str] = []


def _no_side_file(uri: str) -> bytes:
    raise UserError("its numbers lie in another file, which is not read")


@dataclass
class GltfFile:
    """A document, and the bytes that it speaks of.

    Attributes:
        path: named in errors.
        document: what the file says.
        extensions: the names of all that the document has anywhere.
        binary: the binary chunk of a ``.glb``, or None.
        side_file: reads what an URI names. Raises UserError.
    """

    path: Path
    document: _Document
    extensions: list[str]
    binary: bytes | None
    side_file: Callable[[str], bytes]
    _buffers: dict[int, bytes] = field(default_factory=dict)

    def item(self, what: str, index: int) -> Any:
        """One of the document's lists' entries. Raises UserError where there is none."""
        items = getattr(self.document, what)
        if index >= len(items):
            raise UserError(f"{self.path}: broken header ({what}[{index}] of {len(items)})")
        return items[index]

    def content(self, uri: str) -> bytes:
        """The bytes that an URI holds itself, or names. Raises UserError."""
        if not uri.startswith("data:"):
            return self.side_file(uri)
        head, _, data = uri.partition(",")
        try:
            return base64.b64decode(data) if head.endswith(";base64") else unquote_to_bytes(data)
        except ValueError as error:
            raise UserError(f"data that are not base64 ({error})") from error

    def view(self, index: int) -> memoryview:
        """The bytes of a view. Raises UserError where its buffer has less."""
        view = self.item("bufferViews", index)
        if view.buffer not in self._buffers:
            self._buffers[view.buffer] = self._buffer_bytes(view.buffer)
        there = self.item("buffers", view.buffer).byteLength - view.byteOffset
        says = f"the bytes of view {index}"
        compare_sizes(self.path, says, view.byteLength, there, exact=False)
        data = memoryview(self._buffers[view.buffer])
        return data[view.byteOffset : view.byteOffset + view.byteLength]

    def _buffer_bytes(self, index: int) -> bytes:
        buffer, data = self.item("buffers", index), self.binary
        if buffer.uri is not None:
            try:
                data = self.content(buffer.uri)
            except UserError as error:
                raise UserError(f"{self.path}: buffer {index}: {error}") from error
        elif index > 0 or data is None:
            self.refuse_packed()
            raise UserError(f"{self.path}: buffer {index} has no bytes")
        compare_sizes(self.path, f"buffer {index}", buffer.byteLength, len(data), exact=False)
        return data

    def refuse_packed(self) -> None:
        """Raises UserError where the document has an extension that packs triangles."""
        for name in self.extensions:
            if name in PACKED:
                raise UserError(
                    f"{self.path}: packed by {name}, which is not read; unpack it first"
                )

    def values(self, index: int) -> np.ndarray:
        """``[N, C]`` the numbers of an accessor, as they are stored; float64 if normalised.

        Raises:
            UserError: they are not in the file.
        """
        accessor = self.item("accessors", index)
        kind, says = np.dtype(_KINDS[accessor.componentType]), f"values of accessor {index}"
        shape, sparse = (accessor.count, _WIDTHS[accessor.type]), accessor.sparse
        if accessor.bufferView is None:
            if sparse is None:
                self.refuse_packed()
            wanted = kind.itemsize * shape[0] * shape[1]
            compare_sizes(self.path, f"{shape[0]} {says}", wanted, MAX_ZEROS, exact=False)
            rows = np.zeros(shape, kind)
        else:
            rows = self._rows(accessor, kind, shape, says)
        if sparse is not None:
            at = _KINDS[sparse.indices.componentType]
            found = self._rows(sparse.indices, at, (sparse.count, 1), says)[:, 0]
            if sparse.count and found.max() >= shape[0]:
                raise UserError(f"{self.path}: {says}: changes value {found.max()} of {shape[0]}")
            rows = rows.copy()
            rows[found] = self._rows(sparse.values, kind, (sparse.count, shape[1]), says)
        return normalised(rows) if accessor.normalized else rows

    def _rows(self, source: Any, kind: Any, shape: tuple[int, int], says: str) -> np.ndarray:
        data, size = self.view(source.bufferView), np.dtype(kind).itemsize
        step = self.item("bufferViews", source.bufferView).byteStride or size * shape[1]
        wanted = (shape[0] - 1) * step + size * shape[1] if shape[0] else 0
        there = len(data) - source.byteOffset
        compare_sizes(self.path, f"{shape[0]} {says}", wanted, there, exact=False)
        return np.ndarray(shape, kind, data, source.byteOffset, (step, size))

    def placed_nodes(self) -> list[tuple[_Node, int, np.ndarray]]:
        """Each node of the scene, its index, and its matrix ``[4, 4]`` in the scene.

        Raises:
            UserError: there are over ``MAX_NODES``, or a node is its own ancestor.
        """
        document = self.document
        if document.scenes:
            roots = self.item("scenes", document.scene).nodes
        else:  # glTF without a scene: all nodes that are no children
            inner = {child for node in document.nodes for child in node.children}
            roots = [index for index in range(len(document.nodes)) if index not in inner]
        found: list[tuple[_Node, int, np.ndarray]] = []
        left = [(root, np.eye(4)) for root in reversed(roots)]
        while left:
            if len(found) + len(left) > MAX_NODES:
                raise UserError(f"{self.path}: over {MAX_NODES} nodes, or nodes in a circle")
            index, above = left.pop()
            node = self.item("nodes", index)
            if node.matrix is not None:
                matrix = above @ np.array(node.matrix).reshape(4, 4).T
            else:
                matrix = above @ _pose(node.translation, node.rotation, node.scale)
            found.append((node, index, matrix))
            left += [(child, matrix) for child in reversed(node.children)]
        return found


def normalised(values: np.ndarray) -> np.ndarray:
    """Integers as the fractions that they stand for in glTF; floats stay as they are."""
    if values.dtype.kind == "f":
        return values
    return np.maximum(values / np.iinfo(values.dtype).max, -1.0)


def _pose(move: Sequence[float], rotation: Sequence[float], scale: Sequence[float]) -> np.ndarray:
    """``[4, 4]`` that scales, then turns by a quaternion xyzw of any length, then moves."""
    matrix = np.eye(4)
    length = sum(part**2 for part in rotation) ** 0.5
    x, y, z, w = (part / (length or 1.0) for part in rotation)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] *= scale
    matrix[:3, 3] = move
    return matrix


def open_gltf(
    path: Path, file: BinaryIO, size: int, side_file: Callable[[str], bytes] = _no_side_file
) -> GltfFile:
    """Reads the document of a glTF file, and its first binary chunk.

    Args:
        path: if its suffix is ``.gltf``, the file is a document; else a container of one.
        file: at its start.
        size: of the file, bytes.
        side_file: reads what an URI names.

    Raises:
        UserError: the container holds less or more than it says, the document is not one, or needs
            an extension that packs triangles.
    """
    text, binary = file.read(), None
    if path.suffix.lower() != ".gltf":
        text, binary = _chunks(path, text, size)
    document = parse_document(text, _Document, str(path))
    names = [name.decode("ascii", "replace") for name in _EXTENSION.findall(text)]
    names = list(dict.fromkeys([*document.extensionsUsed, *document.extensionsRequired, *names]))
    gltf = GltfFile(path, document, names, binary, side_file)
    if {*PACKED} & {*document.extensionsRequired}:
        gltf.refuse_packed()
    return gltf


def _chunks(path: Path, data: bytes, size: int) -> tuple[bytes, bytes]:
    if data[:4] != b"glTF":
        raise UserError(f"{path}: not a .glb file")
    if size < 12:
        raise UserError(f"{path}: broken header ({size} bytes)")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise UserError(f"{path}: cannot be read as a mesh (version {version} of .glb, not 2)")
    compare_sizes(path, "its header and chunks", length, size)
    found: dict[bool, bytes] = {}
    at = 12
    while at + 8 <= size:
        chunk, name = struct.unpack_from("<I4s", data, at)
        compare_sizes(path, f"a chunk at byte {at}", chunk, size - at - 8, exact=False)
        found.setdefault(name == b"JSON", data[at + 8 : at + 8 + chunk])
        at += 8 + chunk
    if True not in found:
        raise UserError(f"{path}: no JSON chunk")
    # Padded with blanks; some writers pad with zeros.
    return found[True].rstrip(b"\0 "), found.get(False, b"")
