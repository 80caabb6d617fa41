"""Reader of Gaussians in binary glTF by the Khronos extension ``KHR_gaussian_splatting``.

Scales are linear (early drafts of the extension stored logarithms), quaternions xyzw, axes +y up.
Colours are display values, as the extension's ``srgb_rec709_display`` says.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional as F

from ...errors import UserError
from ...gaussians import SH_C0, Gaussians
from ..gltf_file import Entry, GltfFile, Index
from .arrays import checked_gaussians, flip_axes

EXTENSION = "KHR_gaussian_splatting"
COLOR_SPACE = "srgb_rec709_display"
POINTS = 0
_STRAIGHT = 1e-4  # largest deviation of a node's matrix from a rotation times a number


def has_gaussians(file: GltfFile) -> bool:
    """Return True if a primitive has the extension. Raises UserError if the file is malformed."""
    return any(_splats(mesh) for mesh in file.document.entries("meshes"))


def _splats(mesh: Entry) -> list[Entry]:
    """Return the primitives of a mesh that have the extension."""
    return [p for p in mesh.entries("primitives") if EXTENSION in p.entry("extensions").values]


def gltf_gaussians(file: GltfFile, left_out: list[str] | None = None) -> Gaussians:
    """Read all Gaussians of a ``.glb``'s scene, moved by its nodes, as one object.

    ``left_out`` as for ``checked_gaussians``, with a line for each primitive.

    Raises:
        UserError: the file is malformed or its scene without Gaussians, an attribute is missing or
            of another type, the colour space is another, a node stretches or mirrors, or the
            values are invalid.
    """
    path, parts = file.path, []
    for node, _, matrix in file.placed_nodes():
        index = node.get("mesh", Index)
        primitives = [] if index is None else _splats(file.item("meshes", index))
        for primitive in primitives:
            part = _primitive(file, primitive, left_out)
            poses = matrix @ file.instances(node)
            parts += [_moved(path, part, pose, left_out) for pose in poses]
    if not parts:
        raise UserError(f"{path}: contains no Gaussians (no primitive has {EXTENSION})")
    return flip_axes(_joined(parts))


def _primitive(file: GltfFile, primitive: Entry, left_out: list[str] | None) -> Gaussians:
    """Return the Gaussians of one primitive in its own frame."""
    path, options = file.path, primitive.entry("extensions").entry(EXTENSION).values
    mode, attributes = primitive.get("mode", int, 4), primitive.entry("attributes")
    if options.get("extensions"):
        names = ", ".join(str(name)[:60] for name in options["extensions"])
        raise UserError(f"{path}: its Gaussians' compression {names[:200]} is not supported")
    space, kernel = options.get("colorSpace", COLOR_SPACE), options.get("kernel", "ellipse")
    if space != COLOR_SPACE or kernel != "ellipse" or mode != POINTS:
        raise UserError(
            f"{path}: Gaussians of colour space {str(space)[:40]!r}, kernel {str(kernel)[:40]!r} "
            f"and mode {mode}; only {COLOR_SPACE}, ellipse and {POINTS} are supported"
        )

    def read(name: str, width: int) -> np.ndarray:
        if name not in attributes.values:
            raise UserError(f"{path}: the Gaussians have no {name}")
        index = attributes.need(name, Index)
        values = file.values(index)
        accessor = file.item("accessors", index).values
        if values.shape[1] != width or "bufferView" not in accessor:
            raise UserError(f"{path}: {name} is of type {accessor['type']}, or has no data")
        return values.astype(np.float64)

    degree = 0
    while f"{EXTENSION}:SH_DEGREE_{degree + 1}_COEF_0" in attributes.values:
        degree += 1
    if degree > 3:
        raise UserError(f"{path}: harmonics of degree {degree}, only 0 to 3 are supported")
    arrays = {
        "means": read("POSITION", 3),
        "quats": np.roll(read(f"{EXTENSION}:ROTATION", 4), 1, axis=1),
        "scales": read(f"{EXTENSION}:SCALE", 3),
        "opacities": read(f"{EXTENSION}:OPACITY", 1)[:, 0],
        "colors": read(f"{EXTENSION}:SH_DEGREE_0_COEF_0", 3) * SH_C0 + 0.5,
    }
    harmonics = [
        read(f"{EXTENSION}:SH_DEGREE_{l}_COEF_{n}", 3)
        for l in range(1, degree + 1)
        for n in range(2 * l + 1)
    ]
    counts = {name: len(value) for name, value in arrays.items()}
    counts |= {f"coefficient {i}": len(value) for i, value in enumerate(harmonics)}
    if len(set(counts.values())) > 1:
        raise UserError(f"{path}: invalid header, its attributes have {counts} values")
    if harmonics:
        arrays["harmonics"] = np.stack(harmonics, 1)
    if (arrays["scales"] < 0).any():
        raise UserError(
            f"{path}: negative scales; drafts of {EXTENSION} with logarithms are not supported"
        )
    return checked_gaussians(path, arrays, left_out)


def _moved(
    path: Path, gaussians: Gaussians, matrix: np.ndarray, left_out: list[str] | None
) -> Gaussians:
    """Return the Gaussians moved by a node. Raises UserError if it stretches or mirrors."""
    if not np.isfinite(matrix).all():
        raise UserError(f"{path}: a node's transform is not finite")
    if (matrix == np.eye(4)).all():
        return gaussians
    with np.errstate(all="ignore"):
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        turn = matrix[:3, :3] / scale
        straight = np.abs(turn @ turn.T - np.eye(3)).max() < _STRAIGHT
    if not (scale > 0 and straight):
        raise UserError(f"{path}: a node that stretches or mirrors Gaussians is not supported")
    moved = gaussians.transformed(
        torch.from_numpy(turn).float(), torch.from_numpy(matrix[:3, 3].copy()).float(), scale
    )
    arrays = {name: value.numpy() for name, value in moved.tensors().items()}
    return checked_gaussians(path, arrays, left_out)


def _joined(parts: list[Gaussians]) -> Gaussians:
    """Join all parts to one object; harmonics of lower degrees are padded with zeros."""
    if len(parts) == 1:
        return parts[0]
    most = max(0 if part.harmonics is None else part.harmonics.shape[1] for part in parts)
    for part in parts if most else ():
        harmonics = torch.zeros(part.num, 0, 3) if part.harmonics is None else part.harmonics
        part.harmonics = F.pad(harmonics, (0, 0, 0, most - harmonics.shape[1]))
    joined = {name: torch.cat([getattr(p, name) for p in parts]) for name in parts[0].tensors()}
    return replace(parts[0], **joined)
