"""Resources of the CUDA kernels: every kernel is found, read from its binary, and in bounds."""

import ast
import re
from pathlib import Path

import pytest
import torch
import warp as wp
from helpers.children import ran
from helpers.kernels import plain_kernel

from gamba_warp.kernels.runtime.views import view

from .cubin import read_cubin
from .dry_run import Launch, can_dry_run, dry_run
from .machine import compiled, cuda_tool
from .resources import MACHINES, compile_kernel, find_kernels, resident_warps

ROOT = Path(__file__).resolve().parents[2]

# op, kernel, case: registers of a thread, bytes of stack, bytes of shared memory of a block, warps
# that fit on a multiprocessor; about a tenth from what the compiler used when this was written.
# The stack of the scan's gradient holds the recomputed states, 16 x 8 floats, and 2 x 32 of its own
# tokens; the bilinear one and that of the last state spill a few on sm_80, the others none.
# The compositor's holds none.
BOUNDS = {
    ("scan", "scan_forward", "bfloat16"): (168, 0, 56000, 12),
    ("scan", "scan_forward", "float32"): (168, 0, 56000, 12),
    ("scan", "scan_forward", "bfloat16, in segments"): (168, 0, 56000, 12),
    ("scan", "scan_forward", "bfloat16, last state alone"): (120, 0, 21000, 16),
    ("scan", "scan_backward", "bfloat16"): (252, 840, 72000, 8),
    ("scan", "scan_backward", "float32"): (252, 840, 72000, 8),
    ("scan", "scan_backward", "bfloat16, bilinear"): (255, 880, 72000, 8),
    ("scan", "scan_backward", "bfloat16, last state alone"): (168, 880, 42000, 12),
    ("scan", "summarise_backward", "bfloat16, in segments"): (140, 0, 21000, 12),
    ("scan", "carry", "bfloat16, in segments"): (48, 0, 2000, 36),
    ("conv", "conv_forward", "bfloat16"): (128, 0, 2000, 16),
    ("conv", "conv_forward", "float32"): (128, 0, 2000, 16),
    ("conv", "conv_backward", "bfloat16"): (196, 0, 2000, 8),
    ("conv", "conv_backward", "float32"): (196, 0, 2000, 8),
    ("raster", "project", "32 views"): (80, 0, 2000, 24),
    ("raster", "project_vjp", "32 views"): (128, 0, 2000, 16),
    ("raster", "record", "32 views"): (48, 0, 2000, 40),
    ("raster", "count", "32 views"): (64, 0, 2000, 32),
    ("raster", "emit", "32 views"): (64, 0, 2000, 32),
    ("raster", "add_rows", "32 views"): (64, 0, 2000, 32),
    ("raster", "quantile", "depth of a transmittance"): (64, 0, 2000, 32),
    # a row of up to 75 coefficients is on its way at once
    ("raster", "harmonics", "harmonics of degree 3"): (96, 0, 2000, 16),
    ("raster", "harmonics", "harmonics of degree 4"): (96, 0, 2000, 16),
    ("raster", "harmonics_vjp", "harmonics of degree 3"): (88, 0, 2000, 16),
    ("raster", "harmonics_vjp", "harmonics of degree 4"): (80, 0, 2000, 24),
    ("raster", "composite", "32 views"): (80, 0, 3200, 24),
    ("raster", "composite", "1 view, a tile in quarters"): (80, 0, 3200, 24),
    ("raster", "composite", "32 views with depth"): (96, 0, 3200, 20),
    ("raster", "composite_vjp", "32 views"): (96, 0, 7600, 20),
    ("raster", "composite_vjp", "1 view, a tile in quarters"): (80, 0, 25000, 24),
    ("raster", "composite_vjp", "32 views with depth"): (128, 0, 7600, 16),
    ("raster", "composite_vjp", "32 views, gradients of colours alone"): (96, 0, 7600, 20),
}
# No registers of the scan of 16 sequences are spilled.
SPILL_FREE = {("scan", name, "bfloat16") for name in ("scan_forward", "scan_backward")}


@pytest.fixture(scope="module")
def listed():
    """Skip tests of the list of kernels where torch asks the driver for a GPU."""
    if not can_dry_run():
        pytest.skip(f"torch {torch.__version__} needs a GPU to list kernels")


@pytest.fixture(scope="module")
def entries(listed):
    return find_kernels()


@pytest.mark.parametrize("key", BOUNDS, ids=" ".join)
def test_a_kernel_is_in_its_bounds(entries, key):
    found = [e for e in entries if (e.op, e.name, e.case) == key]
    assert found, "no such kernel is launched"
    registers, stack, most_shared, warps = BOUNDS[key]
    for entry in found:
        for arch, (used, dynamic) in compile_kernel(entry.launch).items():
            shared = used.shared + dynamic
            fit = resident_warps(MACHINES[arch], entry.launch.block, used.registers, shared)
            assert 16 <= used.registers <= registers, (arch, used)
            most_stack = 0 if key[1] == "composite" and arch == 90 else stack
            assert used.frame <= most_stack, (arch, used)
            assert most_shared / 4 <= shared <= most_shared, (arch, shared)
            assert fit >= warps, (arch, fit)
            if key in SPILL_FREE:
                assert used.reloads == 0, (arch, used)


