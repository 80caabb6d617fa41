"""Gaussians in the ``.ply`` layout of 3D Gaussian Splatting, which every splat viewer opens.

One vertex is float32 ``x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3``: opacity as
a logit, scales as natural logarithms, rotation wxyz, colour as the degree-0 spherical harmonic.
``f_rest_*`` are 0, 9, 24 or 45 coefficients of the harmonics of degrees 1 to 0, 1, 2 or 3: all of
red, then all of green, then all of blue.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import FileWarning, UserError
from ..files import atomic_path
from ..gaussians import SH_C0, Gaussians
from ..versions import __version__
from .gaussians.arrays import (
    MIN_SCALE,
    checked_gaussians,
    export_arrays,
    flip_axes,
    harmonics_of,
    rest_names,
)
from .gaussians.compressed import unpacked
from .headers import open_shape
from .parts import color_range
from .ply_data import MAX_SPLATS, WORDS, PlyData, parse_ply

MIP = "SplatRenderMode: mip"  # comment of Gaussians that were fitted with antialiasing
TURNED = "frame opengl"  # comment of files with y up, which earlier versions could write
_FLAT = 1e-6  # third standard deviation of a flat Gaussian
_OPACITY_MARGIN = 1e-6  # keeps the logit finite (|logit| < 14)
_GROUPS = {
    "means": ("x", "y", "z"),
    "colors": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "opacities": ("opacity",),
    "scales": ("scale_0", "scale_1", "scale_2"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
}
_RGB = ("red", "green", "blue")
_REST = re.compile(r"f_rest_\d+")
_WITHOUT_EFFECT = ("nx", "ny", "nz", *_RGB, "alpha")
# Properties of Gaussians that change with time: SpacetimeGaussians, 4DGS and their like.
_TIME = re.compile(r"trbf_\w+|(motion|omega|rot_r)_\d+|t|time|(scale|scaling|opacity)_t|\w+_t\d+")


def save_ply(path: str | Path, gaussians: Gaussians, *, comments: Iterable[str] = ()) -> None:
    """Write one object as binary little-endian 3DGS ``.ply`` in OpenCV's axes, atomically.

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
        rest_names(rest.shape[1]): rest,
        _GROUPS["opacities"]: np.log(opacities / (1 - opacities))[:, None],
        _GROUPS["scales"]: np.log(arrays["scales"].clip(MIN_SCALE)),
        _GROUPS["quats"]: arrays["quats"],
    }
    lines = [f"element vertex {count}"]
    lines += [f"property float {name}" for names in columns for name in names]
    body = np.hstack(list(columns.values())).astype("<f4").tobytes()
    with atomic_path(path) as temporary:
        temporary.write_bytes(header_bytes(marked(gaussians, comments), lines) + body)


def marked(gaussians: Gaussians, comments: Iterable[str]) -> list[str]:
    """Return the comments of a ``.ply``, including antialiasing's if it applies."""
    return [*([MIP] if gaussians.antialiased else []), *comments]


def header_bytes(comments: Iterable[str], elements: Iterable[str]) -> bytes:
    """Return the header of a ``.ply`` of Gaussians; repeated comments are written once."""
    notes = dict.fromkeys([f"gamba_warp {__version__}", *comments])
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {' '.join(note.split())}" for note in notes]
    return "\n".join([*lines, *elements, "end_header", ""]).encode("ascii", "replace")


def load_ply(path: str | Path) -> Gaussians:
    """Read a 3DGS ``.ply``, from this or another program, as one object.

    It may be binary, text, or compressed (``formats.gaussians.compressed``). Normals and other
    elements are ignored, other properties named by a warning. Without ``f_dc_*``,
    ``red green blue`` are the colours, as nerfstudio's ``ns-export`` writes them. Two scales, of
    flat Gaussians (2DGS), get a third of 1e-6. A scale of -inf is size 0; an opacity of inf is 1,
    of -inf 0.

    Returns:
        Float32 Gaussians on the CPU, ``quats`` normalised.

    Raises:
        UserError: the file is missing, not a ``.ply``, truncated or longer than it states, an
            attribute is missing, the Gaussians change with time, or ``checked_gaussians`` refuses
            them.
    """
    with open_shape(Path(path), MAX_SPLATS) as source:
        return ply_gaussians(source.path, parse_ply(source))


def ply_gaussians(path: Path, data: PlyData, left_out: list[str] | None = None) -> Gaussians:
    """Return the Gaussians of a file's content, as ``load_ply`` does.

    ``left_out`` as for ``checked_gaussians``.
    """
    properties = data.elements.get("vertex", {}).keys()
    packed = not properties.isdisjoint(WORDS)
    read = {*WORDS} if packed else {name for names in _GROUPS.values() for name in names}
    unread = properties - read - {*_WITHOUT_EFFECT}
    names = ", ".join(sorted(name for name in unread if not _REST.fullmatch(name)))
    if any(_TIME.fullmatch(name) for name in unread):
        advice = "write those of one moment as a .ply of 3DGS"
        raise UserError(f"{path}: its Gaussians change with time ({names}); {advice}")
    if names:
        warnings.warn(f"{path}: properties that are not read: {names}", FileWarning, stacklevel=2)
    arrays = (unpacked if packed else _activated)(path, data)
    gaussians = checked_gaussians(path, arrays, left_out)
    gaussians = replace(gaussians, antialiased=MIP in data.header.comments)
    return flip_axes(gaussians) if TURNED in data.header.comments else gaussians


def _activated(path: Path, data: PlyData) -> dict[str, np.ndarray]:
    """Return the activated values. Raises UserError if a property is missing, or a list."""
    columns = data.elements.get("vertex", {}).items()
    vertices = {name: x for name, x in columns if isinstance(x, np.ndarray)}
    plain = vertices.keys().isdisjoint(_GROUPS["colors"]) and vertices.keys() >= {*_RGB}
    groups = _GROUPS | {"colors": _RGB} if plain else {**_GROUPS}
    groups["harmonics"] = rest_names(sum(_REST.fullmatch(name) is not None for name in vertices))
    if "scale_1" in vertices and "scale_2" not in vertices:
        vertices["scale_2"] = np.full_like(vertices["scale_1"], np.log(_FLAT), np.float32)
    arrays = {}
    with np.errstate(over="ignore"):
        for name, properties in groups.items():
            missing = [p for p in properties if p not in vertices]
            if missing:
                raise UserError(f"{path}: no property {', '.join(missing)}; not Gaussians")
            columns = [vertices[p].astype(np.float32) for p in properties]
            arrays[name] = np.stack(columns, 1) if columns else np.zeros((len(vertices["x"]), 0))
        arrays["scales"] = np.exp(arrays["scales"])
        arrays["opacities"] = 1 / (1 + np.exp(-arrays["opacities"][:, 0].astype(np.float64)))
    if plain:
        arrays["colors"] /= color_range(np.stack([vertices[p] for p in _RGB], 1))
    else:
        arrays["colors"] = arrays["colors"] * SH_C0 + 0.5
    arrays["harmonics"] = harmonics_of(path, arrays["harmonics"])
    return arrays
