"""Names of the formats that are written: the suffixes of their files."""

from typing import Literal, get_args

GaussianFormat = Literal["ply", "splat", "glb"]
MeshFormat = Literal["obj", "glb", "ply", "stl"]
ExportFormat = Literal["ply", "splat", "glb", "html", "gif", "mp4"]  # with a page and turntables
MESH_FORMATS: tuple[str, ...] = get_args(MeshFormat)
