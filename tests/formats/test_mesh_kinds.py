"""OBJ, OFF, STL and PLY meshes as programs write them, compared with known values."""

import struct

import numpy as np
import pytest
import trimesh
from helpers.meshes import CORNERS, FACET, MTL, QUAD, QUARTERS, XYZ, ply_head, write_quad
from helpers.refusals import refused
from PIL import Image

from gamba_warp.color_spaces import to_display, to_linear
from gamba_warp.formats.materials import SideFiles
from gamba_warp.formats.meshes import load_mesh
from gamba_warp.formats.parts import cut_polygons
from gamba_warp.surfaces.extract import Surface
from gamba_warp.surfaces.files import save_mesh
from gamba_warp.viewer.pack import viewed_mesh

V = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
FOUR = ["0 0 0", "1 0 0", "1 1 0", "0 1 0"]
# A comb of three teeth, counter-clockwise; area 8.
COMB = np.reshape([*map(int, "005052424131322221111202")], (-1, 2))
FLAT_COMB = np.pad(COMB.astype(float), ((0, 0), (0, 1)))
# Turned, so that no axis is across it.
TURN = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]


def loaded(folder, name, content):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return load_mesh(path)


def places(mesh):
    """Return the corners ``[F, 3, 3]``."""
    return mesh.vertices[mesh.faces]


def areas(points, faces):
    return trimesh.triangles.cross(points[faces]) / 2


def ply(rows, faces, colours="", face_colours="", head="", kind="uchar"):
    of_rows, of_faces = (
        [f"{kind} {n}" for n in names.split()] for names in (colours, face_colours)
    )
    text = ply_head(vertex=(len(rows), *XYZ, *of_rows), face=(len(faces), CORNERS, *of_faces))
    text = text.replace("element vertex", f"{head}element vertex")
    return text + "\n".join([*rows, *faces]) + "\n"


def cut(points, polygons):
    corners = np.concatenate(polygons)
    lengths = np.array([len(polygon) for polygon in polygons])
    return corners[cut_polygons(SideFiles("a.obj"), points, corners, lengths)]


def test_concave_polygons_keep_their_area():
    for points in (FLAT_COMB @ TURN.T, 1e6 + FLAT_COMB[:, [2, 0, 1]]):
        for order in (np.arange(12), np.arange(12)[::-1], np.roll(np.arange(12), 5)):
            found = areas(points, cut(points, [order]))
            sizes = np.linalg.norm(found, axis=1)
            np.testing.assert_allclose([sizes.sum(), np.linalg.norm(found.sum(0))], 8, rtol=1e-6)
            assert len(found) == 10


def test_many_polygons_of_all_kinds_in_their_order():
    """Convex ones become fans; the triangles keep the order of the polygons."""
    arrow = np.array([[0, 0, 0], [2, 1, 0], [0, 2, 0], [1, 1, 0]], float)
    points = np.concatenate([arrow, arrow + [5, 0, 0], FLAT_COMB + [20, 0, 0]])
    polygons = [[4, 5, 6], [0, 1, 2, 3], [5, 6], [*range(8, 20)], [4, 5, 6, 7], [0, 1, 2], [1]]
    found = cut(points, polygons)
    assert found[[0, -1]].tolist() == [[4, 5, 6], [0, 1, 2]]
    sizes = areas(points, found)[:, 2]
    assert (sizes > 0).all()  # a fan from the wrong corner turns one over
    np.testing.assert_allclose([sizes[1:3].sum(), sizes[3:13].sum(), sizes[13:15].sum()], [1, 8, 1])
    ring = np.stack([np.cos(np.arange(6)), np.sin(np.arange(6)), np.zeros(6)], 1)
    fan = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]
    assert cut(ring, [[*range(6)]]).tolist() == fan


def test_polygons_without_area_or_that_intersect_themselves_are_cut_somehow():
    points = np.array([[0, 0, 0], [1, 1, 0], [1, 0, 0], [0, 1, 0], [2, 2, 0], [3, 3, 0]], float)
    for polygon in ([0, 1, 2, 3], [0, 1, 4, 5], [0, 0, 1, 1], [0, 1, 0, 1, 2, 2, 0]):
        assert cut(points, [polygon]).shape == (len(polygon) - 2, 3)


