"""Runs the pieces of a CPU launch on the threads that torch's own operators run on.

After an operator torch's OpenMP threads wait for the next one by spinning, for milliseconds. Other
threads would share the cores with them; the same team starts within microseconds. Where torch has
another runtime than GNU's or one with its interface, and in a forked child, there is no team, and
``interop.parallel_launch`` takes threads of Python.
"""

import ctypes
import os
from collections.abc import Sequence

import warp as wp

wp.set_module_options({"enable_backward": False})


class _Job(ctypes.Structure):
    """The pieces: one after the other in memory, with the number of the next one."""

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
    _parallel = 0  # the threads of the team stayed with the parent


_find()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_lose)


def has_team() -> bool:
    """Whether launches can go to torch's threads."""
    return _parallel != 0


def run(kernel: wp.Kernel, dims: Sequence[tuple[int, ...]], arguments: list, threads: int) -> None:
    """Runs one launch per entry of ``dims`` on a team of ``threads``; returns when all are done.

    Args:
        kernel: its first parameter is ``offset: wp.int32``, the sum of the first dimension of the
            launches before; compiled for the CPU.
        dims: of the launches, which differ in the first dimension.
        arguments: after ``offset``.
        threads: at least 1.
    """
    command = wp.launch(kernel, dims[0], [0, *arguments], device="cpu", record_cmd=True)
    bounds_type, values = type(command.bounds), command.params[1:]
    bounds = (bounds_type * len(dims))()
    names = [arg.label for arg in kernel.adj.args]
    record = _record(tuple(type(value) for value in values), tuple(names))
    records = (record * len(dims))()
    first = record(*values)
    offset = 0
    for i, dim in enumerate(dims):
        padded = (*dim, *(1,) * (kernel.adj.kernel_dim - len(dim)))
        bounds[i] = bounds_type(padded)
        setattr(first, names[0], offset)
        records[i] = first
        offset += dim[0]
    entry = ctypes.cast(command.hooks.forward, ctypes.c_void_p)
    job = _Job(
        entry.value,
        ctypes.addressof(bounds),
        ctypes.sizeof(bounds_type),
        ctypes.addressof(records),
        ctypes.sizeof(record),
        len(dims),
        0,
    )
    inputs = [_parallel, ctypes.addressof(job), threads]
    wp.launch(_team, 1, inputs, device="cpu", record_tape=False)


_records: dict[tuple, type] = {}


def _record(types: tuple[type, ...], names: tuple[str, ...]) -> type:
    """The C structure of a kernel's arguments."""
    if (types, names) not in _records:
        fields = {"_fields_": list(zip(names, types))}
        _records[types, names] = type("Arguments", (ctypes.Structure,), fields)
    return _records[types, names]
