"""What is evaluated, meshes and points, and the motions that bring it into one frame.

The process that only hands pairs to a child reads this module, so torch is imported by functions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias, overload

import numpy as np

from gamba_warp.versions import import_open3d

if TYPE_CHECKING:
    from gamba_warp.gaussians import Gaussians


@dataclass
class Points:
    """Points on a surface.

    Attributes:
        positions: ``[N, 3]`` float.
        normals: ``[N, 3]`` of unit length and of either sign; or None.
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
        """Returns an Open3D ``RaycastingScene`` that holds these triangles alone."""
        scene = import_open3d().t.geometry.RaycastingScene()
        scene.add_triangles(self.vertices.astype(np.float32), self.faces.astype(np.uint32))
        return scene

    def corners(self) -> np.ndarray:
        """Returns ``[F, 3, 3]``, the places of each face's three corners."""
        return self.vertices[self.faces]

    def normals(self) -> np.ndarray:
        """Returns ``[F, 3]``, each face's normal; its length is twice the area of the face."""
        corners = self.corners()
        return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

    def is_closed(self) -> bool:
        """Whether every edge has an even number of faces, after vertices at one place are merged.

        The parity of crossings then means inside and outside, whatever the faces' orientation. Of
        a mesh that is ``flags.tidied`` it is the same as having no flag "open".
        """
        faces = merged(self.vertices)[1][self.faces]
        edges = np.sort(directed_edges(faces), axis=1)
        edges = edges[edges[:, 0] != edges[:, 1]]  # without those of faces that have no area
        counts = np.unique(edges[:, 0] * len(self.vertices) + edges[:, 1], return_counts=True)[1]
        return bool((counts % 2 == 0).all())


Shape: TypeAlias = "Mesh | Points | Gaussians"


def directed_edges(faces: np.ndarray) -> np.ndarray:
    """``[3 F, 2]`` edges of ``[F, 3]`` faces, in the direction in which each face runs along it."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def merged(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct rows of ``[V, 3]`` and ``[V]`` the index of each row among them."""
    rows = np.ascontiguousarray(vertices, np.float64) + 0.0  # -0.0 becomes 0.0
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

    @overload
    def apply(self, shape: Mesh) -> Mesh: ...
    @overload
    def apply(self, shape: Points) -> Points: ...
    @overload
    def apply(self, shape: Gaussians) -> Gaussians: ...
    def apply(self, shape: Shape) -> Shape:
        """Moves a shape of any kind."""
        if isinstance(shape, Mesh):
            return Mesh(self.points(shape.vertices), shape.faces)
        if isinstance(shape, Points):
            normals = None if shape.normals is None else shape.normals @ self.rotation.T
            return Points(self.points(shape.positions), normals)
        import torch

        rotation, translation = (
            torch.from_numpy(v).to(shape.means) for v in (self.rotation, self.translation)
        )
        return shape.transformed(rotation, translation, self.scale)

    def after(self, turn: np.ndarray) -> Similarity:
        """This motion after a rotation ``[3, 3]`` about the origin."""
        return Similarity(self.rotation @ turn, self.translation, self.scale)

    def record(self) -> dict:
        """Returns the motion for a report: ``scale, rotation, translation`` as plain numbers."""
        return {
            "scale": float(self.scale),
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
        }
