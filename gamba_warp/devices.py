"""Device, precision, memory and threads of a command."""

from __future__ import annotations

import ctypes
import functools
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from .conventions import DeviceChoice, Precision
from .errors import UserError
from .kernels.runtime.system import cores

if TYPE_CHECKING:
    import torch

_TRIAL_SECONDS = 0.05
# On a GPU a product of fewer rows takes as long as its launch, in any precision.
_TRIAL_ROWS = {"cpu": 2048, "cuda": 1 << 16}
_FASTER = 1.2  # least speed-up for bfloat16: near 1 the choice would vary from run to run
_FLOAT32_ERROR = 1e-6  # relative rms error of a float32 product; rounded factors make it 2e-3
# Options of glibc's mallopt (malloc.h) with their values in bytes.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = (-1, 1 << 30), (-3, 256 << 20)


def pick_device(name: DeviceChoice) -> torch.device:
    """Return the device of the option ``--device``.

    Args:
        name: ``auto`` is CUDA if a device is available, else the CPU.

    Raises:
        UserError: CUDA is asked for and not available.
    """
    import torch

    if name == "cuda" and not torch.cuda.is_available():
        raise UserError("--device cuda: no CUDA device is available")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def share_cores() -> None:
    """Reduce OpenMP busy-waiting on a loaded machine.

    By default the threads of torch's CPU operators spin for milliseconds while they wait for each
    other. On a busy core that takes time from the thread they wait for: a mesh took five times as
    long beside a training on two cores (docs/reconstruct.md). Call it before torch is imported.
    Variables that the user has set win.
    """
    chosen = {"GOMP_SPINCOUNT", "OMP_WAIT_POLICY"} & {*os.environ}
    if chosen or "torch" in sys.modules:
        return
    if os.getloadavg()[0] > 0.5 * cores():
        os.environ["GOMP_SPINCOUNT"] = "1000"


def keep_memory() -> None:
    """Let glibc keep up to 1 GiB of freed memory.

    Otherwise glibc returns the tensors of torch's operators, of some MiB each, to the system at
    once, and the system clears each page at the next use (docs/lab/step.md has the cost per
    image). Results of our operators stay in the pool of ``kernels/runtime/memory.py``, in every
    program and also over 256 MiB, from where glibc returns blocks as before.

    The allocator is process-wide, so only commands call this; a program that runs the network often
    may do so too. Settings of the user by MALLOC_* or GLIBC_TUNABLES win.
    """
    chosen = [name for name in os.environ if name.startswith("MALLOC_")]
    if chosen or "GLIBC_TUNABLES" in os.environ or sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # other C libraries lack it
    if mallopt is not None:
        for option, value in (_TRIM_THRESHOLD, _MMAP_THRESHOLD):
            mallopt(ctypes.c_int(option), ctypes.c_int(value))


def quiet_warp() -> None:
    """Silence Warp's messages on start and on each module that it loads; warnings stay.

    Without a GPU, Warp's native code also reports a missing driver at its start; that line is
    filtered from stderr. The settings are process-wide, so only commands call this. A log level
    that was set before stays.
    """
    import torch
    import warp

    if warp.config.log_level == warp.LOG_INFO:
        warp.config.log_level = warp.LOG_WARNING
    if torch.cuda.is_available():
        return
    try:
        saved = os.dup(2)
    except OSError:  # stderr is closed, so the line would be lost
        return
    with tempfile.TemporaryFile() as held:
        os.dup2(held.fileno(), 2)
        try:
            warp.init()
        finally:
            os.dup2(saved, 2)
            os.close(saved)
        held.seek(0)
        lines = held.read().decode(errors="replace").splitlines(keepends=True)
    sys.stderr.write("".join(line for line in lines if "NVIDIA CUDA driver" not in line))


def pick_precision(name: Precision, device: torch.device, width: int) -> torch.dtype:
    """Return the dtype of the option ``--precision``.

    Args:
        name: ``auto`` is bfloat16 if a product of the model's size is at least 1.2 times as fast
            as in float32, else float32. The trial takes about 0.1 s, once per process; a processor
            without bfloat16 products is far below.
        device: of the model.
        width: channels of the model's tokens.

    Returns:
        ``torch.float32`` or ``torch.bfloat16``.
    """
    import torch

    if name != "auto":
        return {"float32": torch.float32, "bfloat16": torch.bfloat16}[name]
    faster = _bfloat16_speedup(str(device), width, torch.get_num_threads())
    return torch.bfloat16 if faster >= _FASTER else torch.float32


