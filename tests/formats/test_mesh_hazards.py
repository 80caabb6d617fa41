"""Mesh files with invalid headers, with names outside their folder, or far too large."""

import contextlib
import io
import json
import os
import struct
import time
import tracemalloc

import numpy as np
import pytest
from helpers.meshes import CORNERS, FACET, MTL, QUAD, XYZ, gltf, ply_head, write_quad
from helpers.refusals import refused
from PIL import Image

from gamba_warp.errors import UserError
from gamba_warp.formats import materials
from gamba_warp.formats.gltf_file import FREE_NUMBERS
from gamba_warp.formats.meshes import load_mesh

V = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
OFF = "OFF\n4 2 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n3 1 2 3\n"
STL = "solid a\n" + FACET * 3 + "endsolid a\n"
POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 16 16\n%%EndComments\nshowpage\n"


def ascii_ply(vertices, faces):
    head = ply_head(vertex=(len(vertices), *XYZ), face=(len(faces), CORNERS))
    return head + "\n".join([*vertices, *faces]) + "\n"


def binary_ply(vertices, vertex_count, face_count, faces, corners=CORNERS):
    head = ply_head("binary_little_endian", vertex=(vertex_count, *XYZ), face=(face_count, corners))
    return head.encode() + np.array(vertices, "<f4").tobytes() + faces


def counted(vertices, faces, kind="uchar", length=3):
    """Return a binary .ply of one triangle whose header states these numbers."""
    face = struct.pack("<B3i" if kind == "uchar" else "<I3i", length, 0, 1, 2)
    return binary_ply(np.eye(3), vertices, faces, face, CORNERS.replace("uchar", kind))


