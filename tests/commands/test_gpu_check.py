"""``python -m tests.gpu.check`` on a CPU, and on a machine without other packages."""

import json
import os
import subprocess
import sys
from pathlib import Path

from gpu import check

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
    environment = os.environ | {
        "PYTHONPATH": str(tmp_path),
        "OMP_NUM_THREADS": "1",
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
    }
    out = tmp_path / "out"
    words = ["-m", "tests.gpu.check", "--device", "cpu", "--out", out]
    done = subprocess.run(
        [sys.executable, *words], cwd=ROOT, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr + done.stdout
    assert f"tests: passed ({out / 'tests.txt'})" in done.stdout
    assert f"bench: passed ({out / 'bench.txt'})" in done.stdout
    skipped = (out / "tests.txt").read_text()
    assert "skipped" in skipped and "error" not in skipped
    records = json.loads((out / "bench.json").read_text())["records"]
    assert {r["status"] for r in records} == {"ok"} and all(r["ms_p50"] > 0 for r in records)
    assert "| default | forward |" in (out / "bench.md").read_text()


def test_all_tests_of_the_kernels_are_found():
    names = {path.name for path in check.test_files()}
    assert {"test_gpu.py", "test_machine.py", "test_rasterize_cuda.py"} <= names
    assert "test_doctor.py" not in names
