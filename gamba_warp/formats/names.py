"""Names of the formats that are written, and the suffixes of their files."""

from typing import Literal, get_args

SplatFormat = Literal["ply", "splat", "spz", "glb", "compressed-ply"]
MeshFormat = Literal["obj", "glb", "ply", "stl"]
SPLAT_FORMATS: tuple[str, ...] = get_args(SplatFormat)
MESH_FORMATS: tuple[str, ...] = get_args(MeshFormat)
# What may hold Gaussians; .ply and .glb may hold a mesh as well.
SPLAT_SUFFIXES = (".ply", ".splat", ".spz", ".glb")


def splat_suffix(kind: str) -> str:
    """What follows the name of a file of Gaussians: ``.ply``, or ``.compressed.ply``."""
    return "." + kind.replace("-", ".")
