"""Rows that run, fail, stop and resume, with fake commands that write small reports."""

import contextlib
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
from helpers.forked import python

from gamba_warp import cli, processes
from gamba_warp.files import PART

FAKE = [sys.executable, fake.__file__]
# Runs ``gamba ablate`` with the fake commands, in a process that can be killed.
DRIVER = """
import sys
from gamba_warp import cli, processes
from gamba_warp.untrusted import children
processes.GAMBA = sys.argv[1:3]
children.run_each = lambda *given: ()
cli.main(["ablate", *sys.argv[3:]])
"""


@pytest.fixture
def gamba(tmp_path, monkeypatch):
    """Runs ``gamba ablate`` on a plan, and returns its exit code and the commands that it ran."""
    monkeypatch.setenv("FAKE_CALLS", str(tmp_path / "calls"))
    monkeypatch.setattr(processes, "GAMBA", FAKE)
    monkeypatch.setattr("gamba_warp.untrusted.children.run_each", lambda *given: ())

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
    return made, {row["name"]: row for row in made["rows"]}


def test_rows_run_once_and_their_figures_are_these(gamba, tmp_path, capsys):
    rows = ["a", {"name": "b", "options": {"lr": 0.01}, "paper": {"psnr": 12.72}, "note": "Why."}]
    path = write_plan(tmp_path, *rows, seeds=[0, 2], compare_with="a")
    code, called = gamba(path)
    assert code == 0
    # All rows have one seed before one has two.
    each = [f"{c} {r}" for r in ("a/0", "b/0", "a/2", "b/2") for c in ("train", "eval-views")]
    assert called == each
    said = capsys.readouterr().out
    assert "a, seed 2: PSNR 24.00 dB, 0.25 s a step" in said
    made, found = table(tmp_path)
    # Objects have 20, 24 and 22 dB, and a dB more for each unit of the seed.
    a, b = found["a"]["figures"]["psnr"], found["b"]["figures"]["psnr"]
    assert a["mean"] == pytest.approx(23) and a["by_seed"] == {"0": 22, "2": 24}
    assert a["spread"] == pytest.approx(2**0.5) and a["objects"] == 3
    assert a["interval"][0] == pytest.approx(21) and a["interval"][1] == pytest.approx(25)
    assert b["mean"] == pytest.approx(24)
    # The difference is 1 dB of every object, whatever the object.
    difference = found["b"]["difference"]
    assert difference["to"] == "a" and difference["seeds"] == [0, 2]
    assert difference["figures"]["psnr"]["mean"] == pytest.approx(1)
    assert difference["figures"]["psnr"]["interval"] == pytest.approx([1, 1])
    assert found["a"]["difference"] is None and "lpips" not in found["a"]["figures"]
    assert found["a"]["step_seconds"] == pytest.approx(0.25) and found["a"]["parameters"] == 1234
    assert found["a"]["status"] == "ok" and found["b"]["paper"] == {"psnr": 12.72}
    if hasattr(os, "wait4"):
        import resource

        # Linux counts in what the parent held when it started the child.
        held = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        assert 1e6 < found["a"]["peak_memory"] <= max(1e9, held)
    text = (tmp_path / "out" / "table.md").read_text()
    assert "| 23.00 [21.00, 25.00]" in text and "PSNR [dB] 12.72" in text and "b: Why." in text
    assert "| b - a | +1.00 [1.00, 1.00]" in text and "1.414" in text
    assert "of 3 objects (27 were requested) of the split test." in text
    assert found["a"]["objects"] == 3 and made["evaluation"]["objects"] == 27
    assert "On black and on grey" in text and "| a | 19.00 [17.00, 21.00] | -" in text
    page = (tmp_path / "out" / "index.html").read_text()
    assert "of 3 objects (27 were requested) of the split test." in page
    assert "23.00 <span>[21.00, 25.00]</span>" in page
    assert made["evaluation"]["views"] == 4 and made["budget"] == {"steps": 4}
    before = page
    assert gamba(path) == (0, []), "what is done is not done again"
    assert (tmp_path / "out" / "index.html").read_text() == before
    # Another seed is another run; the table has all that there are.
    code, called = gamba(path, "--rows", "b", "--seeds", 5)
    assert code == 0 and called == ["train b/5", "eval-views b/5"]
    assert table(tmp_path)[1]["b"]["seeds"] == [0, 2, 5]
    assert not list((tmp_path / "out").rglob(f"{PART}*"))
    # The folder gives the options of the last call; those of the command line override them.
    kept = json.loads((tmp_path / "out" / "config.json").read_text())
    assert kept["plan"] == str(path) and kept["seeds"] == [5] and "steps" not in kept
    (tmp_path / "calls").write_text("")
    assert cli.run("ablate", ["--config", str(tmp_path / "out")]) == 0 and not calls(tmp_path)
    assert cli.run("ablate", ["--config", str(tmp_path / "out"), "--rows", "a"]) == 0
    assert calls(tmp_path) == ["train a/5", "eval-views a/5"]


