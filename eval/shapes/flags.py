"""What is unusual about a mesh: it is evaluated all the same, and its record states it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .shape import Mesh, directed_edges, merged

FLAGS = {
    "open": "an edge belongs to an odd number of faces",
    "nonmanifold": "an edge belongs to more than two faces",
    "inconsistent": "two faces run along their common edge in the same direction",
    "inverted": "closed, and its normals point inwards",
    "degenerate": "a face has no area",
    "duplicate": "a face is given more than once",
    "selfintersecting": "a face cuts another",
}
STRICT = tuple(flag for flag in FLAGS if flag != "open")  # the flags that "strict" refuses


class Tidied(NamedTuple):
    """A mesh as it is evaluated, and the flags of the mesh that it was made from.

    Attributes:
        mesh: without repeated vertices and faces and without flat faces; it may have no face left.
        flags: names from ``FLAGS``, in their order.
    """

    mesh: Mesh
    flags: list[str]


def tidied(mesh: Mesh) -> Tidied:
    """Merges vertices at one place, drops faces without area and repeated faces, and sets flags.

    None of this moves the surface.

    Args:
        mesh: any mesh; of one without area no face is left.
    """
    vertices, index = merged(mesh.vertices)
    faces = index[mesh.faces]
    flat = ~(np.abs(Mesh(vertices, faces).normals()).max(1) > 0)
    order = np.sort(faces, axis=1)
    _, first = np.unique(_keys(order, len(vertices)), return_index=True)
    repeated = np.ones(len(faces), bool)
    repeated[first] = False
    kept = Mesh(vertices, faces[~flat & ~repeated])
    found = _edge_flags(kept)
    if flat.any():
        found.add("degenerate")
    if (repeated & ~flat).any():
        found.add("duplicate")
    if len(kept.faces) and _cuts_itself(kept):
        found.add("selfintersecting")
    return Tidied(kept, [flag for flag in FLAGS if flag in found])


def _keys(order: np.ndarray, count: int) -> np.ndarray:
    """One number for each row of vertex indices, or the row itself where that would overflow."""
    if count < 2**21:
        return (order[:, 0] * count + order[:, 1]) * count + order[:, 2]
    return np.ascontiguousarray(order).view([("", order.dtype)] * 3)[:, 0]


def _edge_flags(mesh: Mesh) -> set[str]:
    edges = directed_edges(mesh.faces)
    forward = edges[:, 0] < edges[:, 1]
    order = np.sort(edges, axis=1)
    _, index, counts = np.unique(
        order[:, 0] * len(mesh.vertices) + order[:, 1], return_inverse=True, return_counts=True
    )
    balance = np.bincount(index.reshape(-1), np.where(forward, 1.0, -1.0), len(counts))
    found = set()
    if (counts % 2 == 1).any():
        found.add("open")
    if (counts > 2).any():
        found.add("nonmanifold")
    if (balance[counts == 2] != 0).any():
        found.add("inconsistent")
    if not found & {"open", "inconsistent"} and _signed_volume(mesh) < 0:
        found.add("inverted")
    return found


def _signed_volume(mesh: Mesh) -> float:
    corners = (mesh.vertices - mesh.vertices.mean(0))[mesh.faces]
    return float((corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])).sum()) / 6


def _cuts_itself(mesh: Mesh) -> bool:
    import pymeshlab  # which has no stubs

    meshes = pymeshlab.MeshSet()  # pyright: ignore[reportAttributeAccessIssue]
    copy = pymeshlab.Mesh(  # pyright: ignore[reportAttributeAccessIssue]
        mesh.vertices, mesh.faces.astype(np.int32)
    )
    meshes.add_mesh(copy)
    meshes.compute_selection_by_self_intersections_per_face()
    return meshes.current_mesh().selected_face_number() > 0
