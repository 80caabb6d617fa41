"""The demo on three objects and a few seconds of training: all commands run, the page is whole."""

import json
import shutil

import pytest

from gamba_warp.cli import run
from gamba_warp.commands.demo import STARTER

OBJECTS = {"train": "scopia-dog", "val": "scopia-cat", "test": "scopia-toaster"}


@pytest.fixture
def starter(tmp_path):
    folder = tmp_path / "starter"
    for uid in OBJECTS.values():
        shutil.copytree(STARTER / "data" / uid, folder / "data" / uid)
    split = {"version": 1, **{name: [uid] for name, uid in OBJECTS.items()}}
    (folder / "data" / "split.json").write_text(json.dumps(split))
    (folder / "meshes").mkdir()
    shutil.copy(STARTER / "meshes" / "scopia-toaster.ply", folder / "meshes")
    (folder / "icons").mkdir()
    shutil.copy(STARTER / "icons" / "scopia-toaster.png", folder / "icons")
    return folder


@pytest.mark.slow
def test_demo(starter, tmp_path):
    out = tmp_path / "demo"
    options = ["--minutes", "0.05", "--no-lpips", "--starter", str(starter), "--out", str(out)]
    assert run("demo", options) == 0
    page = (out / "index.html").read_text()
    for part in ("Numbers", "Training", "Predicted", "Truth", "Icon: scopia-toaster", "chamfer"):
        assert part in page
    assert json.loads((out / "geometry" / "report.json").read_text())["num_ok"] == 1


def test_without_starter_set(tmp_path, capsys):
    assert run("demo", ["--starter", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "no such folder" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
