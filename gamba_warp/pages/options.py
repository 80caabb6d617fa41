"""Options of output files, for the commands; without slow imports."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from ..conventions import Axes
from ..formats.names import MeshChoice, SplatFormat
from ..surfaces.options import Faces, Texels
from ..untrusted.ranges import Frames, Opacity, Side


@dataclass(frozen=True, kw_only=True)
class FileOptions:
    """Output files of each object.

    Attributes:
        out: Folder for the results; - writes one file to the standard output, such as the .ply, and
            neither page nor turntable.
        json: Print the results as a JSON object in place of text.
        splats: Files of the Gaussians.
        mesh: Files of a mesh of the surface, in colour except .stl.
        faces: Largest number of faces of the mesh; 0 keeps all. By default 50,000, or 10,000 with a
            texture.
        texture: Side of the mesh's colour texture in pixels, in the .glb, or beside the .obj with
            its .mtl; 0 for none. By default 1024 with --mesh glb.
        watertight: Make the mesh closed, as a slicer for 3D printing needs it.
        size_mm: Longest side of the mesh in millimetres, the unit of slicers.
        page: Write an HTML page with a 3D viewer, and the input and the turntable, if any.
        turntable: Animation of one turn.
        size: Side of the turntable's frames in pixels.
        frames: Number of views in the turntable.
        axes: Axes of meshes except .glb; opengl is y up, opencv y down like files of Gaussians.
        min_opacity: Leave out Gaussians with a lower opacity; by default 1/255, below which they
            are never drawn. 0 keeps all.
    """

    out: Path = Path("out")
    json: bool = False
    splats: tuple[SplatFormat, ...] = ()
    mesh: tuple[MeshChoice, ...] = ()
    faces: Faces | None = None
    texture: Texels | None = None
    watertight: bool = False
    size_mm: Annotated[float, Meta(gt=0, le=1e6)] | None = None
    page: bool = False
    turntable: Literal["gif", "mp4", "none"] = "none"
    size: Side = 256
    frames: Frames = 48
    axes: Axes = "opengl"
    min_opacity: Opacity | None = None


EXPORTED = FileOptions(mesh=("glb",))
RECONSTRUCTED = FileOptions(splats=("ply",), page=True, turntable="gif")
