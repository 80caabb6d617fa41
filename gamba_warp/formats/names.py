"""Names of the formats that are written, and the suffixes of their files."""

from collections.abc import Sequence
from typing import Literal, cast, get_args

from ..errors import UserError

SplatFormat = Literal["ply", "splat", "spz", "glb", "compressed-ply"]
MeshFormat = Literal["obj", "glb", "ply", "stl"]
MeshChoice = Literal[MeshFormat, "none"]
SPLAT_FORMATS: tuple[str, ...] = get_args(SplatFormat)
MESH_FORMATS: tuple[str, ...] = get_args(MeshFormat)
# What may hold Gaussians; .ply and .glb may hold a mesh as well.
SPLAT_SUFFIXES = (".ply", ".splat", ".spz", ".glb")


def splat_suffix(kind: str) -> str:
    """What follows the name of a file of Gaussians: ``.ply``, or ``.compressed.ply``."""
    return "." + kind.replace("-", ".")


def mesh_formats(chosen: Sequence[MeshChoice]) -> tuple[MeshFormat, ...]:
    """The formats of ``--mesh``, of which ``none`` is no format.

    Raises:
        UserError: ``none`` beside a format.
    """
    if "none" in chosen and len({*chosen}) > 1:
        raise UserError(f"--mesh {' '.join(chosen)}: none goes with no format")
    return cast("tuple[MeshFormat, ...]", tuple(kind for kind in chosen if kind != "none"))
