import struct
import webbrowser

import numpy as np
import pytest
import torch
import trimesh
from helpers.refusals import refused_command
from helpers.views import cloud_of
from PIL import Image

from gamba_warp.cameras import fibonacci_sphere
from gamba_warp.cli import run
from gamba_warp.color_spaces import to_linear
from gamba_warp.formats.gaussians.files import write_gaussians
from gamba_warp.formats.names import MESH_FORMATS
from gamba_warp.formats.ply import load_ply, save_ply

QUICK = ["--voxels", "48", "--views", "16", "--pixels", "64"]


@pytest.fixture
def ball(tmp_path):
    """An egg away from the origin, longest side 6, red towards +y: a file of Gaussians."""
    axes, center = np.array([2.0, 3.0, 2.0]), [10.0, 20.0, 30.0]
    points = fibonacci_sphere(2500) * axes
    red = torch.from_numpy(points[:, 1:2] > 0)
    colors = torch.where(red, torch.tensor([0.8, 0.1, 0.1]), torch.tensor([0.1, 0.1, 0.8]))
    path = tmp_path / "egg.ply"
    save_ply(path, cloud_of(points + center, 0.1, 0.95, colors))
    return path


def export(*arguments):
    return run("export", [str(a) for a in (*arguments, *QUICK)])


@pytest.mark.parametrize("surface", ["tsdf", "density"])
def test_meshes_lie_where_the_gaussians_are(ball, tmp_path, surface):
    out = tmp_path / "out"
    words = ["--mesh", *MESH_FORMATS, "--texture", "0", "--surface", surface]
    assert export(ball, "--out", out, *words) == 0
    assert {p.name for p in out.iterdir()} == {f"egg-mesh.{kind}" for kind in MESH_FORMATS}
    assert export(ball, "--out", tmp_path, "--mesh", "ply", "--surface", surface) == 0
    same = "egg-mesh.ply"
    assert (tmp_path / same).read_bytes() == (out / same).read_bytes()
    for kind in MESH_FORMATS:
        mesh = trimesh.load(out / f"egg-mesh.{kind}", force="mesh")
        center, size = mesh.bounds.mean(0), np.ptp(mesh.bounds, axis=0)
        assert np.abs(center - [10, -20, -30]).max() < 0.15  # y up
        assert np.abs(size - [4, 6, 4]).max() < 0.6  # the Gaussians' width, and a voxel
        assert mesh.volume > 0
        if kind == "stl":
            continue
        colors = mesh.visual.vertex_colors[:, :3] / 255
        top = mesh.vertices[:, 1] > -19.5  # what had y < 20
        want = np.array([[0.8, 0.1, 0.1], [0.1, 0.1, 0.8]])
        want = to_linear(want) if kind == "glb" else want
        assert np.abs(colors[top].mean(0) - want[1]).max() < 0.1
        assert np.abs(colors[mesh.vertices[:, 1] < -20.5].mean(0) - want[0]).max() < 0.1


def test_a_glb_has_a_texture_and_a_size_of_print_is_millimetres(ball, tmp_path, capsys):
    out = tmp_path / "out"
    assert export(ball, "-o", out, "--mesh", "glb", "stl", "--watertight", "--size-mm", "80") == 0
    mesh = trimesh.load(out / "egg-mesh.glb", force="mesh")
    assert mesh.visual.material.baseColorTexture.size == (1024, 1024)
    assert np.ptp(mesh.bounds, axis=0).max() == pytest.approx(0.08, rel=1e-4)
    print_me = trimesh.load(out / "egg-mesh.stl")
    assert print_me.is_volume and np.ptp(print_me.bounds, axis=0).max() == pytest.approx(80)
    said = capsys.readouterr().out
    assert "texture of 1024 pixels, closed (moved by " in said and len(print_me.faces) <= 10_000


def test_frame_and_faces_follow_the_options(ball, tmp_path):
    options = ["--axes", "opencv", "--faces", "300", "--mesh", "ply"]
    assert export(ball, "--out", tmp_path / "out", *options) == 0
    mesh = trimesh.load(tmp_path / "out" / "egg-mesh.ply")
    assert np.abs(mesh.bounds.mean(0) - [10, 20, 30]).max() < 0.2
    assert len(mesh.faces) <= 300 and mesh.visual.kind == "vertex"


