"""Point clouds, read completely or refused."""

import struct

import numpy as np
import pytest
from helpers.meshes import CORNERS, XYZ, ply_head
from helpers.refusals import refused

from gamba_warp.formats.headers import open_shape
from gamba_warp.formats.ply_data import parse_ply
from gamba_warp.formats.read import read
from gamba_warp.versions import import_open3d

COUNT = 2500
POINTS = np.random.default_rng(0).normal(size=(COUNT, 3)).astype(np.float32)
ROWS = [" ".join(map(repr, row)) for row in POINTS.tolist()]
GARBAGE = ["no numbers here"] * COUNT
KINDS = [("a.xyz", {}), ("text.ply", {"write_ascii": True}), ("binary.ply", {})]


def ply(rows):
    return (ply_head(vertex=(COUNT, *XYZ)) + "\n".join(rows)).encode()


def lines(*rows):
    return "\n".join(rows).encode()


BAD = {
    "garbage.xyz": (lines(*GARBAGE), "could not convert"),
    "garbage.ply": (ply(GARBAGE), "could not convert"),
    "thousand.xyz": (lines(*ROWS[:1500], *GARBAGE[:1000]), "could not convert"),
    "short_rows.xyz": (lines(*ROWS[:5], "1 2", *ROWS[5:]), "number of columns changed"),
    "two_columns.xyz": (lines("1 2", "3 4"), "expected x y z"),
    "nan.xyz": (lines(*ROWS[:5], "nan 1 2"), "1 of 6 points are not finite"),
    "only_comments.xyz": (b"# a\n# b\n", "no points"),
    "one_line.xyz": (b"1 " * 100_000, "100000 columns"),
    "python.xyz": (b"1_0 2 3\n", "could not convert"),
    "truncated.ply": (ply(ROWS[:-1]), f"but {COUNT - 1} lines follow"),
    "longer.ply": (ply([*ROWS, ROWS[0]]), "more lines follow"),
    "rows.ply": (ply([*ROWS[:-1], "1 2"]), "number of columns changed"),
    "twice.ply": (ply(ROWS).replace(b"float z", b"float y"), "property y occurs twice"),
    "no_z.ply": (ply(ROWS).replace(b"float z", b"float w"), "no x, y and z"),
}


@pytest.mark.parametrize("name", BAD)
def test_damaged_clouds_are_refused(tmp_path, name):
    content, reason = BAD[name]
    path = tmp_path / name
    path.write_bytes(content)
    text = refused(None, read, path)
    assert text.startswith(f"{path}") and reason in text


@pytest.mark.parametrize("normals", [False, True])
@pytest.mark.parametrize("name, options", KINDS)
def test_the_same_as_open3d(tmp_path, name, options, normals):
    """Compare on files that Open3D writes itself."""
    o3d = import_open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(POINTS[:500].astype(float)))
    if normals:
        cloud.normals = o3d.utility.Vector3dVector(np.asarray(cloud.points)[::-1])
    assert o3d.io.write_point_cloud(str(tmp_path / name), cloud, **options)
    want = o3d.io.read_point_cloud(str(tmp_path / name))
    got = read(tmp_path / name).shape
    np.testing.assert_array_equal(got.positions, np.asarray(want.points))
    assert (got.normals is not None) == want.has_normals()
    if normals and want.has_normals():
        lengths = np.linalg.norm(np.asarray(want.normals), axis=1, keepdims=True)
        np.testing.assert_array_equal(got.normals, np.asarray(want.normals) / lengths)


def test_columns_and_comments(tmp_path):
    text = "\ufeff# made by hand\n0 1 2 7 8 9\n\n 3\t4 5 7 8 9 \n"  # perhaps colours
    (tmp_path / "a.xyz").write_text(text, encoding="utf-8", newline="")
    cloud = read(tmp_path / "a.xyz").shape
    assert cloud.positions.tolist() == [[0, 1, 2], [3, 4, 5]] and cloud.normals is None


@pytest.mark.parametrize("layout", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_lists_of_different_lengths(tmp_path, layout):
    order = ">" if "big" in layout else "<"
    faces = [([0, 1, 2], 1.5), ([0, 1, 2, 3], 2.5), ([], 3.5), ([3, 2, 1, 0, 1], 4.5)]
    head = ply_head(layout, face=(4, CORNERS, "float weight"), edge=(1, "int a")).encode()
    if layout == "ascii":
        rows = [f"{len(x)} {' '.join(map(str, x))} {w}\n" for x, w in faces]
        body = "".join([*rows, "7\n"]).encode()
    else:
        rows = [struct.pack(f"{order}B{len(x)}if", len(x), *x, w) for x, w in faces]
        body = b"".join(rows) + struct.pack(f"{order}i", 7)
    (tmp_path / "a.ply").write_bytes(head + body)
    with open_shape(tmp_path / "a.ply") as source:
        data = parse_ply(source).elements
    assert data["edge"]["a"].tolist() == [7]
    assert data["face"]["weight"].tolist() == [1.5, 2.5, 3.5, 4.5]
    lists = data["face"]["vertex_indices"]
    assert lists.lengths.tolist() == [3, 4, 0, 5] and lists.values.sum() == 16
