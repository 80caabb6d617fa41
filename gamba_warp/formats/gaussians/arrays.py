"""Conversion and validation of Gaussians: arrays to write, and arrays of untrusted files."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...conventions import Axes
from ...errors import FileWarning, UserError
from ...gaussians import Gaussians

MAX_REACH = 1e18  # of means and scales: the squares of larger numbers overflow float32
MIN_SCALE = 1e-12  # keeps the logarithm of a scale finite
DEGREES = {0: 0, 3: 1, 8: 2, 15: 3}  # degree of the harmonics by their number K
_NAMES = ("means", "quats", "scales", "opacities", "colors")
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # other indices, by index


def flip_axes(gaussians: Gaussians) -> Gaussians:
    """Turn from OpenCV's axes (y down, z forward) to OpenGL's (y up, z backward), or back."""
    half_turn = torch.diag(gaussians.means.new_tensor([1.0, -1.0, -1.0]))
    return gaussians.transformed(half_turn, gaussians.means.new_zeros(3))


def export_arrays(
    path: str | Path, gaussians: Gaussians, axes: Axes = "opencv"
) -> dict[str, np.ndarray]:
    """Return one object's Gaussians as float32 arrays: finite, quaternions normalised.

    Args:
        path: named in errors.
        gaussians: one object in OpenCV's axes, no batch dimension.
        axes: axes of the format.

    Returns:
        ``means [N, 3]``, ``quats [N, 4]`` wxyz, ``scales [N, 3]``, ``opacities [N]``,
        ``colors [N, 3]``, ``harmonics [N, K, 3]``, K of 0, 3, 8 or 15; activated values.

    Raises:
        ValueError: there is a batch dimension.
        UserError: a value is not finite, or there is no Gaussian.
    """
    if gaussians.opacities.dim() != 1:
        shape = tuple(gaussians.opacities.shape[:-1])
        raise ValueError(f"one object expected, got leading shape {shape}")
    if gaussians.num == 0:
        raise UserError(f"{path}: not written, there are no Gaussians")
    gaussians = gaussians.detach().to("cpu", torch.float32)
    if axes == "opengl":
        gaussians = flip_axes(gaussians)
    if count := int((~gaussians.is_finite()).sum()):
        raise UserError(f"{path}: not written, {count} of {gaussians.num} Gaussians are not finite")
    if gaussians.quats is None:
        gaussians.quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(gaussians.num, 4)
    if gaussians.harmonics is None:
        gaussians.harmonics = torch.zeros(gaussians.num, 0, 3)
    arrays = {name: getattr(gaussians, name).numpy() for name in (*_NAMES, "harmonics")}
    lengths = np.linalg.norm(arrays["quats"], axis=1, keepdims=True)
    arrays["quats"] = arrays["quats"] / lengths.clip(1e-12)
    return arrays


def checked_gaussians(
    path: str | Path,
    arrays: dict[str, np.ndarray],
    left_out: list[str] | None = None,
    step: float = 0.0,
) -> Gaussians:
    """Validate the activated values of a file, and return them as one object.

    Colours may be outside of [0, 1]; a rendering clamps them at 0. A line warns where positions are
    too coarse for the object.

    Args:
        path: named in errors.
        arrays: as ``export_arrays`` returns them, in any byte order; ``harmonics`` may be missing,
            quaternions may have any length > 0.
        left_out: receives one line that counts the Gaussians left out because they cannot be
            drawn: a value that is not finite, means or scales over ``MAX_REACH``, a scale below 0,
            or a rotation of length zero. None: a file with such Gaussians is refused.
        step: of the format's positions, if coarser than float32.

    Returns:
        Float32 Gaussians on the CPU, ``quats`` normalised.

    Raises:
        UserError: there is no Gaussian, none can be drawn, or one cannot and ``left_out`` is None.
    """
    count = len(arrays["opacities"])
    if count == 0:
        raise UserError(f"{path}: holds no Gaussians")
    values: dict[str, torch.Tensor] = {}
    finite: dict[str, torch.Tensor] = {}  # [N], by attribute
    for name, array in arrays.items():
        if not array.size:  # harmonics of degree 0
            continue
        with np.errstate(over="ignore"):
            array = np.ascontiguousarray(array, np.float32)
        values[name] = torch.from_numpy(array if array.flags.writeable else array.copy())
        finite[name] = values[name].reshape(count, -1).isfinite().all(1)
    odd = " or ".join(name for name, mask in finite.items() if not mask.all())
    checks = {f"{odd} that are not finite": ~torch.stack([*finite.values()]).all(0)}
    for name in ("means", "scales"):
        far = (values[name].abs() > MAX_REACH) & values[name].isfinite()
        checks[f"{name} over {MAX_REACH:g}"] = far.any(1)
    checks["scales below 0"] = (values["scales"] < 0).any(1)
    checks["rotations of length zero"] = (values["quats"] == 0).all(1)
    bad = {reason: mask for reason, mask in checks.items() if mask.any()}
    if bad:
        keep = ~torch.stack([*bad.values()]).any(0)
        kept = int(keep.sum())
        line = f"{count - kept} of {count} Gaussians have {', or '.join(bad)}"
        if left_out is None or kept == 0:
            advice = "; gamba export --drop-bad leaves such out" if kept else ""
            raise UserError(f"{path}: {line}{advice}")
        left_out.append(f"{line}: left out")
        values = {name: value[keep] for name, value in values.items()}
    values["quats"] = _unit(values["quats"])
    values["opacities"] = values["opacities"].clamp(0, 1)
    warn_of_steps(path, values["means"], step)
    fields: dict[str, Any] = {**values}
    return Gaussians(**fields)


def warn_of_steps(path: str | Path, means: torch.Tensor, step: float = 0.0) -> None:
    """Warn where positions are in steps of over 1/1000 of the object.

    Args:
        path: named in the warning.
        means: ``[N, 3]`` float32, N > 0.
        step: the file format's; float32's is used instead if it is larger.
    """
    reach, extent = means.abs().max(), (means.amax(0) - means.amin(0)).max().item()
    step = max(step, float(np.spacing(np.float32(reach))))
    if len(means) > 1 and step > extent / 1000:
        line = f"{path}: positions reach {reach:.3g} and have steps of {step:.3g}"
        advice = f"the object has a side of {extent:.3g}; move it to the origin before it is stored"
        warnings.warn(f"{line}, {advice}", FileWarning, stacklevel=2)


def rest_names(count: int) -> tuple[str, ...]:
    """Return the names of a ``.ply``'s properties for ``count`` coefficients of the harmonics."""
    return tuple(f"f_rest_{i}" for i in range(count))


