"""Inputs of ``gamba eval-geometry``: accepted, refused, and flagged ones."""

import json
import struct
from functools import partial

import numpy as np
import pytest
import trimesh
from helpers.children import faulty_pair
from helpers.meshes import CORNERS, XYZ, as_mesh, ply_head

from gamba_warp.cli import run
from gamba_warp.eval.shapes import pairs
from gamba_warp.eval.shapes.flags import clean_mesh
from gamba_warp.eval.shapes.protocol import read_protocol
from gamba_warp.eval.shapes.shape import Mesh


def box(side=1.0, move=(0.0, 0, 0)):
    return trimesh.creation.box((side,) * 3).apply_translation(move)


def evaluate(capfd, *arguments):
    """Return the exit code and the report on stdout, which must have nothing else."""
    words = [str(word) for word in arguments]
    code = run("eval-geometry", [*words, "--points", "1000", "--json"])
    printed = capfd.readouterr()
    return code, json.loads(printed.out) if code != 2 else printed.err


def pairs_of(folder, names):
    for side in ("pred", "gt"):
        (folder / side).mkdir()
        for name in names:
            box().export(folder / side / f"{name}.ply")
    return folder / "pred", folder / "gt"


def cloud(count, points):
    """Return a binary .ply of points, whose header states a number of them."""
    head = ply_head("binary_little_endian", vertex=(count, *XYZ))
    return head.encode() + np.asarray(points, "<f4").tobytes()


def triangle(points, count=3):
    """Return a binary .ply of one face, whose header states a number of vertices."""
    head = ply_head("binary_little_endian", vertex=(count, *XYZ), face=(1, CORNERS))
    return head.encode() + np.asarray(points, "<f4").tobytes() + struct.pack("<B3i", 3, 0, 1, 2)


SCALE = ply_head("binary_little_endian", vertex=(1, "float scale_0")).encode()
BAD = {
    "empty": (b"", "empty"),
    "blank": (cloud(0, []), "contains no points"),
    "nan": (triangle(np.full((3, 3), np.nan)), "not finite"),
    "inf_cloud": (cloud(3, np.full((3, 3), np.inf)), "not finite"),
    "huge": (triangle(1e30 * np.eye(3)), "1e+30"),
    "far": (triangle(1e9 * np.eye(3)), "longest side"),
    "flat": (triangle(np.eye(3)[[0, 0, 1]]), "no area"),
    "lies": (triangle(np.eye(3), 10**12), "invalid header"),
    "half": (SCALE + bytes(4), "not Gaussians"),
    "noise": (b"nothing", "not a .ply"),
}


@pytest.mark.parametrize("side", ["pred", "gt"])
def test_bad_files_are_named_and_the_others_done(tmp_path, side, capfd):
    for folder in ("pred", "gt"):
        (tmp_path / folder).mkdir()
        for name in [*BAD, "good"]:
            box().export(tmp_path / folder / f"{name}.ply")
    for name, (content, _) in BAD.items():
        (tmp_path / side / f"{name}.ply").write_bytes(content)
    box().export(tmp_path / side / "lone.obj")
    code, report = evaluate(capfd, tmp_path / "pred", tmp_path / "gt")
    reasons = {item["name"]: item["reason"] for item in report["failures"]}
    expected = {name: reason for name, (_, reason) in BAD.items()}
    if side == "gt":
        del expected["far"]  # the ground truth sets the unit
    assert code == 1
    for name, reason in expected.items():
        assert reason in reasons.pop(name), name
    lone = "no ground truth" if side == "pred" else "no prediction"
    assert reasons.pop("lone") == lone and set(reasons) <= {"far"}
    done = [record for record in report["objects"] if record["status"] == "ok"]
    assert [r["name"] for r in done] == (["far", "good"] if side == "gt" else ["good"])
    assert done[-1]["iou"] == 1
    assert report["num_failed"] == len(report["failures"]) == len(BAD) + (side == "pred")


def changed(faces=None, more=None):
    mesh = as_mesh(box())
    mesh.faces = mesh.faces if faces is None else faces(mesh.faces)
    return mesh if more is None else as_mesh(trimesh.util.concatenate([box(), more]))


FLAGGED = {
    "open": changed(lambda f: f[1:]),
    "inverted": changed(lambda f: f[:, ::-1]),
    "inconsistent": changed(lambda f: np.concatenate([f[:1, ::-1], f[1:]])),
    "degenerate": changed(lambda f: np.concatenate([f, [[0, 8, 8]]])),
    "duplicate": changed(lambda f: np.concatenate([f, f[:3, ::-1]])),
    "nonmanifold": changed(more=box(0.5, (0.75, 0.75, 0.0))),
    "selfintersecting": changed(more=box(0.5, (0.4, 0.3, 0.2))),
}
FLAGGED["nonmanifold"].vertices[8:, 2] *= 2  # now they share an edge
FLAGGED["degenerate"].vertices = np.concatenate([box().vertices, [[50, 0, 0]]])  # shows nothing


@pytest.mark.parametrize("flag", FLAGGED)
def test_flags(flag):
    mesh, flags = clean_mesh(FLAGGED[flag], True)
    assert flags == [flag]
    assert clean_mesh(mesh, True)[1] == [f for f in flags if f not in ("degenerate", "duplicate")]


