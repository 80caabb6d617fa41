"""Reads Gaussians from binary glTF: the scene's primitives with ``KHR_gaussian_splatting``."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Annotated, Any, BinaryIO

import msgspec
import numpy as np
import torch
from msgspec import Meta
from torch.nn import functional as F

from ...errors import UserError
from ...gaussians import SH_C0, Gaussians
from ..headers import Accessor, Gltf, open_shape, read_glb
from .arrays import flip_axes, sound_gaussians
from .glb import COLOR_SPACE, EXTENSION, POINTS, harmonic_names

MAX_NODES = 10_000
_KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_STRAIGHT = 1e-4  # how far a node's matrix may be from a rotation times a number

_Index = Annotated[int, Meta(ge=0)]


class _Primitive(msgspec.Struct):
    attributes: dict[str, _Index] = {}
    mode: int = 4
    extensions: dict[str, Any] = {}


class _Mesh(msgspec.Struct):
    primitives: list[_Primitive] = []


class _Node(msgspec.Struct):
    mesh: _Index | None = None
    children: list[_Index] = []
    matrix: Annotated[list[float], Meta(min_length=16, max_length=16)] | None = None
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)


class _Scene(msgspec.Struct):
    nodes: list[_Index] = []


class _Document(Gltf):
    meshes: list[_Mesh] = []
    nodes: list[_Node] = []
    scenes: list[_Scene] = []
    scene: _Index | None = None


def holds_gaussians(path: Path, file: BinaryIO, size: int) -> bool:
    """Whether a .glb file has a primitive with the extension; False for whatever is damaged."""
    try:
        document, _ = read_glb(path, file, size, _Document)
    except (UserError, struct.error, IndexError):
        return False
    return any(EXTENSION in p.extensions for mesh in document.meshes for p in mesh.primitives)


def load_glb(path: str | Path) -> Gaussians:
    """Reads all Gaussians of a ``.glb``'s scene, moved as its nodes say, as one object.

    Raises:
        UserError: not a file, not ``.glb``, truncated or false, no Gaussians in it, an attribute
            that is missing or of a kind that the extension does not have, another colour space, a
            node that stretches or mirrors, or values that are not those of Gaussians.
    """
    path = Path(path)
    with open_shape(path) as (file, size):
        try:
            document, binary = read_glb(path, file, size, _Document)
            parts = [
                _moved(path, _primitive(path, document, binary, primitive), matrix)
                for primitive, matrix in _placed(path, document)
            ]
        except (struct.error, IndexError) as error:
            raise UserError(f"{path}: broken header ({error})") from error
    if not parts:
        raise UserError(f"{path}: no Gaussians in it (no primitive has {EXTENSION})")
    return flip_axes(_joined(parts))


def _placed(path: Path, document: _Document) -> list[tuple[_Primitive, np.ndarray]]:
    """Every primitive with the extension in the scene, with the matrix ``[4, 4]`` of its node."""
    scene = document.scene or 0
    if document.scenes:
        roots = document.scenes[scene].nodes
    else:  # glTF without a scene: all nodes that are no children
        inner = {child for node in document.nodes for child in node.children}
        roots = [index for index in range(len(document.nodes)) if index not in inner]
    found: list[tuple[_Primitive, np.ndarray]] = []
    left = [(root, np.eye(4)) for root in roots]
    for _ in range(MAX_NODES):
        if not left:
            return found
        index, above = left.pop()
        node = document.nodes[index]
        matrix = above @ _matrix(node)
        left += [(child, matrix) for child in node.children]
        primitives = [] if node.mesh is None else document.meshes[node.mesh].primitives
        found += [(p, matrix) for p in primitives if EXTENSION in p.extensions]
    raise UserError(f"{path}: over {MAX_NODES} nodes, or nodes in a circle")


def _matrix(node: _Node) -> np.ndarray:
    if node.matrix is not None:
        return np.array(node.matrix).reshape(4, 4).T
    x, y, z, w = node.rotation
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] *= node.scale
    matrix[:3, 3] = node.translation
    return matrix


def _primitive(path: Path, document: _Document, binary: bytes, primitive: _Primitive) -> Gaussians:
    """The Gaussians of one primitive in its own frame."""
    options = primitive.extensions[EXTENSION]
    options = options if isinstance(options, dict) else {}
    if options.get("extensions"):
        names = ", ".join(str(name)[:60] for name in options["extensions"])
        raise UserError(f"{path}: its Gaussians are packed by {names[:200]}, which is not read")
    space, kernel = options.get("colorSpace", COLOR_SPACE), options.get("kernel", "ellipse")
    if space != COLOR_SPACE or kernel != "ellipse" or primitive.mode != POINTS:
        raise UserError(
            f"{path}: Gaussians of colour space {str(space)[:40]!r}, kernel {str(kernel)[:40]!r} "
            f"and mode {primitive.mode}; only {COLOR_SPACE}, ellipse and {POINTS} are read"
        )

    def read(name: str, width: int) -> np.ndarray:
        if name not in primitive.attributes:
            raise UserError(f"{path}: the Gaussians have no {name}")
        accessor = document.accessors[primitive.attributes[name]]
        return _values(path, document, binary, accessor, name, width)

    degree = 0
    while f"{EXTENSION}:SH_DEGREE_{degree + 1}_COEF_0" in primitive.attributes:
        degree += 1
    if degree > 3:
        raise UserError(f"{path}: harmonics of degree {degree}, only 0 to 3 are read")
    arrays = {
        "means": read("POSITION", 3),
        "quats": np.roll(read(f"{EXTENSION}:ROTATION", 4), 1, axis=1),
        "scales": read(f"{EXTENSION}:SCALE", 3),
        "opacities": read(f"{EXTENSION}:OPACITY", 1)[:, 0],
        "colors": read(f"{EXTENSION}:SH_DEGREE_0_COEF_0", 3) * SH_C0 + 0.5,
    }
    if degree:
        arrays["harmonics"] = np.stack([read(name, 3) for name in harmonic_names(degree)], 1)
    counts = {name: len(value) for name, value in arrays.items()}
    if len(set(counts.values())) > 1:
        raise UserError(f"{path}: false header, its attributes have {counts} values")
    if (arrays["scales"] < 0).any():
        raise UserError(
            f"{path}: scales below 0; a draft of {EXTENSION} stored logarithms, which is not read"
        )
    return sound_gaussians(path, arrays)


def _values(
    path: Path, document: _Document, binary: bytes, accessor: Accessor, name: str, width: int
) -> np.ndarray:
    """``[N, width]`` float64, the values of an accessor; those of integers are normalised."""
    if _WIDTHS.get(accessor.type) != width or accessor.bufferView is None:
        raise UserError(f"{path}: {name} is of type {accessor.type}, or has no data")
    view = document.bufferViews[accessor.bufferView]
    if view.buffer != 0:
        raise UserError(f"{path}: {name} lies in another file, which is not read")
    kind = np.dtype(_KINDS[accessor.componentType])
    step = view.byteStride or kind.itemsize * width
    start = view.byteOffset + accessor.byteOffset
    end = start + (accessor.count - 1) * step + kind.itemsize * width if accessor.count else start
    if end > len(binary):
        raise UserError(f"{path}: truncated, {name} ends at byte {end} of {len(binary)}")
    values = np.ndarray((accessor.count, width), kind, binary, start, (step, kind.itemsize))
    if kind.kind == "f":
        return values.astype(np.float64)
    most = np.iinfo(kind).max if accessor.normalized else 1
    return np.maximum(values.astype(np.float64) / most, -1.0 if accessor.normalized else -np.inf)


def _moved(path: Path, gaussians: Gaussians, matrix: np.ndarray) -> Gaussians:
    """The Gaussians moved by a node. Raises UserError where it stretches or mirrors."""
    if not np.isfinite(matrix).all():
        raise UserError(f"{path}: a node's place is not finite")
    if (matrix == np.eye(4)).all():
        return gaussians
    with np.errstate(all="ignore"):
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        turn = matrix[:3, :3] / scale
        straight = np.abs(turn @ turn.T - np.eye(3)).max() < _STRAIGHT
    if not (scale > 0 and straight):
        raise UserError(f"{path}: a node stretches or mirrors its Gaussians, which is not read")
    moved = gaussians.transformed(
        torch.from_numpy(turn).float(), torch.from_numpy(matrix[:3, 3].copy()).float(), scale
    )
    arrays = {name: value.numpy() for name, value in vars(moved).items() if value is not None}
    return sound_gaussians(path, arrays)


def _joined(parts: list[Gaussians]) -> Gaussians:
    """All parts as one object; those of a lower degree get harmonics of zero."""
    if len(parts) == 1:
        return parts[0]
    most = max(0 if part.harmonics is None else part.harmonics.shape[1] for part in parts)
    for part in parts if most else ():
        own = torch.zeros(part.num, 0, 3) if part.harmonics is None else part.harmonics
        part.harmonics = F.pad(own, (0, 0, 0, most - own.shape[1]))
    names = [name for name, value in vars(parts[0]).items() if value is not None]
    return Gaussians(**{name: torch.cat([getattr(p, name) for p in parts]) for name in names})
