"""Launches of kernels, on torch's own threads on the CPU and on its current stream on CUDA.

``wp.launch`` checks and packs its arguments each time, which takes as long as a short kernel
runs. A launch that is recorded once (``Entry``) shows the result; later launches of the
kernel have the same kinds of arguments and fill the same structures.

On the CPU a launch is cut into pieces, which run on the threads of torch's own operators: after an
operator torch's OpenMP threads wait for the next one by spinning, for milliseconds, and other
threads would share the cores with them; the same team starts within microseconds. Where torch has
another runtime than GNU's or one with its interface, in a forked child, and with a Warp whose
recorded launch has other attributes than in 1.18 and 1.19, which are not public, there is no
team, and Python's threads run the pieces.
"""

import copy
import ctypes
import functools
import os
import threading
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
import warp as wp
from torch import Tensor

from . import gpu
from .views import cache_error, view

wp.set_module_options({"enable_backward": False})

_MOST_EXTENTS = 1024  # that a kernel keeps


class Entry:
    """Compiled function and argument structures of a kernel's launches.

    They are attributes of Warp's that are not documented.

    Args:
        kernel: the kernel.
        command: of ``wp.launch(..., record_cmd=True)``.
        dim: of that launch.
        arguments: likewise.

    Raises:
        AttributeError: this Warp has no such attributes; also TypeError, where they are others.
    """

    def __init__(self, kernel: wp.Kernel, command: Any, dim: tuple[int, ...], arguments: list):
        self.rank = kernel.adj.kernel_dim
        self._command, self._own = command, threading.local()
        self.call = command.hooks.forward
        self.executable = command.module_exec  # keeps the function loaded
        self.bounds: Any = type(command.bounds)
        self.names = [arg.label for arg in kernel.adj.args]
        fields = [(name, type(x)) for name, x in zip(self.names, command.params[1:])]
        self.record: Any = type("Arguments", (ctypes.Structure,), {"_fields_": fields})
        self.offsets = [getattr(self.record, name).offset for name in self.names]
        self.addresses: Any = ctypes.c_void_p * (1 + len(fields))
        self._empty = [kind() for _, kind in fields]
        self._structs = [i for i, x in enumerate(arguments) if hasattr(x, "__ctype__")]
        self._extents: dict[tuple[int, ...], Any] = {}
        self.extent(dim)  # to raise errors now, not in a later launch
        self.pack(arguments)

    def command(self) -> Any:
        """The recorded command, a copy for each thread, to be changed before it is launched."""
        command = getattr(self._own, "command", None)
        if command is None:
            command = self._own.command = copy.copy(self._command)
        return command

    def pack(self, arguments: list) -> ctypes.Structure:
        """The arguments as the compiled function takes them; an array that is None is empty."""
        values = [y if x is None else x for x, y in zip(arguments, self._empty)]
        for i in self._structs:
            values[i] = values[i].__ctype__()
        return self.record(*values)

    def extent(self, dim: tuple[int, ...]) -> ctypes.Structure:
        """The dimensions as the compiled function takes them; not to be changed."""
        known = self._extents.get(dim)  # looked up once: another thread may clear them
        if known is None:
            if len(self._extents) >= _MOST_EXTENTS:
                self._extents.clear()
            known = self.bounds((*dim, *(1,) * (self.rank - len(dim))))
            self._extents[dim] = known
        return known


# by kernel on the CPU; by kernel, device and threads of a block on CUDA
_entries: dict[Any, Entry] = {}


class _Job(ctypes.Structure):
    """The pieces, contiguous in memory, and the index of the next one."""

    _fields_ = [
        ("entry", ctypes.c_void_p),
        ("bounds", ctypes.c_void_p),
        ("bounds_size", ctypes.c_int64),
        ("arguments", ctypes.c_void_p),
        ("arguments_size", ctypes.c_int64),
        ("pieces", ctypes.c_int32),
        ("next", ctypes.c_int32),
    ]


@wp.func_native(
    """
    struct Job {
        void (*entry)(void*, void*);
        char* bounds;
        int64_t bounds_size;
        char* arguments;
        int64_t arguments_size;
        int pieces, next;
    };
    auto work = [](void* data) {
        Job& job = *(Job*)data;
        for (;;) {
            const int i = __atomic_fetch_add(&job.next, 1, __ATOMIC_RELAXED);
            if (i >= job.pieces) return;
            job.entry(job.bounds + i * job.bounds_size, job.arguments + i * job.arguments_size);
        }
    };
    typedef void (*Parallel)(void (*)(void*), void*, unsigned, unsigned);
    ((Parallel)parallel)(work, (void*)job, threads, 0);
    """
)
def _run_job(parallel: wp.uint64, job: wp.uint64, threads: wp.int32):
    """Calls OpenMP's ``parallel``: each thread of the team takes pieces until none is left."""
    ...


@wp.kernel
def _team(parallel: wp.uint64, job: wp.uint64, threads: wp.int32):
    _run_job(parallel, job, threads)


_parallel = 0  # address of GOMP_parallel


def _find_team() -> None:
    global _parallel
    try:
        _parallel = ctypes.cast(ctypes.CDLL(None).GOMP_parallel, ctypes.c_void_p).value or 0
    except (AttributeError, OSError):
        _parallel = 0


def _disable_team() -> None:
    global _parallel
    _parallel = 0  # after a fork: the threads of the team stayed with the parent


_find_team()
os.register_at_fork(after_in_child=_disable_team)


def has_team() -> bool:
    """True if launches can go to torch's threads."""
    return _parallel != 0


