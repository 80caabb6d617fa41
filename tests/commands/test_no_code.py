"""Files that name code: no command runs it; runs and plans with such a key are refused."""

import json
import shutil

import pytest
import torch
from helpers import micro
from helpers.refusals import refused_command
from safetensors.torch import load_file, safe_open, save_file

from gamba_warp.cli import run
from gamba_warp.files import sha256

KEYS = ("plugin", "plugins")


class Files:
    """Valid files of every kind, by name, and copies with a key that names a script."""

    def __init__(self, folder):
        self.folder = folder
        self.data, self.run = micro.write_dataset(folder / "data"), folder / "run"
        assert micro.run(self.data, self.run) == 0
        self.script = folder / "theirs.py"
        self.script.write_text(
            "from pathlib import Path\nPath(__file__).with_name('ran').touch()\n"
            "def register(plugin):\n    pass\n"
        )

    def changed(self, path, key, group=None):
        """Copy a JSON file, or the folder around it, with the key at its top or in a group."""
        values = json.loads(path.read_text())
        (values if group is None else values[group])[key] = [str(self.script)]
        shutil.copytree(path.parent, self.folder / "copy", dirs_exist_ok=True)
        copy = self.folder / "copy" / path.name
        copy.write_text(json.dumps(values))
        return copy

    def text(self, name, content):
        (self.folder / name).write_text(content)
        return self.folder / name

    def model(self, key):
        source, copy = self.run / "model.safetensors", self.folder / "theirs.safetensors"
        with safe_open(source, "pt") as file:
            metadata = file.metadata()
        record = [{"name": "theirs", "sha256": "0" * 64, "options": {}, "path": str(self.script)}]
        save_file(load_file(source), copy, metadata | {key: json.dumps(record)})
        return copy

    def checkpoint(self, key):
        (source,) = (self.run / "checkpoints").iterdir()
        copy = self.folder / "checkpoint"
        shutil.copytree(source, copy, dirs_exist_ok=True)
        state = torch.load(copy / "state.pt", weights_only=True)
        state["config"]["run"][key] = [str(self.script)]
        torch.save(state, copy / "state.pt")
        sums = {path.name: sha256(path) for path in copy.iterdir() if path.suffix != ".json"}
        (copy / "checksums.json").write_text(json.dumps(sums))
        return copy


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return Files(tmp_path_factory.mktemp("files"))


def plan(files, key, group):
    path = files.text("plan.json", json.dumps({"name": "p", "title": "P", "rows": [{"name": "a"}],
                                               "base": {"options": {"steps": 1}}}))  # fmt: skip
    values = json.loads(path.read_text())
    (values["base"]["options"] if group else values)[key] = str(files.script)
    return files.text("plan.json", json.dumps(values))


def first_object(files):
    return next(files.data.glob("*/transforms.json"))


# For a key, the words of a command and the file among them that has the key.
READERS = {
    "the config.json of a run": lambda f, key: ("train", "--config", f.changed(f.run / "config.json", key, "run")),  # noqa: E501
    "the folder of a run": lambda f, key: ("train", "--config", f.changed(f.run / "config.json", key).parent),  # noqa: E501
    "a plan": lambda f, key: ("ablate", plan(f, key, ""), f.data),
    "options of a plan": lambda f, key: ("ablate", plan(f, key, "options"), f.data),
    "a model to start from": lambda f, key: ("train", f.data, "--init", f.model(key)),
    "a checkpoint": lambda f, key: ("train", f.data, "--resume", f.checkpoint(key)),
    "a model": lambda f, key: ("reconstruct", f.data / "clouda" / "000.png", "--checkpoint", f.model(key)),  # noqa: E501
    "a model to evaluate": lambda f, key: ("eval-views", "--checkpoint", f.model(key), "--data", f.data, "--split", "val"),  # noqa: E501
    "a dataset": lambda f, key: ("train", f.changed(first_object(f), key).parent),
    "a split": lambda f, key: ("train", f.changed(f.data / "split.json", key).parent),
    "a path of cameras": lambda f, key: ("render", f.data, "--trajectory", f.changed(first_object(f), key)),  # noqa: E501
    "a catalogue": lambda f, key: ("data render", f.text("catalogue.json", json.dumps({"objects": [], key: "x"})).parent, "--out", f.folder / "views"),  # noqa: E501
    "a protocol": lambda f, key: ("eval-geometry", f.data, f.data, "--protocol", f.text("protocol.json", json.dumps({"samples": 5, key: "x"}))),  # noqa: E501
    "a report": lambda f, key: ("compare", f"a={f.text('report.json', json.dumps({'objects': [], key: 'x'}))}"),  # noqa: E501
}  # fmt: skip


# Options of commands; other files may have keys that nobody reads.
REFUSED = ("the config.json of a run", "the folder of a run", "a plan", "options of a plan")


@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize("reader", READERS)
def test_a_file_that_names_code_runs_nothing(files, capsys, reader, key):
    command, *words = READERS[reader](files, key)
    out = files.folder / "out"
    if command in ("train", "reconstruct", "eval-views", "render"):
        words = [*words, "--out", out]
    if command == "train":
        words += ["--preset", "tiny", "--set", *micro.MODEL, "--lpips", "off", "--device", "cpu"]
        words += ["--size", micro.SIZE, "--steps", "1"]
    if reader in REFUSED:
        refused_command(capsys, command, words, key)
    else:
        run(command, [str(word) for word in words])
    assert not (files.folder / "ran").exists()
    shutil.rmtree(out, ignore_errors=True)
