import io
import re
from dataclasses import replace
from unittest.mock import Mock
from urllib.parse import unquote

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from helpers.gaussians import some
from helpers.images import bad_files, cut_out, post
from helpers.model import SMALLEST, quick, run_reconstruct
from helpers.refusals import refused, refused_command
from helpers.views import cloud_of
from PIL import Image

from gamba_warp import pipeline
from gamba_warp.cameras import Cameras, intrinsics, orbit, reference_viewmat
from gamba_warp.data.preprocess import composite
from gamba_warp.errors import UserError
from gamba_warp.formats.meshes import load_mesh
from gamba_warp.formats.ply import load_ply
from gamba_warp.images import find_images, save_image
from gamba_warp.model import checkpoint as checkpoints
from gamba_warp.model.checkpoint import load_model
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.predict import reconstruct
from gamba_warp.photo import cutout
from gamba_warp.render import render
from gamba_warp.trajectories.movies import save_turntable, turntable_frames


@pytest.fixture
def image(tmp_path):
    return cut_out(tmp_path / "thing.png")


@pytest.mark.parametrize("background", ["white", "black"])
def test_the_model_sees_the_object_from_the_reference_camera(image, background):
    model, seen = Gamba(replace(SMALLEST, distance=2.0, fov=40, background=background)), []
    model.register_forward_pre_hook(lambda _, given: seen.append(given))
    rgba = cutout.cut_out(image).rgba
    gaussians = reconstruct(model, rgba)
    assert gaussians.means.shape == (gaussians.num, 3)
    ((images, cameras),) = seen
    want = composite(rgba, 16, 1.0 if background == "white" else 0.0)
    torch.testing.assert_close(images, want[None])
    torch.testing.assert_close(cameras.viewmats, reference_viewmat(2.0)[None])
    torch.testing.assert_close(cameras.Ks, intrinsics(16, 16, 40)[None])
    assert (cameras.width, cameras.height) == (16, 16)


def test_turntable_begins_at_the_reference_view_and_turns():
    gaussians = some(40)
    frames = turntable_frames(gaussians, size=33, frames=5)
    assert frames.shape == (5, 33, 33, 3) and frames.dtype == np.uint8
    viewmats = orbit(torch.arange(5) * 72.0)
    cameras = Cameras(viewmats, intrinsics(33, 33).expand(5, 3, 3), 33, 33)
    want = render(gaussians, cameras, background=torch.full((3,), 0.5)).rgb.numpy()
    # rounding to 8 bits
    np.testing.assert_allclose(frames / 255, want, atol=0.51 / 255)
    assert (frames[0, 0, 0] == 128).all() and np.ptp(frames) > 55
    assert np.abs(frames[0].astype(int) - frames[2]).max() > 20


def moving(size=(18, 21), count=6):
    """A few smooth colours; bright in another place in each frame."""
    y, x = np.mgrid[: size[0], : size[1]] / size[1]
    frames = [np.stack([x, y, np.full_like(x, i / count)], -1) for i in range(count)]
    return (255 * np.stack(frames)).astype(np.uint8)


def test_gif(tmp_path):
    frames = moving()
    save_turntable(tmp_path / "a.gif", frames, seconds=3)
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames == 6 and image.info["loop"] == 0 and image.info["duration"] == 500
        for index, want in enumerate(frames):
            image.seek(index)
            got = np.asarray(image.convert("RGB")).astype(int)
            # 255 colours for 6 x 378; dithering spreads the rest
            assert np.abs(got - want).mean() < 12


@pytest.mark.parametrize("object_there", [True, False])
def test_gif_keeps_its_background_grey(tmp_path, object_there):
    frames = np.full((3, 30, 30, 3), 128, np.uint8)
    if object_there:
        frames[:, 9:21, 9:21] = np.linspace(118, 127, 12 * 12 * 3).reshape(12, 12, 3)  # a soft edge
        frames[:, 10:20, 10:20] = np.random.default_rng(0).integers(0, 256, (3, 10, 10, 3))
    save_turntable(tmp_path / "a.gif", frames)
    with Image.open(tmp_path / "a.gif") as image:
        for index in range(image.n_frames):
            image.seek(index)
            got = np.asarray(image.convert("RGB"))
            assert (got[:9] == 128).all() and (got[10:20, 10:20] == 128).all() != object_there


