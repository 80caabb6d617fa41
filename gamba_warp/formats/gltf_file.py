"""Document, accessors and nodes of a glTF file.

Indices, offsets and lengths are checked where they are used: unused ones may be invalid.
"""

from __future__ import annotations

import base64
import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import unquote, unquote_to_bytes

import msgspec
import numpy as np

from ..errors import UserError
from ..untrusted.documents import parse_document
from .headers import MAX_FILE, Source, compare_sizes
from .materials import SideFiles

MAX_NODES = 200_000  # of a scene, each way to a node counted, and instances of its meshes
MAX_PRIMITIVES = 20_000  # in a scene
# Numbers that a file may mean, in its accessors and in the vertices and faces of its scene: values
# without bytes, shared accessors and instances let a few bytes stand for any number of them.
FREE_NUMBERS, NUMBERS_PER_BYTE = 3_000_000, 8
# Extensions that pack triangles; a reader without them sees zeros.
PACKED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
INSTANCING = "EXT_mesh_gpu_instancing"
_KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_EXTENSION = re.compile(rb'"([A-Z]{2,10}_[a-z]\w{1,60})"\s*:')  # some files do not list them

Index = Annotated[int, msgspec.Meta(ge=0, le=MAX_FILE)]
_Kind = Literal[5120, 5121, 5122, 5123, 5125, 5126]
_Width = Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"]
_Stride = Annotated[int, msgspec.Meta(ge=1, le=252)]
# Translation, rotation (a quaternion xyzw) and scale without effect.
_IDENTITY = {"translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]}
_UNIT = np.eye(4)


class Entry:
    """An object at ``where`` in the document; its values are checked when they are asked for."""

    def __init__(self, where: str, values: Any) -> None:
        if not isinstance(values, dict):
            raise UserError(f"{where} is not an object")
        self.where, self.values = where, values

    def get(self, name: str, kind: Any, default: Any = None) -> Any:
        """Return a value of a declared type, or the default. Raises UserError."""
        return default if self.values.get(name) is None else self.need(name, kind)

    def need(self, name: str, kind: Any) -> Any:
        """Return a value of a declared type. Raises UserError if missing or of another type."""
        try:
            return msgspec.convert(self.values.get(name), kind)
        except msgspec.ValidationError as error:
            raise UserError(f"{self.where}.{name}: {error}") from error

    def vector(self, name: str, default: Sequence[float]) -> np.ndarray:
        """Return as many numbers as the default has, float64. Raises UserError."""
        kind = Annotated[
            list[float], msgspec.Meta(min_length=len(default), max_length=len(default))
        ]
        return np.array(self.get(name, kind, default), np.float64)

    def entry(self, name: str) -> Entry:
        """Return an object in the object, empty if missing. Raises UserError."""
        return Entry(f"{self.where}.{name}", self.values.get(name) or {})

    def entries(self, name: str) -> list[Entry]:
        """Return the objects of a list, empty if missing. Raises UserError."""
        items = self.get(name, list, [])
        return [Entry(f"{self.where}.{name}[{i}]", item) for i, item in enumerate(items)]


@dataclass
class GltfFile:
    """A document and its buffers. All methods raise UserError if the file is malformed."""

    path: Path  # named in errors
    document: Entry  # the root object
    extensions: list[str]  # names of all extensions anywhere in the document
    binary: bytes | None  # the binary chunk of a .glb
    sides: SideFiles  # reads the files of URIs
    size: int  # bytes, including other files of it that were read
    _numbers: int = 0
    _buffers: dict[int, bytes] = field(default_factory=dict)
    _lists: dict[str, list[Entry]] = field(default_factory=dict)
    _values: dict[int, np.ndarray] = field(default_factory=dict)

    def count(self, numbers: int) -> None:
        """Add to the numbers of the scene; raise UserError if the file is too small for them."""
        self._numbers += numbers
        if self._numbers > FREE_NUMBERS + NUMBERS_PER_BYTE * self.size:
            raise UserError(
                f"{self.path}: its {self.size} bytes expand to over {self._numbers} numbers"
            )

    def item(self, what: str, index: int) -> Entry:
        """Return an entry of one of the document's lists."""
        if what not in self._lists:
            self._lists[what] = self.document.entries(what)
        items = self._lists[what]
        if index >= len(items):
            raise UserError(f"{self.path}: broken header ({what}[{index}] of {len(items)})")
        return items[index]

    def content(self, uri: str) -> bytes:
        """Return the bytes of a URI: embedded data, or a file in the document's folder."""
        if not uri.startswith("data:"):
            content = self.sides.read(unquote(uri), uri)
            self.size += len(content)
            return content
        head, _, data = uri.partition(",")
        try:
            return base64.b64decode(data) if head.endswith(";base64") else unquote_to_bytes(data)
        except ValueError as error:
            raise UserError(f"data are not valid base64 ({error})") from error

    def view(self, index: int) -> memoryview:
        """Return the bytes of a view."""
        view = self.item("bufferViews", index)
        buffer, length = view.need("buffer", Index), view.need("byteLength", Index)
        start = view.get("byteOffset", Index, 0)
        if buffer not in self._buffers:
            self._buffers[buffer] = self._buffer(buffer)
        data = memoryview(self._buffers[buffer])[start:]
        compare_sizes(self.path, f"the bytes of view {index}", length, len(data), exact=False)
        return data[:length]

    def _buffer(self, index: int) -> bytes:
        buffer, data = self.item("buffers", index), self.binary
        uri, length = buffer.get("uri", str), buffer.need("byteLength", Index)
        if uri is not None:
            try:
                data = self.content(uri)
            except UserError as error:
                raise UserError(f"{self.path}: buffer {index}: {error}") from error
        elif index > 0 or data is None:
            self.refuse_packed()
            raise UserError(f"{self.path}: buffer {index} has no bytes")
        compare_sizes(self.path, f"buffer {index}", length, len(data), exact=False)
        return data[:length]

    def refuse_packed(self) -> None:
        """Raise UserError if the document has an extension that packs triangles."""
        for name in self.extensions:
            if name in PACKED:
                reason = f"compressed by {name}, which is not supported; decompress it first"
                raise UserError(f"{self.path}: {reason}")

    def values(self, index: int) -> np.ndarray:
        """Return the numbers of an accessor, ``[N, C]``, as stored; float64 if normalised."""
        if index in self._values:
            return self._values[index]
        accessor = self.item("accessors", index)
        kind, says = np.dtype(_KINDS[accessor.need("componentType", _Kind)]), f"accessor {index}"
        shape = accessor.need("count", Index), _WIDTHS[accessor.need("type", _Width)]
        self.count(shape[0] * shape[1])
        sparse = accessor.entry("sparse")
        if accessor.get("bufferView", Index) is None:
            if not sparse.values:
                self.refuse_packed()
            rows = np.zeros(shape, kind)
        else:
            rows = self._rows(accessor, kind, shape, says)
        if sparse.values:
            count, where = sparse.need("count", Index), sparse.entry("indices")
            at = _KINDS[where.need("componentType", Literal[5121, 5123, 5125])]
            indices = self._rows(where, at, (count, 1), says)[:, 0]
            if count and indices.max() >= shape[0]:
                raise UserError(f"{self.path}: {says} changes value {indices.max()} of {shape[0]}")
            rows = rows.copy()
            rows[indices] = self._rows(sparse.entry("values"), kind, (count, shape[1]), says)
        self._values[index] = normalised(rows) if accessor.get("normalized", bool) else rows
        return self._values[index]

    def _rows(self, source: Entry, kind: Any, shape: tuple[int, int], says: str) -> np.ndarray:
        index, start = source.need("bufferView", Index), source.get("byteOffset", Index, 0)
        data, size = self.view(index), np.dtype(kind).itemsize
        step = self.item("bufferViews", index).get("byteStride", _Stride, size * shape[1])
        wanted = (shape[0] - 1) * step + size * shape[1] if shape[0] else 0
        says = f"{shape[0]} values of {says}"
        compare_sizes(self.path, says, wanted, len(data) - start, exact=False)
        return np.ndarray(shape, kind, data, start, (step, size))

    def placed_nodes(self) -> list[tuple[Entry, int, np.ndarray]]:
        """Return each node of the scene, its index, and its matrix ``[4, 4]`` in the scene."""
        kind = list[Index]
        if self.document.values.get("scenes"):
            scene = self.item("scenes", self.document.get("scene", Index, 0))
            roots = scene.get("nodes", kind, [])
        else:  # glTF without a scene: all nodes that are not children
            nodes = self.document.entries("nodes")
            inner = {child for node in nodes for child in node.get("children", kind, [])}
            roots = [index for index in range(len(nodes)) if index not in inner]
        by_index = self._own_nodes(roots)
        placed: list[tuple[Entry, int, np.ndarray]] = []
        left = [(root, _UNIT, 0) for root in reversed(roots)]
        most = min(MAX_NODES, 8 * len(by_index))
        while left:
            index, above, depth = left.pop()
            # A longer way has a node twice.
            if len(placed) + len(left) > most or depth > len(by_index):
                raise UserError(f"{self.path}: nodes form a cycle, or are shared over {most} times")
            node, children, matrix = by_index[index]
            matrix = matrix if above is _UNIT else above @ matrix
            placed.append((node, index, matrix))
            left += [(child, matrix, depth + 1) for child in reversed(children)]
        return placed

    def _own_nodes(self, roots: list[int]) -> dict[int, tuple[Entry, list[int], np.ndarray]]:
        """Return each node under the roots with its children and its own matrix, by index."""
        nodes, children, left = {}, {}, [*roots]
        moves, matrices = {name: [] for name in _IDENTITY}, {}
        while left:
            index = left.pop()
            if index in nodes:
                continue
            if len(nodes) >= MAX_NODES:
                raise UserError(f"{self.path}: over {MAX_NODES} nodes")
            nodes[index] = node = self.item("nodes", index)
            children[index] = node.get("children", list[Index], [])
            left += children[index]
            if node.values.get("matrix") is not None:
                matrices[index] = node.vector("matrix", range(16)).reshape(4, 4).T
            for name, default in _IDENTITY.items():
                given = index not in matrices and node.values.get(name) is not None
                moves[name].append(node.vector(name, default) if given else default)
        if nodes:
            composed = _matrices(*(np.array(moves[name], np.float64) for name in _IDENTITY))
            matrices = dict(zip(nodes, composed)) | matrices
        return {index: (node, children[index], matrices[index]) for index, node in nodes.items()}

    def instances(self, node: Entry) -> np.ndarray:
        """Return the matrices ``[N, 4, 4]`` of the instances of a node's mesh in the node's frame.

        They come from ``EXT_mesh_gpu_instancing``; without it, one unit matrix.
        """
        attributes = node.entry("extensions").entry(INSTANCING).entry("attributes")
        if not attributes.values:
            return _UNIT[None]
        pose, counts = [], set()
        for name, default in _IDENTITY.items():
            rows = np.array([default])
            if name.upper() in attributes.values:
                rows = normalised(self.values(attributes.need(name.upper(), Index)))
                counts.add(len(rows))
            if len(counts) > 1 or rows.shape[1] != len(default):
                raise UserError(f"{attributes.where}: {len(rows)} x {rows.shape[1]} numbers {name}")
            pose.append(rows.astype(np.float64))
        count = counts.pop() if counts else 1
        self.count(16 * count)
        return _matrices(*(np.broadcast_to(rows, (count, rows.shape[1])) for rows in pose))


def normalised(values: np.ndarray) -> np.ndarray:
    """Return the fractions that integers stand for in glTF; floats are unchanged."""
    if values.dtype.kind == "f":
        return values
    return np.maximum(values / np.iinfo(values.dtype).max, -1.0)


@np.errstate(all="ignore")  # untrusted numbers; the vertices are checked
def _matrices(moves: np.ndarray, quats: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Return ``[N, 4, 4]`` that scale, then rotate by quaternions of any length, then move."""
    lengths = np.linalg.norm(quats, axis=1)
    x, y, z, w = quats.T / np.where(lengths == 0, 1.0, lengths)
    rotations = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrices = np.zeros((len(moves), 4, 4))
    matrices[:, :3, :3] = rotations.transpose(2, 0, 1) * scales[:, None]
    matrices[:, :3, 3], matrices[:, 3, 3] = moves, 1.0
    return matrices


def open_gltf(source: Source, sides: SideFiles) -> GltfFile:
    """Read the document of a glTF file, and its first binary chunk.

    Args:
        source: if its suffix is ``.gltf``, the file is a document; else a container of one.
        sides: reads the files of URIs.

    Raises:
        UserError: the container or the document is malformed, or it requires an extension that
            packs triangles.
    """
    path, file, size = source
    text, binary = file.read(), None
    if path.suffix.lower() != ".gltf":
        text, binary = _chunks(path, text, size)
    document = Entry(str(path), parse_document(text, dict[str, Any], str(path)))
    needed = document.get("extensionsRequired", list[str], [])
    names = [name.decode("ascii", "replace") for name in _EXTENSION.findall(text)]
    names = dict.fromkeys([*document.get("extensionsUsed", list[str], []), *needed, *names])
    gltf = GltfFile(path, document, list(names), binary, sides, size)
    if {*PACKED} & {*needed}:
        gltf.refuse_packed()
    return gltf


def _chunks(path: Path, data: bytes, size: int) -> tuple[bytes, bytes]:
    """Return the JSON chunk and the first binary one of a container."""
    if data[:4] != b"glTF":
        raise UserError(f"{path}: not a .glb file")
    if size < 12:
        raise UserError(f"{path}: broken header ({size} bytes)")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise UserError(f"{path}: cannot be read as a mesh (version {version} of .glb, not 2)")
    compare_sizes(path, "its header and chunks", length, size)
    chunks: dict[bool, bytes] = {}
    at = 12
    while at + 8 <= size:
        chunk, name = struct.unpack_from("<I4s", data, at)
        compare_sizes(path, f"a chunk at byte {at}", chunk, size - at - 8, exact=False)
        chunks.setdefault(name == b"JSON", data[at + 8 : at + 8 + chunk])
        at += 8 + chunk
    if True not in chunks:
        raise UserError(f"{path}: no JSON chunk")
    # Padded with blanks; some writers pad with zeros.
    return chunks[True].rstrip(b"\0 "), chunks.get(False, b"")
