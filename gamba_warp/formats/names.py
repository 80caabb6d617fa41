"""Names of the written formats, and the suffixes of their files."""

from collections.abc import Sequence
from typing import Literal, cast, get_args

from ..errors import UserError

SplatFormat = Literal["ply", "splat", "spz", "compressed-ply"]
MeshFormat = Literal["obj", "glb", "ply", "stl"]
MeshChoice = Literal[MeshFormat, "none"]
SPLAT_FORMATS: tuple[str, ...] = get_args(SplatFormat)
MESH_FORMATS: tuple[str, ...] = get_args(MeshFormat)
# Suffixes of files of Gaussians; .ply and .glb may hold a mesh as well.
SPLAT_SUFFIXES = (".ply", ".splat", ".spz", ".glb")
MESH_SUFFIXES = (".obj", ".glb", ".gltf", ".ply", ".stl", ".off")
SHAPE_SUFFIXES = (*MESH_SUFFIXES, ".xyz", ".splat", ".spz")


def splat_suffix(kind: str) -> str:
    """Return the suffix of a format of Gaussians: ``.ply``, or ``.compressed.ply``."""
    return "." + kind.replace("-", ".")


def mesh_formats(chosen: Sequence[MeshChoice]) -> tuple[MeshFormat, ...]:
    """Return the formats of ``--mesh``, empty for ``none``.

    Raises:
        UserError: ``none`` is combined with a format.
    """
    if "none" in chosen and len({*chosen}) > 1:
        raise UserError(f"--mesh {' '.join(chosen)}: none cannot be combined with other formats")
    return cast("tuple[MeshFormat, ...]", tuple(kind for kind in chosen if kind != "none"))
