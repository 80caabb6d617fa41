"""Programs that import mamba_ssm, causal_conv1d and gsplat get our modules."""

import importlib.util
import sys

import pytest
import torch
from helpers.children import ran
from helpers.forked import python

from gamba_warp.compat import VERSIONS, causal_conv1d, gsplat, mamba_ssm, take_names
from gamba_warp.compat import __main__ as program

PROGRAM = """
import importlib.metadata, importlib.util, sys
import causal_conv1d, gsplat, mamba_ssm
import gsplat.cuda._wrapper as wrapper
from causal_conv1d.causal_conv1d_interface import causal_conv1d_fn
from gsplat.rendering import rasterization
from mamba_ssm.ops.selective_scan_interface import selective_scan_fn
from mamba_ssm.ops.triton.selective_state_update import selective_state_update

print(*sys.argv, __name__)
assert importlib.util.find_spec("mamba_ssm") and importlib.util.find_spec("gsplat.rendering")
print(*map(importlib.metadata.version, ("mamba-ssm", "causal_conv1d", "gsplat")))
assert selective_scan_fn is mamba_ssm.selective_scan_fn
assert causal_conv1d_fn is causal_conv1d.causal_conv1d_fn
assert rasterization is gsplat.rasterization
assert wrapper.isect_tiles is gsplat.isect_tiles
from gsplat.cuda_legacy._wrapper import num_sh_bases
from gsplat.optimizers import SelectiveAdam
assert gsplat.__version__ == "1.5.3" and num_sh_bases(2) == 9
ours = selective_scan_fn, selective_state_update, causal_conv1d_fn, rasterization
assert all(x.__module__.startswith("gamba_warp.") for x in ours)
try:
    mamba_ssm.Mamba2()
except NotImplementedError as error:
    print(error)
"""
# gsplat's own, where it is installed, over what takes its place.
OF_GSPLAT = """
import gsplat.strategy.ops as ops
from gsplat import MCMCStrategy, export_splats
from gsplat.compression import PngCompression
from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci

assert MCMCStrategy.__mro__[1].__module__ == "gsplat.strategy.mcmc"
assert PngCompression is gsplat.PngCompression
ours = ops.compute_relocation, ops.quat_scale_to_covar_preci
assert all(x.__module__ == "gamba_warp.compat.gsplat.relocation" for x in ours)
"""


def test_a_program_gets_our_interfaces_under_their_names(tmp_path):
    path = tmp_path / "client.py"
    path.write_text(PROGRAM + (OF_GSPLAT if importlib.util.find_spec("gsplat") else ""))
    done = ran(python(), "-m", "gamba_warp.compat", path, "--steps", 3)
    assert not done.returncode, done.stderr
    assert done.stdout.splitlines() == [
        f"{path} --steps 3 __main__",
        "2.3.2 1.7.0 1.5.3",
        "mamba-ssm's Mamba2 is not here: only its Mamba-1 is",
    ]


def test_a_module_runs_as_with_python(monkeypatch):
    """Own arguments, and the current folder first on the path."""
    calls = []
    monkeypatch.setattr(program, "take_names", lambda: calls.append("names"))
    monkeypatch.setattr(program.runpy, "run_module", lambda *x, **y: calls.append((sys.argv, x, y)))
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(sys, "argv", [])
    program.main(["-m", "client", "--steps", "3"])
    options = {"run_name": "__main__", "alter_sys": True}
    assert calls == ["names", (["client", "--steps", "3"], ("client",), options)]
    assert sys.path[0] == ""


def test_what_cannot_be_run_is_one_line(tmp_path):
    with pytest.raises(SystemExit) as ended:
        program.main([str(tmp_path / "none.py")])
    line, options = ended.value.code, "[--take NAMES] [--fork NAME]"
    assert line.startswith(f"python -m gamba_warp.compat {options} SCRIPT …")
    assert "\n" not in line and "none.py" in line


def test_names_are_refused(monkeypatch):
    """Refuse packages that are already imported, and unknown names, without any change."""
    monkeypatch.setitem(sys.modules, "causal_conv1d", object())
    known = {name: sys.modules.get(name) for name in ("mamba_ssm", "causal_conv1d", "gsplat")}
    for names, kind, text in (
        ((), ImportError, "causal_conv1d is already imported"),
        (("mamba_ssm", "causal_conv1d"), ImportError, "causal_conv1d is already imported"),
        (("flash_attn",), ValueError, "must be one of mamba_ssm, causal_conv1d, gsplat"),
    ):
        with pytest.raises(kind, match=text):
            take_names(*names)
    assert all(sys.modules.get(name) is module for name, module in known.items())


def test_names_of_older_versions():
    from gamba_warp.compat.gsplat.cuda_legacy._torch_impl import quat_to_rotmat
    from gamba_warp.compat.gsplat.cuda_legacy._wrapper import num_sh_bases
    from gamba_warp.compat.gsplat.optimizers.selective_adam import SelectiveAdam

    assert SelectiveAdam is gsplat.SelectiveAdam
    assert [num_sh_bases(degree) for degree in range(6)] == [1, 4, 9, 16, 25, 25]
    quarter = quat_to_rotmat(torch.tensor([[2.0, 0, 0, 2.0]]))  # about z
    assert torch.allclose(quarter, torch.tensor([[[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]]), atol=1e-6)
    packages = dict(gsplat=gsplat, mamba_ssm=mamba_ssm, causal_conv1d=causal_conv1d)
    assert VERSIONS.items() >= {name: x.__version__ for name, x in packages.items()}.items()