def test_mp4_of_odd_size(tmp_path):
    frames = moving(size=(35, 45), count=12)
    save_turntable(tmp_path / "a.mp4", frames, seconds=1)
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "a.mp4"))
    meta = next(reader)
    assert meta["size"] == (46, 36) and meta["fps"] == 12 and meta["codec"] == "h264"
    got = [np.frombuffer(data, np.uint8).reshape(36, 46, 3) for data in reader]
    assert len(got) == 12
    # lossy, and colour at half resolution
    assert np.abs(got[5][:35, :45].astype(int) - frames[5]).mean() < 8


def test_turntables_that_cannot_be_written(tmp_path):
    said = r"a\.avi: a turntable is written as a \.gif or an \.mp4"
    refused(said, save_turntable, tmp_path / "a.avi", moving())
    for suffix in ("gif", "mp4"):
        path = f"/dev/null/a.{suffix}"
        refused(f"cannot write {path}", save_turntable, path, moving())
    assert not list(tmp_path.iterdir())


def test_a_image_becomes_every_file(tmp_path, image, checkpoint, capsys):
    out = tmp_path / "deep" / "out"
    arguments = [image, "--checkpoint", checkpoint, "--out", out, "--size", 32, "--frames", 4]
    assert run_reconstruct(*arguments, "--splats", "ply", "splat", "spz", "--elevation", 0) == 0
    files = {path.name: path.stat().st_size for path in out.iterdir()}
    names = ["thing.gif", "thing.html", "thing.ply", "thing.splat", "thing.spz"]
    assert sorted(files) == names and all(files.values())
    gaussians = load_ply(out / "thing.ply")
    with torch.inference_mode():
        want = reconstruct(load_model(checkpoint), cutout.cut_out(image).rgba)
    assert gaussians.num == 64 and files["thing.splat"] == 64 * 32
    # float32 through a logarithm or a logit
    torch.testing.assert_close(gaussians.means, want.means)
    torch.testing.assert_close(gaussians.scales, want.scales, rtol=1e-5, atol=0)
    torch.testing.assert_close(gaussians.opacities, want.opacities, rtol=1e-5, atol=0)
    source = (out / "thing.html").read_text()
    assert "<h1>thing</h1>" in source and "model.safetensors" in source and ">64<" in source
    table, card = source.split("<details>")
    assert "model.safetensors" in table and "no card" not in table
    assert "Trained on: not known: this model has no card" in card
    said = capsys.readouterr().out
    assert "thing: 64 Gaussians.\n" in said and "1 image, 0 failures" in said


def test_a_image_of_the_standard_input(tmp_path, image, checkpoint, monkeypatch, capsys):
    for content, code in ((image.read_bytes(), 0), (b"", 1)):
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(content)))
        assert run_reconstruct("-", *quick(checkpoint, tmp_path / "out")) == code
    texts = capsys.readouterr()
    assert "stdin: 64 Gaussians." in texts.out and (tmp_path / "out" / "stdin.ply").is_file()
    assert "-: the file is empty\n" in texts.err and texts.err.count("\n") == 1
    assert "/stdin" not in texts.err + texts.out
    monkeypatch.setattr("gamba_warp.commands.reconstruct.MAX_STDIN", 8)
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(bytes(9))))
    refused_command(capsys, "reconstruct", ["-"], "-: over 0 MB on the standard input")


def test_the_number_of_gaussians_is_told_once_they_are_written(
    tmp_path, image, checkpoint, monkeypatch, capsys
):
    full = Mock(side_effect=UserError("no space left"))
    monkeypatch.setattr("gamba_warp.pipeline.write_gaussians", full)
    assert run_reconstruct(image, *quick(checkpoint, tmp_path)) == 1
    texts = capsys.readouterr()
    assert "Gaussians" not in texts.out and "no space left" in texts.err


