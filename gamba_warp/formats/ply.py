"""Gaussians in the ``.ply`` layout of 3D Gaussian Splatting, which every splat viewer opens.

One vertex is float32 ``x y z nx ny nz f_dc_0..2 opacity scale_0..2 rot_0..3``: opacity as a logit,
scales as natural logarithms, rotation wxyz, colour as the degree-0 spherical harmonic.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from ..errors import UserError
from ..files import atomic_path
from ..gaussians import Gaussians
from ..versions import __version__

SH_C0 = 0.28209479177387814  # value of the degree-0 spherical harmonic
Frame = Literal["opencv", "opengl"]

_OPENGL_COMMENT = "frame opengl"
_OPACITY_MARGIN = 1e-6  # keeps the logit finite (|logit| < 14)
_MIN_SCALE = 1e-12  # keeps the logarithm finite
_MAX_HEADER = 1 << 16
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}  # of bytes, numpy's sign
TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_GROUPS = {
    "means": ("x", "y", "z"),
    "colors": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "opacities": ("opacity",),
    "scales": ("scale_0", "scale_1", "scale_2"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
}
_MEANS, *_REST = _GROUPS.values()
_PROPERTIES = (*_MEANS, "nx", "ny", "nz", *(name for group in _REST for name in group))


def flip_frame(gaussians: Gaussians) -> Gaussians:
    """From the OpenCV frame (y down, z forward) to the OpenGL one (y up, z backward), and back."""
    half_turn = torch.diag(gaussians.means.new_tensor([1.0, -1.0, -1.0]))
    return gaussians.transformed(half_turn, gaussians.means.new_zeros(3))


def export_arrays(
    path: str | Path, gaussians: Gaussians, frame: Frame = "opencv", min_opacity: float = 0.0
) -> dict[str, np.ndarray]:
    """One object's Gaussians as float32 arrays fit to be written: finite, quaternions normalised.

    Args:
        path: named in errors.
        gaussians: one object, no batch dimension.
        frame: axes to write in.
        min_opacity: Gaussians below it are left out.

    Returns:
        ``means [N, 3]``, ``quats [N, 4]`` wxyz, ``scales [N, 3]``, ``opacities [N]``,
        ``colors [N, 3]``; activated values.

    Raises:
        ValueError: there is a batch dimension, or the frame is not known.
        UserError: a value is not finite, or no Gaussian is left.
    """
    if gaussians.opacities.dim() != 1:
        raise ValueError(
            f"one object expected, got leading shape {tuple(gaussians.opacities.shape[:-1])}"
        )
    if frame not in ("opencv", "opengl"):
        raise ValueError(f"frame is {frame!r}, expected 'opencv' or 'opengl'")
    gaussians = gaussians.detach().to("cpu", torch.float32)
    if frame == "opengl":
        gaussians = flip_frame(gaussians)
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
    frame: Frame = "opencv",
    min_opacity: float = 0.0,
    comments: Iterable[str] = (),
) -> None:
    """Writes one object as binary little-endian 3DGS ``.ply``, atomically.

    Args:
        path: file to write.
        gaussians: one object, no batch dimension.
        frame: ``opencv`` (y down, what ``.ply`` viewers assume) or ``opengl`` (y up); the latter is
            noted in a comment, by which ``load_ply`` turns it back.
        min_opacity: Gaussians below it are left out.
        comments: lines for the header.

    Raises:
        UserError: a value is not finite, nothing is left, or the file cannot be written.
        ValueError: there is a batch dimension, or the frame is not known.
    """
    arrays = export_arrays(path, gaussians, frame, min_opacity)
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
    if frame == "opengl":
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
            missing, a value not finite, or a rotation of length zero.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from error
    vertices, comments = _parse(path, data)
    values = {}
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
    lengths = values["quats"].norm(dim=1, keepdim=True)
    if (lengths == 0).any():
        raise UserError(f"{path}: {int((lengths == 0).sum())} rotations have length zero")
    gaussians = Gaussians(
        means=values["means"],
        quats=values["quats"] / lengths,
        scales=values["scales"],
        opacities=values["opacities"][:, 0].sigmoid(),
        colors=(values["colors"] * SH_C0 + 0.5).clamp(0, 1),
    )
    return flip_frame(gaussians) if _OPENGL_COMMENT in comments else gaussians


def _parse(path: Path, data: bytes) -> tuple[np.ndarray, list[str]]:
    """The vertices as a structured array, and the header's comments."""
    if not data.startswith(b"ply"):
        raise UserError(f"{path}: not a .ply file")
    end = data.find(b"end_header", 0, _MAX_HEADER)
    start = data.find(b"\n", end) + 1
    if end < 0 or start == 0:
        raise UserError(f"{path}: the .ply header has no end")
    lines = data[:end].decode("ascii", "replace").splitlines()
    comments = [line.partition(" ")[2].strip() for line in lines if line.startswith("comment")]
    words = [line.split() for line in lines[1:] if line.split()]
    layouts = [w[1] for w in words if w[0] == "format" and len(w) > 1]
    if not layouts or layouts[0] not in ORDERS:
        found = layouts[0] if layouts else "none"
        raise UserError(f"{path}: .ply format is {found}, only binary is read")
    count, fields, alone = _vertex_fields(path, words, ORDERS[layouts[0]])
    dtype = np.dtype(fields)
    size, there = count * dtype.itemsize, len(data) - start
    if there < size or (alone and there > size):
        kind = "truncated or false header" if there < size else "false header"
        raise UserError(f"{path}: {kind}, {count} vertices take {size} bytes but {there} follow")
    if count == 0:
        raise UserError(f"{path}: holds no Gaussians")
    return np.frombuffer(data, dtype, count, start), comments


def _vertex_fields(
    path: Path, words: list[list[str]], order: str
) -> tuple[int, list[tuple[str, str]], bool]:
    """The vertex count, the ``numpy`` fields of a vertex, and whether no element follows."""
    elements = [i for i, w in enumerate(words) if w[0] == "element"]
    head = words[elements[0]] if elements else []
    if head[1:2] != ["vertex"] or len(head) != 3 or not head[2].isdecimal() or len(head[2]) > 18:
        raise UserError(f"{path}: the .ply header does not begin with 'element vertex COUNT'")
    stop = elements[1] if len(elements) > 1 else len(words)
    fields: list[tuple[str, str]] = []
    for word in words[elements[0] + 1 : stop]:
        if word[0] != "property":
            continue
        if len(word) != 3 or word[1] not in TYPES:
            raise UserError(f"{path}: vertex property '{' '.join(word[1:])}' is not a plain number")
        if word[2] in dict(fields):
            raise UserError(f"{path}: vertex property {word[2]} is given twice")
        fields.append((word[2], order + TYPES[word[1]]))
    if not fields:
        raise UserError(f"{path}: vertices have no properties")
    return int(head[2]), fields, len(elements) == 1
