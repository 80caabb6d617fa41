"""What is evaluated: meshes and points, and how they are moved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from gamba_warp.gaussians import Gaussians
from gamba_warp.open3d import import_open3d


@dataclass
class Points:
    """Points on a surface.

    Attributes:
        positions: ``[N, 3]`` float.
        normals: ``[N, 3]`` unit length, either sign; or None.
    """

    positions: np.ndarray
    normals: np.ndarray | None = None


@dataclass
class Mesh:
    """Triangles.

    Attributes:
        vertices: ``[V, 3]`` float64.
        faces: ``[F, 3]`` int64, F > 0.
    """

    vertices: np.ndarray
    faces: np.ndarray

    def scene(self):
        """An Open3D ``RaycastingScene`` of these triangles alone."""
        scene = import_open3d().t.geometry.RaycastingScene()
        scene.add_triangles(self.vertices.astype(np.float32), self.faces.astype(np.uint32))
        return scene

    def is_closed(self) -> bool:
        """Whether every edge has an even number of faces, after vertices at one place are merged.

        The parity of crossings then means inside and outside, whatever the faces' orientation.
        """
        faces = merged(self.vertices)[1][self.faces]
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        edges = edges[edges[:, 0] != edges[:, 1]]  # of faces without area
        counts = np.unique(edges[:, 0] * len(self.vertices) + edges[:, 1], return_counts=True)[1]
        return bool((counts % 2 == 0).all())


Shape = Mesh | Points | Gaussians


def merged(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct rows of ``[V, 3]`` and ``[V]`` the index of each row among them."""
    rows = np.ascontiguousarray(vertices, np.float64) + 0.0  # one zero, not two
    _, first, index = np.unique(
        rows.view([("", rows.dtype)] * 3)[:, 0], return_index=True, return_inverse=True
    )
    return rows[first], index.reshape(-1)


@dataclass
class Similarity:
    """The motion ``x -> scale · rotation · x + translation``.

    Attributes:
        rotation: ``[3, 3]`` float64, proper.
        translation: ``[3]`` float64.
        scale: > 0.
    """

    rotation: np.ndarray
    translation: np.ndarray
    scale: float = 1.0

    def points(self, x: np.ndarray) -> np.ndarray:
        """Moves ``[N, 3]``."""
        return self.scale * x @ self.rotation.T + self.translation

    def apply(self, shape: Shape) -> Shape:
        """Moves a shape of any kind."""
        if isinstance(shape, Mesh):
            return Mesh(self.points(shape.vertices), shape.faces)
        if isinstance(shape, Points):
            normals = None if shape.normals is None else shape.normals @ self.rotation.T
            return Points(self.points(shape.positions), normals)
        rotation, translation = (
            torch.from_numpy(v).to(shape.means) for v in (self.rotation, self.translation)
        )
        return shape.transformed(rotation, translation, self.scale)

    def record(self) -> dict:
        """For a report."""
        return {
            "scale": float(self.scale),
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
        }
