"""The bridge between torch and Warp: checked views without copies, and launches.

On the CPU a launch is cut along its first dimension and run on as many threads as torch's own
operators, by ``team.py`` on the very same ones. On CUDA it goes to torch's current stream. Nothing
here synchronises.
"""

from __future__ import annotations

import ctypes
import os
import sys
import tempfile
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import torch
import warp as wp
from torch import Tensor

from . import team

if wp.config.log_level == wp.LOG_INFO:  # the default; a level that somebody chose stays
    wp.config.log_level = wp.LOG_WARNING


def _start_without_gpu() -> None:
    """Starts Warp, holding back its native note on a missing CUDA driver: a CPU is no fault."""
    try:
        saved = os.dup(2)
    except OSError:  # stderr is closed: nobody to spare
        return wp.init()
    with tempfile.TemporaryFile() as held:
        os.dup2(held.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(saved, 2)
            os.close(saved)
        held.seek(0)
        lines = held.read().decode(errors="replace").splitlines(keepends=True)
    sys.stderr.write("".join(line for line in lines if "NVIDIA CUDA driver" not in line))


if not torch.cuda.is_available():
    _start_without_gpu()

_INT32_MAX = 2**31 - 1  # Warp keeps shapes and byte strides as int32

_lock = threading.Lock()
_pool: ThreadPoolExecutor | None = None


def _get_pool() -> ThreadPoolExecutor:
    global _pool
    with _lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="gamba-warp")
        return _pool


def _forget_pool() -> None:
    """A forked child has the executor's object but none of its threads."""
    global _pool, _lock
    _pool, _lock = None, threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pool)


def device_of(tensor: Tensor) -> wp.Device:
    """The Warp device of a tensor.

    Raises:
        ValueError: the tensor is neither on the CPU nor on a CUDA device.
    """
    if tensor.device.type not in ("cpu", "cuda"):
        raise ValueError(f"device is {tensor.device}, allowed are cpu and cuda")
    return wp.device_from_torch(tensor.device)


def view(tensor: Tensor, dtype=None, name: str = "tensor"):
    """A Warp array descriptor on the tensor's own memory, strides kept; it keeps the tensor alive.

    Args:
        tensor: float32, float64, bfloat16, float16 or integer, at most 4 dimensions.
        dtype: a Warp dtype; a vector or matrix type takes up trailing, contiguous dimensions.
        name: the argument's name in errors.

    Raises:
        TypeError: the dtype has no Warp counterpart or is not the one asked for.
        ValueError: too many dimensions, a broken vector dimension, or over 2^31 bytes per stride.
    """
    key = (tensor.dtype, tensor.shape, tensor.stride(), dtype)
    if key not in _descriptors:
        if len(_descriptors) >= _MOST_DESCRIPTORS:
            _descriptors.clear()
        _descriptors[key] = _describe(tensor.detach(), dtype, name)
    known = _descriptors[key]
    descriptor = type(known).from_buffer_copy(known)  # a tenth of the time of making it
    descriptor.data = tensor.data_ptr()
    descriptor.owner = tensor
    return descriptor


_MOST_DESCRIPTORS = 4096
_descriptors: dict[tuple, object] = {}  # of the first tensor of each dtype, shape and strides


def _describe(tensor: Tensor, dtype, name: str):
    reach = max((s * tensor.element_size() for s in tensor.stride()), default=0)
    if max(reach, *tensor.shape, 0) > _INT32_MAX:
        raise ValueError(
            f"{name} has shape {tuple(tensor.shape)} and strides {tensor.stride()}; "
            "each length, and each stride in bytes, must be below 2^31"
        )
    if dtype is not None:
        scalar = wp.dtype_to_torch(getattr(dtype, "_wp_scalar_type_", dtype))
        if tensor.dtype != scalar:
            raise TypeError(f"{name} has dtype {tensor.dtype}, allowed is {scalar}")
    try:
        made = wp.from_torch(tensor, dtype=dtype, requires_grad=False, return_ctype=True)
    except RuntimeError as error:
        raise ValueError(f"{name}: {error}") from error
    return type(made).from_buffer_copy(made)  # without the tensor


