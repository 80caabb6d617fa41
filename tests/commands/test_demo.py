"""The demo on three objects with a few seconds of training: all commands and the page."""

import json
import shutil

import pytest
from helpers.micro import write_split

from gamba_warp.cli import run
from gamba_warp.commands import demo as command
from gamba_warp.commands.demo import STARTER
from gamba_warp.model import checkpoint

OBJECTS = {"train": "scopia-dog", "val": "scopia-cat", "test": "scopia-toaster"}


@pytest.fixture
def starter(tmp_path):
    folder = tmp_path / "starter"
    for uid in OBJECTS.values():
        shutil.copytree(STARTER / "data" / uid, folder / "data" / uid)
    write_split(folder / "data", **{name: [uid] for name, uid in OBJECTS.items()})
    (folder / "meshes").mkdir()
    shutil.copy(STARTER / "meshes" / "scopia-toaster.ply", folder / "meshes")
    (folder / "icons").mkdir()
    for name in ("scopia-toaster", "katorlegaz-fire-hydrant"):
        shutil.copy(STARTER / "icons" / f"{name}.png", folder / "icons")
    return folder


def demo(starter, out, *options):
    return run("demo", ["--starter", str(starter), "--out", str(out), *options])


@pytest.fixture
def short(tmp_path, monkeypatch):
    """Run one command as a process, as for users; the others share this process's imports."""
    protocol = tmp_path / "coarse.json"
    surface = {"voxels": 48, "views": 16, "pixels": 96}
    protocol.write_text(json.dumps({"num_points": 2000, "iou_voxels": 16, "surface": surface}))
    more = {"eval-geometry": ["--protocol", str(protocol)]}
    process = command._call

    def call(words):
        name, *rest = words
        return process(words) if name == "reconstruct" else run(name, rest + more.get(name, []))

    monkeypatch.setattr(command, "_call", call)


@pytest.mark.slow
def test_demo(starter, short, tmp_path, monkeypatch):
    monkeypatch.setenv("GAMBA_CACHE", str(tmp_path / "cache"))  # as long with LPIPS at home
    out = tmp_path / "demo"
    assert demo(starter, out) == 0
    page = (out / "index.html").read_text()
    for part in ("PSNR on black", "Trained on", "Figures of the shapes", "Chamfer"):
        assert part in page, part
    assert "it was not trained on this machine" in page
    assert (out / "icons" / "scopia-toaster.html").exists()
    assert json.loads((out / "geometry" / "report.json").read_text())["num_ok"] == 1


def test_without_starter_set(tmp_path, capsys):
    assert demo(tmp_path, tmp_path / "out") == 2
    said = capsys.readouterr().err
    assert "no such folder" in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()
    assert "make setup unpacks it in a checkout" in said and "--starter" in said


def test_without_the_shipped_model(starter, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(checkpoint, "DEFAULT_CHECKPOINT", tmp_path / "none.safetensors")
    assert demo(starter, tmp_path / "out") == 2
    assert "none.safetensors: no such file" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
