"""What readers of meshes give: parts of one material, as triangles with what their corners have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .materials import Material


@dataclass
class Part:
    """F triangles of one material in the frame of the file.

    Attributes:
        vertices: ``[V, 3]`` float.
        faces: ``[F, 3]`` int64; some of the vertices may be of no face.
        material: that of all faces; None: the file has none.
        normals: ``[F, 3, 3]`` of any length; None: the file has none.
        uvs: ``[F, 3, 2]``, v upwards; None: the file has none.
        colors: ``[F, 3, 4]`` uint8 display RGBA; None: the file has none.
    """

    vertices: np.ndarray
    faces: np.ndarray
    material: Material | None = None
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None
    colors: np.ndarray | None = None


def to_rgba8(values: np.ndarray) -> np.ndarray:
    """Makes uint8 RGBA ``[N, 4]`` of display colours ``[N, 3 or more]`` of any type and range.

    Integers reach to 255, those of 16 bits to 65535; floats to 1, or to the smallest of these three
    that they fit.
    """
    out = np.full((len(values), 4), 255, np.uint8)
    values = np.asarray(values)[:, :4]
    if values.dtype != np.uint8:
        top = np.nan_to_num(values, posinf=0).max(initial=0)
        if values.dtype.kind == "f" and top <= 2:  # some programs go a little over 1
            most = 1
        else:
            most = 65535 if values.dtype == np.uint16 or top > 255 else 255
        values = np.clip(np.nan_to_num(values.astype(np.float64)) / most, 0, 1) * 255 + 0.5
    out[:, : values.shape[1]] = values
    return out
