"""Launches of kernels, on torch's own threads on the CPU and on its current stream on CUDA."""

from __future__ import annotations

import ctypes
import functools
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
import warp as wp
from torch import Tensor

from . import team
from .entry import Entry
from .stand_in import kind_of, stand_in
from .views import unkept, view


@functools.cache
def _pool(process: int) -> ThreadPoolExecutor:
    """Threads of Python; a forked child would have the object of its parent but no threads."""
    return ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="gamba-warp")


def parallel_launch(
    kernel: Any,
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
        kernel: a ``wp.Kernel``, not generic. (To a type checker, ``@wp.kernel`` gives a function.)
        dim: launch dimensions.
        inputs: arguments after ``offset``; tensors are viewed, other values passed on.
        outputs: more arguments, by convention those that are written.
        threads: number of threads; None means ``torch.get_num_threads()``.
        pieces: number of pieces; None means one per thread. More pieces even out uneven work.
            Piece i begins at ``dim[0] * i // pieces``, by which a kernel finds memory of its own.

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
    if threads == 1 and team.has_team() and team.run_alone(kernel, dim, arguments):
        return
    if threads > 1 and team.has_team():
        dims = [(end - begin, *dim[1:]) for begin, end in zip(cuts[:-1], cuts[1:])]
        if team.run(kernel, dims, arguments, threads):
            return
    try:
        kernel.module.load(wp.get_device("cpu"), 1)  # compile once, before the threads
    except OSError as error:
        raise unkept(error) from error
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

    helpers = [_pool(os.getpid()).submit(work) for _ in range(threads - 1)]
    try:
        work()
    finally:
        for helper in helpers:
            helper.exception()  # waits: no thread may write after this call returns
    for helper in helpers:
        helper.result()


def cuda_launch(
    kernel: Any,
    dim: int | Sequence[int],
    inputs: Sequence,
    outputs: Sequence = (),
    *,
    device: torch.device,
    block_dim: int = 256,
) -> None:
    """Launches on torch's current stream of ``device``, or by what stands in for a GPU.

    Args:
        kernel: a ``wp.Kernel``, not generic.
        dim: launch dimensions; for a tile kernel the last one is ``block_dim``.
        inputs: all arguments; tensors are viewed, other values passed on.
        outputs: more arguments, by convention those that are written.
        device: of the tensors.
        block_dim: threads of a block.
    """
    arguments = [view(a) if isinstance(a, Tensor) else a for a in (*inputs, *outputs)]
    dim = (dim,) if isinstance(dim, int) else tuple(dim)
    if (other := stand_in()) is not None:
        other.launch(kernel, dim, arguments, block_dim)
        return
    key = kernel, device, block_dim
    stream = _stream(device)
    if (entry := _entries.get(key)) is not None:
        _launch_again(entry, dim, arguments, stream)
        return
    try:
        command: Any = wp.launch(
            kernel, dim, arguments, block_dim=block_dim, stream=stream, record_cmd=True
        )
    except OSError as error:
        raise unkept(error) from error
    command.launch(stream)
    try:
        _entries[key] = Entry(kernel, command, dim, arguments)
    except (AttributeError, TypeError):  # this Warp keeps launches in another form
        pass


_entries: dict[tuple, Entry] = {}  # by kernel, device and threads of a block


def _launch_again(entry: Entry, dim: tuple[int, ...], arguments: list, stream: wp.Stream) -> None:
    """Launches a kernel that was launched before, in a fraction of the time of ``wp.launch``."""
    record, bounds = entry.pack(arguments), entry.extent(dim)
    first = ctypes.addressof(record)
    places = [ctypes.addressof(bounds), *(first + offset for offset in entry.offsets)]
    command = entry.command()
    command.bounds, command.params_addr = bounds, entry.addresses(*places)
    command.launch(stream)


_MOST_STREAMS = 256
_streams: dict[tuple[torch.device, int], wp.Stream] = {}


def _stream(device: torch.device) -> wp.Stream:
    """Warp's object of torch's current stream, which takes as long to make as a short launch."""
    key = device, torch._C._cuda_getCurrentRawStream(device.index)
    known = _streams.get(key)
    if known is None:
        if len(_streams) >= _MOST_STREAMS:
            _streams.clear()
        known = _streams[key] = wp.stream_from_torch(torch.cuda.current_stream(device))
    return known


def launch(
    kernel: Any,
    dim: int | Sequence[int],
    inputs: Sequence,
    outputs: Sequence,
    device: torch.device,
    threads: int | None = None,
    block_dim: int = 256,
) -> None:
    """Launches a plain kernel whose first parameter is ``offset``; with ``dim`` 0, does nothing.

    The threads are those of ``parallel_launch``, on a CPU; ``block_dim`` is of CUDA.
    """
    if dim == 0 or (not isinstance(dim, int) and 0 in dim):
        return
    if kind_of(device) == "cpu":
        parallel_launch(kernel, dim, inputs, outputs, threads)
    else:
        cuda_launch(kernel, dim, [0, *inputs], outputs, device=device, block_dim=block_dim)
