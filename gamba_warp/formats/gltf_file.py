"""The document of a glTF file, the numbers that its accessors name, and its nodes.

An index, an offset or a length is checked where it is used: what nothing uses may be false.
"""

from __future__ import annotations

import base64
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

Index = Annotated[int, msgspec.Meta(ge=0, le=MAX_FILE)]
Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]
Vec4 = tuple[float, float, float, float]
_Kind = Literal[5120, 5121, 5122, 5123, 5125, 5126]


class _Buffer(msgspec.Struct):
    byteLength: Index
    uri: str | None = None


class _View(msgspec.Struct):
    buffer: Index
    byteLength: Index
    byteOffset: Index = 0
    byteStride: Annotated[int, msgspec.Meta(ge=1, le=252)] | None = None


class _SparseIndices(msgspec.Struct):
    bufferView: Index
    componentType: Literal[5121, 5123, 5125]
    byteOffset: Index = 0


class _SparseValues(msgspec.Struct):
    bufferView: Index
    byteOffset: Index = 0


class _Sparse(msgspec.Struct):
    count: Index
    indices: _SparseIndices
    values: _SparseValues


class Accessor(msgspec.Struct):
    """The numbers in a view of a buffer."""

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
    targets: list[dict[str, Any]] = []
    extensions: dict[str, Any] = {}


class Mesh(msgspec.Struct):
    """Primitives with the weights of their morph targets."""

    primitives: list[Primitive] = []
    weights: list[float] = []


class Node(msgspec.Struct):
    """A place in the scene, with what stands there."""

    mesh: Index | None = None
    skin: Index | None = None
    children: list[Index] = []
    weights: list[float] = []
    matrix: Annotated[list[float], msgspec.Meta(min_length=16, max_length=16)] | None = None
    translation: Vec3 = (0.0, 0.0, 0.0)
    rotation: Vec4 = (0.0, 0.0, 0.0, 1.0)
    scale: Vec3 = (1.0, 1.0, 1.0)
    extensions: dict[str, Any] = {}


class Skin(msgspec.Struct):
    """The nodes that move a mesh's vertices."""

    joints: list[Index] = []
    inverseBindMatrices: Index | None = None


class _Scene(msgspec.Struct):
    nodes: list[Index] = []


class Texture(msgspec.Struct):
    """A picture and how it goes on outside of it."""

    source: Index | None = None
    sampler: Index | None = None
    extensions: dict[str, Any] = {}


class Picture(msgspec.Struct):
    """Where the bytes of a picture are."""

    bufferView: Index | None = None
    uri: str | None = None


class Sampler(msgspec.Struct):
    """How a texture goes on outside of its picture."""

    wrapS: int = 10497
    wrapT: int = 10497