def test_rows_that_fail_are_told_and_the_others_go_on(gamba, tmp_path, capsys):
    odd = {"name": "odd", "options": {"clip": 7}}
    diverges = {"name": "diverges", "options": {"clip": 8}}
    dies = {"name": "dies", "options": {"clip": 9}}
    path = write_plan(tmp_path, odd, diverges, dies, "sound")
    code, called = gamba(path, "--jobs", 2)
    assert code == 1 and "eval-views sound/0" in called
    assert not any("eval-views" in call and "sound" not in call for call in called)
    _, found = table(tmp_path)
    reasons = {name: row["failed"].get("0", "") for name, row in found.items()}
    assert "diverged: its last loss is not finite" in reasons["odd"]
    assert "20 steps in a row were not finite" in reasons["diverges"]
    assert "died of signal 11 (SIGSEGV)" in reasons["dies"]
    assert found["sound"]["status"] == "ok" and found["odd"]["status"] == "failed"
    text = (tmp_path / "out" / "table.md").read_text()
    assert "failed: diverges, seed 0: train: 20 steps" in text
    assert capsys.readouterr().out.count(": failed: ") == 3
    # They stay failed, and are run again when that is asked for.
    assert gamba(path) == (1, [])
    code, called = gamba(path, "--retry", "--rows", "diverges")
    assert code == 1 and called == ["train diverges/0"]


def test_a_changed_plan_is_refused_and_restart_does_what_changed(gamba, tmp_path, capsys):
    path = write_plan(tmp_path, "a", "b")
    assert gamba(path)[0] == 0
    before = (tmp_path / "out" / "table.json").read_bytes()
    path = write_plan(tmp_path, "a", {"name": "b", "set": {"width": 32}})
    capsys.readouterr()
    assert gamba(path) == (2, [])
    said = capsys.readouterr().err
    then, now = (f"train --set width={width}" for width in (16, 32))
    assert f"row b, seed 0: was run with another plan: {then} then, {now} now" in said
    assert said.count("\n") == 1 and (tmp_path / "out" / "table.json").read_bytes() == before
    assert gamba(path, "--restart", "--dry-run") == (0, [])
    assert gamba(path) == (2, []), "a dry run changes nothing"
    assert gamba(path, "--restart") == (0, ["train b/0", "eval-views b/0"])
    # Another evaluation trains nothing again.
    code, called = gamba(path, "--views", 3)
    assert (code, called) == (2, [])
    assert "eval-views --views 4 then, eval-views --views 3 now" in capsys.readouterr().err
    code, called = gamba(path, "--views", 3, "--restart")
    assert code == 0 and called == ["eval-views a/0", "eval-views b/0"]
    other = json.loads(path.read_text()) | {"name": "other"}
    path.write_text(json.dumps(other))
    assert gamba(path)[0] == 2
    assert "holds the ablation trial, not other" in capsys.readouterr().err


