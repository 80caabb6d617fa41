"""Gaussians as arrays that are fit to be written, and arrays of strangers as sound Gaussians."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from ...conventions import Axes
from ...errors import UserError
from ...gaussians import Gaussians

MAX_REACH = 1e18  # of means and scales: the squares of larger numbers overflow float32
MIN_SCALE = 1e-12  # keeps the logarithm of a scale finite
DEGREES = {0: 0, 3: 1, 8: 2, 15: 3}  # degree of the harmonics by their number K
_NAMES = ("means", "quats", "scales", "opacities", "colors")


def flip_axes(gaussians: Gaussians) -> Gaussians:
    """From OpenCV's axes (y down, z forward) to OpenGL's (y up, z backward), and back."""
    half_turn = torch.diag(gaussians.means.new_tensor([1.0, -1.0, -1.0]))
    return gaussians.transformed(half_turn, gaussians.means.new_zeros(3))


def export_arrays(
    path: str | Path, gaussians: Gaussians, axes: Axes = "opencv"
) -> dict[str, np.ndarray]:
    """One object's Gaussians as float32 arrays fit to be written: finite, quaternions normalised.

    Args:
        path: named in errors.
        gaussians: one object, no batch dimension.
        axes: those of the format; those of ``gaussians`` are OpenCV's.

    Returns:
        ``means [N, 3]``, ``quats [N, 4]`` wxyz, ``scales [N, 3]``, ``opacities [N]``,
        ``colors [N, 3]``, ``harmonics [N, K, 3]``, K of 0, 3, 8 or 15; activated values.

    Raises:
        ValueError: there is a batch dimension.
        UserError: a value is not finite, or there is no Gaussian.
    """
    if gaussians.opacities.dim() != 1:
        raise ValueError(
            f"one object expected, got leading shape {tuple(gaussians.opacities.shape[:-1])}"
        )
    if gaussians.num == 0:
        raise UserError(f"{path}: not written, there is no Gaussian")
    gaussians = gaussians.detach().to("cpu", torch.float32)
    if axes == "opengl":
        gaussians = flip_axes(gaussians)
    if gaussians.quats is None:
        gaussians.quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(gaussians.num, 4)
    arrays = {name: getattr(gaussians, name).numpy() for name in _NAMES}
    harmonics = gaussians.harmonics
    arrays["harmonics"] = (
        np.zeros((gaussians.num, 0, 3), np.float32) if harmonics is None else harmonics.numpy()
    )
    bad = sum(~np.isfinite(value.reshape(gaussians.num, -1)).all(1) for value in arrays.values())
    if np.any(bad):
        count = np.count_nonzero(bad)
        raise UserError(f"{path}: not written, {count} of {gaussians.num} Gaussians are not finite")
    lengths = np.linalg.norm(arrays["quats"], axis=1, keepdims=True)
    arrays["quats"] = arrays["quats"] / lengths.clip(1e-12)
    return arrays


def sound_gaussians(
    path: str | Path, arrays: dict[str, np.ndarray], left_out: list[str] | None = None
) -> Gaussians:
    """Arrays of a file, activated values in any order of bytes, as one object.

    Without harmonics colours are clipped to [0, 1]; with them a base colour may lie outside.

    Args:
        path: named in errors.
        arrays: as ``export_arrays`` returns them; ``harmonics`` may be missing, quaternions may
            have any length > 0.
        left_out: gets a line of how many Gaussians are left out because they cannot be drawn: a
            value that is not finite, means or scales over ``MAX_REACH``, a scale below 0, or a
            rotation of length zero. None: a file that has one is refused.

    Returns:
        Float32 Gaussians on the CPU, ``quats`` normalised.

    Raises:
        UserError: no Gaussian, none that can be drawn, or one that cannot where ``left_out`` is
            None.
    """
    values: dict[str, torch.Tensor] = {}
    odd: dict[str, torch.Tensor] = {}  # the Gaussians whose value of a name is not finite
    count = len(arrays["opacities"])
    if count == 0:
        raise UserError(f"{path}: holds no Gaussians")
    for name, array in arrays.items():
        with np.errstate(over="ignore"):
            array = np.ascontiguousarray(array, np.float32)
        values[name] = torch.from_numpy(array if array.flags.writeable else array.copy())
        finite = torch.from_numpy(np.isfinite(array.reshape(count, -1)).all(1))
        if not finite.all():
            odd[name] = ~finite
    checks: dict[str, torch.Tensor] = {}
    if odd:
        checks[f"{' or '.join(odd)} that are not finite"] = torch.stack([*odd.values()]).any(0)
    for name in ("means", "scales"):
        far = (values[name].abs() > MAX_REACH) & values[name].isfinite()
        checks[f"{name} over {MAX_REACH:g}"] = far.any(1)
    checks["scales below 0"] = (values["scales"] < 0).any(1)
    checks["rotations of length zero"] = (values["quats"] == 0).all(1)
    bad = {reason: which for reason, which in checks.items() if which.any()}
    if bad:
        keep = ~torch.stack([*bad.values()]).any(0)
        kept = int(keep.sum())
        line = f"{count - kept} of {count} Gaussians have {', or '.join(bad)}"
        if left_out is None or kept == 0:
            advice = "; gamba export --drop-bad leaves such out" if kept else ""
            raise UserError(f"{path}: {line}{advice}")
        left_out.append(f"{line}: left out")
        values = {name: value[keep] for name, value in values.items()}
    harmonics = values.get("harmonics")
    if harmonics is not None and harmonics.shape[1] == 0:
        harmonics = None
    colors = values["colors"]
    return Gaussians(
        means=values["means"],
        quats=_unit(values["quats"]),
        scales=values["scales"],
        opacities=values["opacities"].clamp(0, 1),
        colors=colors.clamp(0, 1) if harmonics is None else colors,
        harmonics=harmonics,
    )


def _unit(quats: torch.Tensor) -> torch.Tensor:
    """Quaternions of length 1, of such that are not zero."""
    lengths = quats.norm(dim=1, keepdim=True)
    odd = ((lengths == 0) | ~lengths.isfinite())[:, 0]  # the squares leave float32's range
    if odd.any():
        quats[odd] /= quats[odd].abs().amax(1, keepdim=True)
        lengths = quats.norm(dim=1, keepdim=True)
    return quats / lengths


def smallest_three(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The place of the largest number of each quaternion, and the other three.

    A quaternion and its negative are one rotation: the largest is made positive.

    Args:
        quats: ``[N, 4]``, unit.

    Returns:
        ``[N]`` int64, and ``[N, 3]`` within ±1/√2, in their order.
    """
    largest = np.abs(quats).argmax(1)
    rows = np.arange(len(quats))
    sign = np.where(quats[rows, largest] < 0, -1.0, 1.0)[:, None]
    others = np.stack([np.delete(np.arange(4), place) for place in range(4)])[largest]
    return largest, quats[rows[:, None], others] * sign


def from_smallest_three(largest: np.ndarray, three: np.ndarray) -> np.ndarray:
    """The quaternions ``[N, 4]`` of ``smallest_three``."""
    others = np.stack([np.delete(np.arange(4), place) for place in range(4)])[largest]
    rows = np.arange(len(three))
    quats = np.empty((len(three), 4))
    quats[rows[:, None], others] = three
    quats[rows, largest] = np.sqrt(np.maximum(0.0, 1.0 - (three**2).sum(1)))
    return quats
