"""Photos of people and phones: a result, or an error of one line without partial files."""

import os

import numpy as np
import pytest
from helpers.images import disc_on_noise
from helpers.refusals import refused
from PIL import Image

from gamba_warp import cli
from gamba_warp import images as images
from gamba_warp.images import image_size, load_rgba, to_uint8


def photo(size=(96, 128)):
    return Image.fromarray(to_uint8(disc_on_noise(size)[0]))


def reconstruct(*words):
    quick = ("--turntable", "none", "--no-page")
    return cli.run("reconstruct", [str(word) for word in (*words, *quick)])


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
    found, failures = images.find_images([tmp_path])
    assert [p.name for p in found] == ["a.heic", "b.jpg"] and not failures
    data = (tmp_path / "a.heic").read_bytes()
    for count in (11, 12, 40, len(data) // 2):
        (tmp_path / "c.heic").write_bytes(data[:count])
        refused(r"c\.heic: ", load_rgba, tmp_path / "c.heic")


def test_a_heic_without_its_reader_says_what_it_needs(tmp_path, monkeypatch):
    import sys

    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + b"\0" * 99)
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    refused(r"a\.heic: .*pip install '\.\[photo\]'", load_rgba, tmp_path / "a.heic")
