import json

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from helpers.disk import full_at
from helpers.gaussians import some
from PIL import Image

from gamba_warp.cameras import Cameras, intrinsics
from gamba_warp.cli import run
from gamba_warp.formats.ply import load_ply, save_ply
from gamba_warp.render import render
from gamba_warp.surfaces.extract import unit_frame
from gamba_warp.trajectories.files import load_path, save_path
from gamba_warp.trajectories.paths import Viewpoint, turntable

CENTER, SIDE = torch.tensor([30.0, -7.0, 12.0]), 5.0


@pytest.fixture
def thing(tmp_path):
    """A file of Gaussians far from the origin, and what it holds."""
    gaussians = some(60)
    gaussians.opacities.clamp_(0.3)
    gaussians.means, gaussians.scales = gaussians.means * SIDE + CENTER, gaussians.scales * SIDE
    path = tmp_path / "thing.ply"
    save_ply(path, gaussians)
    return path, load_ply(path)


def shoot(*arguments):
    return run("render", [str(a) for a in arguments])


def images(folder):
    return [np.asarray(Image.open(p)) for p in sorted(folder.glob("[0-9]???.png"))]


def test_a_turntable_of_images_with_its_cameras(thing, tmp_path, capsys):
    path, gaussians = thing
    options = ["--kind", "png", "--size", "40x24", "--frames", 3, "--elevation", 20, "--depth"]
    assert shoot(path, "--out", tmp_path / "out", *options) == 0
    assert "1 file, 0 failures" in capsys.readouterr().out
    folder = tmp_path / "out" / "thing"
    moved = gaussians.in_unit(*unit_frame(gaussians))
    cameras = turntable(3, Viewpoint(20.0), (40, 24))
    seen = render(moved, cameras, torch.ones(3), depth=True)
    made = np.stack(images(folder))
    # rounding to 8 bits
    np.testing.assert_allclose(made / 255, seen.rgb.numpy(), atol=0.51 / 255)
    # transforms.json has the same cameras in the file's frame, where depths are as long as there
    stated = load_path(folder / "transforms.json")
    own = render(gaussians, stated.cameras.to(torch.float32), torch.ones(3), depth=True)
    # The place of a camera far from the origin has fewer digits.
    np.testing.assert_allclose(made / 255, own.rgb.numpy(), atol=0.02)
    document = json.loads((folder / "transforms.json").read_text())
    for number, frame in enumerate(document["frames"]):
        assert frame["file_path"] == f"{number:04d}.png"
        depth = np.asarray(Image.open(folder / frame["depth"])) * frame["depth_unit"]
        known = own.alpha[number, ..., 0].numpy() > 0.51
        want = own.depth[number, ..., 0].numpy()
        assert known.sum() > 20 and np.abs(depth - want)[known].max() < 0.02 * SIDE


def test_cameras_of_a_file_are_in_the_frame_of_the_gaussians(thing, tmp_path):
    path, gaussians = thing
    viewmats = torch.eye(4).repeat(2, 1, 1)
    viewmats[:, :3, 3] = -CENTER + torch.tensor([[0.0, 0, 9], [0.5, 0, 8]])
    cameras = Cameras(viewmats, intrinsics(31, 22, 45.0).repeat(2, 1, 1), 31, 22)
    save_path(tmp_path / "transforms.json", cameras, fps=7)
    options = ["--trajectory", tmp_path / "transforms.json", "--kind", "png"]
    assert shoot(path, "--out", tmp_path / "out", *options, "--background", "none") == 0
    made = np.stack(images(tmp_path / "out" / "thing")) / 255
    seen = render(gaussians, cameras)
    np.testing.assert_allclose(made[..., 3:], seen.alpha.numpy(), atol=0.01)
    np.testing.assert_allclose(made[..., :3] * made[..., 3:], seen.rgb.numpy(), atol=0.01)
    assert made[..., 3].max() > 0.5
    again = load_path(tmp_path / "out" / "thing" / "transforms.json")
    assert torch.allclose(again.cameras.viewmats, cameras.viewmats.double()) and again.fps == 7