def test_formats_of_gaussians(ball, tmp_path, capsys):
    out, splats = tmp_path / "out", ["ply", "splat", "spz"]
    options = ["--mesh", "--splats", *splats, "--page", "--turntable", "gif"]
    assert export(ball, "--out", out, *options, "--size", "32", "--frames", "3") == 0
    assert {p.name for p in out.iterdir()} == {f"egg.{kind}" for kind in (*splats, "html", "gif")}
    again, before = load_ply(out / "egg.ply"), load_ply(ball)
    assert torch.allclose(again.means, before.means, atol=1e-5)
    assert (out / "egg.splat").stat().st_size == 32 * 2500
    image = np.array(Image.open(out / "egg.gif").convert("RGB"))
    assert (image < 250).any(-1).mean() > 0.1  # it is in the image, wherever it was
    assert "<iframe" in (out / "egg.html").read_text()
    assert "2,500 Gaussians" in capsys.readouterr().out


def test_a_folder_and_failures(ball, tmp_path, capsys):
    folder = tmp_path / "many"
    folder.mkdir()
    (folder / "a.ply").write_bytes(ball.read_bytes())
    (folder / "bad.ply").write_bytes(b"ply\nnothing")
    trimesh.creation.box().export(folder / "box.ply")
    trimesh.creation.box().export(folder / "a-mesh.glb")  # beside Gaussians, where we put it
    write_gaussians(folder / "b.spz", load_ply(ball), "spz")
    (folder / "notes.txt").write_text("no")
    out = tmp_path / "out"
    assert export(folder, tmp_path / "gone.ply", "--out", out, "--mesh", "stl") == 1
    assert sorted(p.name for p in out.iterdir()) == ["a-mesh.stl", "b-mesh.stl"]
    captured = capsys.readouterr()
    for name in ("bad.ply", "box.ply", "gone.ply"):
        assert f"{name}: " in captured.err
    assert "4 files, 3 failures" in captured.out


@pytest.mark.parametrize(
    "options, reason",
    [
        (["--mesh"], "--mesh, --splats"),
        (["--mesh", "none"], "--mesh, --splats"),
        (["--mesh", "none", "obj"], "--mesh none obj: none cannot be combined with other formats"),
    ],
)
def test_what_cannot_start(ball, tmp_path, options, reason, capsys):
    refused_command(capsys, "export", [ball, "--out", tmp_path / "out", *options], reason)
    assert not (tmp_path / "out").exists()


def test_inputs_are_there_and_stay(ball, tmp_path, capsys):
    assert export(tmp_path / "gone.ply", "--out", tmp_path / "out") == 2
    (tmp_path / "empty").mkdir()
    assert export(tmp_path / "empty", "--out", tmp_path / "out") == 2
    assert "gone.ply: no such file" in capsys.readouterr().err
    before = ball.read_bytes()
    assert export(ball, "--out", tmp_path, "--mesh", "--splats", "ply") == 2
    assert ball.read_bytes() == before and "would be overwritten" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["export", "view", "render"])
def test_gaussians_that_cannot_be_drawn_are_left_out_when_asked(ball, tmp_path, capsys, command):
    """One line has their number; the others are drawn as without them."""
    data = bytearray(ball.read_bytes())
    start = data.index(b"end_header\n") + 11
    data[start : start + 4] = struct.pack("<f", float("nan"))
    bad, good = tmp_path / "bad" / "egg.ply", tmp_path / "good" / "egg.ply"
    bad.parent.mkdir(), good.parent.mkdir()
    bad.write_bytes(data)
    whole = load_ply(ball)
    save_ply(good, whole.select(torch.arange(whole.num) > 0))
    options, name = {
        "export": (["--mesh", "none", "--splats", "splat"], "egg.splat"),
        "view": (["--no-open-browser"], "egg.html"),
        "render": (["--size", "24"], "egg.png"),
    }[command]
    made = []
    for path in (good, bad):
        out = path.parent / "out"
        place = out if command == "export" else out / name
        words = [path, "--out", place, *options]
        if path == bad:
            assert run(command, [str(word) for word in words]) > 0
            assert "1 of 2500 Gaussians have means" in capsys.readouterr().err
            words.append("--drop-bad")
        assert run(command, [str(word) for word in words]) == 0
        made.append((out / name).read_bytes())
    assert made[0] == made[1]
    lines = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    reason = "1 of 2500 Gaussians have means that are not finite: left out"
    assert lines == [f"warning: {bad}: {reason}"]


def test_view_writes_the_page_and_opens_it(ball, tmp_path, monkeypatch, capsys):
    opened = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    page = tmp_path / "page.html"
    assert run("view", [str(ball), "--out", str(page)]) == 0
    assert opened == [page.as_uri()] and "<script" in page.read_text()
    assert run("view", [str(tmp_path / "gone.ply")]) == 2