def test_flags_are_told_and_strict_refuses_them(tmp_path, capfd):
    pred, gt = pairs_of(tmp_path, FLAGGED)
    for flag, mesh in FLAGGED.items():
        flagged = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        flagged.export(pred / f"{flag}.ply")
    code, report = evaluate(capfd, pred, gt)
    told = FLAGGED.keys() - {"selfintersecting"}  # for which only --strict looks
    assert code == 0 and report["flags"]["pred"] == dict.fromkeys(told, 1)
    for record in report["objects"]:
        flag = record["name"]
        assert record["pred_flags"] == [flag] * (flag in told) and record["gt_flags"] == []
        assert record["pred_closed"] == (flag != "open")
        # the surface is the same
        if flag in ("inverted", "inconsistent", "degenerate", "duplicate"):
            assert record["iou"] == 1 and record["normal_consistency"] > 0.9  # edges
    code, report = evaluate(capfd, pred, gt, "--strict")
    reasons = {item["name"]: item["reason"] for item in report["failures"]}
    assert code == 1 and reasons.keys() == FLAGGED.keys() - {"open"}
    assert all(f"--strict: {flag}" in reason for flag, reason in reasons.items())


def test_sound_meshes_have_no_flags():
    for mesh in (trimesh.creation.icosphere(3), trimesh.creation.torus(0.4, 0.1), box()):
        corners = mesh.vertices[mesh.faces].reshape(-1, 3)
        assert clean_mesh(Mesh(corners, np.arange(len(corners)).reshape(-1, 3)), True)[1] == []


def test_point_clouds(tmp_path, capfd):
    cloud = np.random.default_rng(0).normal(size=(600, 3))
    pred, gt = tmp_path / "pred", tmp_path / "gt"
    pred.mkdir(), gt.mkdir()
    np.savetxt(pred / "same.xyz", cloud)
    for path, points in (
        *((gt / "same.ply", cloud), (pred / "one.ply", cloud[:1]), (gt / "one.ply", cloud)),
        *((pred / "back.ply", cloud), (gt / "back.ply", cloud[:1])),
    ):
        trimesh.PointCloud(points).export(path)
    code, report = evaluate(capfd, pred, gt)
    back, one, same = report["objects"]
    assert same["chamfer"] < 1e-6 and same["fscore"]["0.01"] == 1
    assert same["iou"] is None and "point cloud" in same["iou_reason"]
    assert same["noise_floor"] > 0.01 and same["normal_consistency"] is None
    assert one["accuracy"] < 1e-6 and one["completeness"] > 0.1
    assert one["chamfer"] == pytest.approx((one["accuracy"] + one["completeness"]) / 2)
    assert one["hausdorff"] > one["completeness"]
    assert code == 1 and "coincide" in back["reason"]
    code, report = evaluate(capfd, pred / "one.ply", gt / "one.ply", "--align", "icp")
    assert code == 1 and "coincide" in report["failures"][0]["reason"]


def test_an_evaluation_is_repeated_from_its_report(tmp_path, capfd):
    trimesh.creation.icosphere(2, 0.5).export(tmp_path / "a.ply")
    box().export(tmp_path / "b.ply")
    files = [tmp_path / "a.ply", tmp_path / "b.ply"]
    options = ["--align", "scale", "--seed", "3", "--surface", "density", "--voxels", "40"]
    code, first = evaluate(capfd, *files, *options, "--out", tmp_path)
    assert code == 0 and json.loads((tmp_path / "report.json").read_text()) == first
    code, again = evaluate(capfd, *files, "--protocol", tmp_path / "report.json")
    assert again["protocol"] == first["protocol"] and again["mean"]["iou"] == first["mean"]["iou"]
    assert again["mean"]["chamfer"] == first["mean"]["chamfer"]
    assert [len(again["objects"][0][key]) for key in ("pred_sha256", "gt_sha256")] == [64, 64]
    read = read_protocol(str(tmp_path / "report.json"))
    assert read.changes() == ["num_points", "seed", "align", "surface.method", "surface.voxels"]
    lines = (tmp_path / "objects.csv").read_text().splitlines()
    assert len(lines) == 2 and lines[0].startswith("name,status,chamfer") and "a,ok" in lines[1]


def test_one_that_fails_or_kills_its_process_stops_no_other(tmp_path, capfd, monkeypatch):
    """Output of libraries does not get into the report on stdout either."""
    broken = partial(pairs.evaluate_pairs, evaluate=faulty_pair)
    monkeypatch.setattr(pairs, "evaluate_pairs", broken)
    files = pairs_of(tmp_path, ("a", "bad", "c", "odd"))
    code, report = evaluate(capfd, *files, "--out", tmp_path / "out")
    reasons = {item["name"]: item["reason"] for item in report["failures"]}
    assert code == 1 and reasons.pop("bad") == "its process died of signal 11 (SIGSEGV)"
    assert reasons == {"odd": "MemoryError: no room"}
    assert [record.get("iou") for record in report["objects"]] == [1, None, 1, None]
    assert json.loads((tmp_path / "out" / "report.json").read_text()) == report


def test_what_of_a_shape_is_not_read_is_in_the_report(tmp_path, capfd):
    for name, more in (("pred", "l 1 2\nvp 0 0\n"), ("gt", "")):
        text = box().export(file_type="obj")
        (tmp_path / f"{name}.obj").write_text(text + more)
    _, report = evaluate(capfd, tmp_path / "pred.obj", tmp_path / "gt.obj")
    said = "1 of 1 predictions: the statement {} is not read"
    assert report["warnings"] == [said.format("l"), said.format("vp")]


def test_a_limit_takes_objects_of_either_folder(tmp_path, capfd):
    pred, gt = pairs_of(tmp_path, "abcde")
    box().export(gt / "f.ply")
    _, report = evaluate(capfd, pred, gt, "--limit", 2)
    assert [record["name"] for record in report["objects"]] == ["a", "d"]
