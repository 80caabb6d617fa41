"""Surfaces as mesh files, by trimesh: .obj, .glb, .ply and .stl."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from ..color_spaces import to_linear
from ..conventions import Axes
from ..errors import UserError
from ..files import atomic_path
from ..formats.names import MESH_FORMATS, MeshFormat
from ..formats.parts import merged
from ..images import to_uint8
from .extract import Surface
from .texture import Texture


def save_mesh(path: str | Path, surface: Surface, axes: Axes = "opengl") -> None:
    """Write a surface atomically, with vertex colours if the format has them (not .stl).

    A texture is embedded in a ``.glb``; for an ``.obj`` it is NAME.png, named by NAME.mtl; the
    other formats have vertex colours. Those of a ``.glb`` are linear, as the format requires. A
    ``.ply`` states its axes in a comment, which ``eval-geometry`` reads.

    Args:
        path: ends in .obj, .glb, .ply or .stl.
        surface: in OpenCV's axes (y down), like the Gaussians.
        axes: of the file; a ``.glb`` always has OpenGL's (y up), as the format requires.

    Raises:
        UserError: another suffix, or the file cannot be written.
    """
    import trimesh
    from trimesh.visual import ColorVisuals

    kind = Path(path).suffix.lower()[1:]
    if kind not in MESH_FORMATS:
        raise UserError(f"{path}: a mesh is a {', '.join('.' + name for name in MESH_FORMATS)}")
    vertices, colors = surface.vertices, surface.colors
    if kind == "glb" or axes == "opengl":
        vertices = vertices * [1.0, -1.0, -1.0]
    if surface.texture is not None and kind in ("glb", "obj"):
        return _save_textured(Path(path), replace(surface, vertices=vertices), surface.texture)
    mesh = trimesh.Trimesh(vertices, surface.faces, process=False)
    if colors is not None and kind != "stl":
        opaque = np.ones((len(colors), 1), np.float32)
        mesh.visual = ColorVisuals(mesh, vertex_colors=to_uint8(np.hstack([colors, opaque])))
    if colors is not None and kind == "glb":  # 8 bits are too coarse for linear colours
        mesh.visual = ColorVisuals(mesh)
        mesh.vertex_attributes["COLOR_0"] = to_linear(colors)
        data = cast(bytes, mesh.export(file_type=kind, tree_postprocessor=_name_colors))
    else:
        data = cast("bytes | str", mesh.export(file_type=kind))  # other kinds return a dict
    if isinstance(data, bytes) and kind == "ply":  # .ply itself has no field for axes
        data = data.replace(b"\nelement", f"\ncomment axes {axes}\nelement".encode(), 1)
    _write(Path(path), data)


def _name_colors(tree: dict) -> None:
    """Rename the colours in a glTF document, which trimesh writes with a leading underscore."""
    for primitive in tree["meshes"][0]["primitives"]:
        primitive["attributes"]["COLOR_0"] = primitive["attributes"].pop("_COLOR_0")


def _save_textured(path: Path, surface: Surface, texture: Texture) -> None:
    """Write a .glb with its texture, or an .obj after the files that it names."""
    import trimesh
    from PIL import Image
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    image = Image.fromarray(to_uint8(texture.image))
    if path.suffix.lower() == ".glb":  # with vertices of their own at seams of the texture
        corners = np.column_stack([surface.faces.reshape(-1), texture.uvs.reshape(-1, 2)])
        distinct, faces = merged(corners)
        vertices, uvs = surface.vertices[distinct[:, 0].astype(np.int64)], distinct[:, 1:]
        faces = faces.reshape(-1, 3)
        material = PBRMaterial(baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0)
        visual = cast(Any, TextureVisuals(uv=uvs, material=material))
        mesh = trimesh.Trimesh(vertices, faces, visual=visual, process=False)
        _write(path, cast(bytes, mesh.export(file_type="glb")))
        return
    with atomic_path(path.with_suffix(".png")) as temporary:
        image.save(temporary)
    lines = ["newmtl surface", "Kd 1 1 1", "Ks 0 0 0", f"map_Kd {path.stem}.png", ""]
    _write(path.with_suffix(".mtl"), "\n".join(lines))
    uvs, at = merged(texture.uvs.reshape(-1, 2))
    corners = np.column_stack([surface.faces.reshape(-1), at]).reshape(-1, 6) + 1
    lines = [f"mtllib {path.stem}.mtl", "usemtl surface"]
    lines += [f"v {x:.8g} {y:.8g} {z:.8g}" for x, y, z in surface.vertices]
    lines += [f"vt {u:.7f} {v:.7f}" for u, v in uvs]
    lines += ["f {}/{} {}/{} {}/{}".format(*row) for row in corners]
    _write(path, "\n".join([*lines, ""]))


def _write(path: Path, content: bytes | str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_bytes(content if isinstance(content, bytes) else content.encode())


def mesh_suffixes(formats: Sequence[MeshFormat], texture: int) -> list[str]:
    """Return the suffixes of the files of ``write_meshes``."""
    suffixes = [f"-mesh.{kind}" for kind in formats]
    return suffixes + (["-mesh.mtl", "-mesh.png"] if texture and "obj" in formats else [])


def write_meshes(
    base: Path,
    surface: Surface,
    formats: Sequence[MeshFormat],
    axes: Axes,
    size_mm: float | None = None,
) -> None:
    """Write an object's surface as ``NAME-mesh.FORMAT``.

    Args:
        base: folder and NAME.
        surface: of any size and position.
        formats: formats of the files.
        axes: of all formats except .glb, which is always y up.
        size_mm: longest side in the files, in millimetres (in a .glb, whose unit is the metre, a
            thousandth of that); None: the surface's size.

    Raises:
        UserError: a file cannot be written.
    """
    longest = float(np.ptp(surface.vertices, axis=0).max())
    for kind in formats:
        scale = 1.0 if size_mm is None else size_mm / longest / (1000 if kind == "glb" else 1)
        sized = replace(surface, vertices=surface.vertices * scale)
        save_mesh(base.with_name(f"{base.name}-mesh.{kind}"), sized, axes)
