"""Truncated and malformed files of Gaussians in every format: an error of one line each."""

import gzip
import json
import struct
import tracemalloc

import numpy as np
import pytest
import torch
import trimesh
from formats.gaussians.differences import check
from helpers import refusals
from helpers.gaussians import khr_glb, some
from helpers.meshes import glb

from gamba_warp.errors import UserError
from gamba_warp.eval.shapes.load import KINDS, load_shape
from gamba_warp.formats.gaussians.compressed import BOUNDS
from gamba_warp.formats.gaussians.files import write_gaussians
from gamba_warp.formats.gaussians.splat import RECORD
from gamba_warp.formats.meshes import Y_UP
from gamba_warp.formats.names import SPLAT_FORMATS, splat_suffix
from gamba_warp.formats.read import read, read_gaussians


def refused(path, *words):
    text = refusals.refused(None, read_gaussians, path)
    assert str(path) in text and all(word in text for word in words), text


@pytest.fixture
def sound(tmp_path):
    def make(kind, count=300, degree=1):
        path = tmp_path / f"a{splat_suffix(kind)}"
        if kind == "glb":
            path.write_bytes(khr_glb(some(count, degree=degree)))
        else:
            write_gaussians(path, some(count, degree=degree), kind)
        return path, path.read_bytes()

    return make


@pytest.mark.parametrize("kind", [*SPLAT_FORMATS, "glb"])
@pytest.mark.parametrize("fraction", [0.999, 0.5, 0.02])
def test_cut_short(sound, kind, fraction):
    path, data = sound(kind)
    path.write_bytes(data[: int(len(data) * fraction) | 1])  # a .splat of whole records is whole
    refused(path)


@pytest.mark.parametrize("kind", [*SPLAT_FORMATS, "glb"])
def test_too_long(sound, kind):
    path, data = sound(kind)
    path.write_bytes(data + b"\1" * 33)
    if kind != "spz":  # what follows a gzip stream is not of it
        refused(path)


@pytest.mark.parametrize("kind", SPLAT_FORMATS)
def test_empty_missing_and_a_folder(tmp_path, kind):
    path = tmp_path / f"a{splat_suffix(kind)}"
    refused(path, "No such file")
    path.write_bytes(b"")
    refused(path, "empty")
    path.unlink()
    path.mkdir()
    refused(path)


@pytest.fixture
def spz(sound):
    """The path of an .spz, and what it holds."""
    path, data = sound("spz")
    return path, bytearray(gzip.decompress(data))


@pytest.mark.parametrize(
    "at, value, word",
    [
        *((8, struct.pack("<I", count), "") for count in (299, 301, 10_000_000, 2**32 - 1)),
        *((4, b"\4", "version 4"), (4, b"\0", "version 0")),
        *((12, b"\4", "degree 4"), (12, b"\0", "more data follows")),
        (1 << 20, bytes(1 << 26), "more data follows"),  # behind the end: a bomb
    ],
)
def test_an_spz_with_a_false_header(spz, at, value, word):
    path, inner = spz
    inner[at : at + len(value)] = value
    path.write_bytes(gzip.compress(inner, 9))
    tracemalloc.start()
    refused(path, word)
    assert tracemalloc.get_traced_memory()[1] < 5e6  # nothing was made room for
    tracemalloc.stop()


def test_an_spz_with_a_damaged_stream(sound):
    path, data = sound("spz")
    path.write_bytes(data[:-8] + b"\0\0\0\0" + data[-4:])
    refused(path, "damaged")


def test_an_spz_of_two_members_or_with_extensions_is_read(spz):
    """gzip files may be joined."""
    path, inner = spz
    want = read_gaussians(path)
    two = gzip.compress(inner[:30]) + gzip.compress(inner[30:])
    inner[14] |= 2
    for content in (two, gzip.compress(inner + b"an extension")):
        path.write_bytes(content)
        assert torch.equal(read_gaussians(path).means, want.means)


@pytest.mark.parametrize(
    "old, new, word",
    [
        (b"element chunk 2", b"element chunk 1", "invalid header"),
        (b"element vertex 300", b"element vertex 900", "truncated or invalid header"),
        (b"element sh 300", b"element sh 299", "invalid header"),
        (b"uint packed_scale", b"int packed_scales", "packed_scale"),
        (b"float max_scale_y", b"float max_scale_q", "max_scale_y"),
        (b"uchar f_rest_8", b"uchar f_rest_9", "f_rest_8"),
    ],
)
def test_an_invalid_compressed_ply(sound, old, new, word):
    path, data = sound("compressed-ply")
    assert old in data
    path.write_bytes(data.replace(old, new, 1))
    refused(path, word)


