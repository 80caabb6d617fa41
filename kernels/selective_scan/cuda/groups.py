"""A thread's own elements of a tile in the gradient: four adjacent tokens of one channel at a time.

In shared memory these four are one vector, ``[token / 4, channel, 4]``, so that a thread stores and
loads them at once, and so does the recurrence. ``row`` takes every ``rows``-th group of tokens.
"""

import dataclasses
import functools

import torch
import warp as wp

from ...runtime.native import WARP_DTYPES
from ...runtime.scalars import BITS
from .blocks import BlockShape, Position, arena_io

FOUR = 4  # tokens of a vector


@dataclasses.dataclass(frozen=True)
class Groups:
    """Thread-to-token layout of a tile."""

    shape: BlockShape
    tokens: int  # of a tile, a multiple of FOUR and of the rows
    most: int = FOUR  # adjacent elements of a thread

    @property
    def count(self) -> int:
        """Elements of a thread."""
        return self.tokens // self.shape.rows

    @property
    def adjacent(self) -> int:
        """Number of adjacent tokens among them."""
        return min(self.most, self.count)

    def text(self, file: str, **macros: object) -> str:
        """C++ of a file in this folder, for these groups."""
        sizes = {"COUNT": self.count, "ADJACENT": self.adjacent, "TOKENS": self.tokens}
        sizes |= {"STEP": self.step, "LANE_STRIDE": self.lane_stride}
        return self.shape.text(file, **sizes, **macros)

    def token(self, i: int) -> int:
        """The token of element i, after the thread's first."""
        return i // self.adjacent * self.shape.rows * self.adjacent + i % self.adjacent

    @property
    def size(self) -> int:
        """Floats of a tile in shared memory."""
        return self.tokens * self.shape.span

    @property
    def step(self) -> int:
        """Floats between slots' channels of one number in a lane's sums, against bank conflicts."""
        return self.shape.slots + 8 // self.shape.channels

    @property
    def lane_stride(self) -> int:
        """Floats between the sums of two lanes: ``[token / 4, channel of a slot, slot, 4]``."""
        return self.tokens * self.shape.channels * self.step + (8 if self.shape.lanes > 1 else 0)


@functools.cache
def group_io(g: Groups, io: torch.dtype):
    """Access to a thread's elements of ``[B, L, D]``; the 64-bit base address is computed once.

    ``fetch`` loads bits, as ``blocks.channel_io`` does, from the thread's token ``t`` on. In place
    of tokens after ``last`` it loads that one. ``store`` does nothing unless ``inside``.
    """
    scalar = WARP_DTYPES[io]
    raw = wp.types.vector(g.count, wp.uint32)

    @wp.func_native(g.text("io.inl", ORIGIN=True, FROM=f"(({BITS[io]['ELEMENT']}*)x_in.data + d)"))
    def origin(x_in: wp.array3d(dtype=scalar), b: int, d: int) -> wp.uint64: ...

    @wp.func_native(g.text("io.inl", FETCH_CHANNEL=True, **BITS[io]))
    def fetch(x_in: wp.array3d(dtype=scalar), origin: wp.uint64, t: int, last: int) -> raw: ...

    @wp.func_native(g.text("io.inl", STORE_FROM_ORIGIN=True, **BITS[io]))
    def store(
        x_out: wp.array3d(dtype=scalar), origin: wp.uint64, t: int, inside: bool, v: float
    ): ...

    return raw, origin, fetch, store


@functools.cache
def row_io(f: BlockShape, io: torch.dtype, tokens: int):
    """``group_io`` for a block's tile of B or C, ``[B, L, G, N]``; for ``blocks.matrix_io``."""
    scalar = WARP_DTYPES[io]
    count = -(-tokens * f.padded // f.block)
    raw = wp.types.vector(count, wp.uint32)

    of_group = "((char*)x_in.data + wide_(g, x_in.strides[2]))"

    @wp.func_native(f.text("io.inl", ORIGIN=True, FROM=of_group))
    def origin(x_in: wp.array4d(dtype=scalar), b: int, g: int) -> wp.uint64: ...

    @wp.func_native(f.text("io.inl", FETCH_MATRIX=True, COUNT=count, TOKENS=tokens, **BITS[io]))
    def fetch(
        x_in: wp.array4d(dtype=scalar), origin: wp.uint64, p: Position, t0: int, last: int
    ) -> raw: ...

    return origin, fetch


@functools.cache
def group_shared(g: Groups, arena_size: int):
    """``put`` and ``get`` of a thread's elements in shared memory; ``sum_lanes`` of lanes' sums."""
    elements = wp.types.vector(g.count, wp.float32)
    arena_type, _, _ = arena_io(arena_size)

    @wp.func_native(g.text("io.inl", PUT=True))
    def put(arena: arena_type, base: int, p: Position, x: elements): ...

    @wp.func_native(g.text("io.inl", GET=True))
    def get(arena: arena_type, base: int, p: Position) -> elements: ...

    @wp.func_native(g.text("io.inl", SUM_LANES=True))
    def sum_lanes(arena: arena_type, base: int, p: Position) -> elements: ...

    return elements, put, get, sum_lanes
