"""The compressed ``.ply`` of PlayCanvas and SuperSplat: Gaussians packed in chunks of 256.

A chunk states the bounds of its positions, of the logarithms of its scales and of its colours; a
Gaussian is four 32-bit words: position and scale with 11, 10 and 11 bits between the chunk's
bounds, the rotation as its three smaller numbers with 10 bits each behind 2 bits that name the
largest, colour and opacity with 8 bits. Harmonics are 8 bits each, in [-4, 4]. Neighbours in space
share a chunk, so that its bounds are narrow.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import UserError
from ..ply_data import WORDS, PlyData
from .arrays import MIN_SCALE, from_smallest_three, harmonics_of, rest_names, smallest_three

CHUNK = 256
_REACH = 4.0  # of a harmonic's coefficient
_MEANS, _SCALES, _COLORS = ("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b")
BOUNDS = tuple(
    f"{end}_{name}"
    for names in (_MEANS, _SCALES, _COLORS)
    for end in ("min", "max")
    for name in names
)
_MAX_LOG = 20.0  # of a scale, as PlayCanvas has it


def packed(arrays: dict[str, np.ndarray]) -> tuple[list[str], bytes, bool]:
    """Pack one object's arrays of ``export_arrays``.

    Returns:
        The header's lines of the elements, the bytes of the elements, and True if a coefficient of
        the harmonics was clipped.
    """
    order = _morton_order(arrays["means"])
    count = len(order)
    starts, at = np.arange(0, count, CHUNK), np.arange(count) // CHUNK
    rgb = arrays["colors"][order].astype(np.float64)
    logs = np.log(arrays["scales"][order].clip(MIN_SCALE).astype(np.float64))
    logs = logs.clip(-_MAX_LOG, _MAX_LOG)
    bounds, steps = [], []
    for values in (arrays["means"][order].astype(np.float64), logs, rgb):
        low = np.minimum.reduceat(values, starts).astype("<f4")
        high = np.maximum.reduceat(values, starts).astype("<f4")
        bounds += [low, high]
        wide = np.maximum(high.astype(np.float64) - low, 1e-30)
        steps.append(((values - low[at]) / wide[at]).clip(0, 1))
    largest, three = smallest_three(arrays["quats"][order].astype(np.float64))
    opacities = arrays["opacities"][order].astype(np.float64).clip(0, 1)[:, None]
    words = np.column_stack(
        [
            _join(steps[0], (11, 10, 11)),
            _join(three * np.sqrt(0.5) + 0.5, (10, 10, 10)) | (largest.astype(np.uint32) << 30),
            _join(steps[1], (11, 10, 11)),
            _join(np.hstack([steps[2], opacities]), (8, 8, 8, 8)),
        ]
    ).astype("<u4")
    lines = [f"element chunk {len(starts)}", *(f"property float {name}" for name in BOUNDS)]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in WORDS)]
    rest = arrays["harmonics"][order].transpose(0, 2, 1).reshape(count, -1)
    if rest.shape[1]:
        lines += [f"element sh {count}"]
        lines += [f"property uchar {name}" for name in rest_names(rest.shape[1])]
    eighths = np.floor((rest / (2 * _REACH) + 0.5) * 256).clip(0, 255).astype(np.uint8)
    body = np.hstack(bounds).astype("<f4").tobytes() + words.tobytes() + eighths.tobytes()
    return lines, body, bool((np.abs(rest) > _REACH).any())


def unpacked(path: Path, data: PlyData) -> dict[str, np.ndarray]:
    """Return the arrays of a compressed file for ``checked_gaussians``.

    Raises:
        UserError: an element or a property is missing, or their numbers do not fit.
    """
    words = _table(path, data, "vertex", WORDS, np.uint32)
    count = len(words)
    wanted = -(-count // CHUNK)
    there = sum(element.count for element in data.header.elements if element.name == "chunk")
    if there != wanted:
        raise UserError(
            f"{path}: invalid header, {count} packed vertices have {wanted} chunks, not {there}"
        )
    at = np.arange(count) // CHUNK
    means = _between(path, data, _MEANS, at, _split(words[:, 0], (11, 10, 11)))
    logs = _between(path, data, _SCALES, at, _split(words[:, 2], (11, 10, 11)))
    rgba = _split(words[:, 3], (8, 8, 8, 8))
    colors = rgba[:, :3]
    if "min_r" in data.elements.get("chunk", {}):  # early writers kept colours without bounds
        colors = _between(path, data, _COLORS, at, colors)
    three = (_split(words[:, 1] & 0x3FFFFFFF, (10, 10, 10)) - 0.5) * np.sqrt(2)
    with np.errstate(over="ignore"):
        scales = np.exp(logs)
    rest = np.zeros((count, 0))
    if columns := data.elements.get("sh", {}):
        rest = _table(path, data, "sh", rest_names(len(columns)), np.uint8)
    if len(rest) != count:
        raise UserError(f"{path}: invalid header, {count} vertices but {len(rest)} harmonics")
    # The middle of each step, but the ends are the ends.
    middle = np.where(rest == 0, 0.0, np.where(rest == 255, 1.0, (rest + 0.5) / 256))
    return {
        "means": means,
        "quats": from_smallest_three((words[:, 1] >> 30).astype(np.int64), three),
        "scales": scales,
        "opacities": rgba[:, 3],
        "colors": colors,
        "harmonics": harmonics_of(path, (middle - 0.5) * 2 * _REACH),
    }


def _table(
    path: Path, data: PlyData, element: str, names: tuple[str, ...], kind: type
) -> np.ndarray:
    """Return ``[N, C]``. Raises UserError if a property is missing or of another type."""
    columns = data.elements.get(element, {})
    for name in names:
        column = columns.get(name)
        if not isinstance(column, np.ndarray) or column.dtype.newbyteorder("=") != kind:
            raise UserError(f"{path}: {element} has no property {name} of {np.dtype(kind).name}")
    return np.stack([np.asarray(columns[name]).astype(kind) for name in names], 1)


def _between(
    path: Path, data: PlyData, names: tuple[str, ...], at: np.ndarray, steps: np.ndarray
) -> np.ndarray:
    """Interpolate from the minima to the maxima of the chunks ``at``."""
    low, high = (
        _table(path, data, "chunk", tuple(f"{end}_{name}" for name in names), np.float32)[at]
        for end in ("min", "max")
    )
    with np.errstate(all="ignore"):  # untrusted bounds; the result is checked
        values = low.astype(np.float64) * (1 - steps) + high.astype(np.float64) * steps
    # No value is between bounds if one is infinite.
    return np.where(np.isfinite(low) & np.isfinite(high), values, np.nan)


def _join(steps: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Pack columns in [0, 1] into one 32-bit word, the first in the highest bits."""
    word = np.zeros(len(steps), np.uint32)
    for column, width in zip(steps.T, bits):
        most = (1 << width) - 1
        level = np.floor(column * most + 0.5).clip(0, most).astype(np.uint32)
        word = (word << np.uint32(width)) | level
    return word


def _split(words: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Return the columns of ``_join``, float64 in [0, 1]."""
    columns, shift = [], sum(bits)
    for width in bits:
        shift -= width
        most = (1 << width) - 1
        columns.append(((words >> np.uint32(shift)) & np.uint32(most)) / most)
    return np.stack(columns, 1)


def _morton_order(means: np.ndarray) -> np.ndarray:
    """Return the order of positions along Morton's curve, on a grid of 1024 a side."""
    low = means.min(0)
    wide = np.maximum(means.max(0).astype(np.float64) - low, 1e-30)
    grid = ((means - low) / wide * 1023).clip(0, 1023).astype(np.uint32)
    code = np.zeros(len(means), np.uint32)
    for bit in range(10):
        for axis in range(3):
            code |= ((grid[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")
