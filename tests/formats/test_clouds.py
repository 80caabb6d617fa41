"""Point clouds, read completely or refused."""

import struct

import numpy as np
import pytest
from helpers.refusals import refused

from gamba_warp.formats.clouds import read_cloud
from gamba_warp.formats.ply_data import read_ply
from gamba_warp.versions import import_open3d

COUNT = 2500
POINTS = np.random.default_rng(0).normal(size=(COUNT, 3)).astype(np.float32)
ROWS = [" ".join(map(repr, row)) for row in POINTS.tolist()]
GARBAGE = ["no numbers here"] * COUNT
KINDS = [
    ("a.xyz", {}),
    ("a.pts", {}),
    ("text.pcd", {"write_ascii": True}),
    ("binary.pcd", {}),
    ("packed.pcd", {"compressed": True}),
    ("text.ply", {"write_ascii": True}),
    ("binary.ply", {}),
]


def pcd(rows, count=COUNT, fields="x y z", sizes="4 4 4", types="F F F", more=""):
    head = f"VERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\n{more}"
    head += f"WIDTH {count}\nHEIGHT 1\nPOINTS {count}\nDATA "
    return (head + "ascii\n" + "\n".join(rows)).encode()


def ply(rows, count=COUNT):
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat ascii 1.0\nelement vertex {count}\n{axes}end_header\n"
    return (head + "\n".join(rows)).encode()


def lines(*rows):
    return "\n".join(rows).encode()


def raw_pcd(data, kind, count=4):
    return pcd([], count).replace(b"ascii\n", kind.encode() + b"\n") + data


BAD = {
    "garbage.xyz": (lines(*GARBAGE), "could not convert"),
    "garbage.pts": (lines(str(COUNT), *GARBAGE), "could not convert"),
    "garbage.pcd": (pcd(GARBAGE), "could not convert"),
    "garbage.ply": (ply(GARBAGE), "could not convert"),
    "thousand.pts": (lines(str(COUNT), *ROWS[:1500], *GARBAGE[:1000]), "could not convert"),
    "thousand.xyz": (lines(*ROWS[:1500], *GARBAGE[:1000]), "could not convert"),
    "short_rows.xyz": (lines(*ROWS[:5], "1 2", *ROWS[5:]), "number of columns changed"),
    "two_columns.xyz": (lines("1 2", "3 4"), "expected x y z"),
    "nan.xyz": (lines(*ROWS[:5], "nan 1 2"), "1 of 6 points are not finite"),
    "only_comments.xyz": (b"# a\n# b\n", "no points"),
    "one_line.xyz": (b"1 " * 100_000, "100000 columns"),
    "python.xyz": (b"1_0 2 3\n", "could not convert"),
    "truncated.pts": (lines(str(COUNT), *ROWS[:-1]), f"{COUNT} points but {COUNT - 1} lines"),
    "longer.pts": (lines(str(COUNT - 1), *ROWS), f"{COUNT - 1} points but {COUNT} lines"),
    "five.pts": (lines("1", "1 2 3 4 5"), "5 columns"),
    "fraction.pts": (lines("1.5", "1 2 3"), "not a whole number"),
    "truncated.pcd": (pcd(ROWS[:-5]), f"{COUNT} points but {COUNT - 5} lines"),
    "cut.pcd": (pcd(ROWS)[:-30], "number of columns changed"),
    "width.pcd": (pcd(ROWS).replace(b"HEIGHT 1", b"HEIGHT 2"), "WIDTH times HEIGHT"),
    "fields.pcd": (pcd(ROWS, fields="x y w"), "not one field z"),
    "twice.pcd": (pcd(ROWS, fields="x y y"), "not one field y z"),
    "type.pcd": (pcd(ROWS, types="F F X"), "field z has type X"),
    "size.pcd": (pcd(ROWS, sizes="4 4 3"), "field z has type F of 3"),
    "count.pcd": (pcd(ROWS, more="COUNT 1 1 0\n"), "COUNT 1 1 0"),
    "counts.pcd": (pcd(ROWS, more="COUNT 1 1\n"), "differ in length"),
    "words.pcd": (pcd(ROWS, more="VIEWPOINT " + "a" * 5000 + "\n", count="x"), "not a whole"),
    "short.pcd": (raw_pcd(bytes(47), "binary"), "truncated"),
    "long.pcd": (raw_pcd(bytes(60), "binary"), "false header"),
    "back.pcd": (
        raw_pcd(struct.pack("<II", 3, 48) + b"\x20\x00\x00", "binary_compressed"),
        "compressed data are broken",
    ),
    "cut_packed.pcd": (
        raw_pcd(struct.pack("<II", 2, 48) + b"\x1f\x00", "binary_compressed"),
        "compressed data are broken",
    ),
    "truncated.ply": (ply(ROWS[:-1]), f"but {COUNT - 1} lines follow"),
    "longer.ply": (ply([*ROWS, ROWS[0]]), "more lines follow"),
    "rows.ply": (ply([*ROWS[:-1], "1 2"]), "number of columns changed"),
    "twice.ply": (ply(ROWS).replace(b"float z", b"float y"), "property y is given twice"),
    "no_z.ply": (ply(ROWS).replace(b"float z", b"float w"), "no x, y and z"),
}


