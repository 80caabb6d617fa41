"""The demo on three objects and a few seconds of training: all commands run, the page is whole."""

import json
import shutil

import pytest

from gamba_warp.cli import run
from gamba_warp.commands.demo import STARTER
from gamba_warp.pages import stages

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


class Calls:
    """Stands in for the processes: notes the stages, and leaves what each would make."""

    def __init__(self, monkeypatch, out):
        self.stages, self.out, self.codes = [], out, {}
        monkeypatch.setattr(stages, "_call", self)
        monkeypatch.setattr("gamba_warp.pages.demo.write_demo", lambda *arguments: None)

    def __call__(self, words):
        self.stages.append(words[0])
        code = self.codes.get(words[0], 0)
        made = {"train": "run/model.safetensors", "reconstruct": "icons/a.ply"}
        path = self.out / made.get(words[0], {"eval-views": "views"}.get(words[0], "geometry"))
        path = path if path.suffix else path / "report.json"
        if code == 0:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
        return code


ALL = ["train", "reconstruct", "eval-views", "eval-geometry"]


def test_an_interrupted_demo_goes_on(starter, tmp_path, monkeypatch, capsys):
    out = tmp_path / "demo"
    options = ["--no-lpips", "--starter", str(starter), "--out", str(out)]
    calls = Calls(monkeypatch, out)
    calls.codes = {"eval-views": 143}
    assert run("demo", options) == 143 and calls.stages == ALL[:3]
    assert "the same command goes on" in capsys.readouterr().out
    calls.codes, calls.stages = {"eval-views": 1}, []
    assert run("demo", options) == 2 and calls.stages == ["eval-views"]
    calls.codes, calls.stages = {}, []
    assert run("demo", options) == 0 and calls.stages == ALL[2:]
    calls.stages = []
    assert run("demo", options) == 0 and calls.stages == []
    (out / "run" / "model.safetensors").unlink()  # what follows from it is made again, too
    assert run("demo", options) == 0 and calls.stages == ALL


def test_a_demo_of_other_options_is_refused_unless_fresh(starter, tmp_path, monkeypatch, capsys):
    out = tmp_path / "demo"
    options = ["--no-lpips", "--starter", str(starter), "--out", str(out)]
    calls = Calls(monkeypatch, out)
    assert run("demo", options) == 0
    (out / "mine.txt").write_text("not a demo's")
    calls.stages = []
    assert run("demo", [*options, "--minutes", "1"]) == 2 and calls.stages == []
    assert "holds a demo of other options; give --fresh" in capsys.readouterr().err
    assert run("demo", [*options, "--minutes", "1", "--fresh"]) == 0 and calls.stages == ALL
    assert (out / "mine.txt").exists()
