"""``python -m gamba_warp.gpu_check`` on a CPU: its parts, their end, and a machine without more."""

import json
import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest
import torch
from helpers.children import ran

from gamba_warp import gpu_check
from gamba_warp.gpu_check import main, run_part

ROOT = Path(__file__).resolve().parents[2]
HIDE = """
import functools
from importlib.machinery import PathFinder
find = PathFinder.find_spec
def hide(name, path=None, target=None):
    return None if name.split(".")[0] in {names!r} else find(name, path, target)
PathFinder.find_spec = functools.partial(hide)
"""
OTHERS = (
    *("tyro", "tqdm", "timm", "kornia", "safetensors", "PIL", "skimage", "scipy", "trimesh"),
    *("imageio", "imageio_ffmpeg", "open3d", "pymeshlab", "tensorboard", "torchvision"),
    *("msgspec", "filelock", "hypothesis", "gsplat", "playwright", "platformdirs"),
)


def test_torch_warp_and_pytest_are_enough(tmp_path):
    """A real run on a CPU with all other packages hidden: the tests of a GPU are skipped."""
    (tmp_path / "sitecustomize.py").write_text(HIDE.format(names=OTHERS))
    environment = os.environ | {"PYTHONPATH": str(tmp_path), "OMP_NUM_THREADS": "1"}
    environment["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    out = tmp_path / "out"
    words = ["-m", "gamba_warp.gpu_check", "--device", "cpu", "--out", out]
    done = ran(sys.executable, *words, cwd=ROOT, env=environment)
    assert done.returncode == 0, done.stderr + done.stdout
    assert f"tests: passed ({out / 'tests.txt'})" in done.stdout
    assert f"bench: passed ({out / 'bench.txt'})" in done.stdout
    skipped = (out / "tests.txt").read_text()
    assert "skipped" in skipped and "error" not in skipped
    records = json.loads((out / "bench.json").read_text())["records"]
    assert {r["status"] for r in records} == {"ok"} and all(r["ms_p50"] > 0 for r in records)
    assert "| default | B 1, L 1024, D 256, taps 4 | forward |" in (out / "bench.md").read_text()


@pytest.mark.parametrize(
    "arguments, reason",
    [([], "no CUDA device"), (["--device", "cpu", "--minutes", "0"], "--minutes 0.0")],
)
def test_nothing_to_start_is_one_line_and_code_2(monkeypatch, tmp_path, capsys, arguments, reason):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main([*arguments, "--out", str(tmp_path / "new")]) == 2
    said = capsys.readouterr().err
    assert said.startswith("gpu_check: ") and reason in said and said.count("\n") == 1
    assert not (tmp_path / "new").exists()


def test_a_wrong_result_fails(monkeypatch, tmp_path, capsys):
    from gamba_warp.kernels.cases.case import Case

    call = Case.call
    monkeypatch.setattr(Case, "call", lambda *a, **k: call(*a, **k) * 1.001)
    assert gpu_check.bench("cpu", str(tmp_path)) == 1
    assert "conv: operator: default, forward: check failed" in capsys.readouterr().out


@pytest.mark.parametrize("tests, bench, code", [(1, 1, 0), (0, 1, 1), (1, 0, 1)])
def test_both_parts_must_pass(monkeypatch, tmp_path, tests, bench, code):
    given = []

    def part(name, words, log, seconds):
        given.append((name, seconds))
        return bool({"tests": tests, "bench": bench}[name])

    monkeypatch.setattr(gpu_check, "run_part", part)
    assert main(["--device", "cpu", "--minutes", "2", "--out", str(tmp_path)]) == code
    assert [name for name, _ in given] == ["tests", "bench"]
    assert given[0][1] == 60 and 90 < given[1][1] <= 100  # less what a part may take to end


ANOTHER = """
import pathlib, subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
pathlib.Path(sys.argv[1]).write_text(str(child.pid))
time.sleep(60)
"""


def is_gone(number):
    stat = Path("/proc") / number / "stat"
    return not stat.exists() or stat.read_text().rsplit(")", 1)[1].split()[0] == "Z"


@pytest.mark.parametrize("how", ["interrupted", "late"])
def test_a_part_is_ended_with_what_it_started(tmp_path, capsys, how):
    number, words = tmp_path / "number", ("-c", ANOTHER, str(tmp_path / "number"))

    def interrupt():
        while not (number.exists() and number.read_text()):
            time.sleep(0.1)
        os.kill(os.getpid(), signal.SIGINT)

    if how == "interrupted":
        threading.Thread(target=interrupt, daemon=True).start()
        with pytest.raises(KeyboardInterrupt):
            run_part("x", words, tmp_path / "log", 60)
    else:
        started = time.time()
        assert not run_part("x", words, tmp_path / "log", 3)
        assert time.time() - started < 30
        assert "x: stopped after 3 s, failed with" in capsys.readouterr().out
    time.sleep(0.5)
    assert is_gone(number.read_text())