@pytest.mark.parametrize("name", BAD)
def test_damaged_clouds_are_refused(tmp_path, name):
    content, reason = BAD[name]
    path = tmp_path / name
    path.write_bytes(content)
    text = refused(None, read_cloud, path)
    assert text.startswith(f"{path}") and reason in text


@pytest.mark.parametrize("normals", [False, True])
@pytest.mark.parametrize("name, options", KINDS)
def test_the_same_as_open3d(tmp_path, name, options, normals):
    """Compare on files that Open3D writes itself."""
    o3d = import_open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(POINTS[:500].astype(float)))
    cloud.points.extend(np.full((200, 3), 0.25))  # which LZF finds
    if normals:
        cloud.normals = o3d.utility.Vector3dVector(np.asarray(cloud.points)[::-1])
    assert o3d.io.write_point_cloud(str(tmp_path / name), cloud, **options)
    want = o3d.io.read_point_cloud(str(tmp_path / name))
    got = read_cloud(tmp_path / name)
    np.testing.assert_array_equal(got.positions, np.asarray(want.points))
    assert (got.normals is not None) == want.has_normals()
    if normals and want.has_normals():
        np.testing.assert_array_equal(got.normals, np.asarray(want.normals))


def test_columns_and_comments(tmp_path):
    three = np.array([[0.0, 1, 2], [3, 4, 5]])
    good = {
        "a.xyz": "\ufeff# made by hand\n0 1 2 7 8 9\n\n 3\t4 5 7 8 9 \n",  # perhaps colours
        "none.pts": "0 1 2\n3 4 5\n",  # as ShapeNet's parts
        "intensity.pts": "2\n0 1 2 -9\n3 4 5 -9\n",
        "all.pts": "2\r\n0 1 2 -9 255 0 0\r\n3 4 5 -9 0 0 0\r\n",
        "a.pcd": pcd(
            ["9 0 1 2 8 8", "9 3 4 5 nan 8"], 2, "_ x y z more", "4 8 4 2 4", "U F F I F",
            "COUNT 1 1 1 1 2\n",
        ).decode(),
    }  # fmt: skip
    for name, text in good.items():
        (tmp_path / name).write_text(text, encoding="utf-8", newline="")
        cloud = read_cloud(tmp_path / name)
        assert cloud.positions.tolist() == three.tolist() and cloud.normals is None, name


def test_binary_pcd_of_mixed_types(tmp_path):
    kind = np.dtype([("_", "u1"), ("x", "<f8"), ("n", "<f4", 3), ("y", "<i2"), ("z", "<f4")])
    rows = np.zeros(4, kind)
    rows["x"], rows["y"], rows["z"] = np.arange(4) / 7, [-3, 5, 7, 9], 0.5
    more = "COUNT 1 1 3 1 1\n"
    head = pcd([], 4, "_ x n y z", "1 8 4 2 4", "U F F I F", more)[: -len(b"ascii\n")]
    path = tmp_path / "a.pcd"
    path.write_bytes(head + b"binary\n" + rows.tobytes())
    want = np.stack([rows[axis] for axis in "xyz"], 1)
    np.testing.assert_array_equal(read_cloud(path).positions, want)
    columns = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in kind.names)
    packed = b"".join(bytes([len(c) - 1]) + c for c in _pieces(columns))
    sizes = struct.pack("<II", len(packed), len(columns))
    path.write_bytes(head + b"binary_compressed\n" + sizes + packed)
    np.testing.assert_array_equal(read_cloud(path).positions, want)


def _pieces(data):
    return [data[i : i + 32] for i in range(0, len(data), 32)]


@pytest.mark.parametrize("layout", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_lists_of_different_lengths(tmp_path, layout):
    order = ">" if "big" in layout else "<"
    faces = [([0, 1, 2], 1.5), ([0, 1, 2, 3], 2.5), ([], 3.5), ([3, 2, 1, 0, 1], 4.5)]
    head = (
        f"ply\nformat {layout} 1.0\nelement face 4\nproperty list uchar int vertex_indices\n"
        "property float weight\nelement edge 1\nproperty int a\nend_header\n"
    ).encode()
    if layout == "ascii":
        rows = [f"{len(x)} {' '.join(map(str, x))} {w}\n" for x, w in faces]
        body = "".join([*rows, "7\n"]).encode()
    else:
        rows = [struct.pack(f"{order}B{len(x)}if", len(x), *x, w) for x, w in faces]
        body = b"".join(rows) + struct.pack(f"{order}i", 7)
    (tmp_path / "a.ply").write_bytes(head + body)
    data = read_ply(tmp_path / "a.ply").elements
    assert data["edge"]["a"].tolist() == [7]
    assert data["face"]["weight"].tolist() == [1.5, 2.5, 3.5, 4.5]
    lists = data["face"]["vertex_indices"]
    assert lists.lengths.tolist() == [3, 4, 0, 5] and lists.values.sum() == 16
