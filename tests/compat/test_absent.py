"""Missing names of other packages: importable, an error of one line on use, and documented."""

import importlib
import runpy
import sys
import types
from typing import Optional

import pytest
import torch

from gamba_warp.compat import causal_conv1d, gsplat, mamba_ssm

PACKAGES = {"gsplat": gsplat, "mamba": mamba_ssm, "causal_conv1d": causal_conv1d}
NAMES = [
    pytest.param(package, path, names, id=f"{key}.{path}")
    for key, package in PACKAGES.items()
    for path, names in package.ABSENT.items()
]


@pytest.mark.parametrize("package, path, names", NAMES)
def test_each_is_imported_and_says_so_when_used(package, path, names):
    module = f"{package.__name__}.{path}".rstrip(".")
    space: dict = {}
    exec(f"from {module} import {', '.join(names)}\nimport {module}", space)
    for name in names:
        absent = space[name]
        assert Optional[absent] == absent | None  # noqa: UP045
        uses = (
            lambda: absent(1, device="cpu"),  # noqa: B023
            lambda: isinstance("", (int, absent)),  # noqa: B023
            lambda: issubclass(torch.nn.Linear, absent),  # noqa: B023
            lambda: type("Mine", (torch.nn.Module, absent), {}),  # noqa: B023
            lambda: absent.from_pretrained,  # noqa: B023
        )
        for use in uses:
            with pytest.raises(NotImplementedError, match=f"^.*'s {name} is not here: .*$"):
                use()


@pytest.mark.parametrize(
    "line",
    [
        "from gamba_warp.compat.gsplat import rasterization_3dgs",
        "from gamba_warp.compat.gsplat.compression import rasterization",
        "from gamba_warp.compat.mamba_ssm import Mamba4",
        "from gamba_warp.compat.mamba_ssm.modules.mamba2 import Mamba3",
        "import gamba_warp.compat.mamba_ssm.modules.mamba4",
        "import gamba_warp.compat.causal_conv1d.cpp_functions.more",
    ],
)
def test_what_the_original_lacks_too_is_an_import_error(line):
    with pytest.raises(ImportError):
        exec(line)


GUARDED = """
def late():
    {head}
        from {package} import {name}
    {handler}
        {name} = None
    return {name}
{body}
"""
BODY = "{head}\n    from {package} import {name}\n{handler}\n    {name} = None"


@pytest.mark.parametrize(
    "path, name",
    [
        ("mamba_ssm", "Mamba2"),
        ("mamba_ssm.modules.mamba2", "Mamba2"),
        ("gsplat", "accumulate_2dgs"),
    ],
)
@pytest.mark.parametrize(
    "head, handler, missing",
    [
        ("try:", "except ImportError:", True),
        ("try:", "except (AttributeError, ModuleNotFoundError) as error:", True),
        ("try:", "except Exception:", True),
        ("try:", "except:", True),
        ("try:", "except AttributeError:", False),
        ("try:", "finally:", None),
        ("if True:", "else:", False),
    ],
)
def test_a_name_is_an_import_error_where_the_program_catches_it(
    tmp_path, path, name, head, handler, missing
):
    """At a module's top and in a function, from a package and from a module."""
    words = {"head": head, "handler": handler, "package": f"gamba_warp.compat.{path}", "name": name}
    client = tmp_path / "client.py"
    client.write_text(GUARDED.format(**words, body=BODY.format(**words)))
    space = runpy.run_path(str(client))
    for found in (space[name], space["late"]()):
        if missing is None:
            assert found is None, "the finally clause follows an import that worked"
        else:
            assert (found is None) == missing


def test_the_import_error_says_what_is_missing(tmp_path):
    client, package = tmp_path / "client.py", mamba_ssm.__name__
    guarded = f"try:\n from {package} import (Mamba,\n  Mamba2)\n"
    client.write_text(guarded + "except ImportError as e:\n text = str(e)")
    space = runpy.run_path(str(client))
    assert space["text"] == "mamba-ssm's Mamba2 is not here: only its Mamba-1 is"


def test_names_that_are_here_are_so_under_every_path():
    wrapper = importlib.import_module("gamba_warp.compat.gsplat.cuda._wrapper")
    assert wrapper.rasterize_to_pixels is gsplat.rasterize_to_pixels
    assert gsplat.cuda._wrapper is wrapper


def test_nothing_of_gsplat_is_missing():
    """Public names of the package that is installed."""
    pytest.importorskip("gsplat", reason="needs the package gsplat (pip install gsplat==1.5.3)")
    for path in ("", "rendering", "utils", "cuda._wrapper", "distributed", "optimizers"):
        theirs = importlib.import_module(f"gsplat.{path}".rstrip("."))
        ours = importlib.import_module(f"{gsplat.__name__}.{path}".rstrip("."))
        public = {k: x for k, x in vars(theirs).items() if callable(x) and k[0] != "_"}
        names = {k for k, x in public.items() if path == "" or x.__module__ == theirs.__name__}
        assert {name for name in names if not hasattr(ours, name)} == set()


def test_a_guard_around_the_import_of_another_module(tmp_path, monkeypatch):
    """Takes its other way where one that is imported there lacks a name."""
    layers = "from gamba_warp.compat.mamba_ssm import Mamba2\n\nclass Mine:\n    pass\n"
    (tmp_path / "own_layers.py").write_text(layers)
    (tmp_path / "own_models.py").write_text("from own_layers import Mine\n")
    monkeypatch.syspath_prepend(tmp_path)
    words = {"head": "try:", "handler": "except ImportError:", "package": "own_models"}
    path = tmp_path / "client.py"
    path.write_text(BODY.format(**words, name="Mine") + "\nimport own_layers\n")
    space = runpy.run_path(str(path))
    assert space["Mine"] is None and space["own_layers"].Mine is not None


@pytest.mark.parametrize("argument", [{"bimamba": True}, {"nslices": 64}, {"bimamba_type": "v3"}])
def test_arguments_of_forks_name_the_way_out(argument):
    (name,) = argument
    line = f"^{name} is .*, which is not supported: a fork's own layer file runs .*drop-ins.md"
    with pytest.raises((TypeError, ValueError), match=line):
        mamba_ssm.Mamba(8, **argument)


def test_names_of_later_gsplat():
    from typing import get_args

    assert gsplat.has_3dgs() and not gsplat.has_2dgs() and not gsplat.has_losses()
    assert get_args(gsplat.RasterizeMode) == ("classic", "antialiased")
    assert get_args(gsplat.CameraModel) == ("pinhole",) and "ED" in get_args(gsplat.RenderMode)
    from gamba_warp.compat.gsplat.cuda._wrapper import CameraModel  # as gsplat 1.6 has it

    assert CameraModel is gsplat.CameraModel


def test_losses_are_an_installed_gsplats(monkeypatch):
    made = types.ModuleType("gsplat.losses")
    vars(made)["l1_loss"] = abs
    monkeypatch.setitem(sys.modules, "gsplat", types.ModuleType("gsplat"))
    monkeypatch.setitem(sys.modules, "gsplat.losses", made)
    from gamba_warp.compat.gsplat import l1_loss

    assert l1_loss is abs
