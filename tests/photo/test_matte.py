"""Matting networks: input sizes, and invalid files; each in a child process."""

import os

import numpy as np
import pytest
from helpers.cutouts import iou
from helpers.images import disc_on_noise
from helpers.matting import matting_network
from helpers.refusals import refused
from PIL import Image

from gamba_warp import cli
from gamba_warp.images import save_image
from gamba_warp.photo import matte
from gamba_warp.photo.matte import Matte
from gamba_warp.untrusted.children import end_idle

pytest.importorskip("onnxruntime")


@pytest.fixture(scope="module", autouse=True)
def children():
    yield
    end_idle()


def network(folder, name="net.onnx", **options):
    path = folder / name
    path.write_bytes(matting_network(**options))
    return path


def test_a_networks_alpha_lies_on_the_image(tmp_path):
    rgb, alpha = disc_on_noise((90, 133))
    for options in (dict(size=352), dict(size=512, last="Identity")):
        found = Matte(network(tmp_path, **options))(rgb)
        assert found.shape == alpha.shape and found.dtype == np.float32
        assert iou(found, alpha) > 0.93


def test_small_inputs_have_imagenets_colours(tmp_path):
    """One plain colour, at which the weights make exactly one half of either scale of colours."""
    colour, mean, spread = 0.8, np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    rgb = np.full((40, 40, 3), colour, np.float32)
    rgb[:20] = 1.0  # the largest value is 1: colours are divided by it
    for size, at in ((320, (colour - mean) / spread), (321, np.full(3, colour - 0.5))):
        weights = (1.0, 2.0, -1.5)
        path = network(tmp_path, weights=weights, bias=-float(at @ weights), size=size)
        found = Matte(path)(rgb)
        assert abs(found[35, 20] - 0.5) < 0.005, size  # 0.8 in 8 bits
        assert abs(found[5, 20] - 0.5) > 0.05


@pytest.mark.parametrize(
    "data, reason",
    [
        (b"", "not a model in ONNX"),
        (b"hello" * 99, "not a model in ONNX"),
        (matting_network()[:-40], "not a model in ONNX"),
        (matting_network(last="NoSuchThing"), "not a model in ONNX"),
        (matting_network(size=8), "sides may be"),
        (matting_network(size=100_000), "sides may be"),
        (matting_network(bias=float("nan")), "or no numbers"),
    ],
    ids=["empty", "text", "cut", "operator", "small", "large", "nan"],
)
def test_files_that_are_no_matting_models(tmp_path, data, reason):
    path = tmp_path / "odd.onnx"
    path.write_bytes(data)
    said = refused(None, lambda: Matte(path)(np.zeros((20, 20, 3), np.float32)))
    assert said.startswith(f"--matte-model {path}: ") and reason in said


def test_a_model_that_is_no_file(tmp_path):
    for path, reason in ((tmp_path / "none", "no such file"), (tmp_path, "not a plain file")):
        refused(reason, Matte, path)
    os.mkfifo(tmp_path / "pipe")
    refused("not a plain file", Matte, tmp_path / "pipe")


def _die(task):
    os.kill(os.getpid(), 9)


def test_a_crash_of_the_runtime_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(matte.models, "alpha_of", _die)
    refused(r"--matte-model .*its process died of signal 9", Matte, network(tmp_path))


def test_the_command_says_the_way_and_writes_the_input(tmp_path, capsys):
    rgb, _ = disc_on_noise((80, 95))
    save_image(tmp_path / "ball.png", rgb)
    model, out = network(tmp_path, size=352), tmp_path / "out"
    words = [str(tmp_path / "ball.png"), "--matte-model", str(model), "--out", str(out)]
    quick = ["--frames", "2", "--size", "16", "--turntable", "none"]
    assert cli.run("reconstruct", [*words, *quick, "--save-inputs"]) == 0
    said = capsys.readouterr().out
    assert f"{tmp_path / 'ball.png'}: The matting model net.onnx cut the object out." in said
    assert {p.name for p in out.iterdir()} == {"ball.ply", "ball.html", "ball-input.png"}
    with Image.open(out / "ball-input.png") as image:
        assert image.mode == "RGBA" and image.size == (95, 80)
    page = (out / "ball.html").read_text()
    assert "The matting model net.onnx" in page and "NAME-input.png" in page
    bad = [words[0], "--matte-model", str(tmp_path / "none.onnx"), "--out", str(tmp_path / "no")]
    assert cli.run("reconstruct", bad) == 2 and not (tmp_path / "no").exists()