def _entry(kernel: Any, dim: tuple[int, ...], arguments: list) -> Entry | None:
    """Entry of a kernel; None, and no team from now on, with a Warp that has none.

    A launch that is only recorded makes it and checks the arguments; later launches have arguments
    of the same kinds.
    """
    if kernel not in _entries:
        try:
            command = wp.launch(kernel, dim, arguments, device="cpu", record_cmd=True)
        except OSError as error:
            raise cache_error(error) from error
        try:
            entry = Entry(kernel, command, dim, arguments)
            if not ctypes.cast(entry.call, ctypes.c_void_p).value:
                raise TypeError("a recorded launch has no compiled function")
            _entries[kernel] = entry
        except (AttributeError, TypeError) as error:
            if has_team():
                warnings.warn(
                    f"warp-lang {wp.__version__} stores launches in another form ({error}): those "
                    "on the CPU use a second pool of threads, which is slower than sharing torch's",
                    RuntimeWarning,
                    stacklevel=2,
                )
            _disable_team()
            return None
    return _entries[kernel]


def _run(kernel: wp.Kernel, dims: Sequence[tuple[int, ...]], arguments: list, threads: int) -> bool:
    """Runs one launch per entry of ``dims`` on a team of ``threads``; returns when all are done.

    Returns False, having done nothing, with a Warp that cannot; then the team is dropped.

    Args:
        kernel: its first parameter is ``offset: wp.int32``, the sum of the first dimension of the
            launches before.
        dims: of the launches, which differ in the first dimension.
        arguments: after ``offset``.
        threads: at least 1.
    """
    entry = _entry(kernel, dims[0], [0, *arguments])
    if entry is None:
        return False
    bounds, records = (entry.bounds * len(dims))(), (entry.record * len(dims))()
    record, name, offset = entry.pack([0, *arguments]), entry.names[0], 0
    for i, dim in enumerate(dims):
        setattr(record, name, offset)
        bounds[i], records[i] = entry.extent(dim), record
        offset += dim[0]
    job = _Job(
        ctypes.cast(entry.call, ctypes.c_void_p).value,
        ctypes.addressof(bounds),
        ctypes.sizeof(entry.bounds),
        ctypes.addressof(records),
        ctypes.sizeof(entry.record),
        len(dims),
        0,
    )
    inputs = [_parallel, ctypes.addressof(job), threads]
    team = _entry(_team, (1,), inputs)
    if team is None:
        return False
    team.call(ctypes.byref(team.extent((1,))), ctypes.byref(team.pack(inputs)))
    return True


def _run_alone(kernel: Any, dim: tuple[int, ...], arguments: list) -> bool:
    """Runs a launch in this thread, in a quarter of the time of ``wp.launch``.

    Returns False, having done nothing, with a Warp that cannot.

    Args:
        kernel: its first parameter is ``offset: wp.int32``, which is 0 here.
        dim: of the launch, each at least 1.
        arguments: after ``offset``.
    """
    arguments = [0, *arguments]
    entry = _entry(kernel, dim, arguments)
    if entry is None:
        return False
    entry.call(ctypes.byref(entry.extent(dim)), ctypes.byref(entry.pack(arguments)))
    return True


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
            Piece i begins at ``dim[0] * i // pieces``, from which a kernel finds its workspace.

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
    if threads == 1 and has_team() and _run_alone(kernel, dim, arguments):
        return
    if threads > 1 and has_team():
        dims = [(end - begin, *dim[1:]) for begin, end in zip(cuts[:-1], cuts[1:])]
        if _run(kernel, dims, arguments, threads):
            return
    try:
        kernel.module.load(wp.get_device("cpu"), 1)  # compile once, before the threads
    except OSError as error:
        raise cache_error(error) from error
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
    block_dim: int = 128,
) -> None:
    """Launches on torch's current stream of ``device``.

    Args:
        kernel: a ``wp.Kernel``, not generic.
        dim: launch dimensions; for a tile kernel the last one is ``block_dim``.
        inputs: all arguments; tensors are viewed, other values passed on.
        outputs: more arguments, by convention those that are written.
        device: of the tensors.
        block_dim: threads of a block.
    """
    arguments = [view(a) if isinstance(a, Tensor) else a for a in (*inputs, *outputs)]
    launch_on_stream(
        kernel, (dim,) if isinstance(dim, int) else tuple(dim), arguments, block_dim, device
    )


def launch_on_stream(
    kernel: Any, dim: tuple[int, ...], arguments: list, block_dim: int, device: torch.device
) -> None:
    """Launches with arguments as Warp takes them; see ``cuda_launch``."""
    key = kernel, device, block_dim
    stream = _stream(device)
    if (entry := _entries.get(key)) is not None:
        _replay_launch(entry, dim, arguments, stream)
        return
    try:
        command: Any = wp.launch(
            kernel, dim, arguments, block_dim=block_dim, stream=stream, record_cmd=True
        )
    except OSError as error:
        raise cache_error(error) from error
    command.launch(stream)
    try:
        _entries[key] = Entry(kernel, command, dim, arguments)
    except (AttributeError, TypeError):  # this Warp keeps launches in another form
        pass


def _replay_launch(entry: Entry, dim: tuple[int, ...], arguments: list, stream: wp.Stream) -> None:
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
    pieces: int | None = None,
    block_dim: int = 128,
) -> None:
    """Launches a plain kernel whose first parameter is ``offset``; with ``dim`` 0, does nothing.

    Threads and pieces are as in ``parallel_launch``, on a CPU; ``block_dim`` is for CUDA.
    """
    if dim == 0 or (not isinstance(dim, int) and 0 in dim):
        return
    if gpu.kind_of(device) == "cpu":
        parallel_launch(kernel, dim, inputs, outputs, threads, pieces)
    else:
        cuda_launch(kernel, dim, [0, *inputs], outputs, device=device, block_dim=block_dim)