@pytest.mark.parametrize("frame", ["opencv", "opengl", None])
def test_a_mesh_of_what_was_reconstructed(tmp_path, image, checkpoint, monkeypatch, frame):
    ends = torch.tensor([0.35, -0.1, 0.0])
    stick = cloud_of((torch.arange(64.0)[:, None] / 63) * ends, 0.04, 0.9, [0.9, 0.1, 0.1])
    monkeypatch.setattr(pipeline, "reconstruct", lambda *_: stick)
    options = [*quick(checkpoint, tmp_path), "--mesh", "ply"]
    options += ["--axes", frame] if frame else []
    assert run_reconstruct(image, *options) == 0
    mesh = load_mesh(tmp_path / "thing-mesh.ply")
    middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    want = [0.175, -0.05 if frame == "opencv" else 0.05, 0.0]
    assert np.abs(middle - want).max() < 0.02  # half a Gaussian
    assert run_reconstruct(image, *options, "--min-opacity", 0.95) == 1  # nothing is left


def test_the_precision_reaches_the_network(tmp_path, image, checkpoint, monkeypatch, capsys):
    monkeypatch.setattr("gamba_warp.devices._bfloat16_speedup", lambda *_: 2.0)
    made = {}
    for precision in ("float32", "bfloat16", "auto"):
        options = [*quick(checkpoint, tmp_path / precision), "--precision", precision]
        assert run_reconstruct(image, *options) == 0
        made[precision] = load_ply(tmp_path / precision / "thing.ply").means
    assert torch.equal(made["auto"], made["bfloat16"])
    gap = (made["bfloat16"] - made["float32"]).abs().max()
    assert 0 < gap < 0.02  # object units; a bfloat16 has 8 digits
    options = [*quick(checkpoint, tmp_path / "no"), "--precision", "float16"]
    assert run_reconstruct(image, *options) == 2
    assert "precision" in capsys.readouterr().err and not (tmp_path / "no").exists()


def test_options_reach_the_files(tmp_path, image, checkpoint, capsys):
    arguments = [image, "--checkpoint", checkpoint, "--out", tmp_path, "--no-page"]
    arguments += ["--elevation", 0]
    assert run_reconstruct(*arguments, "--turntable", "mp4", "--size", 16, "--frames", 2) == 0
    assert (tmp_path / "thing.mp4").stat().st_size > 0 and not (tmp_path / "thing.html").exists()
    plain = load_ply(tmp_path / "thing.ply")
    limit = plain.opacities.median().item()
    assert run_reconstruct(*quick(checkpoint, tmp_path), image, "--min-opacity", limit) == 0
    few = load_ply(tmp_path / "thing.ply").num
    said = f"thing: {few} Gaussians, {64 - few} left out"
    assert 0 < few < 64 and said in capsys.readouterr().out
    assert run_reconstruct(*quick(checkpoint, tmp_path), image, "--axes", "opencv") == 0
    torch.testing.assert_close(load_ply(tmp_path / "thing.ply").means, plain.means)
    mask = tmp_path / "mask.png"
    save_image(mask, np.eye(20, 30))
    for words, cut in (
        (["--no-recenter"], {"recenter": False}),
        (["--mask", mask], {"mask": mask}),
    ):
        assert run_reconstruct(*quick(checkpoint, tmp_path), image, *words) == 0
        rgba = cutout.cut_out(image, cutout.CutoutOptions(**cut)).rgba
        want = reconstruct(load_model(checkpoint), rgba).means.detach()
        got = load_ply(tmp_path / "thing.ply").means
        torch.testing.assert_close(got, want, atol=1e-5, rtol=0)  # the file's rounding
        assert not torch.allclose(got, plain.means, atol=1e-3)