@pytest.mark.parametrize(
    "bound, value, bad",
    [
        ("min_x", np.nan, "means"),
        *((f"{end}_scale_x", -np.inf, "scales") for end in ("min", "max")),
    ],
)
def test_a_compressed_ply_with_bounds_that_are_not_finite(sound, bound, value, bad):
    """The sizes of 256 Gaussians between -inf and a logarithm are unknown."""
    path, data = sound("compressed-ply")
    start = data.index(b"end_header\n") + 11 + 4 * BOUNDS.index(bound)
    path.write_bytes(data[:start] + struct.pack("<f", value) + data[start + 4 :])
    refused(path, f"256 of 300 Gaussians have {bad} that are not finite")


def nan_first(kind, data):
    """Return the file with a position that is not finite, and the number of Gaussians with it."""
    nan = struct.pack("<f", float("nan"))
    if kind == "spz":  # its first version has positions of 16-bit floats
        head = struct.pack("<4sIIBBBB", b"NGSP", 1, 300, 0, 12, 0, 0)
        means = np.ones((300, 3), "<f2")
        means[0, 0] = np.nan
        return gzip.compress(head + means.tobytes() + bytes([128]) * (300 * 10)), 1
    if kind == "glb":
        start = 28 + struct.unpack_from("<I", data, 12)[0]
    else:
        start = 0 if kind == "splat" else data.index(b"end_header\n") + 11
    # In a compressed file it is a bound of a chunk of 256.
    return data[:start] + nan + data[start + 4 :], 256 if "compressed" in kind else 1


@pytest.mark.parametrize("kind", [*SPLAT_FORMATS, "glb"])
def test_drop_bad_leaves_out_gaussians_that_cannot_be_drawn(sound, kind):
    path, whole = sound(kind)
    data, lost = nan_first(kind, whole)
    path.write_bytes(data)
    reason = f"{lost} of 300 Gaussians have means that are not finite"
    refused(path, reason, "gamba export --drop-bad")
    lines = []
    left = read_gaussians(path, lines)
    assert lines == [f"{reason}: left out"]
    assert left.num == 300 - lost and left.means.isfinite().all()
    path.write_bytes(whole)
    lines.clear()
    want = read_gaussians(path, lines).select(torch.arange(300) >= lost)
    assert lines == []
    if kind != "spz":  # which is another object above
        for name, value in left.tensors().items():
            assert value is None or torch.equal(value, getattr(want, name)), name


def test_each_reason_is_named_once_and_all_bad_is_refused(tmp_path):
    path = tmp_path / "a.splat"
    records = np.zeros(5, RECORD)
    records["quats"] = 200
    records["means"][0], records["scales"][0] = np.nan, np.nan
    records["means"][1, 2] = 1e30
    records["scales"][2] = -1
    records["quats"][3] = 128  # of which all numbers are 0
    path.write_bytes(records.tobytes())
    lines = []
    assert read_gaussians(path, lines).num == 1
    assert lines == [
        "4 of 5 Gaussians have means or scales that are not finite, or means over 1e+18, "
        "or scales below 0, or rotations of length zero: left out"
    ]
    path.write_bytes(records[:4].tobytes())
    with pytest.raises(UserError, match=r"4 of 4 .* length zero$"):
        read_gaussians(path, [])


def taken_apart(data):
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def changed(path, data, change):
    tree, binary = taken_apart(data)
    change(tree, tree["meshes"][0]["primitives"][0])
    path.write_bytes(glb(json.dumps(tree).encode(), binary))


NAME = "KHR_gaussian_splatting"
CHANGES = {
    "no rotation": (lambda t, p: p["attributes"].pop(f"{NAME}:ROTATION"), "ROTATION"),
    "not there": (lambda t, p: p["attributes"].update({f"{NAME}:SCALE": 99}), "broken header"),
    "wrong type": (lambda t, p: p["attributes"].update({f"{NAME}:SCALE": 1}), "VEC4"),
    "half a degree": (lambda t, p: p["attributes"].pop(f"{NAME}:SH_DEGREE_1_COEF_2"), "COEF_2"),
    "packed": (lambda t, p: p["extensions"][NAME].update({"extensions": {"X_y": {}}}), "X_y"),
    "linear": (lambda t, p: p["extensions"][NAME].update({"colorSpace": "lin"}), "lin"),
    "triangles": (lambda t, p: p.update({"mode": 4}), "mode 4"),
    "other counts": (lambda t, p: t["accessors"][3].update({"count": 9}), "invalid header"),
    "other harmonics": (lambda t, p: t["accessors"][7].update({"count": 9}), "invalid header"),
    "too many": (lambda t, p: t["accessors"][0].update({"count": 9999}), "truncated or invalid"),
    "circle": (lambda t, p: t["nodes"][0].update({"children": [0]}), "cycle"),
    "stretched": (lambda t, p: t["nodes"][0].update({"scale": [1, 2, 1]}), "stretches"),
    "mirrored": (lambda t, p: t["nodes"][0].update({"scale": [1, -1, 1]}), "stretches"),
    "no extension": (lambda t, p: p.pop("extensions"), "contains a mesh, not Gaussians"),
}