def test_fits_shapes_and_a_series(gamba, tmp_path, monkeypatch):
    (tmp_path / "meshes").mkdir()
    empty = {"apple": 19.0, "bench": 22.0, "chair": 20.0}
    monkeypatch.setattr("gamba_warp.ablation.page.empty_psnr", lambda *given: empty)
    fits = [
        {"name": f"f{n}", "kind": "fit", "options": {"gaussians": n}, "series": "fits"}
        for n in (400, 100)
    ]
    path = write_plan(tmp_path, "a", *fits, base={"fit": {"steps": 5}})
    words = ("--meshes", tmp_path / "meshes", "--geometry-objects", 2, "--rows", "a")
    code, called = gamba(path, *words)
    assert code == 0 and called == ["train a/0", "eval-views a/0", "eval-geometry a/0"]
    code, called = gamba(path)
    assert code == 2, "without the meshes it is another plan"
    _, found = table(tmp_path)
    chamfer = found["a"]["figures"]["chamfer"]
    assert chamfer["objects"] == 2 and chamfer["mean"] == pytest.approx(0.05)
    chosen = tmp_path / "out" / "rows" / "a" / "seed-0" / "chosen-2"
    assert sorted(p.name for p in chosen.iterdir()) == ["apple.ply", "bench.ply"]
    code, called = gamba(path, "--rows", "f100", "f400")
    assert code == 0 and called == ["fit f100/0", "fit f400/0"]
    made, found = table(tmp_path)
    assert found["a"]["absent"] == [0], "its commands were others"
    assert found["f100"]["figures"]["psnr"]["mean"] == pytest.approx(23)
    assert found["f100"]["figures"]["psnr_grey"]["mean"] == pytest.approx(21)
    assert found["f100"]["step_seconds"] == pytest.approx(2)
    series = made["series"]["fits"]
    # Gains over the empty picture: means of 2, 3, 3 dB and of 5, 6, 6 dB.
    assert series["numbers"] == [100, 400] and series["quality"] == pytest.approx([8 / 17, 1])
    want = 100 * 4 ** ((0.87 - 8 / 17) / (9 / 17))
    assert series["needed"]["87"]["number"] == pytest.approx(want)
    text = (tmp_path / "out" / "table.md").read_text()
    assert f"87 % of the quality of 400 Gaussians needs {want:,.0f} [" in text


def test_a_dry_run_prints_the_commands_and_does_nothing(gamba, tmp_path, capsys):
    path = write_plan(tmp_path, "a", {"name": "b", "kind": "fit"}, seeds=[0, 1])
    assert gamba(path, "--dry-run", "--jobs", 2) == (0, [])
    said = capsys.readouterr().out
    assert said.count("gamba train ") == 2 and said.count("gamba fit ") == 2
    assert said.endswith("4 runs\n") and not (tmp_path / "out").exists()


AFTER = ["train b/0", "eval-views b/0", "train c/0", "eval-views c/0"]


@pytest.fixture
def waiting(gamba, tmp_path):
    """Start an ablation as a process whose run waits for a signal."""
    path = write_plan(tmp_path, "a", {"name": "b", "options": {"clip": 6}}, "c")
    (tmp_path / "calls").write_text("")
    command = [python(), "-c", DRIVER, *FAKE, str(path), str(tmp_path / "data")]
    command += ["--out", str(tmp_path / "out"), "--device", "cpu"]
    said = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    process = subprocess.Popen(command, **said)
    run = tmp_path / "out" / "rows" / "b" / "seed-0" / "run"
    for _ in range(600):
        if (run / "waits").exists():
            return path, process, run, lambda: subprocess.Popen(command, **said)
        time.sleep(0.1)
    raise AssertionError(f"{run} never came")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_lets_the_training_save_and_the_same_command_goes_on(gamba, waiting, number):
    path, process, run, _ = waiting
    process.send_signal(number)
    said, _ = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    assert "the same command resumes" in said and (run / "saved").exists()
    record = json.loads((run.parent / "row.json").read_text())
    assert record["status"] == "begun" and record["parts"]["train"]["seconds"] > 0
    assert gamba(path) == (0, AFTER)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a child outlives a killed parent")
def test_a_killed_ablation_leaves_no_child_and_goes_on(gamba, waiting):
    path, process, run, start = waiting
    again = start()
    said, _ = again.communicate(timeout=60)
    assert again.returncode == 2 and "another process runs an ablation here" in said
    process.kill()
    process.communicate(timeout=60)
    (run / "saved").write_text("x")  # the fake waits no more
    assert gamba(path) == (0, AFTER)
    for line in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            assert bytes(run) not in line.read_bytes(), "a child is alive"


def test_what_is_damaged_is_told(gamba, tmp_path, capsys):
    path = write_plan(tmp_path, "a")
    assert gamba(path)[0] == 0
    folder = tmp_path / "out" / "rows" / "a" / "seed-0"
    (folder / "views" / "report.json").write_text("{")
    capsys.readouterr()
    assert gamba(path)[0] == 2
    assert "report.json: not valid JSON" in capsys.readouterr().err
    (folder / "row.json").write_text('{"row": 3}')
    assert gamba(path)[0] == 2
    assert "row.json: " in capsys.readouterr().err