def test_too_many_concave_corners_are_named(monkeypatch):
    monkeypatch.setattr("gamba_warp.formats.parts.MAX_WORK", 4000)
    sides, corners, lengths = SideFiles("a.obj"), np.tile(np.arange(12), 3), np.full(3, 12)
    assert cut_polygons(sides, FLAT_COMB, corners, lengths).shape == (30, 3)
    (warning,) = sides.warnings
    assert warning == "too many concave polygons: some are triangulated as if they were convex"


@pytest.mark.parametrize("suffix", ["obj", "off", "ply"])
def test_concave_polygons_of_files(tmp_path, suffix):
    rows, face = [f"{x} {y} 0" for x, y in COMB], f"12 {' '.join(map(str, range(12)))}"
    text = {
        "obj": "".join(f"v {row}\n" for row in rows) + f"f {' '.join(map(str, range(1, 13)))}",
        "off": "\n".join(["OFF", "12 1 0", *rows, face]),
        "ply": ply(rows, [face]),
    }[suffix]
    mesh = loaded(tmp_path, f"a.{suffix}", text)
    assert (areas(mesh.vertices, mesh.faces)[:, 2] > 0).all()
    np.testing.assert_allclose(areas(mesh.vertices, mesh.faces)[:, 2].sum(), 8)


@pytest.mark.parametrize("suffix", ["obj", "off", "ply"])
def test_vertices_of_no_visible_face_are_left_out(tmp_path, suffix):
    """Otherwise they move and shrink the object in every image."""
    rows = ["9 3 1", *FOUR, "nan 0 0", "8.1 2.7 0.9"]
    line = "3 0 1 6"  # the third corner lies between the others up to rounding
    text = {
        "obj": "".join(f"v {row}\n" for row in rows) + "f 2 3 4 5\nf 1 2 7\nf 1 1 1\n",
        "off": "OFF\n7 3 0\n" + "\n".join([*rows, "4 1 2 3 4", line, "3 0 0 0"]),
        "ply": ply(rows, ["4 1 2 3 4", line, "3 0 0 0"]),
    }[suffix]
    mesh = loaded(tmp_path, f"a.{suffix}", text)
    assert mesh.flat == 2 and len(mesh.faces) == len(mesh.uvs) == len(mesh.normals) == 2
    assert len(mesh.vertices) == 4 and places(mesh).max((0, 1)).tolist() == [1, 1, 0]
    assert mesh.normalized("z")[2] == 1
    text = text.replace(*{"obj": ("f 2 3 4 5\n", "")}.get(suffix, ("4 1 2 3 4", "3 0 1 6")))
    flat = loaded(tmp_path, f"b.{suffix}", text)
    assert flat.warnings[-1:] == ["no face has an area"] and flat.normalized("z")[2] == 1 / 9


OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 1\nf 1//1 2//1 3//1\n"
SPELLINGS = {
    "tabs": OBJ.replace(" ", "\t"),
    "blanks before": OBJ.replace("\n", "\n  \t"),
    "blanks behind": OBJ.replace("\n", " \t \n"),
    "CR": OBJ.replace("\n", "\r"),
    "CRLF": OBJ.replace("\n", "\r\n"),
    "BOM": "\ufeff" + OBJ,
    "comments": OBJ.replace("\n", " # 1 2 3\n"),
    "comments at once": OBJ.replace("\n", "# f 1 2 3\n"),
    "no end": OBJ.rstrip(),
    "joined lines": OBJ.replace("2//1 3", "2//1 \\\n3"),
    "joined lines of Windows": OBJ.replace("2//1 3", "2//1 \\\r\n3").replace("\n", "\r\n", 1),
    "groups": "o a\ng b c\ns off\n" + OBJ,
    "other than ASCII": "# caf\u00e9\no caf\u00e9\n" + OBJ,
    "plus and exponents": OBJ.replace("v 1 0 0", "v +1.0e0 -0 .0"),
    "control signs": OBJ.replace("v 1", "v\v1").replace("f ", "f\f"),
}


@pytest.mark.parametrize("name", SPELLINGS)
def test_spellings_of_obj(tmp_path, name):
    mesh = loaded(tmp_path, "a.obj", SPELLINGS[name])
    assert places(mesh).tolist() == [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]
    assert mesh.normals[0].tolist() == [[0, 0, 1]] * 3
    assert mesh.warnings == ["a part has no material: grey"]


