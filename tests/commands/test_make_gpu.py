"""``make gpu`` on a machine with torch, numpy, warp-lang and pytest only; here on a CPU."""

import json
import os
import sys
from pathlib import Path

from helpers.children import ran

from gamba_warp.measure import __main__ as bench

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
    """The commands of the Makefile with all other packages hidden: the tests are skipped."""
    (tmp_path / "sitecustomize.py").write_text(HIDE.format(names=OTHERS))
    environment = os.environ | {"PYTHONPATH": str(tmp_path), "OMP_NUM_THREADS": "1"}
    environment["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    recipe = ran("make", "-n", "gpu", f"PYTHON={sys.executable}", cwd=ROOT).stdout
    on_cpu = recipe.replace("gamba_warp.measure", f"gamba_warp.measure cpu {tmp_path / 'out'}")
    done = ran("bash", "-c", on_cpu, cwd=ROOT, env=environment)
    assert done.returncode == 0, done.stderr + done.stdout
    assert "skipped" in done.stdout and "passed" not in done.stdout
    records = json.loads((tmp_path / "out" / "bench.json").read_text())["records"]
    assert {r["status"] for r in records} == {"ok"} and all(r["ms_p50"] > 0 for r in records)
    page = (tmp_path / "out" / "bench.md").read_text()
    assert "| default | B 1, L 1024, D 256, taps 4 | forward |" in page


def test_a_wrong_result_fails(monkeypatch, tmp_path, capsys):
    from gamba_warp.kernels.cases.case import Case

    call = Case.call
    monkeypatch.setattr(Case, "call", lambda *a, **k: call(*a, **k) * 1.001)
    assert bench.main("cpu", str(tmp_path)) == 1
    assert "conv: operator: default, forward: check failed" in capsys.readouterr().out
