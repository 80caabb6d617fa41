"""Public names: each is the right object, for any order of imports."""

import ast
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.children import ran
from helpers.forked import python

import gamba_warp
from gamba_warp import kernels
from gamba_warp.images import load_rgba, save_image
from gamba_warp.model.checkpoint import load_model
from gamba_warp.model.predict import reconstruct

ROOT = Path(__file__).resolve().parents[2]
# Modules and packages that have the name of a function beside them.
BESIDE = ("gamba_warp.render", "gamba_warp.kernels.selective_scan.reference",
          "gamba_warp.kernels.causal_conv1d.autograd", "gamba_warp.kernels.rasterize")  # fmt: skip


def run(code: str, program: str = sys.executable) -> str:
    """Return the output of a fresh Python."""
    done = ran(program, "-c", code, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("package", [gamba_warp, kernels], ids=lambda p: p.__name__)
def test_every_public_name_is_there_and_listed(package):
    assert list(package.__all__) == sorted(package.__all__)
    for name in package.__all__:
        assert getattr(package, name) is not None
        assert name in dir(package)
    with pytest.raises(AttributeError, match="no_such_name"):
        package.no_such_name  # noqa: B018


def test_importing_the_packages_is_light():
    heavy = {"torch", "warp", "numpy", "tyro"}
    code = f"import sys, gamba_warp, gamba_warp.kernels; print({heavy} & {{*sys.modules}})"
    assert run(code).strip() == "set()"


def test_a_module_does_not_hide_a_function():
    """Each order of imports in a process of its own, forked after torch and Warp are loaded."""
    names = "from gamba_warp import render\nfrom gamba_warp.kernels import *"
    code = """
import gamba_warp, gamba_warp.kernels as kernels
for name in ("selective_scan", "causal_conv1d", "rasterization", "render"):
    assert type(globals()[name]).__name__ == "function", name
assert render is gamba_warp.render and selective_scan is kernels.selective_scan
from gamba_warp.render import Rendering
from gamba_warp.kernels.selective_scan import reference
from gamba_warp.kernels.causal_conv1d import autograd
assert reference.selective_scan_reference
assert autograd.__name__.endswith("causal_conv1d.autograd")
"""
    orders = []
    for module in BESIDE:
        modules = f"import {module}\nimport gamba_warp.measure.models"
        for order in ((modules, names, modules), (names, modules, names)):
            orders.append("\n".join([*order, code]))
    forks = """
import os
for code in {!r}:
    child = os.fork()
    if child == 0:
        exec(code, dict(__name__="__main__"))
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0, code
print("right")
"""
    assert run(forks.format(orders), python()).strip() == "right"


def test_a_image_may_be_a_file_or_an_array(tmp_path):
    rgba = np.zeros((30, 30, 4), np.float32)
    rgba[3:27, 3:27] = (0.8, 0.3, 0.1, 1)  # as ``prepare`` leaves it
    save_image(tmp_path / "a.png", rgba)
    model = load_model()
    want = reconstruct(model, load_rgba(tmp_path / "a.png"))
    for path in (tmp_path / "a.png", str(tmp_path / "a.png")):
        got = reconstruct(model, path)
        assert np.array_equal(got.means.numpy(), want.means.numpy())
    for shape in ((30, 30, 3), (30, 20, 4), (30, 30)):
        with pytest.raises(ValueError, match=re.escape(f"image has shape {shape}")):
            reconstruct(model, np.zeros(shape))


@pytest.mark.parametrize("package", [gamba_warp, kernels], ids=lambda p: p.__name__)
def test_editors_are_told_what_is_loaded(package):
    body = ast.parse(Path(package.__file__).read_text()).body
    typing = [n for n in body if isinstance(n, ast.If) and "TYPE_CHECKING" in ast.unparse(n.test)]
    typed = {name.name: "." + n.module for n in typing[0].body for name in n.names}
    calls = [n.value for n in body if isinstance(n, ast.Expr) and isinstance(n.value, ast.Call)]
    (loaded,) = [ast.literal_eval(c.args[1]) for c in calls if "load_when_used" in ast.unparse(c)]
    assert typed == loaded and set(package.__all__) - {"__version__"} == set(loaded)
