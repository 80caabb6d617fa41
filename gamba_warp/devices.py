"""The device that a command computes on, and how it shares the cores."""

from __future__ import annotations

import ctypes
import functools
import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING

from .conventions import DeviceChoice, Precision
from .errors import UserError
from .kernels.runtime.system import cores

if TYPE_CHECKING:
    import torch

_TRIAL_SECONDS, _TRIAL_ROWS = 0.05, 2048
_FASTER = 1.2  # how much faster bfloat16 must be: a choice on the edge would change from run to run
_ALL_DIGITS = 1e-6  # relative rms error of a product of float32; rounded factors make it 2e-3
# Options of glibc's mallopt, and their values: what is kept free, and the size from which a block
# is mapped by itself.
_KEEP, _MAPPED = (-1, 1 << 30), (-3, 256 << 20)


def pick_device(name: DeviceChoice) -> torch.device:
    """The device of the option ``--device``.

    Args:
        name: ``auto`` is CUDA where there is a device, else the CPU.

    Raises:
        UserError: CUDA is asked for and is not there.
    """
    import torch

    if name == "cuda" and not torch.cuda.is_available():
        raise UserError("--device cuda: no CUDA device is available")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def share_cores() -> None:
    """Lets threads that wait sleep at once, where other programs use the cores too.

    By default the threads of torch's CPU operators turn in a loop for milliseconds while they wait
    for each other. Where a core is not free, that takes the time of the thread that is waited for:
    a mesh took five times as long beside a training on two cores (docs/pace.md). It must be called
    before torch is imported, and leaves what the user has set as it is.
    """
    chosen = {"GOMP_SPINCOUNT", "OMP_WAIT_POLICY"} & {*os.environ}
    if chosen or "torch" in sys.modules or not hasattr(os, "getloadavg"):
        return
    if os.getloadavg()[0] > 0.5 * cores():
        os.environ["GOMP_SPINCOUNT"] = "1000"


def keep_memory() -> None:
    """Lets the process keep the memory that it frees, up to 1 GiB, where glibc gives it.

    It is for the tensors of torch's own operators. Their blocks of some MiB are otherwise given
    back at once, and the system clears each page again at the next use (docs/lab/step.md says what
    that costs a picture). The results of our operators do not need it: the pool of
    ``kernels/runtime/memory.py`` keeps them in every program, also those over 256 MiB, which glibc
    gives back as before.

    It changes the allocator of the whole process, so only commands call it; a program that runs the
    network often may do so too. What the user has set by MALLOC_* or GLIBC_TUNABLES stays.
    """
    chosen = [name for name in os.environ if name.startswith("MALLOC_")]
    if chosen or "GLIBC_TUNABLES" in os.environ or sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # other C libraries have none
    if mallopt is not None:
        for option, value in (_KEEP, _MAPPED):
            mallopt(ctypes.c_int(option), ctypes.c_int(value))


def quiet_warp() -> None:
    """Has Warp say its warnings alone, and not its start and each module that it loads.

    Where there is no GPU, its start also says that no driver was found: that line, which Warp's own
    machine code writes, is held back. These are settings of the whole process, so only commands
    call this; a level that somebody chose stays.
    """
    import torch
    import warp

    if warp.config.log_level == warp.LOG_INFO:
        warp.config.log_level = warp.LOG_WARNING
    if torch.cuda.is_available():
        return
    try:
        saved = os.dup(2)
    except OSError:  # stderr is closed, so nobody would see the line
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
    """The dtype of the option ``--precision``.

    Args:
        name: ``auto`` is bfloat16 where a product of the model's size is at least 1.2 times as
            fast in it as in float32 (``network_products``), else float32. The trial takes about
            0.1 s once a process; a processor without bfloat16 products fails it by far.
        device: where the model computes.
        width: channels of the model's tokens.

    Returns:
        ``torch.float32`` or ``torch.bfloat16``.
    """
    import torch

    if name != "auto":
        return {"float32": torch.float32, "bfloat16": torch.bfloat16}[name]
    faster = _gain_of_bfloat16(str(device), width, torch.get_num_threads())
    return torch.bfloat16 if faster >= _FASTER else torch.float32