@pytest.mark.parametrize(
    "line",
    ["v 1 0", "v 1 0 x", "v 1_0 0 0", "f 1 2 0", "f 1 2 +3", "f 1 2 3/", "f 1/2/3/4 2 3",
     "f /1 2 3", "f 1 2 " + 99 * "1", "vt", "vn 1 2", "f 1 2 3.0", "v 1 0 0\0", "f 1 2 1_0"],
)  # fmt: skip
def test_invalid_lines_of_obj(tmp_path, line):
    if line == "f 1 2 3/":  # without a texture coordinate
        assert len(loaded(tmp_path, "a.obj", V + line).faces) == 1
        return
    refused("line 5, ", loaded, tmp_path, "a.obj", V + line + "\nf 1 2 3\n")


MIXED = f"""{V}vt 0 0
vn 0 0 1
usemtl a
f -1/1/1 -2//1 -3
v 1 1 0 1 0 0
f 1/1 2/1 5/1 # all of a
usemtl b
f 1 2 5 4
l 1 2
f -1 -2 -3
"""


@pytest.mark.parametrize("block", [30, 60, 1 << 24])
def test_a_text_is_read_in_blocks_of_any_length(tmp_path, monkeypatch, block):
    """Indices that count back, and the material in use, go on from one to the next."""
    monkeypatch.setattr("gamba_warp.formats.headers._BLOCK", block)
    mesh = loaded(tmp_path, "a.obj", MIXED)
    corners = [[0, 0, 1], [0, 1, 0], [1, 0, 0]], [[0, 0, 0], [1, 0, 0], [1, 1, 0]]
    assert places(mesh)[:2].tolist() == [*corners] and len(mesh.faces) == 5
    assert mesh.material_ids.tolist() == [0, 0, 1, 1, 1]
    assert mesh.colors[1, 2].tolist() == [255, 0, 0, 255] == mesh.colors[4, 0].tolist()
    assert mesh.omitted == ["the statement l is not read"]
    refused("line 15, 'f 1 x'", loaded, tmp_path, "a.obj", MIXED + "f 1 x")
    mesh = loaded(tmp_path, "a.ply", ply(FOUR, ["4 0 1 2 3", "3 0 1 2"]))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]]
    assert len(loaded(tmp_path, "a.stl", f"solid a\n{FACET * 3}endsolid a\n").faces) == 3


def test_statements_of_obj_that_are_not_read_are_named(tmp_path):
    mesh = loaded(tmp_path, "a.obj", V + "vp 1 2\ncurv 1 2\nl 1 2\nf 1 2 3\n")
    for word in ("curv", "l", "vp"):
        assert f"the statement {word} is not read" in mesh.warnings
    mesh = loaded(tmp_path, "a.obj", "#MRGB ffff\n" + V + "vt 0 0\nf 1/9 2/9 3/9\n")
    assert "the colours of ZBrush (#MRGB) are not read" in mesh.warnings
    assert "faces name texture coordinates or normals that are not there" in mesh.warnings


@pytest.mark.parametrize(
    "numbers", ["255 128 0", "1 0.5019608 0", "65535 32896 0", "1.0 0.5019608 0.0 1.0"]
)
def test_colours_of_obj_of_any_range(tmp_path, numbers):
    lines = [f"v {row} {numbers}" for row in FOUR[:3]]
    mesh = loaded(tmp_path, "a.obj", "\n".join([*lines, "f 1 2 3"]))
    assert (mesh.colors == [255, 128, 0, 255]).all() and not mesh.warnings
    assert mesh.materials[0].color.tolist() == [1, 1, 1, 1]


def test_materials_of_obj(tmp_path):
    """Two libraries on a line, one with a BOM; blanks in names; a material for each face."""
    (tmp_path / "one.mtl").write_bytes("\ufeffnewmtl a b\nKd 1 0 0\n".encode())
    (tmp_path / "two.mtl").write_bytes(b"\tNEWMTL c\r\n\tkd 0 1 0\r\n\tKd 0 0 1\r\n")
    text = "mtllib one.mtl two.mtl\n" + V
    text += "usemtl a b\nf 1 2 3\nusemtl c\nf 2 3 4\nusemtl a b\nf 1 3 4\n"
    mesh = loaded(tmp_path, "a.obj", text)
    assert not mesh.warnings
    colors = np.array([material.color[:3] for material in mesh.materials])
    assert colors[mesh.material_ids].tolist() == [[1, 0, 0], [1, 0, 0], [0, 0, 1]]
    (tmp_path / "a b.mtl").write_text("newmtl c\nKd 1 1 1\n")  # one name with a blank goes first
    mesh = loaded(tmp_path, "a.obj", "mtllib a b.mtl\n" + V + "usemtl c\nf 1 2 3\n")
    assert mesh.materials[0].color.tolist() == [1, 1, 1, 1] and not mesh.warnings
    mesh = loaded(tmp_path, "a.obj", text.replace("two.mtl", "none.mtl"))
    assert "none.mtl: not found" in mesh.warnings
    assert mesh.materials[0].color.tolist() == [1, 0, 0, 1]


