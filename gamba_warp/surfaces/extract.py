"""Surfaces of Gaussians by fused depth (TSDF) or a level set, with cleaning and colours."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..batch import STAGES
from ..errors import UserError
from ..gaussians import Gaussians
from ..untrusted.ranges import check_options
from .density import level_set
from .options import SurfaceOptions
from .solid import distances, solid_of
from .texture import Texture, bake_texture, point_colors, vertex_normals
from .tsdf import fuse, look_around

_SOLID_VOXELS = 96  # voxels per unit of a closed surface; 128 take twice the time
VISIBLE = 0.05  # opacity from which a Gaussian counts for the object's extent


@dataclass
class Surface:
    """Triangles, outside in front.

    Attributes:
        vertices: ``[V, 3]`` float64.
        faces: ``[F, 3]`` int64, F > 0.
        colors: ``[V, 3]`` float32 RGB in [0, 1] (display values), or None.
        texture: the colours as an image, or None.
        moved: mean and largest distance of the surface before it was closed from this one, in units
            of the longest side, or None.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None = None
    texture: Texture | None = None
    moved: tuple[float, float] | None = None

    def is_watertight(self) -> bool:
        """Return True if every edge has two faces."""
        import trimesh

        return bool(trimesh.Trimesh(self.vertices, self.faces, process=False).is_watertight)


def extract_surface(gaussians: Gaussians, options: SurfaceOptions, texture: int = 0) -> Surface:
    """Extract the surface of an object about the origin with a longest side of about 1.

    Parts outside [-1, 1]^3 are left out.

    Args:
        gaussians: one object, on the device that renders.
        options: any method but centers.
        texture: side of a texture, pixels; 0: none.

    Raises:
        UserError: the surface is empty, or a value is not finite.
        ValueError: the method has no surface.
    """
    if options.method not in ("tsdf", "density"):
        raise ValueError(f"method is {options.method!r}, which has no surface")
    check_options(options)
    gaussians = near_and_visible(gaussians.detach())
    views: Any = None  # rendered where they are used
    STAGES.begin("mesh views")
    if options.method == "tsdf" or options.colors or texture:
        views = look_around(gaussians, options)
    STAGES.begin("mesh surface")
    if options.method == "tsdf":
        support = max(1.0, options.min_support * options.views)
        mesh = fuse(views, options.voxels, options.truncation, support)
    else:
        mesh = level_set(gaussians, options.voxels, options.level)
    STAGES.begin("mesh cleaning")
    vertices, faces = cleaned_mesh(*mesh, options)
    colors = image = moved = None
    if options.watertight:
        STAGES.begin("mesh closing")
        before = vertices
        voxels = min(options.voxels, _SOLID_VOXELS)
        vertices, faces = solid_of(vertices, faces, voxels, options.faces)
        distance = distances(before, vertices, faces)
        moved = float(distance.mean()), float(distance.max())
    if options.colors:
        STAGES.begin("mesh colors")
        normals = vertex_normals(vertices, faces)
        colors = point_colors(vertices, normals, views, options.voxels)
    if texture:
        STAGES.begin("mesh texture")
        image = bake_texture(vertices, faces, views, options.voxels, texture)
    STAGES.begin("mesh")  # what follows, such as its file
    return Surface(vertices, faces, colors, image, moved)


