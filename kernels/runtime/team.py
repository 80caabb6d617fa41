"""Runs the pieces of a CPU launch on the threads that torch's own operators run on.

After an operator torch's OpenMP threads wait for the next one by spinning, for milliseconds. Other
threads would share the cores with them; the same team starts within microseconds. Where torch has
another runtime than GNU's or one with its interface, and in a forked child, there is no team, and
``launch.parallel_launch`` takes threads of Python. It does so too with a Warp whose recorded launch
has other attributes than those of 1.18 and 1.19, which are not public.
"""

import ctypes
import os
import warnings
from collections.abc import Sequence
from typing import Any

import warp as wp

from .entry import Entry
from .views import unkept

wp.set_module_options({"enable_backward": False})


class _Job(ctypes.Structure):
    """The pieces, which lie one after the other in memory, and the number of the next one."""

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


def _find() -> None:
    global _parallel
    try:
        _parallel = ctypes.cast(ctypes.CDLL(None).GOMP_parallel, ctypes.c_void_p).value or 0
    except (AttributeError, OSError, TypeError):
        _parallel = 0


def _lose() -> None:
    global _parallel
    _parallel = 0  # after a fork: the threads of the team stayed with the parent


_find()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_lose)


def has_team() -> bool:
    """True if launches can go to torch's threads."""
    return _parallel != 0


_entries: dict[Any, Entry] = {}  # by kernel


def _entry(kernel: Any, dim: tuple[int, ...], arguments: list) -> Entry | None:
    """The entry of a kernel; None, and no team from now on, where this Warp has no such thing.

    It is made by a launch that is recorded only, which checks the arguments; later launches have
    the same kinds of them.
    """
    if kernel not in _entries:
        try:
            command = wp.launch(kernel, dim, arguments, device="cpu", record_cmd=True)
        except OSError as error:
            raise unkept(error) from error
        try:
            entry = Entry(kernel, command, dim, arguments)
            if not ctypes.cast(entry.call, ctypes.c_void_p).value:
                raise TypeError("a recorded launch has no compiled function")
            _entries[kernel] = entry
        except (AttributeError, TypeError) as error:
            if has_team():
                warnings.warn(
                    f"warp-lang {wp.__version__} keeps launches in another form ({error}): those "
                    "on the CPU take threads of their own, which is slower beside torch's own",
                    RuntimeWarning,
                    stacklevel=2,
                )
            _lose()
            return None
    return _entries[kernel]


def run(kernel: wp.Kernel, dims: Sequence[tuple[int, ...]], arguments: list, threads: int) -> bool:
    """Runs one launch per entry of ``dims`` on a team of ``threads``; returns when all are done.

    Returns False, having done nothing, where this Warp cannot do it; then there is no team any
    more.

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


def run_alone(kernel: Any, dim: tuple[int, ...], arguments: list) -> bool:
    """Runs a launch in this thread, in a quarter of the time of ``wp.launch``.

    Returns False, having done nothing, where this Warp cannot do it.

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
