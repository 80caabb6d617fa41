"""Large tensors on the CPU, in memory that was touched before.

The first touch of a page costs many times its use: the system has to find it, to clear it, and in a
virtual machine to ask the host for it. Memory of the size of a result goes back to the system when
the result is freed, so every call would pay again. Here it goes to a pool instead, as soon as no
tensor holds its storage any more, and the next result of about that size is taken from there.

Only our operators' results come from here. For torch's operators a command can tell the C
library to keep freed memory (``gamba_warp.devices.keep_memory``); that is a setting of the whole
process, which a library must not change, and it reaches no block of 256 MiB and more, as each
result of a scan of 65,536 tokens and 1,024 channels is.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import mmap
import os
import sys
import weakref
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from .views import laid_as

LARGE = 4 << 20  # bytes from which a tensor is taken from the pool
_PAGE = 2 << 20  # a huge page
_FRACTION = 8  # the pool keeps this part of the memory at most
_TOUCHED = 256 << 20  # bytes that are not lent to the system, at most
_LIMITS = ("memory.max", "memory/memory.limit_in_bytes")  # of a container, in /sys/fs/cgroup


class _Block(mmap.mmap):
    """Memory; ``lent``: the system may take its pages."""

    lent = False


class Pool:
    """Blocks of memory that no tensor holds.

    The newest blocks are kept, up to ``touched`` bytes. The others are lent to the
    system, which may take their pages when it needs them (``MADV_FREE``); they are then fresh ones
    at the next use. The first write to a lent page costs more than filling it, even where the
    system did not take it. Beyond ``most`` bytes the blocks that have waited longest go back at
    once.

    There is no lock: the operations on the list are atomic, and a block may come back from a
    finalizer, which may run inside any of them.

    Attributes:
        most: bytes that are kept at most.
        touched: bytes of them that are not lent.
    """

    def __init__(self, most: int, touched: int = _TOUCHED) -> None:
        self.most, self.touched = most, min(touched, most)
        self._free: list[_Block] = []  # those that came last at the end

    def take(self, size: int) -> Tensor:
        """A new tensor of ``size`` bytes, uint8, of any contents.

        Its storage cannot be resized.
        """
        block = self._find(size)
        if block is None:  # rounded up, and a page to begin at a huge page
            rounded = -(-size // _PAGE) * _PAGE + _PAGE
            block = _Block(-1, rounded, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
            with contextlib.suppress(OSError, AttributeError):  # a kernel without huge pages
                block.madvise(mmap.MADV_HUGEPAGE)
        block.lent = False
        begin = ctypes.addressof(ctypes.c_char.from_buffer(block))
        # torch holds this object for as long as the storage lives
        held = (ctypes.c_char * size).from_buffer(block, -begin % _PAGE)
        weakref.finalize(held, self._give_back, block).atexit = False
        return torch.frombuffer(held, dtype=torch.uint8)

    def _find(self, size: int) -> _Block | None:
        """Takes the smallest block that is large enough, but not more than twice as large."""
        while True:
            fits = [x for x in self._free[::-1] if size <= len(x) - _PAGE <= 2 * size + _PAGE]
            if not fits:
                return None
            best = min(fits, key=len)
            with contextlib.suppress(ValueError):  # another thread has taken it: look again
                self._free.remove(best)
                return best

    def _give_back(self, block: _Block) -> None:
        self._free.append(block)
        with contextlib.suppress(IndexError):
            while self.size() > self.most:
                self._free.pop(0)
        self._lend()

    def _lend(self) -> None:
        """Lends the system all blocks but the newest, whose sum is at most ``touched`` bytes."""
        newer = 0
        for block in self._free[::-1]:
            newer += len(block)
            if newer <= self.touched or block.lent:
                continue
            with contextlib.suppress(ValueError):  # another thread has taken it
                place = self._free.index(block)
                self._free.remove(block)  # not available while its pages are given away
                with contextlib.suppress(OSError, AttributeError):  # an old kernel keeps it
                    block.madvise(mmap.MADV_FREE)
                block.lent = True
                self._free.insert(place, block)

    def size(self) -> int:
        """Bytes in the pool."""
        return sum(map(len, self._free[:]))

    def clear(self) -> None:
        """Give all memory of the pool back to the system."""
        self._free.clear()


def _most() -> int:
    """Return the limit of the pool: ``GAMBA_POOL`` in MiB, or a part of the memory."""
    chosen = os.environ.get("GAMBA_POOL", "")
    if chosen.isdecimal():
        return int(chosen) << 20
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    for name in _LIMITS:
        with contextlib.suppress(OSError, ValueError):  # "max", or no such file
            memory = min(memory, int((Path("/sys/fs/cgroup") / name).read_text(encoding="ascii")))
    return memory // _FRACTION


pool = Pool(_most()) if sys.platform == "linux" else None

if pool is not None:
    # a child would have to copy the pages that it shares with its parent, which costs more
    os.register_at_fork(after_in_child=pool.clear)


def empty(shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    """Makes a tensor as ``torch.empty`` does on the CPU; a large one comes from the pool.

    The storage of a large one cannot be resized. ``GAMBA_POOL=0`` in the environment switches the
    pool off; another number is the MiB that it keeps at most.
    """
    size = math.prod(shape) * dtype.itemsize
    if pool is None or pool.most == 0 or size < LARGE:
        return torch.empty(*shape, dtype=dtype)
    # Not a view: autograd forbids in-place changes of a view made inside an operator.
    return torch.empty(0, dtype=dtype).set_(pool.take(size).untyped_storage()).resize_(shape)


def empty_like(x: Tensor) -> Tensor:
    """The same for a result of the shape, dtype and layout of x (``views.laid_as``)."""
    return laid_as(x, lambda shape: empty(shape, x.dtype))


def release() -> None:
    """Give unused memory of the pool back to the system."""
    if pool is not None:
        pool.clear()
