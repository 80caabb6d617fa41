"""Mesh files for the viewer: one colour a vertex, in the axes of the Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..conventions import Axes
from ..formats.materials import to_linear
from ..formats.meshes import TexturedMesh, load_mesh, to_display

_LINEAR = (".glb", ".gltf")  # the format's colours of vertices are linear light


@dataclass
class ViewedMesh:
    """Triangles with coloured corners.

    Attributes:
        vertices: ``[V, 3]`` float64.
        faces: ``[F, 3]`` int64.
        colors: ``[V, 3]`` float32, display values in [0, 1].
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray


def read_viewed_mesh(path: str | Path, axes: Axes = "opengl") -> ViewedMesh:
    """Reads a mesh file for the viewer, which shows OpenCV's axes (y down).

    A texture is seen as its colours at the corners.

    Args:
        path: the file.
        axes: those of the file; OpenGL's (y up) are what ``save_mesh`` writes.

    Raises:
        UserError: as ``load_mesh``.
    """
    mesh = load_mesh(path)
    linear = Path(path).suffix.lower() in _LINEAR
    vertices = mesh.vertices * ([1.0, -1.0, -1.0] if axes == "opengl" else 1.0)
    paint = (255 * _corner_colors(mesh, linear) + 0.5).astype(np.int64)
    # A vertex that has several colours becomes several.
    keys = mesh.faces << 24 | paint[..., 0] << 16 | paint[..., 1] << 8 | paint[..., 2]
    found, corners = np.unique(keys, return_inverse=True)
    colors = np.stack([found >> 16 & 255, found >> 8 & 255, found & 255], 1) / np.float32(255)
    return ViewedMesh(vertices[found >> 24], corners.reshape(mesh.faces.shape), colors)


def _corner_colors(mesh: TexturedMesh, linear: bool) -> np.ndarray:
    """``[F, 3, 3]`` display values: the product of material, texture and vertices' colours."""
    light = mesh.colors[..., :3].astype(np.float32) / 255
    light = light if linear else to_linear(light)
    for i, material in enumerate(mesh.materials):
        mine = mesh.material_ids == i
        light[mine] *= material.color[:3]
        if material.texture is not None:
            height, width = material.texture.shape[:2]
            u, v = np.moveaxis(mesh.uvs[mine] % 1, -1, 0)
            rows = ((1 - v) * height).astype(int).clip(0, height - 1)
            columns = (u * width).astype(int).clip(0, width - 1)
            light[mine] *= to_linear(material.texture[rows, columns, :3] / np.float32(255))
    return to_display(light.clip(0, 1))