ON_THE_HOST = {"runtime/launch.py", "ssim/lanes.py"}  # a CPU launches these; no path says so


MAKERS = "native_kernel", "cuda_kernel"


def kernels_of_the_sources():
    """Names of the kernels in what a GPU runs: under ``@wp.kernel``, or of C++."""
    names = set()
    for path in (ROOT / "kernels").rglob("*.py"):
        inside = path.relative_to(ROOT / "kernels")
        if {"cpu", "bench"} & set(inside.parts) or inside.as_posix() in ON_THE_HOST:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                decorators = " ".join(map(ast.unparse, node.decorator_list))
                if "wp.kernel" in decorators:
                    names.add(node.name.lstrip("_"))
            elif isinstance(node, ast.Call) and ast.unparse(node.func) in MAKERS:
                if isinstance(name := node.args[0], ast.Constant):
                    names.add(name.value)
    return names


def test_a_dry_run_leaves_nothing_behind():
    """A description of memory that is not there would be taken for that of a like CPU tensor."""
    shape = (2, 77, 33)
    with dry_run():
        view(torch.empty(shape, device="cuda"))
    found = view(torch.ones(shape))
    assert tuple(found.shape)[:3] == shape and tuple(found.strides)[:3] == (77 * 33 * 4, 33 * 4, 4)


def test_no_kernel_is_forgotten(entries):
    assert {entry.name for entry in entries} == kernels_of_the_sources()
    launches = [entry.launch for entry in entries]
    assert len(set(launches)) == len(launches)


def test_the_choice_of_kernels_is_the_operators(entries):
    """Few sequences are cut into segments, few views into parts of tiles: other kernels."""
    names = {(entry.case, entry.name) for entry in entries}
    assert ("bfloat16, in segments", "summarise_backward") in names
    assert ("bfloat16", "summarise_backward") not in names
    composites = [e for e in entries if e.name == "composite"]
    assert len({e.launch.kernel for e in composites}) == len(composites) == 5
    assert {e.launch.block for e in composites} == {32}
    directions = {e.name: e.direction for e in entries if e.op != "scan"}
    of_gradients = "conv_backward composite_vjp project_vjp add_rows harmonics_vjp"
    assert {n for n, d in directions.items() if d == "gradient"} == {*of_gradients.split()}


# Known from NVIDIA's occupancy calculator.
@pytest.mark.parametrize(
    "arch, block, registers, shared, blocks",
    [
        (80, 256, 32, 0, 8),
        (80, 256, 33, 0, 6),  # 40 registers are allocated
        (80, 256, 64, 0, 4),
        (90, 128, 168, 0, 3),
        (90, 96, 168, 0, 4),  # 3 warps in each quarter
        (80, 1024, 255, 0, 0),
        (80, 32, 16, 0, 32),  # the most blocks
        (80, 1024, 16, 0, 2),  # the most warps
        (80, 128, 32, 48 << 10, 3),  # 49 KB of 164
        (90, 128, 32, 48 << 10, 4),  # of 228
        (90, 128, 32, 113 << 10, 2),
        (90, 128, 32, (113 << 10) + 1, 1),
    ],
)
def test_resident_warps(arch, block, registers, shared, blocks):
    found = resident_warps(MACHINES[arch], block, registers, shared)
    assert found == blocks * -(-block // 32)


Forty = wp.types.vector(40, wp.float32)


@wp.kernel(enable_backward=False, module="unique")
def table_kernel(index_in: wp.array[int], x_in: wp.array[float], x_out: wp.array[float]):
    """A table indexed at run time: it cannot be in registers."""
    i = wp.tid()
    table = Forty()
    for k in range(40):
        table[k] = x_in[i + k]
    x_out[i] = table[index_in[i]]


def test_local_memory_is_seen():
    table, plain = (compile_kernel(Launch(k, 64)) for k in (table_kernel, plain_kernel))
    for arch in MACHINES:
        used, dynamic = table[arch]
        assert used.frame >= 160 and used.reloads == dynamic == 0
        used, _ = plain[arch]
        assert used.frame == used.reloads == 0 and 4 <= used.registers <= 32


def test_a_disassembler_counts_the_same(entries):
    tool = cuda_tool("nvdisasm")
    if tool is None:
        pytest.skip("no nvdisasm")
    entry = next(e for e in entries if e.name == "scan_backward")
    used, _ = compile_kernel(entry.launch)[90]
    launch = entry.launch
    ((path, _),) = compiled(launch.kernel.module, launch.block, arch=90, use_ptx=False)
    done = ran(tool, "-c", path)
    assert done.returncode == 0, done.stderr
    loads = re.findall(r"^\s+/\*[0-9a-f]{4,}\*/.*\bLDL\b.*", done.stdout, re.MULTILINE)
    assert sum("[R1" in line and "[R1." not in line for line in loads) == used.reloads


@pytest.mark.parametrize("data", [b"", b"text", b"\x7fELF\x02" + bytes(100), b"\x7fELF\x02\x01"])
def test_no_cubin_is_an_error(data):
    with pytest.raises(ValueError, match="cubin"):
        read_cubin(data)
