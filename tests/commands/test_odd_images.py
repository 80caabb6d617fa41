"""Odd images, and those of telephones, through ``gamba reconstruct``: a result, or one line."""

import os
import sys

import numpy as np
import pytest
import torch
from helpers.images import disc_on_noise
from helpers.refusals import refused
from PIL import Image

from gamba_warp import cli
from gamba_warp.formats.ply import load_ply
from gamba_warp.images import find_images, image_size, load_rgba, save_image, to_uint8
from gamba_warp.model.checkpoint import save_model
from gamba_warp.model.config import GambaConfig
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.posing import reference_cameras
from gamba_warp.render import render

SIDE = 40
SMALL = {"image_size": 32, "patch_size": 8, "width": 16, "depth": 1, "state_size": 4}
SMALL |= {"encoder": "none", "encoder_size": 16}
MODELS = {
    "bins": GambaConfig(**SMALL),
    "rays": GambaConfig(decoder="rays", ray_cells=8, ray_layers=2, ray_features=8, **SMALL),
}


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("models")
    for name, config in MODELS.items():
        save_model(folder / f"{name}.safetensors", Gamba(config))
    return folder


def images():
    """Alpha of each image that has a result; the colour runs from side to side."""
    y, x = np.mgrid[:SIDE, :SIDE] / (SIDE - 1)
    corner = np.ones((SIDE, SIDE))
    corner[0, 0] = 0
    return {
        "fills": corner,
        "side": (x - 0.9) ** 2 + (y - 0.5) ** 2 < 0.1,
        "line": np.abs(x - 0.5) < 0.02,
        "soft": np.clip(1 - 2 * np.hypot(x - 0.5, y - 0.5), 0, 1),
        "white": (x - 0.5) ** 2 + (y - 0.5) ** 2 < 0.16,
    }


def save(folder, name, alpha):
    height, width = np.shape(alpha)
    ramp = np.tile(np.linspace(0, 1, width), (height, 1))
    rgb = np.ones((height, width, 3)) if name == "white" else np.dstack([ramp] * 3)
    path = folder / f"{name}.png"
    save_image(path, np.dstack([rgb, np.asarray(alpha, float)]))
    return path


def reconstruct(*words):
    quick = ("--turntable", "none", "--no-page")
    return cli.run("reconstruct", [str(word) for word in (*words, *quick)])


@pytest.mark.parametrize("decoder", MODELS)
def test_odd_objects_are_reconstructed(tmp_path, checkpoints, decoder):
    paths = [save(tmp_path, name, alpha) for name, alpha in images().items()]
    out = tmp_path / "out"
    model = checkpoints / f"{decoder}.safetensors"
    assert reconstruct(*paths, "--checkpoint", model, "--out", out) == 0
    for path in paths:
        gaussians = load_ply(out / f"{path.stem}.ply")
        assert gaussians.num > 0
        for values in (gaussians.means, gaussians.scales, gaussians.opacities, gaussians.colors):
            assert values.isfinite().all(), path.stem


def test_a_white_object_on_white_is_seen_by_its_alpha(tmp_path, checkpoints):
    """Fresh weights of the decoder rays reproduce the image, on any background."""
    paths = [save(tmp_path, name, images()[name]) for name in ("white", "side")]
    model = checkpoints / "rays.safetensors"
    assert reconstruct(*paths, "--checkpoint", model, "--out", tmp_path) == 0
    camera = reference_cameras(MODELS["rays"], 1)
    for path in paths:
        seen = render(load_ply(tmp_path / f"{path.stem}.ply"), camera, background=torch.zeros(3))
        inside = seen.alpha[0, ..., 0] > 0.5
        box = inside.nonzero()
        # the longer side of the object is 0.8 of the image, as for every other object
        longest = (box.max(0).values - box.min(0).values + 1).max().item()
        assert abs(longest - 0.8 * 32) <= 2
        if path.stem == "white":  # and no black comes through from behind
            assert (seen.rgb[0] / seen.alpha[0])[inside].min() > 0.9


def photo(size=(96, 128)):
    return Image.fromarray(to_uint8(disc_on_noise(size)[0]))


def test_outputs_that_cannot_be_written(tmp_path, capsys):
    photo().save(tmp_path / "a.png")
    (tmp_path / "out" / "a.ply").mkdir(parents=True)  # a folder where a result is to be
    assert reconstruct(tmp_path / "a.png", "--out", tmp_path / "out") == 1
    assert not any((tmp_path / "out" / "a.ply").iterdir())
    assert "a.ply" in capsys.readouterr().err
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["a.ply"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_folders_without_permission(tmp_path):
    photo().save(tmp_path / "a.png")
    (tmp_path / "shut").mkdir(mode=0o500)
    assert reconstruct(tmp_path / "a.png", "--out", tmp_path / "shut") == 2
    (tmp_path / "a.png").chmod(0)
    assert reconstruct(tmp_path / "a.png", "--out", tmp_path / "out") == 1


def test_images_of_telephones(tmp_path):
    heif = pytest.importorskip("pillow_heif")
    heif.register_heif_opener()
    upright = photo((64, 96))
    turned = upright.transpose(Image.Transpose.ROTATE_90)
    exif = Image.Exif()
    exif[0x0112] = 6
    turned.save(tmp_path / "a.heic", exif=exif.tobytes(), quality=95)
    assert image_size(tmp_path / "a.heic") == (96, 64)
    want = np.asarray(upright, np.float32) / 255
    assert np.abs(load_rgba(tmp_path / "a.heic")[..., :3] - want).mean() < 0.03
    (tmp_path / "b.jpg").write_bytes((tmp_path / "a.heic").read_bytes())  # by content, not by name
    assert load_rgba(tmp_path / "b.jpg").shape == (64, 96, 4)
    found, failures = find_images([tmp_path])
    assert [p.name for p in found] == ["a.heic", "b.jpg"] and not failures
    data = (tmp_path / "a.heic").read_bytes()
    for count in (11, 12, 40, len(data) // 2):
        (tmp_path / "c.heic").write_bytes(data[:count])
        refused(r"c\.heic: ", load_rgba, tmp_path / "c.heic")


def test_a_heic_without_its_reader_says_what_it_needs(tmp_path, monkeypatch):
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + b"\0" * 99)
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    refused(r"a\.heic: .*pip install '\.\[photo\]'", load_rgba, tmp_path / "a.heic")
