"""Gaussians as ``.splat``: 32 bytes each, no header, read by most web viewers.

One record is float32 position ×3, float32 scale ×3 (standard deviations), 8-bit RGBA, and an
8-bit wxyz quaternion stored as ``128 · q + 128``. The largest and most opaque Gaussians come first,
so that a viewer that streams the file shows them first. There is no place for harmonics.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import UserError
from ...files import atomic_path
from ...gaussians import Gaussians
from ...images import to_uint8
from ..headers import open_shape
from .arrays import export_arrays, sound_gaussians

RECORD = np.dtype(
    [("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)]
)


def splat_bytes(gaussians: Gaussians, name: str | Path = "splat") -> bytes:
    """The content of a ``.splat`` file of one object, with OpenCV's axes, without its harmonics.

    Args:
        gaussians: one object, no batch dimension.
        name: named in errors.

    Raises:
        UserError: a value is not finite, or there is no Gaussian.
        ValueError: there is a batch dimension.
    """
    arrays = export_arrays(name, gaussians)
    weight = arrays["scales"].prod(1) * arrays["opacities"]
    records = np.empty(len(weight), RECORD)
    records["means"], records["scales"] = arrays["means"], arrays["scales"]
    records["rgba"] = to_uint8(np.column_stack([arrays["colors"], arrays["opacities"]]))
    records["quats"] = np.clip(np.rint(arrays["quats"] * 128 + 128), 0, 255)
    return records[np.argsort(-weight, kind="stable")].tobytes()


def save_splat(path: str | Path, gaussians: Gaussians) -> str | None:
    """Writes one object as ``.splat``, atomically; arguments and errors as ``splat_bytes``.

    Returns:
        A sentence about what is lost, or None.

    Raises:
        UserError: also where the file cannot be written.
    """
    data = splat_bytes(gaussians, path)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
    if gaussians.harmonics is None:
        return None
    return f"{path}: the harmonics are lost, a .splat has one colour for all directions."


def load_splat(path: str | Path, left_out: list[str] | None = None) -> Gaussians:
    """Reads a ``.splat`` file, from this or another program, as one object.

    The format has no header: any file of whole records whose values make sense is taken.
    ``left_out`` as for ``sound_gaussians``.

    Raises:
        UserError: not a file, no whole number of records, or values that are not those of
            Gaussians.
    """
    path = Path(path)
    with open_shape(path) as (file, size):
        if size % RECORD.itemsize:
            raise UserError(
                f"{path}: truncated or no .splat file, {size} bytes are not a multiple of "
                f"{RECORD.itemsize}"
            )
        records = np.frombuffer(file.read(), RECORD)
    rgba = records["rgba"].astype(np.float32) / 255
    return sound_gaussians(
        path,
        {
            "means": records["means"],
            "quats": (records["quats"].astype(np.float32) - 128) / 128,
            "scales": records["scales"],
            "opacities": rgba[:, 3],
            "colors": rgba[:, :3],
        },
        left_out,
    )
