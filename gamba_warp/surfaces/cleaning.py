"""Meshes made clean with pymeshlab: floaters, small holes, number of faces."""

from __future__ import annotations

import numpy as np

from ..errors import UserError


def cleaned_mesh(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    min_component: float = 0.0,
    min_diameter: float = 0.0,
    largest: bool = False,
    close_holes: int = 0,
    smooth: int = 0,
    max_faces: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """A mesh without double and null faces; what else is asked for is done in this order.

    Args:
        vertices: ``[V, 3]``.
        faces: ``[F, 3]``, outside in front.
        min_component: parts with a smaller share of all faces are removed.
        min_diameter: parts whose bounding box has a shorter diagonal are removed, in units of the
            whole's.
        largest: only the part with the most faces stays.
        close_holes: holes with at most so many edges are closed; 0: none.
        smooth: steps of Taubin smoothing, which hardly shrinks.
        max_faces: quadric decimation to at most so many, borders kept; 0: all stay.

    Returns:
        Vertices ``[V, 3]`` float64, all in use, and faces ``[F, 3]`` int64.

    Raises:
        UserError: nothing is left.
    """
    from pymeshlab import Mesh, MeshSet  # pyright: ignore[reportAttributeAccessIssue] (no stubs)

    meshes = MeshSet()
    meshes.add_mesh(Mesh(vertices, faces.astype(np.int32)))
    meshes.meshing_remove_duplicate_vertices()
    meshes.meshing_remove_duplicate_faces()
    meshes.meshing_remove_null_faces()
    _drop_parts(meshes, min_component, min_diameter, largest)
    if meshes.current_mesh().face_number() == 0:
        raise UserError("no part of the surface is large enough")
    if close_holes:
        _make_manifold(meshes)
        meshes.meshing_close_holes(maxholesize=close_holes, newfaceselected=False)
    if smooth:
        meshes.apply_coord_taubin_smoothing(stepsmoothnum=smooth)
    if 0 < max_faces < meshes.current_mesh().face_number():
        meshes.meshing_decimation_quadric_edge_collapse(
            targetfacenum=max_faces, preserveboundary=True, preservenormal=True
        )
        meshes.meshing_remove_unreferenced_vertices()
    kept = meshes.current_mesh()
    return kept.vertex_matrix(), kept.face_matrix().astype(np.int64)


def _drop_parts(meshes, min_component: float, min_diameter: float, largest: bool) -> None:
    from pymeshlab import PureValue  # pyright: ignore[reportAttributeAccessIssue] (no stubs)

    least = int(min_component * meshes.current_mesh().face_number())
    if largest:
        parts = _part_sizes(meshes.current_mesh().face_matrix())
        least = max(least, int(parts.max(initial=0)))
    meshes.meshing_remove_connected_component_by_face_number(
        mincomponentsize=least, removeunref=True
    )
    if min_diameter > 0:
        shortest = min_diameter * meshes.current_mesh().bounding_box().diagonal()
        meshes.meshing_remove_connected_component_by_diameter(
            mincomponentdiag=PureValue(shortest), removeunref=True
        )


def _part_sizes(faces: np.ndarray) -> np.ndarray:
    """The number of faces of each part; faces of one part are joined by edges."""
    import trimesh
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    pairs = np.asarray(trimesh.graph.face_adjacency(faces))
    links = coo_array((np.ones(len(pairs), bool), pairs.T), shape=(len(faces),) * 2)
    return np.bincount(connected_components(links, directed=False)[1])


def _make_manifold(meshes) -> None:
    """Makes the mesh manifold, as closing holes needs it.

    Of the faces at an edge of more than two, the smallest are removed first.
    """
    meshes.meshing_repair_non_manifold_edges(method="Remove Faces")
    meshes.meshing_repair_non_manifold_vertices()