def test_movies_and_a_single_image(thing, tmp_path):
    path, _ = thing
    out = tmp_path / "out"
    common = [path, "--size", "32", "--background", "#204060"]
    assert shoot(*common, "--out", out / "a.gif", "--frames", 4, "--fps", 10) == 0
    with Image.open(out / "a.gif") as movie:
        assert movie.n_frames == 4 and movie.size == (32, 32) and movie.info["duration"] == 100
        movie.seek(2)
        assert movie.convert("RGB").getpixel((0, 0)) == (0x20, 0x40, 0x60)
    options = ["--trajectory", "spiral", "--frames", 6, "--fps", 3]
    assert shoot(*common[:1], "--size", "33x17", "--out", out / "a.mp4", *options) == 0
    meta = next(imageio_ffmpeg.read_frames(str(out / "a.mp4")))
    assert meta["size"] == (34, 18) and meta["fps"] == 3 and meta["duration"] == 2
    assert shoot(*common, "--out", out / "a.png", "--fov", 20) == 0
    assert Image.open(out / "a.png").size == (32, 32)
    assert sorted(p.name for p in out.iterdir()) == ["a.gif", "a.mp4", "a.png"]


def test_several_files_and_a_bad_one(thing, tmp_path, capsys):
    path, _ = thing
    bad = tmp_path / "bad.ply"
    bad.write_bytes(b"ply\nnothing")
    options = ["--size", "16", "--frames", 2]
    assert shoot(path, bad, "--out", tmp_path / "out", *options) == 1
    assert "2 files, 1 failure," in capsys.readouterr().out
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["thing.gif"]


REFUSED = {
    "--size 8": "--size 8: must be at least 16",
    "--size 10x": "--size 10x: give a width such as 512",
    "--size 5000": "--size 5000: must be at least 16 and at most 4,096",
    "--background blue": "--background blue: one of white",
    "--background none": "--background none needs images",
    "--depth": "--depth needs images",
    "--trajectory {ply}": "not valid JSON",
    "--trajectory none.json": "none.json: No such file",
    "--trajectory {cameras} --frames 3": "--frames applies to a turntable or a spiral",
    "--trajectory {cameras} --fov 30": "--fov applies to a turntable or a spiral",
    "--trajectory {cameras} --out a.png": "there are 2 views",
    "--out a.gif --kind mp4": "its name says gif",
    "--out a.webm": "expected a folder, or a file .gif, .mp4, .png",
    "--size 4096 --frames 100": "too many for a .gif",
}


@pytest.mark.parametrize("words", REFUSED)
def test_bad_options_are_one_line_and_leave_nothing(thing, tmp_path, monkeypatch, capsys, words):
    path, _ = thing
    cameras = Cameras(torch.eye(4).repeat(2, 1, 1), intrinsics(16, 16).repeat(2, 1, 1), 16, 16)
    save_path(tmp_path / "two.json", cameras)
    monkeypatch.chdir(tmp_path)
    filled = words.format(ply=path, cameras="two.json")
    where = [] if "--out" in words else ["--out", "out"]
    code = shoot(path, *filled.split(), *where)
    told = capsys.readouterr().err.strip().splitlines()
    assert code in (1, 2) and REFUSED[words] in told[-1]
    left = [p.name for p in tmp_path.rglob("*") if p.is_file()]
    assert sorted(left) == ["thing.ply", "two.json"]


def test_a_folder_of_other_files_is_not_replaced(thing, tmp_path, capsys):
    path, _ = thing
    folder = tmp_path / "out" / "thing"
    folder.mkdir(parents=True)
    (folder / "0000.png").touch()
    (folder / "notes.txt").write_text("mine")
    options = ["--kind", "png", "--size", "16", "--frames", 2, "--out", tmp_path / "out"]
    assert shoot(path, *options) == 1
    assert "holds other files (notes.txt)" in capsys.readouterr().err
    (folder / "notes.txt").unlink()
    assert shoot(path, *options) == 0
    assert sorted(p.name for p in folder.iterdir()) == ["0000.png", "0001.png", "transforms.json"]


@pytest.mark.parametrize("kind", ["gif", "mp4", "png"])
def test_a_full_disk_leaves_nothing(thing, tmp_path, kind, capsys):
    path, _ = thing
    out = tmp_path / "out"
    with full_at(700):
        code = shoot(path, "--kind", kind, "--size", 64, "--frames", 3, "--out", out)
    assert code == 1 and "cannot write" in capsys.readouterr().err
    assert list(out.iterdir()) == []