def near_and_visible(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians whose centre is within [-1, 1]^3.

    Raises:
        UserError: a value is not finite, no Gaussian is visible, or all are outside.
    """
    parts = (gaussians.means, gaussians.scales, gaussians.opacities[:, None], gaussians.colors)
    finite = torch.cat(parts, -1).isfinite().all(-1)
    if not finite.all():
        raise UserError(f"{int((~finite).sum())} of {gaussians.num} Gaussians are not finite")
    visible = gaussians.opacities > VISIBLE
    if not visible.any():
        raise UserError(f"no Gaussian has an opacity above {VISIBLE}")
    near = (gaussians.means.abs() < 1).all(-1)
    if not (near & visible).any():
        raise UserError("no visible Gaussian is within [-1, 1]^3")
    return gaussians.select(near)


def unit_frame(gaussians: Gaussians) -> tuple[Tensor, float]:
    """Return the centre ``[3]`` and the longest side of an object at any position.

    Only visible Gaussians count, without half a percent of the centres at each end of each axis, so
    that floaters far from the object do not count.

    Raises:
        UserError: a value is not finite, no Gaussian is visible, or all are at one point.
    """
    visible = gaussians.select(gaussians.opacities > VISIBLE)
    means = visible.means.double().cpu()
    if not gaussians.means.isfinite().all():
        raise UserError("a Gaussian's position is not finite")
    if len(means) == 0:
        raise UserError(f"no Gaussian has an opacity above {VISIBLE}")
    ends = np.quantile(means.numpy(), [0.005, 0.995], axis=0)
    # A single Gaussian has an extent as well.
    width = float(visible.scales.median())
    side = float((ends[1] - ends[0]).max()) + 4 * width
    if not 0 < side < float("inf"):
        raise UserError("the Gaussians have no extent")
    return torch.from_numpy(ends.mean(0)).to(gaussians.means), side


def surface_of(
    gaussians: Gaussians, options: SurfaceOptions, device: torch.device, texture: int = 0
) -> Surface:
    """Extract the surface of an object of any size and position, in its own frame.

    Args:
        gaussians: one object.
        options: any method but centers.
        device: device that renders.
        texture: side of a texture, pixels; 0: none.

    Raises:
        UserError: the surface is empty.
    """
    center, side = unit_frame(gaussians)
    moved = gaussians.in_unit(center, side).to(device)
    surface = extract_surface(moved, options, texture)
    vertices = surface.vertices * side + center.double().numpy()
    return replace(surface, vertices=vertices)


def cleaned_mesh(
    vertices: np.ndarray, faces: np.ndarray, options: SurfaceOptions
) -> tuple[np.ndarray, np.ndarray]:
    """Remove duplicate and null faces and small parts of a mesh, close holes, smooth and decimate.

    Args:
        vertices: ``[V, 3]``.
        faces: ``[F, 3]``, outside in front.
        options: ``min_component``, ``min_diameter``, ``largest``, ``close_holes``, ``smooth`` and
            ``faces``. A surface that is closed later is decimated there.

    Returns:
        Vertices ``[V, 3]`` float64, all in use, and faces ``[F, 3]`` int64.

    Raises:
        UserError: nothing is left.
    """
    # which has no stubs
    from pymeshlab import Mesh, MeshSet, PureValue  # pyright: ignore[reportAttributeAccessIssue]
    from trimesh.graph import connected_component_labels, face_adjacency

    meshes = MeshSet()
    meshes.add_mesh(Mesh(vertices, faces.astype(np.int32)))
    meshes.meshing_remove_duplicate_vertices()
    meshes.meshing_remove_duplicate_faces()
    meshes.meshing_remove_null_faces()
    least = int(options.min_component * meshes.current_mesh().face_number())
    if options.largest:
        triangles = meshes.current_mesh().face_matrix()  # of parts that are connected by edges
        parts = connected_component_labels(face_adjacency(triangles), node_count=len(triangles))
        least = max(least, int(np.bincount(parts).max(initial=0)))
    meshes.meshing_remove_connected_component_by_face_number(
        mincomponentsize=least, removeunref=True
    )
    if options.min_diameter > 0:
        shortest = options.min_diameter * meshes.current_mesh().bounding_box().diagonal()
        meshes.meshing_remove_connected_component_by_diameter(
            mincomponentdiag=PureValue(shortest), removeunref=True
        )
    if meshes.current_mesh().face_number() == 0:
        raise UserError("no part of the surface is large enough")
    if options.close_holes:
        # Closing holes needs a manifold: the smallest faces at non-manifold edges are removed.
        meshes.meshing_repair_non_manifold_edges(method="Remove Faces")
        meshes.meshing_repair_non_manifold_vertices()
        meshes.meshing_close_holes(maxholesize=options.close_holes, newfaceselected=False)
    if options.smooth:  # Taubin's, which hardly shrinks
        meshes.apply_coord_taubin_smoothing(stepsmoothnum=options.smooth)
    if not options.watertight and 0 < options.faces < meshes.current_mesh().face_number():
        meshes.meshing_decimation_quadric_edge_collapse(
            targetfacenum=options.faces, preserveboundary=True, preservenormal=True
        )
        meshes.meshing_remove_unreferenced_vertices()
    cleaned = meshes.current_mesh()
    return cleaned.vertex_matrix(), cleaned.face_matrix().astype(np.int64)