@pytest.mark.parametrize("options", ["d 0", "Tr 1", "d -halo 0", "d 0.001"])
def test_materials_that_would_be_invisible(tmp_path, options):
    path = write_quad(tmp_path, mtl=f"newmtl paint\nKd 1 0 0\n{options}\n", texture=None)
    mesh = load_mesh(path)
    assert mesh.materials[0].color.tolist() == [1, 0, 0, 1]
    assert mesh.warnings == ["the material paint would be invisible: it is drawn opaque"]


def test_light_and_moved_textures_of_mtl(tmp_path):
    mtl = "newmtl paint\nKd 0 0 0\nKe 1 0.5 0\n"
    mesh = load_mesh(write_quad(tmp_path, mtl=mtl, texture=None))
    np.testing.assert_allclose(mesh.materials[0].color[:3], to_linear([1, 0.5, 0]))
    assert mesh.warnings == ["emission of a surface is drawn as its base colour, shaded"]
    moved = MTL.replace("paint.png", "-s 2 2 1 paint.png")
    for files, warning in (
        ({"mtl": MTL + "Ke 1 1 1\n"}, "emission of a surface with a base colour is not drawn"),
        ({"mtl": moved}, "-s 2 2 1 paint.png: the option -s is not read"),
        ({"obj": QUAD.replace("-1 0 0", "-1 0 0 1 0 0")}, "colours with a texture are not drawn"),
    ):
        assert load_mesh(write_quad(tmp_path, **files)).warnings == [warning]


def test_strips_of_ply(tmp_path):
    """Every second triangle is turned; -1 ends a strip."""
    head = ply_head(vertex=(5, *XYZ), tristrips=(2, "list int int vertex_indices"))
    rows = ["0 0 0", "1 0 0", "0 1 0", "1 1 0", "2 0 0", "8 0 1 2 3 -1 1 4 3", "3 4 3 1"]
    mesh = loaded(tmp_path, "a.ply", head + "\n".join([*rows, ""]))
    assert mesh.faces.tolist() == [[0, 1, 2], [1, 3, 2], [1, 4, 3], [4, 3, 1]]


def test_numbers_of_obj_as_some_programs_write_them(tmp_path):
    """Homogeneous vertices, and NaN as Microsoft's libraries print it."""
    rows = ["v 0 0 0 2", "v 2 0 0 2", "v 0 -2 0 -2", "vt 1.#QNAN 0", "vn -1.#IND00 0 0"]
    mesh = loaded(tmp_path, "a.obj", "\n".join([*rows, "f 1/1/1 2/1/1 3/1/1"]))
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert np.isfinite(mesh.uvs).all() and np.isfinite(mesh.normals).all()
    rows[0] = "v -1.#IND 0 0"
    refused("not finite", loaded, tmp_path, "a.obj", "\n".join([*rows, "f 1 2 3"]))


def test_comments_and_other_colours_of_mtl(tmp_path):
    """Comments behind names, colours up to 255, a texture of the ambient light alone, TARGA."""
    mtl = "newmtl paint # the wood\nKd 255 0 51 # red\n"
    obj = QUAD.replace("paint", "paint # here").replace("quad.mtl", "quad.mtl # colours")
    assert obj.count(" # ") == 2
    mesh = load_mesh(write_quad(tmp_path, obj=obj, mtl=mtl, texture=None))
    np.testing.assert_allclose(mesh.materials[0].color[:3], to_linear([1, 0, 0.2]))
    assert mesh.warnings == ["the colour of paint goes to 255"]
    for mtl in (MTL.replace("map_Kd", "map_Ka"), MTL.replace("paint.png", "paint.tga")):
        path = write_quad(tmp_path, mtl=mtl)
        Image.open(tmp_path / "paint.png").save(tmp_path / "paint.tga")
        assert load_mesh(path).materials[0].texture is not None


def test_a_text_stl_without_its_last_line(tmp_path):
    mesh = loaded(tmp_path, "a.stl", f"solid\n{FACET}")
    assert len(mesh.faces) == 1
    assert mesh.omitted == ["there is no endsolid: the end of the file may be missing"]


