"""Gaussians in the ``.ply`` layout of 3D Gaussian Splatting, which every splat viewer opens.

One vertex is float32 ``x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3``: opacity as
a logit, scales as natural logarithms, rotation wxyz, colour as the degree-0 spherical harmonic.
``f_rest_*`` are 9, 24 or 45 coefficients of the harmonics of degrees 1 to 1, 2 or 3: all of red,
then all of green, then all of blue; they are left out where there are none.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ..errors import UserError
from ..files import atomic_path
from ..gaussians import SH_C0, Gaussians
from ..versions import __version__
from .gaussians.arrays import MIN_SCALE, export_arrays, flip_axes, sound_gaussians
from .gaussians.compressed import is_compressed, unpacked
from .headers import open_shape
from .parts import color_range
from .ply_data import read_ply
from .ply_header import PlyHeader, read_ply_header

TURNED = "frame opengl"  # the comment of files with y up, which earlier versions could write
_OPACITY_MARGIN = 1e-6  # keeps the logit finite (|logit| < 14)
MAX_FILE = 4 << 30  # bytes; 17 million Gaussians with all their harmonics
_GROUPS = {
    "means": ("x", "y", "z"),
    "colors": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "opacities": ("opacity",),
    "scales": ("scale_0", "scale_1", "scale_2"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
}
_RGB = ("red", "green", "blue")
_REST = re.compile(r"f_rest_\d+")


def save_ply(
    path: str | Path,
    gaussians: Gaussians,
    *,
    comments: Iterable[str] = (),
) -> None:
    """Writes one object as binary little-endian 3DGS ``.ply`` in OpenCV's axes, atomically.

    Args:
        path: file to write.
        gaussians: one object, no batch dimension.
        comments: lines for the header.

    Raises:
        UserError: a value is not finite, there is no Gaussian, or the file cannot be written.
        ValueError: there is a batch dimension.
    """
    arrays = export_arrays(path, gaussians)
    count = len(arrays["opacities"])
    opacities = arrays["opacities"].astype(np.float64)
    opacities = opacities.clip(_OPACITY_MARGIN, 1 - _OPACITY_MARGIN)
    rest = arrays["harmonics"].transpose(0, 2, 1).reshape(count, -1)
    columns = {
        _GROUPS["means"]: arrays["means"],
        ("nx", "ny", "nz"): np.zeros((count, 3)),
        _GROUPS["colors"]: (arrays["colors"] - 0.5) / SH_C0,
        tuple(f"f_rest_{i}" for i in range(rest.shape[1])): rest,
        _GROUPS["opacities"]: np.log(opacities / (1 - opacities))[:, None],
        _GROUPS["scales"]: np.log(arrays["scales"].clip(MIN_SCALE)),
        _GROUPS["quats"]: arrays["quats"],
    }
    lines = [*header_lines(comments), f"element vertex {count}"]
    lines += [f"property float {name}" for names in columns for name in names]
    body = np.hstack(list(columns.values())).astype("<f4").tobytes()
    with atomic_path(path) as temporary:
        temporary.write_bytes(ended_header(lines) + body)


def header_lines(comments: Iterable[str]) -> list[str]:
    """The first lines of a ``.ply`` of Gaussians: format, version, and each comment once."""
    notes = dict.fromkeys([f"gamba_warp {__version__}", *comments])
    lines = ["ply", "format binary_little_endian 1.0"]
    return lines + [f"comment {' '.join(note.split())}" for note in notes]


def ended_header(lines: list[str]) -> bytes:
    """The lines as the bytes of a header."""
    return "\n".join([*lines, "end_header", ""]).encode("ascii", "replace")


def load_ply(path: str | Path, left_out: list[str] | None = None) -> Gaussians:
    """Reads a 3DGS ``.ply``, from this or another program, as one object.

    It may be binary, text, or compressed (packed in chunks of 256, ``formats.gaussians.compressed``
    says how). Normals, other properties and other elements are passed over. Where there is no
    ``f_dc_*``, ``red green blue`` are the colours, as nerfstudio's ``ns-export`` writes them.
    Without harmonics colours are clipped to [0, 1]. A scale of -inf is size 0; an opacity of inf is
    1, of -inf 0. ``left_out`` as for ``sound_gaussians``.

    Returns:
        Float32 Gaussians on the CPU, ``quats`` normalised.

    Raises:
        UserError: not a file, not a ``.ply``, truncated or longer than it says, an attribute
            missing, or Gaussians that ``sound_gaussians`` refuses.
    """
    path = Path(path)
    with open_shape(path, MAX_FILE) as (file, _):
        header = read_ply_header(path, file)
        if is_compressed(header):
            arrays = unpacked(path, read_ply(path))
        else:
            arrays = _activated(path, _vertices(path, header))
    gaussians = sound_gaussians(path, arrays, left_out)
    return flip_axes(gaussians) if TURNED in header.comments else gaussians


def _activated(path: Path, vertices: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The values of the vertices' properties. Raises UserError where one is missing."""
    plain = vertices.keys().isdisjoint(_GROUPS["colors"]) and vertices.keys() >= {*_RGB}
    groups = _GROUPS | {"colors": _RGB} if plain else _GROUPS
    arrays = {}
    with np.errstate(over="ignore"):
        for name, properties in groups.items():
            missing = [p for p in properties if p not in vertices]
            if missing:
                raise UserError(f"{path}: no property {', '.join(missing)}; not Gaussians")
            arrays[name] = np.stack([vertices[p].astype(np.float32) for p in properties], 1)
        arrays["scales"] = np.exp(arrays["scales"])
        arrays["opacities"] = 1 / (1 + np.exp(-arrays["opacities"][:, 0].astype(np.float64)))
    if plain:
        arrays["colors"] /= color_range(np.stack([vertices[p] for p in _RGB], 1))
    else:
        arrays["colors"] = arrays["colors"] * SH_C0 + 0.5
    rest = sum(_REST.fullmatch(name) is not None for name in vertices)
    if rest not in (0, 9, 24, 45) or not all(f"f_rest_{i}" in vertices for i in range(rest)):
        raise UserError(
            f"{path}: {rest} properties f_rest_*; harmonics of degree 1, 2 and 3 have 9, 24 and 45"
        )
    if rest:
        with np.errstate(over="ignore"):
            flat = np.stack([vertices[f"f_rest_{i}"].astype(np.float32) for i in range(rest)], 1)
        arrays["harmonics"] = flat.reshape(len(flat), 3, rest // 3).transpose(0, 2, 1)
    return arrays


def _vertices(path: Path, header: PlyHeader) -> dict[str, np.ndarray]:
    """The vertices' properties of a text or binary file. Raises UserError."""
    vertex = next((element for element in header.elements if element.name == "vertex"), None)
    if vertex is None:
        raise UserError(f"{path}: the .ply header has no 'element vertex COUNT'")
    if not vertex.properties:
        raise UserError(f"{path}: vertices have no properties")
    for name, _, length in vertex.properties:
        if length:
            raise UserError(f"{path}: vertex property {name} is a list, not a plain number")
    found = read_ply(path, MAX_FILE).elements["vertex"]
    return {name: np.asarray(column) for name, column in found.items()}