FOUR = ["0 0 0", "1 0 0", "0 1 0", "0 0 1"]
BAD = {
    "empty.obj": ("", "the file is empty"),
    "points.obj": (V, "no faces"),
    "nan.obj": (V.replace("v 1", "v nan") + "f 1 2 3\n", "1 of 3 vertices are not finite"),
    "beyond.obj": (V + "f 1 2 9\n", "names vertex 8 of 4"),
    "one_point.obj": ("v 1 1 1\n" * 3 + "f 1 2 3\n", "all vertices coincide"),
    "binary.obj": (b"\x00\x01 binary \xff", "no faces"),
    "nonsense.glb": (b"glTF nonsense", "cannot be read as a mesh"),
    "nothing.stl": ("solid nothing\nendsolid", "no faces"),
    "nothing.ply": ("ply\nformat ascii 1.0\nend_header\n", "its vertices have no x, y and z"),
    "suffix.txt": (V, "not a mesh file"),
    "word.obj": (V + "f 1 2 3\nf 1 x 3\n", "line 6, 'f 1 x 3', is not a valid vertex or face"),
    "too_far_back.obj": (V + "f -9 1 2\n", "before the first"),
    "huge.obj": (V.replace("1 0 0", "1e30 0 0") + "f 1 2 3\n", "coordinates reach 1e+30"),
    "tiny.obj": (V.replace("1", "1e-30") + "f 1 2 3\n", "longest side is 1e-30"),
    "digits.obj": (V + "v 1 2 " + "1" * 100_000 + "x\nf 1 2 3\n", "line 5"),
    "materials.obj": (V + "usemtl m%d\nf 1 2 3\n" * 100_000 % (*range(100_000),), "uses 100000"),
    "few_faces.off": (OFF[:-8], "invalid header, 4 vertices and 2 faces, but 5 lines follow"),
    "more_faces.off": (OFF + "3 0 1 2\n", "but 7 lines follow"),
    "short_face.off": (OFF[:-3] + "\n", "row 6 has too few numbers"),
    "long_face.off": (OFF.replace("3 0 1 2", "999999999 0 1 2"), "row 5 has too few numbers"),
    "negative.off": (OFF.replace("4 2 0", "4 -2 0"), "broken header"),
    "truncated.stl": (STL[: STL.rindex("vertex")], "truncated"),
    "uncounted.stl": (bytes(84) + b"\1" * 50, "states no faces, but 50 bytes follow"),
    "utf16.obj": (QUAD.encode("utf-16"), "text in UTF-16"),
    "without_a_vertex.stl": (STL.replace("vertex 1 0 0\n", "", 1), "8 vertices"),
    "word.ply": (ascii_ply(FOUR, ["3 0 1 2", "3 0 1 x"]), "could not convert"),
    "short_row.ply": (ascii_ply(FOUR, ["3 0 1 2", "3 0 1"]), "a row of 3 numbers, not 4"),
    "huge_list.ply": (ascii_ply(FOUR, ["3 0 1 2", "1e300 0"]), "a list of length 1e+300"),
    "half.ply": (ascii_ply(FOUR, ["3 0 1 2", "3 0 1 1.5"]), "vertex_indices is 1.5"),
    "vertex_word.ply": (ascii_ply([*FOUR, "0 0 x"], ["3 0 1 2"]), "could not convert"),
    "vertices.ply": (counted(10**12, 1), "invalid header"),
    "faces.ply": (counted(3, 10**12), "invalid header"),
    "text.ply": (counted(10**12, 1).replace(b"binary_little_endian", b"ascii"), "text.ply"),
    "list.ply": (counted(3, 1, "uint", 2**31), "list.ply"),
    "count.stl": (bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(50), "count.stl"),
    "short.stl": (bytes(60), "short.stl"),
    "count.off": (OFF.replace("4 2 0", f"{10**12} {10**12} 0"), "invalid header"),
    "index.obj": (V + f"f 1 2 {10**25}\n", "index.obj"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_meshes_are_one_line(tmp_path, name):
    text, reason = BAD[name]
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    start = time.process_time()
    tracemalloc.start()
    said = refused(None, load_mesh, path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert time.process_time() - start < 5 and peak < 200e6  # one of them took minutes
    assert reason in said and name in said
    path.unlink()
    refused("no such file|not a mesh file", load_mesh, path)


def mixed(indices):
    rows = b"".join(struct.pack(f"<B{len(row)}i", len(row), *row) for row in indices)
    return binary_ply([row.split() for row in FOUR], 4, len(indices), rows)


def test_polygons_of_different_lengths(tmp_path):
    """Indices out of range crashed the native reader that once read such files."""
    path = tmp_path / "a.ply"
    path.write_bytes(mixed([[0, 1, 2], [0, 1, 2, 3]]))
    mesh = load_mesh(path)
    assert mesh.vertices[mesh.faces].tolist() == [
        [[0, 0, 0], [1, 0, 0], [0, 1, 0]],
        [[0, 0, 0], [1, 0, 0], [0, 1, 0]],
        [[0, 0, 0], [0, 1, 0], [0, 0, 1]],
    ]
    for wrong in (2**31 - 1, -5):
        path.write_bytes(mixed([[0, 1, 2], [0, 1, wrong, 3]]))
        refused(f"names vertex {wrong} of 4", load_mesh, path)
    path.write_bytes(mixed([[0, 1], [0]]))
    refused("no faces", load_mesh, path)


@pytest.mark.parametrize("name", ["../secret.png", "sub/../../secret.png", "link.png", "{folder}"])
def test_textures_lie_in_the_folder(tmp_path, name):
    inner = tmp_path / "inner"
    (inner / "sub").mkdir(parents=True)
    Image.new("RGB", (4, 4), (1, 2, 3)).save(tmp_path / "secret.png")
    os.symlink(tmp_path / "secret.png", inner / "link.png")
    name = name.format(folder=tmp_path / "secret.png")
    mesh = load_mesh(write_quad(inner, mtl=MTL.replace("paint.png", name), texture=None))
    assert mesh.materials[0].texture is None
    reasons = "not found", f"outside of {inner}, not read"
    assert any(line.endswith(reasons) for line in mesh.warnings), mesh.warnings


@pytest.mark.parametrize("name", ["../images/paint.png", "..\\images\\PAINT.png"])
def test_textures_of_a_sister_folder_are_read_below_the_given_one(tmp_path, name):
    """The layout of ShapeNet v2."""
    inner = tmp_path / "models"
    inner.mkdir()
    (tmp_path / "images").mkdir()
    Image.new("RGB", (4, 4), (1, 2, 3)).save(tmp_path / "images" / "paint.png")
    path = write_quad(inner, mtl=MTL.replace("paint.png", name), texture=None)
    assert load_mesh(path, root=tmp_path).materials[0].texture is not None
    assert load_mesh(path).materials[0].texture is None


def test_what_is_no_image_is_not_opened(tmp_path, monkeypatch):
    monkeypatch.setattr("subprocess.check_call", lambda *_, **__: pytest.fail("it is started"))
    for name in ("paint.png", "paint.eps", "paint.mtl", "paint.bin"):
        (tmp_path / name).write_bytes(POSTSCRIPT)
        mtl = MTL.replace("paint.png", name) + f"map_d {name}\n"
        mesh = load_mesh(write_quad(tmp_path, mtl=mtl, texture=None))
        assert mesh.materials[0].texture is None
        assert f"{name}: not an image that can be read" in mesh.warnings
    mesh = load_mesh(write_quad(tmp_path, mtl=MTL + "map_d paint.eps\n", texture="paint.png"))
    assert mesh.materials[0].texture is not None
    assert "paint.eps: not an image that can be read" in mesh.warnings


def test_sizes_beside_a_mesh_have_a_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(materials, "MAX_SIDE_FILE", 1000)
    path = write_quad(tmp_path)
    (tmp_path / "quad.mtl").write_text(MTL + "#" * 1000)
    assert any("quad.mtl: over" in line for line in load_mesh(path).warnings)
    os.unlink(tmp_path / "quad.mtl")
    os.mkfifo(tmp_path / "quad.mtl")  # reading one waits for ever
    assert any("quad.mtl: not found" in line for line in load_mesh(path).warnings)


ACCESSOR = gltf()["accessors"][0]
DEEP = {"nodes": [{"mesh": 0, "extras": json.loads("[" * 500 + "]" * 500)}]}
LIES = {
    "beyond": ({"accessors": [ACCESSOR | {"byteOffset": 12}]}, "3 values of accessor 0"),
    "negative": ({"accessors": [ACCESSOR | {"count": -1}]}, "count"),
    "kind": ({"accessors": [ACCESSOR | {"componentType": 9}]}, "componentType"),
    "no_view": ({"bufferViews": []}, "broken header"),
    "view": ({"bufferViews": [{"buffer": 0, "byteLength": 36, "byteOffset": 4}]}, "view 0"),
    "stride": ({"bufferViews": [{"buffer": 0, "byteLength": 36, "byteStride": 0}]}, "byteStride"),
    "sparse": ({"accessors": [ACCESSOR | {"sparse": {"count": 1}}]}, "indices"),
    "zeros": (
        {"accessors": [{**ACCESSOR, "bufferView": None, "count": FREE_NUMBERS}]},
        "bytes expand to over",
    ),
    "circle": ({"nodes": [{"mesh": 0, "children": [0]}]}, "nodes form a cycle"),
    "no_mesh": ({"nodes": [{"mesh": 1}]}, "meshes[1] of 1"),
    "lists": ({"accessors": {}}, "array"),
    "deep": (DEEP, "nested"),
    "short": ({"buffers": [{"byteLength": 36, "uri": "data:;base64,AAAA"}]}, "take 36 bytes"),
}


@pytest.mark.parametrize("name", LIES)
def test_invalid_gltf(tmp_path, name):
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(gltf()))
    assert len(load_mesh(path).faces) == 1
    changes, reason = LIES[name]
    path.write_text(json.dumps(gltf(**changes)))
    assert reason in refused(None, load_mesh, path)


_NONE = {"componentType": 5121, "bufferView": None}  # values without bytes are 0
_SPREAD = {"extensions": {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 1}}}, "mesh": 0}
_MORE = [ACCESSOR, ACCESSOR | {"bufferView": None, "count": 150_000}]
_MORPHED = {"attributes": {"POSITION": 1}, "targets": [{"POSITION": 1}] * 20_000}
_TWICE = [{"children": [i + 1, i + 1]} for i in range(40)]
_MOVED = {"mesh": 0, "translation": [1, 2, 3], "scale": [1, 1, 2]}


