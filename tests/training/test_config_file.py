"""``gamba train --config``: the options of another run, overridden by further options."""

import json

import pytest
from helpers import micro
from helpers.micro import lines
from helpers.refusals import refused

from gamba_warp import cli
from gamba_warp.train.command import expand


def _train(*words) -> int:
    return cli.run("train", [str(word) for word in words])


def test_a_second_run_has_the_options_of_the_first(data, tmp_path, capsys):
    one, two = tmp_path / "one", tmp_path / "two"
    options = ["--preset", "tiny", "--set", *micro.MODEL, "--steps", 2, "--batch-size", 1]
    options += ["--views-per-object", 1, "--no-radial-mask", "--lpips", "off", "--size", 16]
    assert _train(data, *options, "--val-every", 0, "--log-every", 1, "--out", one) == 0
    assert _train("--config", one, "--out", two, "--steps", 3, "--lr", 2e-3) == 0
    first, second = (json.loads((folder / "config.json").read_text()) for folder in (one, two))
    changed = {"length": {"steps": 3}, "optim": {"lr": 2e-3}, "run": {"out": str(two)}}
    for group, values in changed.items():
        first[group] |= values
    assert first == second and len(lines(two, "train")) == 3
    assert "loss_rdist" not in lines(two, "train")[0]
    # Without --out the same run is resumed, here with another length.
    assert _train(f"--config={one / 'config.json'}", "--steps", 4) == 0
    assert [record["step"] for record in lines(one, "train")] == [1, 2, 3, 4]


def test_data_may_be_another(tmp_path):
    values = {"data": "here", "preset": "tiny", "set": ["depth=1"], "run": {"out": "run one"}}
    path = tmp_path / "config.json"
    path.write_text(json.dumps(values))
    want = ["--preset", "tiny", "--set", "depth=1", "--out", "run one"]
    assert expand(["--config", str(path)]) == ["here", *want]
    assert expand(["there", "--config", str(path), "--lr", "1"]) == ["there", *want, "--lr", "1"]
    assert expand(["--lr", "1", "--config", str(path)]) == ["here", *want, "--lr", "1"]
    for before in ([], ["--lr", "1"]):  # the word after the file is DATA, no value of an option
        given = expand([*before, "--config", str(path), "there", "--steps", "2"])
        assert given == ["there", *want, *before, "--steps", "2"]
    assert expand(["there", "--steps", "3"]) == ["there", "--steps", "3"]


@pytest.mark.parametrize(
    "content, words",
    [
        (None, "not the config.json of a run"),
        (b"\xff", "not the config.json of a run"),
        (b"[1]", "not the config.json of a run"),
        (b"{}", "missing required field `data`"),
        (b'{"data": "x", "preset": "tiny", "speed": 1}', "unknown speed"),
        (b'{"data": "x", "preset": "tiny", "optim": {"speed": 1}}', "unknown optim.speed"),
        # no file names code
        (b'{"data": "x", "preset": "tiny", "plugin": ["a.py"]}', "unknown plugin"),
        (b'{"data": "x", "preset": "tiny", "run": {"plugins": ["a.py"]}}', "unknown run.plugins"),
        (b'{"data": "x", "preset": "tiny", "optim": 3}', "optim: Expected `object`"),
        (b'{"data": "--out=/", "preset": "tiny"}', "'--out=/' is not a valid value"),
        (b'{"data": "x", "preset": "tiny", "optim": {"lr": "fast"}}', "lr: Expected `float`, got"),
        (b'{"data": "x", "preset": "tiny", "optim": {"lr": {}}}', "lr: Expected `float`"),
    ],
)
def test_bad_files_are_one_line(tmp_path, content, words):
    path = tmp_path / "config.json"
    if content is not None:
        path.write_bytes(content)
    refused(words, expand, ["--config", str(path)])
    refused("--config: expected .* a run's folder", expand, ["--lr", "1", "--config"])
