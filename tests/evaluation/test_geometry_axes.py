"""Files with different axes: rotated if known, reported if not, warned about if wrong."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from helpers.views import cloud_of

from gamba_warp.cli import run
from gamba_warp.eval.shapes.table import rotation_warnings
from gamba_warp.formats.ply import save_ply
from gamba_warp.surfaces.extract import Surface
from gamba_warp.surfaces.files import save_mesh

pytestmark = pytest.mark.usefixtures("one_thread")

BEAR = Path(__file__).parents[2] / "starter" / "meshes" / "blendswap-cc-0-teddybear.ply"
Z_TO_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
Y_DOWN = np.diag([1.0, -1, -1, 1])
LIFT = [0.2, 0.6, -0.1]  # the object does not lie about the origin of its file


def bear(*turns):
    """A real object, whose file is z-up, after turns."""
    mesh = trimesh.load_mesh(BEAR)
    mesh.apply_translation(LIFT)
    for turn in turns:
        mesh.apply_transform(turn)
    return mesh


def save_gaussians(path, mesh, count=6000):
    """Small Gaussians on the surface of a mesh, in its axes."""
    points, _ = trimesh.sample.sample_surface(mesh, count, seed=0)
    save_ply(path, cloud_of(np.asarray(points), 0.006, 0.95, torch.full((3,), 0.5)))


def evaluate(capfd, *words):
    protocol = words[0].with_name("protocol.json")  # fewer points and voxels: it is faster
    protocol.write_text('{"num_points": 8000, "iou_voxels": 24}')
    code = run("eval-geometry", [*map(str, words), "--protocol", str(protocol), "--json"])
    out, err = capfd.readouterr()
    assert code == 0
    return json.loads(out), err


@pytest.fixture
def files(tmp_path):
    """Gaussians in OpenCV's axes, and the mesh that they were made of, y-up."""
    bear(Z_TO_Y_UP).export(tmp_path / "true.obj")
    bear(Z_TO_Y_UP).export(tmp_path / "true.glb")
    bear().export(tmp_path / "true.ply")
    save_gaussians(tmp_path / "made.ply", bear(Z_TO_Y_UP, Y_DOWN))
    return tmp_path


CENTERS = ("--surface", "centers")  # the fastest; whole surfaces are made in the first test


def test_gaussians_of_a_mesh_against_the_mesh(files, capfd):
    words = ["--voxels", "64", "--views", "32", "--pixels", "128"]
    report, err = evaluate(capfd, files / "made.ply", files / "true.obj", *words)
    assert report["mean"]["chamfer"] < 0.016 and report["mean"]["iou"] > 0.88
    assert report["axes"] == {"pred": {"opencv": 1}, "gt": {"opengl": 1}}
    assert report["warnings"] == [] and "warning" not in err
    assert report["objects"][0]["pred_axes"] == "opencv"
    assert report["protocol"]["pred_axes"] == report["protocol"]["up"] == "auto"
    report, _ = evaluate(capfd, files / "made.ply", files / "true.glb", *CENTERS)
    assert report["mean"]["chamfer"] < 0.016 and report["axes"]["gt"] == {"opengl": 1}


def test_misstated_axes_are_warned_of(files, capfd):
    """ICP cannot correct it, and there is a warning too."""
    for align in ("none", "icp"):
        words = [files / "made.ply", files / "true.obj", "--align", align, "--pred-axes", "frame"]
        report, err = evaluate(capfd, *words, *CENTERS)
        assert report["mean"]["chamfer"] > 0.025
        (said,) = report["warnings"]
        assert said.startswith("1 of 1 predictions") and "by 180 degrees about x" in said
        assert f"warning: {said}" in err and err.count("warning:") == 1
        turned = report["objects"][0]["chamfer_turned"]
        assert turned["turned by 180 degrees about x"] < 0.2 * turned["as it is"]
        assert "chamfer_turned" not in report["mean"]


def test_what_is_not_known_is_used_as_it_is_and_told(files, capfd):
    """A .ply states its upward axis only by a comment; else an option can."""
    report, err = evaluate(capfd, files / "true.obj", files / "true.ply")
    assert report["axes"] == {"pred": {"opengl": 1}, "gt": {"unknown": 1}}
    assert report["mean"]["chamfer"] > 0.05 and "90 degrees about x" in report["warnings"][0]
    names = [str(files / name) for name in ("true.obj", "true.ply")]
    assert run("eval-geometry", [*names, "--protocol", str(files / "protocol.json")]) == 0
    out, err = capfd.readouterr()
    assert "unknown axes: coordinates are used unchanged" in out and "warning: 1 of 1" in err
    asked, _ = evaluate(capfd, files / "made.ply", files / "true.ply", "--up", "z", *CENTERS)
    assert asked["mean"]["chamfer"] < 0.02 and asked["axes"]["gt"] == {"z-up": 1}
    content = (files / "true.ply").read_bytes()
    stated = content.replace(b"\nelement", b"\ncomment axes z-up\nelement", 1)
    (files / "said.ply").write_bytes(stated)
    told, _ = evaluate(capfd, files / "made.ply", files / "said.ply", *CENTERS)
    assert told["mean"]["chamfer"] == asked["mean"]["chamfer"] and told["warnings"] == []
    y_up, _ = evaluate(capfd, files / "said.ply", files / "true.obj")
    assert y_up["mean"]["chamfer"] < 0.01


