"""A real ablation of a few steps, by the commands themselves."""

import json

import pytest
from helpers import micro
from helpers.forked import python

from gamba_warp import cli, processes
from gamba_warp.ablation.figures import empty_psnr
from gamba_warp.ablation.run import failure_reason
from gamba_warp.data.dataset import open_dataset
from gamba_warp.eval.views.baselines import background
from gamba_warp.eval.views.compare import Truth, compare
from gamba_warp.model.posing import relative_cameras

PLAN = {
    "name": "small",
    "title": "A small ablation",
    "seeds": [0],
    "base": {
        "preset": "tiny",
        "set": dict(change.split("=") for change in micro.MODEL),
        "options": {
            **{"steps": 4, "batch_size": 2, "size": 16, "views_per_object": 2, "lpips": "off"},
            **{"val_every": 2, "log_every": 1},
        },
        "fit": {"steps": 3, "limit": 1, "held_out": 3, "size": 16},
    },
    "evaluation": {"split": "val", "objects": 1, "views": 3, "size": 16},
    "compare_with": "a",
    "rows": [
        {"name": "a"},
        {"name": "no-prepend", "set": {"prepend": False}, "options": {"radial_mask": False}},
        {"name": "bad", "options": {"lr": 10, "clip": 1e9, "max_skipped": 1}},
        {"name": "fit", "kind": "fit", "options": {"gaussians": 20}},
    ],
}


@pytest.mark.slow
def test_the_commands_do_what_the_table_says(tmp_path, monkeypatch):
    monkeypatch.setattr(processes, "GAMBA", (python(), "-m", "gamba_warp"))
    data = micro.write_dataset(tmp_path / "data")
    (tmp_path / "plan.json").write_text(json.dumps(PLAN))
    words = [tmp_path / "plan.json", data, "--out", tmp_path / "out", "--device", "cpu"]
    words += ["--rows", "a", "no-prepend", "fit", "--jobs", 2]
    assert cli.run("ablate", [str(word) for word in words]) == 0
    made = json.loads((tmp_path / "out" / "table.json").read_text())
    rows = {row["name"]: row for row in made["rows"]}
    report = json.loads(
        (tmp_path / "out" / "rows" / "a" / "seed-0" / "views" / "report.json").read_text()
    )
    assert rows["a"]["figures"]["psnr"]["mean"] == pytest.approx(report["mean"]["psnr"])
    assert rows["no-prepend"]["parameters"] < rows["a"]["parameters"]
    difference = rows["no-prepend"]["difference"]["figures"]["psnr"]["mean"]
    means = [rows[name]["figures"]["psnr"]["mean"] for name in ("no-prepend", "a")]
    assert difference == pytest.approx(means[0] - means[1])
    assert rows["fit"]["figures"]["psnr"]["mean"] > 5 and rows["fit"]["gaussians"] == 20
    assert rows["bad"]["status"] == "not run" and rows["a"]["step_seconds"] > 0
    page = (tmp_path / "out" / "index.html").read_text()
    assert "cloudc, models" in page and "fits" in page


def test_the_empty_picture_is_that_of_the_evaluation(tmp_path):
    """PSNR of the baseline "background", over the novel views."""
    data = micro.write_dataset(tmp_path / "data")
    views = [0, 2, 5]
    dataset = open_dataset(data)
    loaded = dataset.load("cloudb", views=views)
    cameras = relative_cameras(loaded.cameras, 1.5)
    truth = Truth("cloudb", loaded.images, cameras, views)
    values = compare({"": background(truth)}, truth)[""]
    found = empty_psnr(data, {"cloudb": views[1:], "nobody": [1], "cloudc": []}, None)
    assert list(found) == ["cloudb"]
    assert found["cloudb"] == pytest.approx((values[1]["psnr"] + values[2]["psnr"]) / 2)


def test_why_a_command_failed_is_its_own_last_word(tmp_path):
    log = tmp_path / "train.log"
    old = b"$ gamba train A\ngamba: of an older run\n"
    log.write_bytes(old + b"$ gamba train B\n 10%|#  |\r 20%|## |\ngamba: too bad\nwrote nothing\n")
    assert failure_reason(2, log) == "too bad"
    log.write_bytes(old + b"$ gamba train B\nTraceback\nKeyError: 'x'\n\n")
    assert failure_reason(1, log) == "exit code 1: KeyError: 'x'"
    assert failure_reason(128 + 9, log) == "died of signal 9 (SIGKILL), perhaps out of memory"
    log.write_bytes(old + b"$ gamba train B\n")
    assert failure_reason(70, log) == "exit code 70: no output"
    log.write_bytes(b"$ gamba train B\n")
    assert failure_reason(70, log) == "exit code 70: no output"
    assert "no output" in failure_reason(70, tmp_path / "none")