def _scene(node, count):
    """Return a scene of equal nodes."""
    return {"nodes": [node] * count, "scenes": [{"nodes": list(range(count))}]}


# Documents of up to a megabyte that stand for much more.
SMALL = {
    "corners without bytes": {
        "accessors": [ACCESSOR, _NONE | {"type": "SCALAR", "count": 2_949_999}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
    },
    "every node has a child twice": {"nodes": [*_TWICE, {"mesh": 0}]},
    "instances": {"nodes": [_SPREAD], "accessors": _MORE},
    "instances of 1,000 nodes": _scene(_SPREAD, 1000) | {"accessors": _MORE},
    "morph targets": {
        "meshes": [{"primitives": [_MORPHED], "weights": [1.0] * 20_000}],
        "accessors": _MORE,
    },
    "primitives": {"meshes": [{"primitives": [{"attributes": {"POSITION": 0}}] * 25_000}]},
    "primitives that share vertices": {
        "meshes": [{"primitives": [{"attributes": {"POSITION": 1}}] * 1_000}],
        "accessors": [ACCESSOR, ACCESSOR | {"bufferView": None, "count": 1_200}],
    },
    "nodes": _scene({"mesh": 0}, 55_000),
    "moved nodes": _scene(_MOVED, 15_000),
}


def test_a_scene_that_repeats_a_part_too_often(tmp_path, monkeypatch):
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(gltf(**_scene({"mesh": 0}, 50))))
    assert len(load_mesh(path).faces) == 50
    monkeypatch.setattr("gamba_warp.formats.meshes.MAX_PARTS", 100)
    refused("over 100 vertices and faces", load_mesh, path)