@pytest.mark.parametrize("axes", ["opencv", "opengl"])
def test_our_own_mesh_files_say_their_axes(files, capfd, axes):
    """A surface is y down as the Gaussians are; each file of it lies on the ground truth."""
    mesh = bear(Z_TO_Y_UP, Y_DOWN)
    save_mesh(files / "ours.ply", Surface(mesh.vertices, mesh.faces, None), axes)
    report, err = evaluate(capfd, files / "ours.ply", files / "true.obj")
    assert report["axes"]["pred"] == {axes: 1} and report["mean"]["chamfer"] < 0.01 and err == ""


def test_axes_can_be_asked_for(files, capfd):
    """For predictions, and by the frame: in the unit frame coordinates are z-up."""
    bear(Z_TO_Y_UP, Y_DOWN).export(files / "down.stl")
    report, _ = evaluate(capfd, files / "down.stl", files / "true.obj", "--pred-axes", "opencv")
    assert report["mean"]["iou"] == 1 and report["axes"]["pred"] == {"opencv": 1}
    unit = bear()
    unit.apply_translation(-unit.bounds.mean(0))
    unit.apply_scale(1 / unit.extents.max())
    unit.export(files / "unit.obj")
    report, _ = evaluate(capfd, files / "unit.obj", files / "true.obj", "--frame", "unit")
    assert report["mean"]["iou"] > 0.99 and report["axes"]["pred"] == {"z-up": 1}
    unit.apply_transform(Z_TO_Y_UP)
    unit.export(files / "unit.obj")
    words = ["--frame", "unit", "--pred-axes", "opengl"]
    report, _ = evaluate(capfd, files / "unit.obj", files / "true.obj", *words)
    assert report["mean"]["iou"] > 0.99


def test_mirrored_files_are_told_from_rotated_ones(tmp_path, capfd):
    """Also after an alignment that searches all rotations, which mends rotations alone."""
    sides = [(1.0, 0.2, 0.3), (0.2, 0.7, 0.2), (0.3, 0.2, 0.5)]
    boxes = [trimesh.creation.box(side) for side in sides]
    for mesh, place in zip(boxes, np.eye(3) * 0.4):
        mesh.apply_translation(place)
    mesh = trimesh.util.concatenate(boxes)
    mesh.export(tmp_path / "true.obj")
    turns = {"mirrored along z": [1, 1, -1], "turned by 180 degrees about x": [1, -1, -1]}
    for name, matrix in turns.items():
        wrong = mesh.copy()
        wrong.vertices = mesh.vertices * matrix
        wrong.export(tmp_path / "pred.obj")
        report, _ = evaluate(capfd, tmp_path / "pred.obj", tmp_path / "true.obj")
        assert f"far smaller Chamfer distance {name} (" in report["warnings"][0]
        words = [tmp_path / "pred.obj", tmp_path / "true.obj", "--align", "turn", "icp"]
        report, _ = evaluate(capfd, *words)
        if name.startswith("turned"):
            assert report["warnings"] == []
        else:
            (said,) = report["warnings"]
            assert "mirrored along x (" in said and "left-handed" in said


def test_good_shapes_are_not_warned_of(tmp_path, capfd):
    """A symmetric cube, and a poor prediction that no rotation improves."""
    trimesh.creation.box().export(tmp_path / "cube.obj")
    trimesh.creation.icosphere(3, 0.6).export(tmp_path / "ball.obj")
    for pred in ("cube.obj", "ball.obj"):
        assert evaluate(capfd, tmp_path / pred, tmp_path / "cube.obj")[0]["warnings"] == []


def test_one_turn_of_many_is_one_warning():
    """Poor predictions, all slightly improved by a rotation, but none a lot."""

    def record(straight, turned):
        others = {"turned by 180 degrees about x": turned, "mirrored along x": 0.2}
        return {"name": "a", "chamfer_turned": {"as it is": straight} | others}

    (said,) = rotation_warnings([record(0.06, 0.045)] * 4 + [record(0.05, 0.05)])
    assert "of 5 predictions would be 0.046 in place of 0.058 if all were turned by 180" in said
    assert rotation_warnings([record(0.06, 0.045)] * 4) == []
    assert rotation_warnings([record(0.06, 0.058)] * 9) == []
    (said,) = rotation_warnings([record(0.05, 0.06)] * 9 + [record(0.06, 0.03)])
    assert said.startswith("1 of 10 predictions") and "a 0.03 in place of 0.06" in said