def lane_contiguous(tensor: Tensor) -> Tensor:
    """The tensor itself if its last dimension is dense (rows may be strided), else a dense copy."""
    return tensor if tensor.stride(-1) == 1 or tensor.shape[-1] == 1 else tensor.contiguous()


_HUGE = 4 << 20  # bytes from which huge pages pay
_libc = ctypes.CDLL(None) if sys.platform == "linux" else None


def empty(shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    """As ``torch.empty`` on the CPU; a large tensor asks for huge pages.

    The first touch of a page costs more than filling it, and with rows of 4 KiB each row would be a
    page of its own.
    """
    tensor = torch.empty(*shape, dtype=dtype)
    size = tensor.numel() * tensor.element_size()
    if _libc is not None and size >= _HUGE:
        begin = -(-tensor.data_ptr() // 4096) * 4096
        end = (tensor.data_ptr() + size) // 4096 * 4096
        # 14 is MADV_HUGEPAGE; a kernel without huge pages refuses, which does no harm
        _libc.madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), 14)
    return tensor


def parallel_launch(
    kernel: wp.Kernel,
    dim: int | Sequence[int],
    inputs: Sequence,
    outputs: Sequence = (),
    threads: int | None = None,
    pieces: int | None = None,
) -> None:
    """Runs a CPU kernel over several threads by cutting dimension 0 of the launch.

    The kernel's first parameter is ``offset: wp.int32``, which it adds to its first ``wp.tid()``;
    this function passes it, so ``inputs`` starts with the second parameter. Pieces must not write
    to the same places. Returns when all are done.

    Args:
        kernel: not generic.
        dim: launch dimensions.
        inputs: arguments after ``offset``; tensors are viewed, other values passed on.
        outputs: more arguments, by convention those that are written.
        threads: how many at once; None means ``torch.get_num_threads()``.
        pieces: how many pieces; None means one per thread. More of them even out uneven work.

    Raises:
        Exception: the first one that a piece raised.
    """
    dim = (dim,) if isinstance(dim, int) else tuple(dim)
    if 0 in dim:
        return
    threads = max(1, min(threads or torch.get_num_threads(), dim[0]))
    pieces = max(threads, min(pieces or threads, dim[0]))
    arguments = [view(a) if isinstance(a, Tensor) else a for a in (*inputs, *outputs)]
    cuts = [dim[0] * i // pieces for i in range(pieces + 1)]
    if threads > 1 and team.has_team():
        dims = [(end - begin, *dim[1:]) for begin, end in zip(cuts[:-1], cuts[1:])]
        return team.run(kernel, dims, arguments, threads)
    kernel.module.load(wp.get_device("cpu"), 1)  # compile once, before the threads
    todo = iter(list(zip(cuts[:-1], cuts[1:])))

    def work() -> None:
        while (piece := next(todo, None)) is not None:  # list iterators are atomic under the GIL
            begin, end = piece
            wp.launch(
                kernel,
                (end - begin, *dim[1:]),
                [begin, *arguments],
                device="cpu",
                record_tape=False,
            )

    helpers = [_get_pool().submit(work) for _ in range(threads - 1)] if threads > 1 else []
    try:
        work()
    finally:
        for helper in helpers:
            helper.exception()  # waits: no thread may write after this call returns
    for helper in helpers:
        helper.result()


def cuda_launch(
    kernel: wp.Kernel,
    dim: int | Sequence[int],
    inputs: Sequence,
    outputs: Sequence = (),
    *,
    device: torch.device,
    block_dim: int = 256,
) -> None:
    """Launches on torch's current stream of ``device``; on a CPU device, on the CPU (for tests).

    Args:
        kernel: not generic.
        dim: launch dimensions; for a tile kernel the last one is ``block_dim``.
        inputs: all arguments; tensors are viewed, other values passed on.
        outputs: more arguments, by convention those that are written.
        device: of the tensors.
        block_dim: threads of a block; on a CPU it needs ``wp.config.enable_cpu_blocks``.
    """
    arguments = [view(a) if isinstance(a, Tensor) else a for a in (*inputs, *outputs)]
    where = {"device": "cpu"}
    if device.type == "cuda":
        where = {"stream": wp.stream_from_torch(torch.cuda.current_stream(device))}
    wp.launch(kernel, dim, arguments, block_dim=block_dim, record_tape=False, **where)