@pytest.mark.parametrize("head", ["OFF4 1 0", "OFF 4 1 0", "OFF\n4 1 0", "\ufeffOFF\r\n\r\n4 1"])
def test_headers_of_off(tmp_path, head):
    mesh = loaded(tmp_path, "a.off", "\n".join([head, *FOUR, "4 0 1 2 3"]))
    square = [0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]
    assert places(mesh).tolist() == [[*square[:3]], [square[0], *square[2:]]]
    for wrong in ("OFFA\n4 1 0", "4OFF\n4 1 0", "nOFF\n4 1 0", "OFF4"):
        refused("broken header", loaded, tmp_path, "a.off", "\n".join([wrong, *FOUR, "3 0 1 2"]))


@pytest.mark.parametrize(
    "word, row", [("COFF", "51 128 204 255"), ("COFF", "51 128 204"), ("COFF", "0.2 0.502 0.8 1"),
                  ("NOFF", "0 0 1"), ("CNOFF", "0 0 1 51 128 204 255"), ("STOFF", "0.5 0.5"),
                  ("STCOFF", "51 128 204 255 0.5 0.5")]
)  # fmt: skip
def test_words_of_off(tmp_path, word, row):
    rows = [f"{place} {row}" for place in FOUR]
    mesh = loaded(tmp_path, "a.off", "\n".join([word, "4 1 0", *rows, "4 0 1 2 3"]))
    want = [51, 128, 204, 255] if "C" in word else [255] * 4
    assert (mesh.colors == want).all() and len(mesh.faces) == 2
    assert mesh.warnings == ([] if "C" in word else ["a part has no material: grey"])


def test_colours_of_the_faces_of_off(tmp_path):
    faces = ["3 0 1 2 255 0 0", "3 0 2 3 0 0 255", "3 0 1 3"]
    mesh = loaded(tmp_path, "a.off", "\n".join(["OFF", "4 3 0", *FOUR, *faces]))
    assert mesh.colors[:, 0, :3].tolist() == [[255, 0, 0], [0, 0, 255], [255, 255, 255]]
    mesh = loaded(tmp_path, "a.off", "\n".join(["OFF", "4 1 0", *FOUR, "3 0 1 2 7"]))
    assert "colours that are not RGB are left out" in mesh.warnings
    text = "\n".join(["OFF", "4 1 0", *FOUR, "3 0 1 2.5"])
    refused("names vertex 2.5 of 4", loaded, tmp_path, "a.off", text)


SOLIDS = {
    "facet in the name": f"solid facetted endfacet vertex\n{FACET}endsolid facetted vertex\n",
    "upper case": f"solid a\n{FACET}endsolid a\n".upper(),
    "no name": f"solid\n{FACET}endsolid",
    "CR": f"solid a\n{FACET}endsolid a\n".replace("\n", "\r"),
    "indented": f"solid a\n{FACET}endsolid a\n".replace("\n", "\n\t "),
    "exponents": f"solid a\n{FACET}endsolid a\n".replace("1 0 0", "+1.0E+00 0.e0 0"),
    "BOM": f"\ufeffsolid a\n{FACET}endsolid a\n",
    "two solids": f"solid a\nendsolid a\nsolid b\n{FACET}endsolid b\n",
}


@pytest.mark.parametrize("name", SOLIDS)
def test_texts_of_stl(tmp_path, name):
    mesh = loaded(tmp_path, "a.stl", SOLIDS[name])
    assert places(mesh).tolist() == [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]


def test_bytes_of_stl(tmp_path):
    row = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0)
    for head in (b"solid facet of a CAD program", b"\0", b"SOLID"):
        data = head.ljust(80) + struct.pack("<I", 1) + row
        mesh = loaded(tmp_path, "a.stl", data)
        assert places(mesh).tolist() == [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]
        mesh = loaded(tmp_path, "a.stl", data + b"written by somebody")
        assert "19 bytes behind the faces are left out" in mesh.warnings and len(mesh.faces) == 1
    short = data[:80] + b"\2\0\0\0" + row
    refused("take 100 bytes but 50 follow", loaded, tmp_path, "a.stl", short)
    painted = row[:-2] + struct.pack("<H", 0x8000 | 31)
    mesh = loaded(tmp_path, "a.stl", b"".ljust(80) + struct.pack("<I", 1) + painted)
    assert "the colours of an .stl file are not read" in mesh.warnings


