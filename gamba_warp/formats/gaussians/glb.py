"""Gaussians as binary glTF with the Khronos extension ``KHR_gaussian_splatting``.

Scales are linear (early drafts of the extension stored logarithms), quaternions xyzw, axes +y up.
Colours are those of a display, as the extension's ``srgb_rec709_display`` says; ``COLOR_0``, which
lets a viewer without the extension show coloured points, is linear light, as glTF has it.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np

from ...files import atomic_path
from ...gaussians import SH_C0, Gaussians
from ...versions import __version__
from ..materials import to_linear
from .arrays import DEGREES, export_arrays

EXTENSION = "KHR_gaussian_splatting"
COLOR_SPACE = "srgb_rec709_display"
FLOAT = 5126
POINTS = 0
_ARRAY_BUFFER = 34962
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def harmonic_names(degree: int) -> list[str]:
    """Names of the attributes of the harmonics of degrees 1 to ``degree``, in their order."""
    return [
        f"{EXTENSION}:SH_DEGREE_{l}_COEF_{n}"
        for l in range(1, degree + 1)
        for n in range(2 * l + 1)
    ]


def save_glb(path: str | Path, gaussians: Gaussians) -> None:
    """Writes one object as ``.glb``, turned to glTF's axes (+y up, front towards +z), atomically.

    Args:
        path: file to write.
        gaussians: one object, no batch dimension.

    Raises:
        UserError: a value is not finite, there is no Gaussian, or the file cannot be written.
        ValueError: there is a batch dimension.
    """
    arrays = export_arrays(path, gaussians, "opengl")
    harmonics = arrays["harmonics"]
    rgb = arrays["colors"] if harmonics.shape[1] else arrays["colors"].clip(0, 1)
    opacities = arrays["opacities"].clip(0, 1)[:, None]
    attributes = {
        "POSITION": arrays["means"],
        "COLOR_0": np.hstack([to_linear(rgb.clip(0, 1)), opacities]),
        f"{EXTENSION}:ROTATION": np.roll(arrays["quats"], -1, axis=1),
        f"{EXTENSION}:SCALE": arrays["scales"],
        f"{EXTENSION}:OPACITY": opacities,
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": (rgb - 0.5) / SH_C0,
    }
    names = harmonic_names(DEGREES[harmonics.shape[1]])
    attributes |= {name: harmonics[:, i] for i, name in enumerate(names)}
    views, accessors, parts, offset = [], [], [], 0
    for value in attributes.values():
        part = value.astype("<f4")
        views.append(
            {"buffer": 0, "byteOffset": offset, "byteLength": part.nbytes, "target": _ARRAY_BUFFER}
        )
        accessors.append(
            {
                "bufferView": len(accessors),
                "componentType": FLOAT,
                "count": len(part),
                "type": _TYPES[part.shape[1]],
            }
        )
        parts.append(part.tobytes())
        offset += part.nbytes
    # The format asks for bounds of POSITION, of the values as they are rounded.
    means = attributes["POSITION"].astype("<f4")
    accessors[0] |= {"min": means.min(0).tolist(), "max": means.max(0).tolist()}
    primitive = {
        "mode": POINTS,
        "attributes": {name: index for index, name in enumerate(attributes)},
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": COLOR_SPACE}},
    }
    document = {
        "asset": {"version": "2.0", "generator": f"gamba_warp {__version__}"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": Path(path).stem}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": offset}],
        "bufferViews": views,
        "accessors": accessors,
    }
    # The container: a header, a JSON chunk padded with spaces, and a BIN chunk of float32.
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", offset, b"BIN\0") + b"".join(parts)
    with atomic_path(path) as temporary:
        temporary.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