class Document(msgspec.Struct):
    """What is read of a glTF document; materials are decoded by those who use them."""

    buffers: list[_Buffer] = []
    bufferViews: list[_View] = []
    accessors: list[Accessor] = []
    meshes: list[Mesh] = []
    nodes: list[Node] = []
    skins: list[Skin] = []
    scenes: list[_Scene] = []
    scene: Index | None = None
    materials: list[msgspec.Raw] = []
    textures: list[Texture] = []
    images: list[Picture] = []
    samplers: list[Sampler] = []
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
        binary: the binary chunk of a ``.glb``, or None.
        side_file: reads what an URI names. Raises UserError.
    """

    path: Path
    document: Document
    binary: bytes | None = None
    side_file: Callable[[str], bytes] = _no_side_file
    _buffers: dict[int, bytes] = field(default_factory=dict)

    def item(self, what: str, index: int) -> Any:
        """One of the document's lists' entries. Raises UserError where there is none."""
        items = getattr(self.document, what)
        if index >= len(items):
            raise UserError(f"{self.path}: broken header ({what}[{index}] of {len(items)})")
        return items[index]

    def declared(self, value: Any, kind: Any, where: str) -> Any:
        """A part of the document as a declared type. Raises UserError where it is not of it."""
        try:
            return msgspec.convert(value, kind)
        except msgspec.ValidationError as error:
            raise UserError(f"{self.path}: {where}: {error}") from error

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
        buffer = self.item("buffers", view.buffer)
        if view.buffer not in self._buffers:
            self._buffers[view.buffer] = self._buffer_bytes(view.buffer, buffer)
        there = buffer.byteLength - view.byteOffset
        says = f"the bytes of view {index}"
        compare_sizes(self.path, says, view.byteLength, there, exact=False)
        data = memoryview(self._buffers[view.buffer])
        return data[view.byteOffset : view.byteOffset + view.byteLength]

    def _buffer_bytes(self, index: int, buffer: _Buffer) -> bytes:
        if buffer.uri is not None:
            try:
                data = self.content(buffer.uri)
            except UserError as error:
                raise UserError(f"{self.path}: buffer {index}: {error}") from error
        elif index == 0 and self.binary is not None:
            data = self.binary
        else:
            packed = [name for name in PACKED if name in self.document.extensionsUsed]
            reason = f", packed by {packed[0]}, which is not read" if packed else ""
            raise UserError(f"{self.path}: buffer {index} has no bytes{reason}")
        compare_sizes(self.path, f"buffer {index}", buffer.byteLength, len(data), exact=False)
        return data

    def values(self, index: int) -> np.ndarray:
        """``[N, C]`` the numbers of an accessor, as they are stored; float64 if normalised.

        Raises:
            UserError: they are not in the file.
        """
        accessor = self.item("accessors", index)
        kind, says = np.dtype(_KINDS[accessor.componentType]), f"values of accessor {index}"
        shape = accessor.count, _WIDTHS[accessor.type]
        if accessor.bufferView is None:
            wanted = kind.itemsize * shape[0] * shape[1]
            compare_sizes(self.path, f"{shape[0]} {says}", wanted, MAX_ZEROS, exact=False)
            rows = np.zeros(shape, kind)
        else:
            rows = self._rows(accessor.bufferView, accessor.byteOffset, kind, shape, says)
        if accessor.sparse is not None:
            count, where, new = (
                accessor.sparse.count,
                accessor.sparse.indices,
                accessor.sparse.values,
            )
            at = _KINDS[where.componentType]
            found = self._rows(where.bufferView, where.byteOffset, at, (count, 1), says)[:, 0]
            if count and found.max() >= shape[0]:
                raise UserError(f"{self.path}: {says}: changes value {found.max()} of {shape[0]}")
            rows = rows.copy()
            changed = count, shape[1]
            rows[found] = self._rows(new.bufferView, new.byteOffset, kind, changed, says)
        return normalised(rows) if accessor.normalized else rows

    def _rows(
        self, view: int, offset: int, kind: Any, shape: tuple[int, int], says: str
    ) -> np.ndarray:
        data, size = self.view(view), np.dtype(kind).itemsize
        step = self.item("bufferViews", view).byteStride or size * shape[1]
        wanted = (shape[0] - 1) * step + size * shape[1] if shape[0] else 0
        compare_sizes(self.path, f"{shape[0]} {says}", wanted, len(data) - offset, exact=False)
        return np.ndarray(shape, kind, data, offset, (step, size))

    def placed_nodes(self) -> list[tuple[Node, int, np.ndarray]]:
        """Each node of the scene, its index, and its matrix ``[4, 4]`` in the scene.

        Raises:
            UserError: there are over ``MAX_NODES``, or a node is its own ancestor.
        """
        document = self.document
        if document.scenes:
            roots = self.item("scenes", document.scene or 0).nodes
        else:  # glTF without a scene: all nodes that are no children
            inner = {child for node in document.nodes for child in node.children}
            roots = [index for index in range(len(document.nodes)) if index not in inner]
        found: list[tuple[Node, int, np.ndarray]] = []
        left = [(root, np.eye(4)) for root in reversed(roots)]
        while left:
            if len(found) + len(left) > MAX_NODES:
                raise UserError(f"{self.path}: over {MAX_NODES} nodes, or nodes in a circle")
            index, above = left.pop()
            node = self.item("nodes", index)
            if node.matrix is not None:
                matrix = above @ np.array(node.matrix).reshape(4, 4).T
            else:
                matrix = above @ pose_matrix(node.translation, node.rotation, node.scale)
            found.append((node, index, matrix))
            left += [(child, matrix) for child in reversed(node.children)]
        return found


def normalised(values: np.ndarray) -> np.ndarray:
    """Integers as the fractions that they stand for in glTF; floats stay as they are."""
    if values.dtype.kind == "f":
        return values
    return np.maximum(values / np.iinfo(values.dtype).max, -1.0)


def pose_matrix(
    translation: Sequence[float], rotation: Sequence[float], scale: Sequence[float]
) -> np.ndarray:
    """``[4, 4]`` that scales, then turns by a quaternion xyzw of any length, then moves."""
    matrix = np.eye(4)
    length = sum(float(part) ** 2 for part in rotation)
    x, y, z, w = (float(part) / np.sqrt(length or 1.0) for part in rotation)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] *= scale
    matrix[:3, 3] = translation
    return matrix


def open_gltf(
    path: Path, file: BinaryIO, size: int, side_file: Callable[[str], bytes] = _no_side_file
) -> GltfFile:
    """Reads the document of a ``.glb`` or ``.gltf`` file, and the first binary chunk.

    Args:
        path: its suffix says which of both it is.
        file: at its start.
        size: of the file, bytes.
        side_file: reads what an URI names.

    Raises:
        UserError: the container holds less or more than it says, the document is not one, or needs
            an extension that packs triangles.
    """
    text, binary = file.read(), None
    if path.suffix.lower() == ".glb":
        text, binary = _chunks(path, text, size)
    document = parse_document(text, Document, str(path))
    for name in PACKED:
        if name in document.extensionsRequired:
            raise UserError(f"{path}: packed by {name}, which is not read; unpack it first")
    return GltfFile(path, document, binary, side_file)


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