def test_one_bad_image_does_not_stop_the_others(tmp_path, checkpoint, capsys):
    folder, out = tmp_path / "in", tmp_path / "out"
    folder.mkdir()
    cases = [(path, reason) for name, path, reason in bad_files(folder) if name != "folder"]
    save_image(folder / "clear.png", np.zeros((9, 9, 4)))
    save_image(folder / "noise.bmp", np.random.default_rng(0).random((9, 9, 3)))
    first, last = cut_out(folder / "aa.png"), cut_out(folder / "zz.png")
    cases += [(folder / "clear.png", "no object"), (folder / "noise.bmp", "cannot tell object")]
    paths = [first, *(path for path, _ in cases), last]
    assert run_reconstruct(*quick(checkpoint, out), *paths, "--save-inputs") == 1
    names = ["aa-input.png", "aa.ply", "zz-input.png", "zz.ply"]
    assert sorted(path.name for path in out.iterdir()) == names
    said = capsys.readouterr().err.splitlines()
    errors = [line for line in said if line.startswith("gamba: ")]
    notes = [line for line in said if line.startswith("note: no matting model is here")]
    assert len(errors) == len(cases) and len(notes) == 1
    for line, (path, reason) in zip(errors, cases):
        assert line.startswith(f"gamba: failed: {path}: ") and reason in line
        assert line.count(str(path)) == 1


def test_a_folder_has_one_page_that_leads_to_every_result(tmp_path, checkpoint, capsys):
    folder, out = tmp_path / "in", tmp_path / "out"
    folder.mkdir()
    for name in ("index.png", "a b.png", "a b.webp"):
        cut_out(folder / name)
    (folder / "bad.png").write_bytes(b"no image")
    options = ["--checkpoint", checkpoint, "--out", out, "--size", 16, "--frames", 2]
    assert run_reconstruct(folder, *options) == 1
    said = capsys.readouterr().out
    assert f"{folder / 'a b.webp'}: its results are named a b-2\n" in said
    assert f"{folder / 'index.png'}: its results are named index-2\n" in said
    page = (out / "index.html").read_text()
    links = re.findall(r'<a href="([^"]+)">', page)
    assert links == ["a%20b.html", "a%20b-2.html", "index-2.html"] and "3 reconstructions" in page
    assert all((out / unquote(link)).is_file() for link in links)
    result = (out / "a b.html").read_text()
    assert re.findall(r'href="([^"]+)" download', result) == ["a%20b.ply", "a%20b.gif"]
    options[3] = tmp_path / "one"
    assert run_reconstruct(folder / "index.png", *options) == 0
    assert "<h1>index</h1>" in (tmp_path / "one" / "index.html").read_text()


def test_folders_are_searched(tmp_path, checkpoint, capsys):
    folder, empty = tmp_path / "in", tmp_path / "empty"
    folder.mkdir(), empty.mkdir()
    cut_out(folder / "b.png"), cut_out(folder / "a.PNG")
    (folder / "notes.txt").write_text("no image")
    assert find_images([folder, folder / "b.png"]) == ([folder / "a.PNG", folder / "b.png"], [])
    assert run_reconstruct(*quick(checkpoint, tmp_path / "out"), folder, empty) == 1
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["a.ply", "b.ply"]
    said = capsys.readouterr()
    assert f"{empty}: the folder holds no images" in said.err
    assert f"{folder}: 1 file of other kinds (.txt) skipped\n" in said.out
    for words in (f"[2/2] {folder / 'b.png'}: ", f"results in {tmp_path / 'out'}"):
        assert words in said.out
    (folder / "more").mkdir(), (folder / ".hidden").mkdir()
    cut_out(folder / "more" / "c.png")
    assert run_reconstruct(*quick(checkpoint, tmp_path / "out"), folder) == 0
    said = capsys.readouterr().out
    assert "1 file of other kinds (.txt), 1 folder skipped; --recursive takes the folders\n" in said
    assert f"{tmp_path / 'out'}: 2 files of an earlier run will be replaced\n" in said
    assert run_reconstruct(*quick(checkpoint, tmp_path / "all"), folder, "--recursive") == 0
    assert sorted(p.name for p in (tmp_path / "all").iterdir()) == ["a.ply", "b.ply", "c.ply"]
    assert "--recursive" not in capsys.readouterr().out


