"""The endurance command: what it counts as lost, whole and left over; and a quick run of it."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from helpers.gaussians import some
from safetensors.torch import save_file

from gamba_warp.cli import run
from gamba_warp.endurance.child import End, run_child
from gamba_warp.endurance.folders import age, contents, is_whole, leftovers, lost
from gamba_warp.endurance.jobs import jobs
from gamba_warp.endurance.released import SIZES, make_released
from gamba_warp.files import PART, output_folder
from gamba_warp.formats.gaussians.glb import save_glb
from gamba_warp.formats.ply import save_ply
from gamba_warp.images import save_image


def test_files_cut_short_are_not_whole(tmp_path):
    save_ply(tmp_path / "a.ply", some(9))
    save_glb(tmp_path / "a.glb", some(9))
    save_file({"a": torch.rand(3), "b": torch.rand(2, 2)}, tmp_path / "a.safetensors")
    save_image(tmp_path / "a.png", np.random.default_rng(0).random((9, 9, 3)))
    (tmp_path / "a.html").write_text("<p></p>\n</html>\n")
    (tmp_path / "a.json").write_text('{"a": 1}\n')
    (tmp_path / "a.csv").write_text("a\n")
    for name, data in contents(tmp_path).items():
        assert is_whole(name, data), name
        assert not is_whole(name, data[:-1]), name
        assert not is_whole(name, b""), name


def test_what_is_lost_is_missing_or_damaged():
    before = {"a.json": b"1\n", "b.json": b"2\n", "c.csv": b"x"}
    assert lost(before, before) == []
    assert lost(before, before | {"a.json": b"3\n", "d.json": b"4\n"}) == []
    assert lost(before, {"b.json": b"{", "c.csv": b"x", "d.json": b"["}) == [
        *("a.json", "b.json", "d.json")
    ]


def test_leftovers_are_told_from_results(tmp_path):
    part = tmp_path / "sub" / f"{PART}abcd1234"
    part.mkdir(parents=True)
    (part / "a.ply").touch()
    (tmp_path / ".lock").touch()
    (tmp_path / "sub" / "a.ply").touch()
    assert list(contents(tmp_path)) == ["sub/a.ply"] and leftovers(tmp_path) == [part]
    output_folder(tmp_path / "sub")
    assert part.exists()
    age(tmp_path)
    output_folder(tmp_path / "sub")
    assert not part.exists()


@pytest.mark.parametrize(
    "end, good",
    [
        (End(2, "gamba: cannot write a: full", 1, False), True),
        (End(1, "failed: a: cannot write a", 1, False), True),
        (End(1, "Traceback (most recent call last)\ngamba: a", 1, False), False),
        (End(-11, "gamba: a", 1, False), False),
        (End(1, "", 1, False), False),
    ],
)
def test_which_ends_are_told_in_one_line(end, good):
    assert end.is_one_line == good


def test_children_end_as_they_are_told(tmp_path):
    end = run_child(lambda: os.write(1, b"hello") and 3)
    assert (end.code, end.said) == (3, "hello")
    assert run_child(lambda: os.abort()).code == -6
    end = run_child(lambda: __import__("time").sleep(60), kill_after=0.1)
    assert end.killed and end.code == -9 and end.seconds < 5
    full = run_child(lambda: (tmp_path / "a").write_bytes(bytes(9999)) and 0, file_limit=5)
    assert full.code == 70 and "File too large" in full.said
    assert (tmp_path / "a").stat().st_size == 5


def test_unknown_commands_are_refused(tmp_path, capsys):
    assert run("endurance", ["--commands", "none", "--out", str(tmp_path / "out")]) == 2
    assert "--commands none: there are reconstruct, " in capsys.readouterr().err


def test_a_made_up_released_file_is_imported(tmp_path):
    make_released(tmp_path / "released")
    (job,) = [job for job in jobs(tmp_path) if job.name == "import-released"]
    assert run(job.name, [*map(str, job.words(tmp_path / "out"))]) == 0
    config = json.loads((tmp_path / "out" / "config.json").read_text())
    assert {name: config[name] for name in SIZES} == SIZES


@pytest.mark.slow
def test_a_quick_run_is_clean(tmp_path):
    # A process of its own: it forks, which a process that has computed with torch must not.
    command = [sys.executable, "-m", "gamba_warp", "endurance", "--quick", "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    counts = json.loads((tmp_path / "endurance.json").read_text())["counts"]
    assert {count["command"] for count in counts} == {"train", "reconstruct"}
    assert all(count["runs"] for count in counts) and "| train | SIGKILL |" in done.stdout