@functools.cache
def _gain_of_bfloat16(name: str, width: int, threads: int) -> float:
    """How many times as fast a product is in bfloat16 as in float32, by the fastest of each."""
    import torch
    from torch.utils.benchmark import Timer

    device = torch.device(name)
    g = torch.Generator().manual_seed(0)  # the state of torch's own chance belongs to the caller
    full = torch.randn(_TRIAL_ROWS, width, generator=g).to(device)
    matrix = torch.randn(width, 4 * width, generator=g).to(device)
    pairs = [(full, matrix), (full.bfloat16(), matrix.bfloat16())]
    best = []
    with torch.no_grad(), network_products(device):
        for a, b in pairs:
            timer = Timer("a @ b", globals={"a": a, "b": b}, num_threads=threads)
            best.append(min(timer.blocked_autorange(min_run_time=_TRIAL_SECONDS).times))
    return best[0] / best[1]


class _Products:
    """How many threads are inside each of the two settings below; before them all, torch's own.

    torch has one setting for the whole process.
    """

    lock = threading.Lock()
    network = float32 = 0
    before = "highest"


def _count(network: int = 0, float32: int = 0) -> None:
    """Counts threads that come or go, and sets what those that are left need."""
    import torch

    with _Products.lock:
        if not (_Products.network or _Products.float32):
            _Products.before = torch.get_float32_matmul_precision()
        _Products.network += network
        _Products.float32 += float32
        wanted = "medium" if _Products.network else _Products.before
        torch.set_float32_matmul_precision("highest" if _Products.float32 else wanted)


@contextmanager
def float32_weights() -> Iterator[None]:
    """Networks that are made inside are of float32, whatever torch's default dtype is.

    The operators take no float64, and random weights are drawn otherwise in it. The default is the
    process's: where it is another, other threads see this one meanwhile.
    """
    import torch

    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextmanager
def network_products(device: torch.device, precision: torch.dtype | None = None) -> Iterator[None]:
    """Matrix products inside are those of a network: in ``precision``, by the fastest library.

    What it does to products of float32 depends on the processor:

    - AMD with AVX-512, without AMX: oneDNN makes them. torch gives them to MKL, which makes no use
      of AVX-512 there and takes twice as long on a Zen 5. torch's setting for oneDNN is "medium",
      which also allows it to round the factors to bfloat16; without AMX nothing is to be gained by
      that, and all digits are kept. Once a process a product is compared with float64, and where
      its error is not that of float32, nothing is changed.
    - Other CPUs: nothing. Intel's are those that MKL is made for.
    - A GPU: nothing. It rounds the factors (TF32) where the process lets it.

    Products of bfloat16 are torch's autocast, on every processor. Inside ``float32_products``, of
    whichever thread, and inside torch.compile the library stays as it is. What autograd computes
    later is outside, unless ``backward`` is called inside too.

    Args:
        device: where the network computes.
        precision: ``torch.bfloat16``, or ``torch.float32``, which also ends an autocast of the
            caller inside; None leaves an autocast as it is.
    """
    import torch

    cast = nullcontext()
    if precision is not None:
        cast = torch.autocast(device.type, precision, enabled=precision != torch.float32)
    with cast:
        if device.type != "cpu" or torch.compiler.is_compiling() or not _onednn_is_better():
            yield
            return
        _count(network=1)
        try:
            yield
        finally:
            _count(network=-1)


@contextmanager
def float32_products() -> Iterator[None]:
    """Matrix products of float32 inside keep all digits, and are made by torch's own library.

    - A GPU does not round their factors (no TF32), whatever the process lets it do otherwise.
    - A CPU makes them by MKL, or what else torch was built with: ``network_products`` changes
      nothing inside. That is for comparisons; it loses no digits either.

    What autograd computes later is outside.
    """
    _count(float32=1)
    try:
        yield
    finally:
        _count(float32=-1)


@functools.cache
def _onednn_is_better() -> bool:
    """Whether this is such a processor, and oneDNN's products have all digits."""
    import torch

    known = getattr(torch.cpu, "get_capabilities", dict)()  # torch 2.6 does not say
    amx = any(value for name, value in known.items() if name.startswith("amx"))
    amd = str(known.get("cpu_name", "")).startswith("AMD")
    if amx or not (amd and known.get("avx512_f")) or not torch.backends.mkldnn.is_available():
        return False
    a, b = torch.randn(2, 128, 128, generator=torch.Generator().manual_seed(0))
    truth = a.double() @ b.double()
    # The caller's autocast would round this product, and all later ones would be MKL's.
    with _Products.lock, torch.autocast("cpu", enabled=False):
        before = torch.get_float32_matmul_precision()
        torch.set_float32_matmul_precision("medium")
        try:
            error = (a @ b).double() - truth
        finally:
            torch.set_float32_matmul_precision(before)
    return bool(error.norm() <= _ALL_DIGITS * truth.norm())
