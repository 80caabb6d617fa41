"""Rows that run, fail, stop and resume, with fake commands that write small reports."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from ablation import fake
from ablation.fake import write_plan
from helpers import micro
from helpers.forked import python

from gamba_warp import cli, processes
from gamba_warp.files import PART

FAKE = [sys.executable, fake.__file__]
# Runs ``gamba ablate`` with the fake commands, in a process that can be stopped.
DRIVER = """
import sys
from gamba_warp import cli, processes
processes.GAMBA = sys.argv[1:3]
cli.main(["ablate", *sys.argv[3:]])
"""


@pytest.fixture
def gamba(tmp_path, monkeypatch):
    """Runs ``gamba ablate`` on a plan, and returns its exit code and the commands that it ran."""
    monkeypatch.setenv("FAKE_CALLS", str(tmp_path / "calls"))
    monkeypatch.setattr(processes, "GAMBA", FAKE)
    micro.write_dataset(tmp_path / "data")

    def run(path, *words):
        (tmp_path / "calls").write_text("")
        out = ["--out", str(tmp_path / "out"), "--device", "cpu"]
        code = cli.run("ablate", [str(path), str(tmp_path / "data"), *out, *map(str, words)])
        return code, calls(tmp_path)

    return run


def calls(folder):
    """Command and row of each call, the row as ``name/seed``."""
    found = []
    for line in (folder / "calls").read_text().splitlines():
        parts = Path(line.split()[line.split().index("--out") + 1]).parts
        found.append(f"{line.split()[0]} {parts[-3]}/{parts[-2].removeprefix('seed-')}")
    return found


def table(folder):
    made = json.loads((folder / "out" / "table.json").read_text())
    return {row["name"]: row for row in made["rows"]}


def test_rows_run_once_and_have_these_figures(gamba, tmp_path, capsys):
    rows = ["a", {"name": "b", "options": {"lr": 0.01}, "paper": {"psnr": 12.72}, "note": "Why."}]
    path = write_plan(tmp_path, *rows, seeds=[0, 2], compare_with="a")
    code, called = gamba(path)
    assert code == 0
    # All rows have one seed before one has two.
    each = [f"{c} {r}" for r in ("a/0", "b/0", "a/2", "b/2") for c in ("train", "eval-views")]
    assert called == each and "a, seed 2: done" in capsys.readouterr().out
    found = table(tmp_path)
    # Objects have 20, 24 and 22 dB, and a dB more for each unit of the seed.
    a, b = found["a"]["figures"]["psnr"], found["b"]["figures"]["psnr"]
    assert a["mean"] == pytest.approx(23) and a["spread"] == pytest.approx(2**0.5)
    assert a["interval"][0] == pytest.approx(21) and a["interval"][1] == pytest.approx(25)
    # The difference is 1 dB of every object, whatever the object.
    assert b["mean"] == pytest.approx(24) and b["difference"]["mean"] == pytest.approx(1)
    assert b["difference"]["interval"] == pytest.approx([1, 1])
    assert a["difference"] is None and "lpips" not in found["a"]["figures"]
    assert found["a"]["step_seconds"] == pytest.approx(0.25) and found["a"]["objects"] == 3
    text = (tmp_path / "out" / "table.md").read_text()
    assert "23.00 [21.00, 25.00]" in text and "12.72" in text and "b: Why." in text
    assert "+1.00 [1.00, 1.00]" in text and "1.4 " in text
    assert gamba(path) == (0, []), "finished work is not done again"
    assert gamba(path, "--threads", 5) == (2, [])
    assert "seed-0: was run with other options" in capsys.readouterr().err
    code, called = gamba(path, "--rows", "b", "--seeds", 5)
    assert code == 0 and called == ["train b/5", "eval-views b/5"]
    assert table(tmp_path)["b"]["seeds"] == ["0", "2", "5"]
    # The difference is over the seeds of both rows.
    assert table(tmp_path)["b"]["figures"]["psnr"]["difference"]["mean"] == pytest.approx(1)
    assert not list((tmp_path / "out").rglob(f"{PART}*"))


def test_a_failed_row_stops_no_other(gamba, tmp_path, capsys):
    rows = ["a", *({"name": f"b{kind}", "options": {"novel_weight": kind}} for kind in (8, 9)), "c"]
    path = write_plan(tmp_path, *rows)
    code, called = gamba(path)
    said = capsys.readouterr().out
    assert code == 1 and "eval-views c/0" in called and "eval-views b8/0" not in called
    assert "b8, seed 0: failed: train: 20 steps in a row were not finite (step 20)" in said
    assert "b9, seed 0: failed: train: died of SIGSEGV" in said
    assert table(tmp_path)["b8"]["figures"] == {} and table(tmp_path)["c"]["objects"] == 3
    assert gamba(path)[1] == ["train b8/0", "train b9/0"], "failed rows are tried again"


def test_a_dry_run_prints_the_commands(gamba, tmp_path, capsys):
    code, called = gamba(write_plan(tmp_path, "a"), "--dry-run", "--threads", 3)
    first, second = capsys.readouterr().out.splitlines()
    assert code == 0 and not called and not (tmp_path / "out").exists()
    assert first.startswith("gamba train ") and "--threads 3" in first and "--seed 0" in first
    assert second.startswith("gamba eval-views ")


def test_invalid_data_stop_before_the_first_run(gamba, tmp_path, capsys):
    """And options may change until a run has begun."""
    path, data = write_plan(tmp_path, "a"), tmp_path / "data"
    data.rename(tmp_path / "elsewhere")
    assert gamba(path) == (2, []) and not (tmp_path / "out").exists()
    assert capsys.readouterr().err.count("\n") == 1
    (tmp_path / "elsewhere").rename(data)
    folder = tmp_path / "out" / "rows" / "a" / "seed-0"
    folder.mkdir(parents=True)
    (folder / "commands.json").write_text('{"an earlier": ["try"]}')
    assert gamba(path)[0] == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_ablation_resumes(gamba, tmp_path, number):
    """The training is asked to stop, and saves."""
    path = write_plan(tmp_path, {"name": "a", "options": {"novel_weight": 6}}, "b")
    (tmp_path / "calls").write_text("")
    words = [path, tmp_path / "data", "--out", tmp_path / "out", "--device", "cpu"]
    run = tmp_path / "out" / "rows" / "a" / "seed-0" / "run"
    process = subprocess.Popen([python(), "-c", DRIVER, *FAKE, *map(str, words)])
    while not (run / "waits").exists():
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(number)
    assert process.wait(60) == 128 + number and (run / "saved").exists()
    assert calls(tmp_path) == ["train a/0"]
    assert gamba(path)[0] == 0 and table(tmp_path)["b"]["objects"] == 3


def test_the_commands_do_what_the_table_says(tmp_path, monkeypatch):
    monkeypatch.setattr(processes, "GAMBA", (python(), "-m", "gamba_warp"))
    data, options = micro.write_dataset(tmp_path / "data"), {"steps": 2, "batch_size": 2}
    options |= {"size": 16, "views_per_object": 2, "lpips": "off", "val_every": 0, "log_every": 1}
    base = {"set": dict(change.split("=") for change in micro.MODEL), "options": options}
    evaluation = {"split": "val", "objects": 1, "views": 3, "size": 16}
    rows = ["a", {"name": "b", "set": {"prepend": False}}]
    path = write_plan(tmp_path, *rows, base=base, evaluation=evaluation, compare_with="a")
    words = [path, data, "--out", tmp_path / "out", "--device", "cpu"]
    assert cli.run("ablate", [str(word) for word in words]) == 0
    report = tmp_path / "out" / "rows" / "a" / "seed-0" / "views" / "report.json"
    found = table(tmp_path)
    mean = found["a"]["figures"]["psnr"]["mean"]
    assert mean == pytest.approx(json.loads(report.read_text())["mean"]["psnr"])
    difference = found["b"]["figures"]["psnr"]["difference"]["mean"]
    assert difference == pytest.approx(found["b"]["figures"]["psnr"]["mean"] - mean)


def test_a_child_ends_when_the_caller_is_interrupted(monkeypatch):
    started = []

    def interrupted(seconds):
        raise KeyboardInterrupt

    popen = subprocess.Popen
    waiting = (sys.executable, "-c", "import time; time.sleep(60)")
    monkeypatch.setattr(processes, "GAMBA", waiting)
    monkeypatch.setattr(processes.time, "sleep", interrupted)
    monkeypatch.setattr(
        processes.subprocess, "Popen", lambda *a, **k: started.append(popen(*a, **k)) or started[0]
    )
    with pytest.raises(KeyboardInterrupt), open(os.devnull, "wb") as output:
        processes.run_gamba([], output, ())
    assert started[0].returncode == -signal.SIGKILL