def test_a_doubtful_cut_out_is_said_and_shown(tmp_path, checkpoint, capsys):
    options = ["--checkpoint", checkpoint, "--out", tmp_path / "out", "--turntable", "none"]
    assert run_reconstruct(post(tmp_path), *options, "--size", 16, "--frames", 2) == 0
    said = capsys.readouterr().err
    assert "may be wrong: it touches the image's border." in said and "--save-inputs" in said
    page = (tmp_path / "out" / "post.html").read_text()
    assert "may be wrong: it touches" in page and 'class="strip"' in page


@pytest.mark.parametrize("which", ["image", "mask", "checkpoint"])
def test_nothing_that_is_read_is_replaced(tmp_path, checkpoint, capsys, which):
    photo, mask = cut_out(tmp_path / "photo.png"), cut_out(tmp_path / "mask.png")
    model = tmp_path / "model.safetensors"
    model.write_bytes(checkpoint.read_bytes())
    victim = {"image": photo, "mask": mask, "checkpoint": model}[which]
    victim = victim.rename(tmp_path / "photo.gif")  # the turntable's name
    files = {"image": photo, "mask": mask, "checkpoint": model} | {which: victim}
    before = {path: path.read_bytes() for path in files.values()}
    options = ["--mask", files["mask"], "--checkpoint", files["checkpoint"], "--out", tmp_path]
    said = f"gamba: {victim}: would be overwritten by an output; give another --out"
    refused_command(capsys, "reconstruct", [files["image"], *options], said)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_what_cannot_start_is_refused(tmp_path, image, checkpoint, capsys):
    other, file = cut_out(tmp_path / "other.png"), tmp_path / "file"
    file.touch()
    (tmp_path / "empty").mkdir()
    ready = quick(checkpoint, tmp_path / "out")
    missing = tmp_path / "none.safetensors"
    cases = [
        ([image, *quick(missing, tmp_path / "out")], missing, "gamba train"),
        ([image, *quick(file, tmp_path / "out")], file, "safetensors"),
        ([image, *quick(checkpoint, file)], "cannot write into", file),
        ([image, *quick(checkpoint, "/dev/null/x")], "cannot write into /dev/null/x"),
        (ready, "give at least one image or folder"),
        ([tmp_path / "empty", *ready], "empty: the folder holds no images"),
        ([image, other, *ready, "--mask", image], "--mask goes with one image"),
        ([image, *ready, "--sam", missing], "--sam", missing),
    ]
    if not torch.cuda.is_available():
        cases.append(([image, *ready, "--device", "cuda"], "no CUDA device"))
    for words, *reasons in cases:
        refused_command(capsys, "reconstruct", words, *reasons)
    assert not (tmp_path / "out" / "thing.ply").exists()


def test_the_starter_model_is_the_default(tmp_path, image, checkpoint, monkeypatch, capsys):
    monkeypatch.setattr(checkpoints, "DEFAULT_CHECKPOINT", tmp_path / "tiny.safetensors")
    arguments = [image, "--out", tmp_path / "out", "--turntable", "none", "--no-page"]
    refused_command(capsys, "reconstruct", arguments, "tiny.safetensors", "--checkpoint FILE")
    (tmp_path / "tiny.safetensors").write_bytes(checkpoint.read_bytes())
    assert run_reconstruct(*arguments) == 0


def test_a_model_that_diverged_is_a_failure(tmp_path, image, checkpoint, monkeypatch, capsys):
    gaussians = some(9)
    gaussians.means[3] = float("nan")
    monkeypatch.setattr(pipeline, "reconstruct", lambda *_: gaussians)
    assert run_reconstruct(image, *quick(checkpoint, tmp_path / "out")) == 1
    assert "1 of 9 Gaussians are not finite" in capsys.readouterr().err
