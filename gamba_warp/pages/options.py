"""Options of output files, for the commands; without slow imports."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ..conventions import Axes
from ..formats.names import MeshChoice, SplatFormat
from ..untrusted.ranges import Frames, Opacity, Side


@dataclass(frozen=True, kw_only=True)
class FileOptions:
    """Output files of each object.

    Attributes:
        out: Folder for the results.
        splats: Files of the Gaussians.
        mesh: Files of a coloured mesh of the surface (gamba export has its options).
        page: Write an HTML page with a 3D viewer, and the input and the turntable, if any.
        turntable: Animation of one turn.
        size: Side of the turntable's frames in pixels.
        frames: Number of views in the turntable.
        frame: Axes of meshes except .glb; opengl is y up, opencv y down like files of Gaussians.
        min_opacity: Leave out Gaussians with a lower opacity; by default 1/255, below which they
            are never drawn. 0 keeps all.
    """

    out: Path = Path("out")
    splats: tuple[SplatFormat, ...] = ()
    mesh: tuple[MeshChoice, ...] = ()
    page: bool = False
    turntable: Literal["gif", "mp4", "none"] = "none"
    size: Side = 256
    frames: Frames = 48
    frame: Axes = "opengl"
    min_opacity: Opacity | None = None


EXPORTED = FileOptions(mesh=("glb",))
RECONSTRUCTED = FileOptions(splats=("ply",), page=True, turntable="gif")
