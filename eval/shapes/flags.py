"""Cleaning of meshes, and flags of their defects for the records."""

from __future__ import annotations

import numpy as np

from gamba_warp.formats.parts import merged

from .shape import Mesh, directed_edges, edges_of

FLAGS = {
    "open": "an edge belongs to an odd number of faces",
    "nonmanifold": "an edge belongs to more than two faces",
    "inconsistent": "two faces run along their common edge in the same direction",
    "inverted": "closed, and its normals point inwards",
    "degenerate": "a face has no area",
    "duplicate": "a face is given more than once",
    "selfintersecting": "a face cuts another; looked for on request, with pymeshlab",
}
STRICT = tuple(flag for flag in FLAGS if flag != "open")  # refused by "strict"


def clean_mesh(mesh: Mesh, intersections: bool = False) -> tuple[Mesh, list[str]]:
    """Merge equal vertices, drop faces without area and duplicate faces, and set flags.

    The surface does not change.

    Args:
        mesh: any mesh; without area the result has no face.
        intersections: look for faces that cut each other, too: 3 s for 110,000 faces.

    Returns:
        The mesh without duplicate vertices, duplicate faces and faces without area, perhaps empty;
        the flags of the original, names from ``FLAGS`` in their order.
    """
    vertices, index = merged(mesh.vertices)
    faces = index[mesh.faces]
    flat = ~(np.abs(Mesh(vertices, faces).normals()).max(1) > 0)
    order = np.sort(faces, axis=1)
    rank = np.lexsort(order.T)  # equal rows adjacent, in the order of the file
    repeated = np.zeros(len(faces), bool)
    repeated[rank[1:]] = (order[rank[1:]] == order[rank[:-1]]).all(1)
    cleaned = Mesh(vertices, faces[~flat & ~repeated])
    flags = _edge_flags(cleaned)
    if flat.any():
        flags.add("degenerate")
    if (repeated & ~flat).any():
        flags.add("duplicate")
    if intersections and len(cleaned.faces) and _cuts_itself(cleaned):
        flags.add("selfintersecting")
    return cleaned, [flag for flag in FLAGS if flag in flags]


def _edge_flags(mesh: Mesh) -> set[str]:
    start, end = directed_edges(mesh.faces).T
    _, index, counts = edges_of(mesh.faces)
    balance = np.bincount(index, np.where(start < end, 1.0, -1.0), len(counts))
    there = {
        "open": (counts % 2 == 1).any(),
        "nonmanifold": (counts > 2).any(),
        "inconsistent": (balance[counts == 2] != 0).any(),
    }
    flags = {flag for flag, yes in there.items() if yes}
    if not flags & {"open", "inconsistent"}:
        corners = (mesh.vertices - mesh.vertices.mean(0))[mesh.faces]
        if (corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])).sum() < 0:  # 6 volumes, signed
            flags.add("inverted")
    return flags


def _cuts_itself(mesh: Mesh) -> bool:
    # which has no stubs
    from pymeshlab import Mesh as Faces  # pyright: ignore[reportAttributeAccessIssue]
    from pymeshlab import MeshSet  # pyright: ignore[reportAttributeAccessIssue]

    meshes = MeshSet()
    meshes.add_mesh(Faces(mesh.vertices.astype(np.float64), mesh.faces.astype(np.int32)))
    meshes.compute_selection_by_self_intersections_per_face()
    return meshes.current_mesh().selected_face_number() > 0
