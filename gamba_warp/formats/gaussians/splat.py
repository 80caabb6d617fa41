"""Gaussians as ``.splat``: 32 bytes each, no header, read by most web viewers.

One record is float32 position ×3, float32 scale ×3 (standard deviations), 8-bit RGBA, and an
8-bit wxyz quaternion stored as ``128 · q + 128``. The largest and most opaque Gaussians come first,
for viewers that stream the file. The format has no harmonics.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import UserError
from ...files import atomic_path
from ...gaussians import Gaussians
from ...images import to_uint8
from ..headers import Source
from .arrays import checked_gaussians, export_arrays

RECORD = np.dtype(
    [("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)]
)


def save_splat(path: str | Path, gaussians: Gaussians) -> str | None:
    """Write one object as ``.splat`` in OpenCV's axes, atomically.

    Returns:
        A sentence about what is lost, or None.

    Raises:
        UserError: a value is not finite, there is no Gaussian, or the file cannot be written.
        ValueError: there is a batch dimension.
    """
    arrays = export_arrays(path, gaussians)
    weight = arrays["scales"].prod(1) * arrays["opacities"]
    records = np.empty(len(weight), RECORD)
    records["means"], records["scales"] = arrays["means"], arrays["scales"]
    records["rgba"] = to_uint8(np.column_stack([arrays["colors"], arrays["opacities"]]))
    records["quats"] = np.clip(np.rint(arrays["quats"] * 128 + 128), 0, 255)
    with atomic_path(path) as temporary:
        temporary.write_bytes(records[np.argsort(-weight, kind="stable")].tobytes())
    lost = ["harmonics"] * (gaussians.harmonics is not None)
    lost += ["antialiasing"] * gaussians.antialiased
    return f"{path}: a .splat has no place for {' and '.join(lost)}." if lost else None


def read_splat(source: Source, left_out: list[str] | None = None) -> Gaussians:
    """Read a ``.splat`` file, from this or another program, as one object.

    The format has no header: any file of whole records with valid values is accepted.
    ``left_out`` as for ``checked_gaussians``.

    Raises:
        UserError: the file is not of whole records, or its values are invalid.
    """
    path, file, size = source
    if size % RECORD.itemsize:
        raise UserError(
            f"{path}: truncated or not a .splat file, {size} bytes are not a multiple of "
            f"{RECORD.itemsize}"
        )
    records = np.frombuffer(file.read(), RECORD)
    rgba = records["rgba"].astype(np.float32) / 255
    arrays = {
        "means": records["means"],
        "quats": (records["quats"].astype(np.float32) - 128) / 128,
        "scales": records["scales"],
        "opacities": rgba[:, 3],
        "colors": rgba[:, :3],
    }
    return checked_gaussians(path, arrays, left_out)
