"""A new process: what imports and first calls load, change, and say of the folder of kernels."""

import os
import subprocess
import sys
from pathlib import Path

from helpers.children import ran

IMPORTS = """
import os, sys
import warp
before = dict(vars(warp.config)), warp.Module._compile, warp.Module.load
handles = os.listdir("/proc/self/fd") if os.path.isdir("/proc/self/fd") else []
import gamba_warp.kernels.bench, gamba_warp.kernels.causal_conv1d, gamba_warp.kernels.rasterize
import gamba_warp.kernels.runtime.launch, gamba_warp.kernels.selective_scan
import gamba_warp.kernels.ssim, gamba_warp.model.gamba, gamba_warp.vision.lpips
assert (dict(vars(warp.config)), warp.Module._compile, warp.Module.load) == before
assert not handles or os.listdir("/proc/self/fd") == handles
"""
CALLS = """
import torch
from gamba_warp.kernels import causal_conv1d
causal_conv1d(torch.randn(1, 7, 5), torch.randn(5, 4))
"""

COMPILER = """
import sys
import torch
from gamba_warp.kernels import causal_conv1d

x, weight = torch.randn(1, 7, 5), torch.randn(5, 4, requires_grad=True)
plain = causal_conv1d(x, weight)
plain.sum().backward()
assert "torch._dynamo" not in sys.modules, "the first call has imported torch's compiler"

def layer(x):
    return causal_conv1d(torch.sin(x), weight).cos()

eager = layer(x)
compiled = torch.compile(layer, fullgraph=True, backend="aot_eager")
assert torch.equal(compiled(x), eager)
# Once the compiler is there, it passes over the operator's body as for every operator of torch.
torch._dynamo.reset()
torch._dynamo.utils.counters.clear()
assert torch.equal(torch.compile(layer, backend="eager")(x), eager)
assert not torch._dynamo.utils.counters["graph_break"]
assert torch.equal(causal_conv1d(x, weight), plain)
print("done")
"""


def python(program: str, **environment: str) -> subprocess.CompletedProcess:
    """Run code in a new process."""
    return ran(sys.executable, "-c", program, env=os.environ | environment)


def test_imports_leave_warp_as_it_is():
    done = python(IMPORTS)
    assert done.returncode == 0 and done.stdout == done.stderr == "", done.stderr


def test_a_folder_of_kernels_that_cannot_be_made_is_one_line(tmp_path):
    """A file is in its place, so that it cannot be made by root either."""
    home = tmp_path / "home"
    home.touch()
    done = python(CALLS, WARP_CACHE_PATH=str(home / "kernels"))
    last = done.stderr.splitlines()[-1]
    assert done.returncode == 1 and str(home) in last, done.stderr
    assert "WARP_CACHE_PATH names another folder" in last


def test_a_kernel_that_cannot_be_kept_is_one_line(tmp_path):
    """Below the folder of this version of Warp nothing can be made."""
    program = "import os, pathlib, warp\nwarp.init()\n"
    program += "made = pathlib.Path(warp.config.kernel_cache_dir)\nmade.rmdir()\nmade.touch()\n"
    done = python(program + CALLS, WARP_CACHE_PATH=str(tmp_path / "kernels"))
    last = done.stderr.splitlines()[-1]
    assert done.returncode == 1 and str(Path("kernels")) in last, done.stderr
    assert "WARP_CACHE_PATH names another folder" in last


def test_an_operator_loads_no_compiler_and_compiles_when_asked():
    done = python(COMPILER)
    assert done.returncode == 0 and done.stdout.endswith("done\n"), done.stderr