def harmonics_of(path: str | Path, rest: np.ndarray) -> np.ndarray:
    """Return the columns ``f_rest_*`` of a ``.ply``, ``[N, 3 K]``, as harmonics ``[N, K, 3]``.

    Raises:
        UserError: they are not of degree 0 to 3.
    """
    count = rest.shape[1]
    if count not in (0, 9, 24, 45):
        raise UserError(
            f"{path}: {count} properties f_rest_*; harmonics of degree 1, 2 and 3 have 9, 24 and 45"
        )
    return rest.reshape(len(rest), 3, count // 3).transpose(0, 2, 1)


def _unit(quats: torch.Tensor) -> torch.Tensor:
    """Normalise nonzero quaternions."""
    lengths = quats.norm(dim=1, keepdim=True)
    odd = ((lengths == 0) | ~lengths.isfinite())[:, 0]  # the squares leave float32's range
    if odd.any():
        quats[odd] /= quats[odd].abs().amax(1, keepdim=True)
        lengths = quats.norm(dim=1, keepdim=True)
    return quats / lengths


def smallest_three(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split unit quaternions ``[N, 4]`` into the index of the largest number and the other three.

    The sign is chosen so that the largest number is positive.

    Returns:
        ``[N]`` int64, and ``[N, 3]`` within ±1/√2, in their order.
    """
    largest = np.abs(quats).argmax(1)[:, None]
    sign = np.where(np.take_along_axis(quats, largest, 1) < 0, -1.0, 1.0)
    return largest[:, 0], np.take_along_axis(quats, _OTHERS[largest[:, 0]], 1) * sign


def from_smallest_three(largest: np.ndarray, three: np.ndarray) -> np.ndarray:
    """Return the quaternions ``[N, 4]`` of ``smallest_three``."""
    quats = np.empty((len(three), 4))
    np.put_along_axis(quats, _OTHERS[largest], three, 1)
    quats[np.arange(len(three)), largest] = np.sqrt(np.maximum(0.0, 1.0 - (three**2).sum(1)))
    return quats
