"""Surfaces as mesh files, by trimesh: .obj, .glb, .ply and .stl."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
import torch

from ..conventions import Axes
from ..errors import UserError
from ..files import atomic_path
from ..formats.materials import to_linear
from ..formats.names import MESH_FORMATS, MeshFormat
from ..gaussians import Gaussians
from ..images import to_uint8
from .extract import Surface, surface_of
from .options import SurfaceOptions


def save_mesh(path: str | Path, surface: Surface) -> None:
    """Writes a surface, atomically, with vertex colours where the format has them (not .stl).

    The axes are left as they are, except in ``.glb``: it is turned from OpenCV's (y down) to
    glTF's (y up), as ``save_glb`` does, and its colours are linear light, as the format asks.

    Args:
        path: ends in .obj, .glb, .ply or .stl.
        surface: what to write.

    Raises:
        UserError: another suffix, or the file cannot be written.
    """
    import trimesh
    from trimesh.visual import ColorVisuals

    kind = Path(path).suffix.lower()[1:]
    if kind not in MESH_FORMATS:
        raise UserError(f"{path}: a mesh is a {', '.join('.' + name for name in MESH_FORMATS)}")
    vertices, colors = surface.vertices, surface.colors
    if kind == "glb":
        vertices = vertices * [1.0, -1.0, -1.0]
        colors = None if colors is None else to_linear(colors)
    mesh = trimesh.Trimesh(vertices, surface.faces, process=False)
    if colors is not None and kind != "stl":
        opaque = np.ones((len(colors), 1), np.float32)
        mesh.visual = ColorVisuals(mesh, vertex_colors=to_uint8(np.hstack([colors, opaque])))
    content = cast("bytes | str", mesh.export(file_type=kind))  # a dict is of other kinds
    with atomic_path(path) as temporary:
        temporary.write_bytes(content if isinstance(content, bytes) else content.encode())


def write_meshes(
    base: Path,
    gaussians: Gaussians,
    formats: Sequence[MeshFormat],
    options: SurfaceOptions,
    axes: Axes,
    device: torch.device,
) -> Surface:
    """Makes an object's surface and writes it as ``NAME-mesh.FORMAT``.

    Args:
        base: folder and NAME.
        gaussians: an object of any size anywhere.
        formats: formats of the files.
        options: how the surface is made.
        axes: axes of all but .glb, which is y up in any case.
        device: device that renders.

    Returns:
        The surface in the Gaussians' own frame.

    Raises:
        UserError: there is no surface, or a file cannot be written.
    """
    found = surface_of(gaussians, options, device)
    for kind in formats:
        turned = found
        if axes == "opengl" and kind != "glb":
            turned = Surface(found.vertices * [1.0, -1.0, -1.0], found.faces, found.colors)
        save_mesh(base.with_name(f"{base.name}-mesh.{kind}"), turned)
    return found
