"""What is written of an object, as options of the commands; imports nothing that is slow."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ..conventions import Axes
from ..formats.names import MeshChoice, SplatFormat
from ..untrusted.ranges import Frames, Opacity, Side


@dataclass(frozen=True, kw_only=True)
class FileOptions:
    """What is written of each object.

    Attributes:
        out: Folder for the results.
        splats: Files of the Gaussians.
        mesh: Files of a coloured mesh of the surface (gamba export has its options).
        page: Write an HTML page with a 3D viewer, and the input and the turntable if there are.
        turntable: Moving picture of one turn.
        size: Side of the turntable's frames in pixels.
        frames: Number of views in the turntable.
        frame: Axes of meshes but .glb; opengl is y up, opencv y down as files of Gaussians are.
        min_opacity: Leave out Gaussians fainter than this; 1/255 if not given, below which they
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
