"""Gaussians in the ``.ply`` layout of 3D Gaussian Splatting, which every splat viewer opens.

One vertex is float32 ``x y z nx ny nz f_dc_0..2 opacity scale_0..2 rot_0..3``: opacity as a logit,
scales as natural logarithms, rotation wxyz, colour as the degree-0 spherical harmonic.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import get_args

import numpy as np
import torch

from ..conventions import Axes
from ..errors import UserError
from ..files import atomic_path
from ..gaussians import SH_C0, Gaussians
from ..versions import __version__
from .headers import open_shape
from .ply_header import ORDERS, PlyElement, read_ply_header

_OPENGL_COMMENT = "frame opengl"
_OPACITY_MARGIN = 1e-6  # keeps the logit finite (|logit| < 14)
MAX_FILE = 4 << 30  # bytes; 17 million Gaussians with all their harmonics
MAX_REACH = 1e18  # of means and scales: the squares of larger numbers overflow float32
_MIN_SCALE = 1e-12  # keeps the logarithm finite
_GROUPS = {
    "means": ("x", "y", "z"),
    "colors": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "opacities": ("opacity",),
    "scales": ("scale_0", "scale_1", "scale_2"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
}
_MEANS, *_REST = _GROUPS.values()
_PROPERTIES = (*_MEANS, "nx", "ny", "nz", *(name for group in _REST for name in group))


def flip_axes(gaussians: Gaussians) -> Gaussians:
    """From OpenCV's axes (y down, z forward) to OpenGL's (y up, z backward), and back."""
    half_turn = torch.diag(gaussians.means.new_tensor([1.0, -1.0, -1.0]))
    return gaussians.transformed(half_turn, gaussians.means.new_zeros(3))


def export_arrays(
    path: str | Path, gaussians: Gaussians, axes: Axes = "opencv", min_opacity: float = 0.0
) -> dict[str, np.ndarray]:
    """One object's Gaussians as float32 arrays fit to be written: finite, quaternions normalised.

    Args:
        path: named in errors.
        gaussians: one object, no batch dimension.
        axes: in which the values are returned; those of ``gaussians`` are OpenCV's.
        min_opacity: Gaussians below it are left out.

    Returns:
        ``means [N, 3]``, ``quats [N, 4]`` wxyz, ``scales [N, 3]``, ``opacities [N]``,
        ``colors [N, 3]``; activated values.

    Raises:
        ValueError: there is a batch dimension, or the axes are not known.
        UserError: a value is not finite, or no Gaussian is left.
    """
    if gaussians.opacities.dim() != 1:
        raise ValueError(
            f"one object expected, got leading shape {tuple(gaussians.opacities.shape[:-1])}"
        )
    if axes not in get_args(Axes):
        raise ValueError(f"axes are {axes!r}, expected one of {', '.join(get_args(Axes))}")
    gaussians = gaussians.detach().to("cpu", torch.float32)
    if axes == "opengl":
        gaussians = flip_axes(gaussians)
    if gaussians.quats is None:
        gaussians.quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(gaussians.num, 4)
    arrays = {name: getattr(gaussians, name).numpy() for name in _GROUPS}
    bad = sum(~np.isfinite(value.reshape(gaussians.num, -1)).all(1) for value in arrays.values())
    if np.any(bad):
        count = np.count_nonzero(bad)
        raise UserError(f"{path}: not written, {count} of {gaussians.num} Gaussians are not finite")
    keep = arrays["opacities"] >= min_opacity
    if not keep.any():
        raise UserError(
            f"{path}: not written, no Gaussian has an opacity of {min_opacity:g} or more"
        )
    arrays = {name: np.ascontiguousarray(value[keep]) for name, value in arrays.items()}
    arrays["quats"] /= np.linalg.norm(arrays["quats"], axis=1, keepdims=True).clip(1e-12)
    return arrays


def save_ply(
    path: str | Path,
    gaussians: Gaussians,
    *,
    axes: Axes = "opencv",
    min_opacity: float = 0.0,
    comments: Iterable[str] = (),
) -> None:
    """Writes one object as binary little-endian 3DGS ``.ply``, atomically.

    Args:
        path: file to write.
        gaussians: one object, no batch dimension.
        axes: ``opencv`` (y down, what ``.ply`` viewers assume) or ``opengl`` (y up); the latter is
            noted in a comment, by which ``load_ply`` turns it back.
        min_opacity: Gaussians below it are left out.
        comments: lines for the header.

    Raises:
        UserError: a value is not finite, nothing is left, or the file cannot be written.
        ValueError: there is a batch dimension, or the axes are not known.
    """
    arrays = export_arrays(path, gaussians, axes, min_opacity)
    opacities = arrays["opacities"].astype(np.float64)
    opacities = opacities.clip(_OPACITY_MARGIN, 1 - _OPACITY_MARGIN)
    columns = [
        arrays["means"],
        np.zeros_like(arrays["means"]),
        (arrays["colors"] - 0.5) / SH_C0,
        np.log(opacities / (1 - opacities))[:, None],
        np.log(arrays["scales"].clip(_MIN_SCALE)),
        arrays["quats"],
    ]
    notes = [f"gamba_warp {__version__}", *comments]
    if axes == "opengl":
        notes.append(_OPENGL_COMMENT)
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {' '.join(note.split())}" for note in notes]
    lines += [f"element vertex {len(opacities)}", *(f"property float {p}" for p in _PROPERTIES)]
    header = "\n".join([*lines, "end_header", ""]).encode("ascii", "replace")
    with atomic_path(path) as temporary:
        temporary.write_bytes(header + np.hstack(columns).astype("<f4").tobytes())


def load_ply(path: str | Path) -> Gaussians:
    """Reads a binary 3DGS ``.ply``, from this or another program, as one object.

    Colour is the degree-0 term; higher degrees (``f_rest_*``), normals and other properties are
    passed over. Colours are clipped to [0, 1].

    Returns:
        Float32 Gaussians on the CPU, ``quats`` normalised.

    Raises:
        UserError: not a file, not a binary ``.ply``, truncated or longer than it says, an attribute
            missing, a value not finite or over ``MAX_REACH``, or a rotation of length zero.
    """
    vertices, comments = _read_vertices(Path(path))
    values: dict[str, torch.Tensor] = {}
    for name, properties in _GROUPS.items():
        missing = [p for p in properties if p not in vertices.dtype.names]
        if missing:
            raise UserError(f"{path}: no property {', '.join(missing)}; not Gaussians")
        with np.errstate(over="ignore"):
            stacked = np.stack([vertices[p].astype(np.float32) for p in properties], 1)
            if name == "scales":
                stacked = np.exp(stacked)
        if not np.isfinite(stacked).all():
            bad = np.count_nonzero(~np.isfinite(stacked).all(1))
            raise UserError(
                f"{path}: {bad} of {len(vertices)} Gaussians have {name} that are not finite"
            )
        values[name] = torch.from_numpy(stacked)
    for name in ("means", "scales"):
        reach = float(values[name].abs().max())
        if reach > MAX_REACH:
            raise UserError(f"{path}: {name} reach {reach:.3g}, over {MAX_REACH:g}")
    quats = values["quats"]
    lengths = quats.norm(dim=1, keepdim=True)
    odd = ((lengths == 0) | ~lengths.isfinite())[:, 0]  # the squares leave float32's range
    if odd.any():
        quats[odd] /= quats[odd].abs().amax(1, keepdim=True)
        lengths = quats.norm(dim=1, keepdim=True)
        bad = int((~(lengths > 0)).sum())
        if bad:
            raise UserError(f"{path}: {bad} rotations have length zero")
    gaussians = Gaussians(
        means=values["means"],
        quats=quats / lengths,
        scales=values["scales"],
        opacities=values["opacities"][:, 0].sigmoid(),
        colors=(values["colors"] * SH_C0 + 0.5).clamp(0, 1),
    )
    return flip_axes(gaussians) if _OPENGL_COMMENT in comments else gaussians


def _read_vertices(path: Path) -> tuple[np.ndarray, list[str]]:
    """The vertices as a structured array, and the header's comments."""
    with open_shape(path, MAX_FILE) as (file, _):
        header = read_ply_header(path, file)
        file.seek(header.start)
        data = file.read()
    if header.format not in ORDERS:
        raise UserError(f"{path}: .ply format is {header.format}, only binary is read")
    if not header.elements or header.elements[0].name != "vertex":
        raise UserError(f"{path}: the .ply header does not begin with 'element vertex COUNT'")
    vertex = header.elements[0]
    dtype = _vertex_dtype(path, vertex, ORDERS[header.format])
    size, there = vertex.count * dtype.itemsize, len(data)
    if there < size or (len(header.elements) == 1 and there > size):
        kind = "truncated or false header" if there < size else "false header"
        raise UserError(
            f"{path}: {kind}, {vertex.count} vertices take {size} bytes but {there} follow"
        )
    if vertex.count == 0:
        raise UserError(f"{path}: holds no Gaussians")
    return np.frombuffer(data, dtype, vertex.count), header.comments


def _vertex_dtype(path: Path, vertex: PlyElement, order: str) -> np.dtype:
    """The type of a vertex for numpy. Raises UserError where it is not made of named numbers."""
    if not vertex.properties:
        raise UserError(f"{path}: vertices have no properties")
    fields: dict[str, str] = {}
    for name, kind, length in vertex.properties:
        if length:
            raise UserError(f"{path}: vertex property {name} is a list, not a plain number")
        if name in fields:
            raise UserError(f"{path}: vertex property {name} is given twice")
        fields[name] = order + kind
    return np.dtype(list(fields.items()))
