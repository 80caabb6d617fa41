"""Allowed imports between packages (docs/architecture/packages.py)."""

import configparser
from pathlib import Path

import pytest
from architecture.imports import modules, read_imports
from architecture.packages import PACKAGES, circle, edges, package_of, refused

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def entries():
    """All imports of the checkout."""
    return read_imports(ROOT)


def _refusals(folder: Path, files: dict[str, str]) -> list[str]:
    """Return the violations in a small made-up checkout."""
    for name, text in {"gamba_warp/__init__.py": "", **files}.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return [*filter(None, map(refused, read_imports(folder)))]


def test_imports(entries):
    refusals = [*filter(None, map(refused, entries))]
    assert not refusals, "\n".join(refusals)


def test_no_circles(entries):
    assert not circle(edges(entries, by_package=True)), "packages"
    assert not circle(edges(entries, by_package=False)), "files"


def test_the_table_has_no_circle():
    allowed = {name: {*package.may, *package.later} for name, package in PACKAGES.items()}
    assert not circle(allowed)
    assert {there for packages in allowed.values() for there in packages} <= set(PACKAGES)


def test_every_package_is_there():
    found = {package_of(module) for module in modules(ROOT)}
    assert found == set(PACKAGES)


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        ("kernels/rasterize/a.py", "from gamba_warp.files import x", "may import core not"),
        ("kernels/rasterize/a.py", "from ..selective_scan import x", "kernels.selective_scan not"),
        ("kernels/runtime/a.py", "import kornia", "kernels import only"),
        ("kernels/runtime/a.py", "try:\n    import kornia\nexcept: ...", "kernels import only"),
        ("kernels/rasterize/cuda/a.py", "from ..cpu import b", "code of one device"),
        ("kernels/rasterize/reference.py", "from . import function", "shares only constants"),
        ("kernels/cases/a_oracle.py", "from ..rasterize import function", "only constants"),
        ("kernels/cases/a.py", "from ..bench import scan", "kernels.bench not"),
        ("gamba_warp/files.py", "import kernels.rasterize", "write gamba_warp.kernels"),
        ("gamba_warp/files.py", "from .model import gamba", "may import model not"),
        ("gamba_warp/files.py", "import open3d", "only inside functions"),
        ("gamba_warp/files.py", "if 1:\n    import pymeshlab.x", "only inside functions"),
        ("gamba_warp/data/a.py", "def f():\n    from ..model import gamba", "may import model not"),
        ("gamba_warp/data/a.py", "class A:\n    from ..model import gamba", "may import model not"),
        ("gamba_warp/model/a.py", "from ..data.layouts import _read", "_read is private"),
        ("gamba_warp/pages/a.py", "from .. import commands", "may import commands not"),
        ("gamba_warp/pages/a.py", "from ..commands import view", "may import commands not"),
        ("gamba_warp/measure/a.py", 'T = "gamba_warp.train.loop"', "may import train not"),
        ("gamba_warp/measure/a.py", 'T = "gamba_warp.train.loop:run"', "may import train not"),
        ("gamba_warp/measure/a.py", 'T = f"gamba_warp.train.{x}"', "may import train not"),
        ("gamba_warp/measure/a.py", 'load("..train.loop", __package__)', "may import train not"),
        ("gamba_warp/commands/a.py", "from ..train import loop", "only inside functions"),
        ("gamba_warp/commands/b.py", "from ..cli import run", "may import cli not"),
        ("gamba_warp/cli.py", "from .commands import view", "only inside functions"),
        ("gamba_warp/__init__.py", "from .model import gamba", "only inside functions"),
        ("gamba_warp/__init__.py", 'T = {"x": "commands.view"}', "may import commands not"),
        ("train/a.py", "from gamba_warp.eval import report", "may import eval not"),
        ("train/a.py", "def f():\n    from gamba_warp.commands import view", "commands not"),
        ("eval/a.py", "from gamba_warp.train import loop", "may import train not"),
        ("eval/a.py", "from gamba_warp import __version__", "may import public not"),
    ],
)
def test_each_rule_can_fail(tmp_path, name, text, reason):
    there = ("train/loop.py", "eval/report.py", "gamba_warp/commands/view.py", "gamba_warp/cli.py")
    there += ("gamba_warp/files.py", "gamba_warp/model/gamba.py", "gamba_warp/data/layouts.py")
    there += ("kernels/rasterize/function.py", "kernels/rasterize/cpu/b.py")
    there += ("kernels/selective_scan/__init__.py", "kernels/bench/scan.py")
    files = dict.fromkeys((*there, "train/__init__.py", "gamba_warp/commands/__init__.py"), "")
    refusals = _refusals(tmp_path, {**files, "eval/__init__.py": "", name: text})
    assert len(refusals) == 1
    assert reason in refusals[0]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("gamba_warp/files.py", "def f():\n    import open3d"),
        ("gamba_warp/data/a.py", '"""gamba_warp.model.gamba"""'),
        ("gamba_warp/data/a.py", 'FORMAT = "gamba_warp.model.1"'),
        ("gamba_warp/pages/a.py", "from ..model.gamba import Gamba"),
        ("gamba_warp/cli.py", 'T = f"gamba_warp.commands.{x}"'),
        ("gamba_warp/cli.py", "import os, tyro\nfrom .errors import UserError"),
        ("kernels/rasterize/a.py", "import numpy, warp\nfrom ..runtime import launch"),
    ],
)
def test_what_is_allowed(tmp_path, name, text):
    there = ("gamba_warp/errors.py", "gamba_warp/model/gamba.py", "kernels/runtime/launch.py")
    files = dict.fromkeys((*there, "gamba_warp/commands/__init__.py"), "")
    assert _refusals(tmp_path, {**files, name: text}) == []


def test_an_unlisted_folder_is_refused(tmp_path):
    with pytest.raises(KeyError, match="is in no package"):
        _refusals(
            tmp_path, {"gamba_warp/attic/a.py": "from .b import x", "gamba_warp/attic/b.py": ""}
        )


def test_circles_are_seen(tmp_path):
    def found(by_package, **files):
        _refusals(tmp_path, {f"gamba_warp/{name}.py": text for name, text in files.items()})
        return {*circle(edges(read_imports(tmp_path), by_package))}

    here = {"gamba_warp.a", "gamba_warp.b"}
    assert found(False, a="from .b import x", b="from . import a") == here
    for later in ("def f():\n    from . import a", "if TYPE_CHECKING:\n    from .a import x"):
        assert found(False, a="from .b import x", b=later) == here
    assert not found(False, a="from .b import x", b="import torch")
    files = {"data/a": "from ..model import b", "model/b": 'T = "gamba_warp.data.a"'}
    assert found(True, **files) == {"data", "model"}
    assert not found(False, **files)


def test_every_package_is_listed():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    listed = set(config["options"]["packages"].split())
    found = {name for name, path in modules(ROOT).items() if path.name == "__init__.py"}
    assert listed == found | {"gamba_warp.starter"}  # the shipped model: files, and no code
    folders = {path.parent for path in modules(ROOT).values()}
    assert all((folder / "__init__.py").is_file() for folder in folders), "code outside a package"