@pytest.mark.parametrize("name", SMALL)
def test_small_files_cost_little(tmp_path, name):
    """A file under 1 MB takes at most 2 s of a core (.6 measured) and 500 MB (110)."""
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(gltf(**SMALL[name]), separators=(",", ":")))
    assert path.stat().st_size < 1e6
    began = time.process_time()
    with contextlib.suppress(UserError):
        load_mesh(path)
    assert time.process_time() - began < 2
    tracemalloc.start()
    with contextlib.suppress(UserError):
        load_mesh(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 500e6


@pytest.mark.parametrize("limit", ["texels", "pixels"])
def test_textures_over_the_limit_are_left_out(tmp_path, monkeypatch, limit):
    """Images beyond the memory of all textures are named; those before them stay."""
    monkeypatch.setattr(materials, "PIXELS_PER_BYTE", 0)
    sides = materials.SideFiles(tmp_path / "a.glb", **{limit: 2 * 4 * 6 * 5})
    file = io.BytesIO()
    Image.new("RGB", (6, 5)).save(file, "PNG")
    found = [sides.texture(file.getvalue(), f"image {i}") for i in range(3)]
    assert [x is None for x in found] == [False, False, True]
    (warning,) = sides.warnings
    assert warning.startswith("image 2: too many")


def test_faces_of_one_or_two_corners_are_ignored(tmp_path):
    """They have one or two corners, as modellers leave them behind."""
    path = tmp_path / "a.obj"
    path.write_text(V + "f 1 2\nf 1 2 3\n  f 3/1/1 4/2/2 \r\nf 4\nf -4 -1\n")
    assert len(load_mesh(path).faces) == 1