@pytest.mark.parametrize(
    "names", ["red green blue", "diffuse_red diffuse_green diffuse_blue", "r g b"]
)
@pytest.mark.parametrize("kind, scale", [("uchar", 1), ("ushort", 257), ("float", 1 / 255)])
def test_colours_of_ply(tmp_path, names, kind, scale):
    colour = " ".join(f"{value * scale:.7g}" for value in (51, 128, 204))
    rows = [f"{row} {colour}" for row in FOUR]
    mesh = loaded(tmp_path, "a.ply", ply(rows, ["4 0 1 2 3"], names, kind=kind))
    assert (mesh.colors == [51, 128, 204, 255]).all() and not mesh.warnings
    face = ply(FOUR, [f"3 0 1 2 {colour}", f"3 0 2 3 {colour}"], "", names, kind=kind)
    mesh = loaded(tmp_path, "b.ply", face)
    assert (mesh.colors == [51, 128, 204, 255]).all() and not mesh.warnings


def test_a_ply_of_one_face(tmp_path):
    head = ply_head("binary_little_endian", vertex=(4, *XYZ), face=(1, CORNERS))
    rows = np.array([row.split() for row in FOUR], "<f4").tobytes()
    data = head.encode() + rows + struct.pack("<B4i", 4, 0, 1, 2, 3)
    for content in (data, ply(FOUR, ["4 0 1 2 3"]), ply(FOUR[:3], ["3 0 1 2"])):
        assert len(loaded(tmp_path, "a.ply", content).faces) in (1, 2)


def test_further_elements_of_ply_are_named(tmp_path):
    edge = "element edge 1\nproperty int a\nend_header"
    text = ply(FOUR, ["4 0 1 2 3"]).replace("end_header", edge)
    assert "the element edge is not read" in loaded(tmp_path, "a.ply", text + "7\n").warnings


def test_textures_of_ply(tmp_path):
    """As MeshLab and scanners write them: for each corner, or for each vertex."""
    Image.fromarray(QUARTERS).save(tmp_path / "a b.png")
    head = "comment TextureFile a b.png\n"
    text = ply(FOUR, ["4 0 1 2 3 8 0 0 1 0 1 1 0 1"], head=head)
    text = text.replace("end_header", "property list uchar float texcoord\nend_header")
    corners = loaded(tmp_path, "a.ply", text)
    rows = [f"{row} {row[:3]}" for row in FOUR]
    vertices = loaded(tmp_path, "b.ply", ply(rows, ["4 0 1 2 3"], "s t", head=head, kind="float"))
    for mesh in (corners, vertices):
        assert not mesh.warnings
        np.testing.assert_array_equal(mesh.uvs, places(mesh)[..., :2])
        assert mesh.materials[0].texture[..., :3].tolist() == QUARTERS.tolist()


@pytest.mark.parametrize("kind", ["glb", "obj", "ply"])
def test_colours_round_trip(tmp_path, kind):
    """Every display value comes back to 1/255, dark ones of .glb too."""
    values = np.arange(256)
    colors = np.stack([values, values[::-1], np.roll(values, 99)], 1)
    points = np.stack([np.cos(values), np.sin(values), values / 99], 1)
    faces = np.stack([values, np.roll(values, 1), np.roll(values, 2)], 1)
    path = tmp_path / f"a.{kind}"
    save_mesh(path, Surface(points, faces, colors / np.float32(255)))
    mesh = load_mesh(path)
    assert np.abs(mesh.colors[..., :3].astype(int) - colors[faces]).max() <= 1
    assert (mesh.colors[..., 3] == 255).all() and not mesh.warnings
    np.testing.assert_allclose(places(mesh), points[faces] * [1, -1, -1], atol=1e-6)
    viewed = viewed_mesh(load_mesh(path))
    np.testing.assert_allclose(viewed.colors[viewed.faces], colors[faces] / 255, atol=1.01 / 255)


def test_colours_of_another_program(tmp_path):
    box = trimesh.creation.box()
    light = np.tile(to_linear(np.array([51, 128, 204]) / 255), (8, 1))
    box.visual.vertex_colors = np.rint(np.column_stack([light, np.ones(8)]) * 255).astype(np.uint8)
    box.export(tmp_path / "a.glb")
    want = to_display(np.rint(light[0] * 255) / 255) * 255  # as fine as its 8 bits
    np.testing.assert_allclose(load_mesh(tmp_path / "a.glb").colors[0, 0, :3], want, atol=0.51)