def precision_note(name: Precision, device: torch.device, width: int) -> str | None:
    """Return a line if ``--precision bfloat16`` takes longer than float32; arguments as above."""
    import torch

    if name != "bfloat16" or device.type != "cpu":
        return None
    faster = _bfloat16_speedup(str(device), width, torch.get_num_threads())
    if faster >= 1:
        return None
    return (
        f"bfloat16 takes {1 / faster:.1f} times as long as float32 on this processor; "
        "--precision auto chooses the faster one"
    )


@functools.cache
def _bfloat16_speedup(name: str, width: int, threads: int) -> float:
    """Return the speed-up of a product in bfloat16 over float32, by the fastest run of each."""
    import torch
    from torch.utils.benchmark import Timer

    device = torch.device(name)
    g = torch.Generator().manual_seed(0)  # leaves torch's global generator alone
    full = torch.randn(_TRIAL_ROWS[device.type], width, generator=g).to(device)
    matrix = torch.randn(width, 4 * width, generator=g).to(device)
    pairs = [(full, matrix), (full.bfloat16(), matrix.bfloat16())]
    best = []
    with torch.no_grad():
        for a, b in pairs:
            timer = Timer("a @ b", globals={"a": a, "b": b}, num_threads=threads)
            best.append(min(timer.blocked_autorange(min_run_time=_TRIAL_SECONDS).times))
    return best[0] / best[1]


@contextmanager
def float32_weights() -> Iterator[None]:
    """Create networks in float32 within the block, whatever torch's default dtype is.

    The operators take no float64, and random weights differ in it. The default dtype is
    process-wide, so other threads see float32 meanwhile.
    """
    import torch

    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def use_fastest_products() -> None:
    """Let torch compute float32 matrix products by the library that is fastest on this processor.

    - AMD with AVX-512 and without AMX: oneDNN. By default torch calls MKL, which does not use
      AVX-512 there and takes twice as long on a Zen 5. torch selects oneDNN by the setting
      "medium", which also permits factors rounded to bfloat16; without AMX oneDNN does not round
      them. A product is compared with float64; if its error is larger than float32's,
      nothing is changed.
    - Other CPUs: unchanged. MKL is made for Intel's.
    - Machines with a GPU: unchanged, since the setting would round factors there (TF32).

    The setting is process-wide, so only commands call this; a program may do so too.
    """
    import torch

    if not torch.cuda.is_available() and _onednn_is_better():
        torch.set_float32_matmul_precision("medium")


def network_precision(device: torch.device, precision: torch.dtype) -> torch.autocast:
    """Return the context in which a network's products have ``precision``.

    Args:
        device: of the network.
        precision: ``torch.bfloat16``, or ``torch.float32``, which disables an outer autocast.
    """
    import torch

    return torch.autocast(device.type, precision, enabled=precision != torch.float32)


@contextmanager
def float32_products() -> Iterator[None]:
    """Compute float32 matrix products in full precision, by torch's default library.

    A GPU does not round their factors (no TF32), whatever the process allows. The setting is
    process-wide. A later backward pass is not covered.
    """
    import torch

    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def _onednn_is_better() -> bool:
    """True on AMD with AVX-512 and without AMX, if oneDNN's products are exact to float32."""
    import torch

    known = getattr(torch.cpu, "get_capabilities", dict)()  # torch 2.6 lacks it
    amx = any(value for name, value in known.items() if name.startswith("amx"))
    amd = str(known.get("cpu_name", "")).startswith("AMD")
    if amx or not (amd and known.get("avx512_f")) or not torch.backends.mkldnn.is_available():
        return False
    a, b = torch.randn(2, 128, 128, generator=torch.Generator().manual_seed(0))
    gt = a.double() @ b.double()
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    try:
        error = (a @ b).double() - gt
    finally:
        torch.set_float32_matmul_precision(before)
    return bool(error.norm() <= _FLOAT32_ERROR * gt.norm())