@pytest.mark.parametrize("case", CHANGES)
def test_a_glb_that_is_false_or_of_another_kind(sound, case):
    path, data = sound("glb")
    change, word = CHANGES[case]
    changed(path, data, change)
    refused(path, word)


def test_a_glb_of_a_draft_with_logarithms(sound):
    path, data = sound("glb")
    tree, binary = taken_apart(data)
    view = tree["bufferViews"][2]
    start, end = view["byteOffset"], view["byteOffset"] + view["byteLength"]
    logs = np.log(np.frombuffer(binary[start:end], "<f4")).astype("<f4").tobytes()
    path.write_bytes(glb(json.dumps(tree).encode(), binary[:start] + logs + binary[end:]))
    refused(path, "logarithms")


def test_a_glb_is_moved_by_its_nodes(sound, tmp_path):
    path, data = sound("glb")
    want = read_gaussians(path)
    s = 0.5**0.5

    def move(tree, primitive):
        tree["nodes"] = [
            {"children": [1], "translation": [1, 2, 3]},
            {"mesh": 0, "rotation": [0, s, 0, s], "scale": [2, 2, 2]},
        ]

    changed(path, data, move)
    # In glTF's axes: doubled, turned by 90 degrees about y, moved. Ours have y and z negated.
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    turn = flip @ torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]) @ flip
    moved = want.transformed(turn, flip @ torch.tensor([1.0, 2, 3]), 2.0)
    # float32 twice through a rotation
    check("compressed-ply", moved, read_gaussians(path))


def test_a_glb_has_all_instances_of_its_nodes(sound):
    path, data = sound("glb")
    want = read_gaussians(path)

    def repeat(tree, primitive):
        tree["accessors"].append(tree["accessors"][0] | {"count": 2})
        attributes = {"TRANSLATION": len(tree["accessors"]) - 1}
        tree["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}

    changed(path, data, repeat)
    got = read_gaussians(path)
    moved = torch.cat([want.means + want.means[:1], want.means + want.means[1:2]])
    torch.testing.assert_close(got.means, moved)
    torch.testing.assert_close(got.scales, want.scales.repeat(2, 1))


def test_meshes_are_no_gaussians(tmp_path):
    box = trimesh.creation.box()
    for suffix in ("glb", "ply", "stl", "obj"):
        box.export(tmp_path / f"box.{suffix}")
        refused(tmp_path / f"box.{suffix}", "contains a mesh, not Gaussians")


def test_every_file_is_opened_once(sound, tmp_path, monkeypatch):
    boxes = [tmp_path / f"box.{suffix}" for suffix in ("ply", "glb", "obj", "stl", "off")]
    for path in boxes:
        trimesh.creation.box().export(path)
    boxes.append(tmp_path / "points.xyz")
    boxes[-1].write_text("0 1 2\n")
    opened, plain = [], open
    monkeypatch.setattr("builtins.open", lambda *a, **k: opened.append(a[0]) or plain(*a, **k))
    for path in (*(sound(kind)[0] for kind in (*SPLAT_FORMATS, "glb")), *boxes):
        opened.clear()
        found = read(path)
        assert opened == [path]
        kind = "points" if path.suffix == ".xyz" else "mesh" if path in boxes else "gaussians"
        assert KINDS[type(load_shape(path)[0])] == kind
        want = "opencv" if kind == "gaussians" else "opengl" if path.suffix in Y_UP else "unknown"
        assert found.axes == want


def test_other_files_are_told_what_to_do(tmp_path):
    (tmp_path / "a.png").write_bytes(b"x")
    said = {"a.png": "gamba reconstruct", "a.sog": "SuperSplat", "a.txt": "not one of .obj"}
    for name, reason in said.items():
        (tmp_path / name).write_bytes(b"some text")
        assert reason in refusals.refused(None, read, tmp_path / name)
    (tmp_path / "b.obj").touch()
    assert f"such as {tmp_path / 'b.obj'}" in refusals.refused("a folder", read, tmp_path)
