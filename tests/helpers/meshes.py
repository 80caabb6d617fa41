"""A textured square as an .obj file, and the container of a .glb, for tests of meshes."""

import base64
import json
import struct

import numpy as np
import trimesh
from PIL import Image

from gamba_warp.eval.shapes.shape import Mesh
from gamba_warp.train.data.settings import Settings
from gamba_warp.train.sources.commands import Selection, data_render_command

QUAD = """mtllib quad.mtl
v -1 0 0
v 1 0 0
v 1 2 0
v -1 2 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl paint
f 1/1 2/2 3/3 4/4
"""
MTL = "newmtl paint\nKd 0.1 0.1 0.1\nmap_Kd paint.png\n"
# Properties in a .ply.
XYZ, CORNERS = ("float x", "float y", "float z"), "list uchar int vertex_indices"
QUARTERS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 0]]], np.uint8)


def as_mesh(source, move=(0.0, 0, 0)) -> Mesh:
    """Return a mesh of trimesh's as one to evaluate, moved."""
    return Mesh(np.array(source.vertices) + move, np.array(source.faces))


def cube(move=(0.0, 0, 0), side=1.0) -> Mesh:
    """Return a cube about a place."""
    return as_mesh(trimesh.creation.box((side,) * 3), move)


def write_quad(folder, obj=QUAD, mtl=MTL, texture="paint.png"):
    """A 2x2 upright square that faces +z, textured with four colours."""
    if mtl:
        (folder / "quad.mtl").write_text(mtl)
    if texture:
        Image.fromarray(QUARTERS.repeat(8, 0).repeat(8, 1)).save(folder / texture)
    path = folder / "quad.obj"
    path.write_text(obj)
    return path


def glb(tree: dict | bytes, binary: bytes) -> bytes:
    """A GLB container of a tree, which may be given as text, and a binary part."""
    text = tree if isinstance(tree, bytes) else json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def ply_head(form: str = "ascii", **elements: tuple) -> str:
    """The header of a .ply; an element has its count and its properties."""
    lines = ["ply", f"format {form} 1.0"]
    for name, (count, *properties) in elements.items():
        lines += [f"element {name} {count}", *(f"property {each}" for each in properties)]
    return "\n".join([*lines, "end_header", ""])


def render_views(folder, out, **options):
    """``gamba data render`` with options by their names; returns the exit code."""
    own = {name: options.pop(name) for name in ("split", "workers") if name in options}
    selection = {name: options.pop(name) for name in ("shard", "limit") if name in options}
    return data_render_command(folder, out, Settings(**options), Selection(**selection), **own)


def gltf(**changes):
    """Return the document of one triangle, its buffer embedded, with other values."""
    points = np.eye(3, dtype="<f4").tobytes()
    uri = "data:;base64," + base64.b64encode(points).decode()
    return {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"componentType": 5126, "type": "VEC3", "count": 3, "bufferView": 0}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36, "uri": uri}],
    } | changes


# A triangle of an .stl in text.
FACET = (
    "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
)
