"""Map of a block of threads to channels, states and tokens, and its shared memory.

A block holds adjacent channels of one group. For the recurrence a thread owns ``channels`` times
``states`` of them (an outer product, so that values from shared memory are used more than
once), and ``lanes`` threads share a channel; for loads, stores and values of a channel,
a thread owns one channel and every ``rows``-th token, so that a warp touches adjacent addresses.
The loops are C++ in the files next to this one, for a CPU as well, where the tests run it.
"""

import dataclasses
import functools
from pathlib import Path
from typing import no_type_check

import torch
import warp as wp

from ...runtime.native import WARP_DTYPES, native
from ...runtime.scalars import BITS, EXP2, RECIPROCAL, WIDE, softplus
from ...runtime.views import struct
from ..problem import macros

STATES = 16  # of a state block, the most that a channel holds in registers
MARK = 64  # tokens between the states that the forward saves for the gradient
# Chunks whose sums are added in a row: equal terms in a row round to the same side.
RUN = 16
SUB = 4  # tokens whose states and decays the gradient holds in registers
UNROLL = 4  # tokens whose sums wait in registers, so that their loads need not wait for stores

_HERE = Path(__file__).parent
_HEAD = EXP2 + RECIPROCAL + WIDE


@dataclasses.dataclass(frozen=True)
class BlockShape:
    """The static shape of a block."""

    block: int  # threads
    channels: int  # of a thread
    states: int  # of a thread, in one state block
    lanes: int  # threads that share a channel
    walks: int  # state blocks, walked one after the other; 1 up to 16 states

    @property
    def width(self) -> int:
        """States of a state block, padded."""
        return self.lanes * self.states

    @property
    def padded(self) -> int:
        """All states, padded."""
        return self.width * self.walks

    @property
    def slots(self) -> int:
        """Groups of ``lanes`` threads."""
        return self.block // self.lanes

    @property
    def span(self) -> int:
        """Channels of a block."""
        return self.slots * self.channels

    @property
    def rows(self) -> int:
        """Threads that share the loads of one channel, each for other tokens."""
        return self.block // self.span

    @property
    def held(self) -> int:
        """Elements (channel, state) of a thread."""
        return self.channels * self.states

    @property
    def pad(self) -> int:
        """Floats between the lanes' partial sums, against bank conflicts."""
        return 32 // self.lanes if self.lanes > 1 else 0

    def text(self, file: str, **macros: object) -> str:
        """C++ of a file in this folder, for blocks of this shape."""
        names = (*vars(self), "width", "padded", "slots", "span", "rows", "held", "pad")
        shape = {name.upper(): getattr(self, name) for name in names}
        return _HEAD + native(_HERE / file, **shape, **macros)


def block_shape(block: int, channels: int, states: int, total: int) -> BlockShape:
    """The block shape for ``total`` states; the others are a tuning's, of a block or a thread."""
    width = min(STATES, 1 << (total - 1).bit_length())
    states = min(states, width)
    lanes = width // states
    return BlockShape(block, min(channels, lanes), states, lanes, -(-total // width))


@functools.cache
def widening(io: torch.dtype):
    """Makes the function that turns the bits of an ``io`` into a float."""

    @wp.func_native(BITS[io]["WIDEN"])
    def widen(bits: wp.uint32) -> float: ...

    return widen


def stepping(delta_io: torch.dtype, use_softplus: bool):
    """Makes the function that turns the bits of a delta into δ, which is 0 where not ``inside``."""
    widen = widening(delta_io)

    @wp.func
    def step_of(bits: wp.uint32, bias: float, inside: bool) -> float:
        step = widen(bits) + bias
        if wp.static(use_softplus):
            step = softplus(step)
        return wp.where(inside, step, 0.0)

    return step_of


@struct
class Sizes:
    """Launch parameters of all kernels: shapes, and numbers that map block indices to them."""

    length: int
    states: int
    group_width: int
    groups: int
    parts: int  # blocks of channels in a group
    segments: int  # of a sequence, each a block's own; of packed ones at most
    segment: int  # tokens of one, a multiple of MARK; packed sequences have their own
    save: int


@struct
class Position:
    """Position of a thread in the problem."""

    b: int
    group: int
    part: int
    segment: int
    last: int  # segment of the sequence
    sequence: int
    segment_row: int  # of arrays [B * segments, ...]
    mark: int  # row of the saved states, of the first token
    run: int  # row of the gradient's sums, of the first token
    begin: int  # tokens
    end: int
    lane: int  # of the block
    d0: int  # the block's first channel
    count: int  # its channels inside the group
    d: int  # the thread's own channel; threads past the last share that one and are not active
    c: int  # the same channel, counted from d0
    active: int
    row: int  # the thread's first token of a tile
    slot: int  # the thread's channels in the recurrence, of ``slots``
    q: int  # the thread's states in the recurrence, of ``lanes``
    states: int  # N


# Shared memory is one tile of floats that is addressed by plain offsets, because each assignment to
# an element of a tile has a barrier.
def offsets(parts: dict) -> tuple[dict, int]:
    """Return the offsets in shared memory of parts of these sizes in floats, and their sum."""
    starts, size = {}, 0
    for name, count in parts.items():
        starts[name] = size
        size += -(-count // 4) * 4
    return starts, size


@functools.cache
def arena_io(size: int):
    """The type of a block's shared memory of ``size`` floats, and access to it."""
    arena_type = wp.tile[float, size]  # pyright: ignore[reportIndexIssue] (in its stub a function)

    @wp.func_native("arena.data.ptr[i] = v;")
    def put(arena: arena_type, i: int, v: float): ...

    @wp.func_native("return arena.data.ptr[i];")
    def get(arena: arena_type, i: int) -> float: ...

    return arena_type, put, get


@wp.func_native("WP_TILE_SYNC();")
def sync(): ...


@functools.cache
def position_of(f: BlockShape):
    """Makes the function that finds a thread's Position."""

    @wp.func
    @no_type_check
    def position(sizes: Sizes, packed_in: wp.array2d(dtype=int), index: int, lane: int) -> Position:
        p = Position()
        p.part = index % sizes.parts
        rest = index / sizes.parts
        p.group = rest % sizes.groups
        rest = rest / sizes.groups
        p.segment = rest % sizes.segments
        p.sequence = rest / sizes.segments
        p.segment_row = rest
        if packed_in.shape[0] > 0:  # cut as alone; rows as ``packed.slots`` has them
            p.b = packed_in[p.sequence, 0]
            begin = packed_in[p.sequence, 1]
            end = packed_in[p.sequence, 2]
            chunks = wp.max((end - begin + MARK - 1) / MARK, 1)
            segment = (chunks + sizes.segments - 1) / sizes.segments * MARK
            p.last = (chunks * MARK - 1) / segment
            p.begin = wp.min(begin + p.segment * segment, end)  # after the last: no token
            p.end = wp.min(p.begin + segment, end)
            t = p.b * sizes.length
            p.mark = (t + begin) / MARK + p.sequence + (p.begin - begin) / MARK
            p.run = (t + p.begin) / wp.static(RUN * MARK) + p.segment_row
        else:
            p.last = sizes.segments - 1
            p.b = p.sequence
            p.begin = p.segment * sizes.segment
            p.end = wp.min(p.begin + sizes.segment, sizes.length)
            p.mark = p.b * ((sizes.length + MARK - 1) / MARK) + p.begin / MARK
            p.run = p.segment_row * ((sizes.segment / MARK + RUN - 1) / RUN)
        p.lane = lane
        p.d0 = p.group * sizes.group_width + p.part * wp.static(f.span)
        p.count = wp.min(wp.static(f.span), sizes.group_width - p.part * wp.static(f.span))
        p.c = lane % wp.static(f.span)
        p.row = lane / wp.static(f.span)
        p.active = int(p.c < p.count)
        p.d = p.d0 + wp.min(p.c, p.count - 1)
        p.slot = lane / wp.static(f.lanes)
        p.q = lane % wp.static(f.lanes)
        p.states = sizes.states
        return p

    return position


@functools.cache
def states_io(f: BlockShape):
    """The vector of a thread's states, walk by walk, and its load from and store to ``[*, D, N]``.

    States past the last are 0.
    """
    vec = wp.types.vector(f.walks * f.held, wp.float32)

    @wp.func_native(f.text("io.inl", READ_STATES=True))
    def read(states: wp.array3d(dtype=float), i: int, p: Position) -> vec: ...

    @wp.func_native(f.text("io.inl", WRITE_STATES=True))
    def write(states: wp.array3d(dtype=float), i: int, p: Position, h: vec): ...

    return vec, read, write


@functools.cache
def halves(f: BlockShape):
    """Two vectors of a thread's states as one, for a native function to return."""
    n = f.walks * f.held
    vec = wp.types.vector(n, wp.float32)
    pair = wp.types.vector(2 * n, wp.float32)
    loop = f"WP_PRAGMA_UNROLL for (int k = 0; k < {n}; ++k) "
    one = f"wp::vec_t<{n}, float> r; {loop}"

    @wp.func_native(
        f"wp::vec_t<{2 * n}, float> r; {loop} r.c[k] = x.c[k], r.c[{n} + k] = y.c[k]; return r;"
    )
    def join(x: vec, y: vec) -> pair: ...

    @wp.func_native(f"{one} r.c[k] = v.c[k]; return r;")
    def first(v: pair) -> vec: ...

    @wp.func_native(f"{one} r.c[k] = v.c[{n} + k]; return r;")
    def second(v: pair) -> vec: ...

    return pair, join, first, second


@functools.cache
def channel_io(f: BlockShape, io: torch.dtype, tokens: int):
    """Access to a thread's own elements of a tile of ``[B, L, D]``.

    ``fetch`` loads their bits: the loads are on their way while the tile before is worked on, and
    converting would wait for them. Elements from ``end`` on are 0.
    """
    scalar = WARP_DTYPES[io]
    count = tokens // f.rows
    raw = wp.types.vector(count, wp.uint32)

    @wp.func_native(f.text("io.inl", LOAD_CHANNEL=True, COUNT=count, **BITS[io]))
    def load(x_in: wp.array3d(dtype=scalar), p: Position, t: int, left: int) -> raw: ...

    @wp.func
    def fetch(x_in: wp.array3d(dtype=scalar), p: Position, t0: int, end: int) -> raw:
        left = wp.where(t0 < 0, 0, end - t0 - p.row)  # there is no tile before the first
        return load(x_in, p, t0 + p.row, left)

    @wp.func_native(f.text("io.inl", STORE_CHANNEL=True, **BITS[io]))
    def store(x_out: wp.array3d(dtype=scalar), b: int, d: int, t: int, v: float): ...

    return count, raw, fetch, store


@functools.cache
def matrix_io(f: BlockShape, io: torch.dtype, tokens: int, arena_size: int):
    """``channel_io`` for a block's tile of B or C, ``[B, L, G, N]``; ``put_rows`` as floats."""
    scalar = WARP_DTYPES[io]
    size = tokens * f.padded
    count = -(-size // f.block)
    raw = wp.types.vector(count, wp.uint32)
    arena_type, _, _ = arena_io(arena_size)
    widen = widening(io)

    @wp.func_native("(arena.data.ptr + base)[i] = v;")
    def put(arena: arena_type, base: int, i: int, v: float): ...

    @wp.func_native(f.text("io.inl", LOAD_MATRIX=True, COUNT=count, TOKENS=tokens, **BITS[io]))
    def load(x_in: wp.array4d(dtype=scalar), p: Position, t0: int, left: int) -> raw: ...

    @wp.func
    def fetch(x_in: wp.array4d(dtype=scalar), p: Position, t0: int, end: int) -> raw:
        left = wp.where(t0 < 0, 0, end - t0)
        return load(x_in, p, t0, left)

    @wp.func
    def put_rows(arena: arena_type, base: int, p: Position, r: raw):
        for i in range(wp.static(count)):
            first = base + wp.static(i * f.block)
            if wp.static(size % f.block == 0):
                put(arena, first, p.lane, widen(r[i]))
            elif p.lane < wp.static(size - i * f.block):
                put(arena, first, p.lane, widen(r[i]))

    return raw, fetch, put_rows


@functools.cache
def recurrence(
    f: BlockShape, mode: str, tokens: int, parts: tuple, arena_size: int, read: bool, reverse: bool
):
    """The recurrence over a tile, and for rules whose decays are not exponentials their product.

    Equations are README.md's. The operands of a tile are floats in shared memory, channels
    or states adjacent. Tokens past the end have δ = 0 and change nothing. Forward it is equation 1,
    and with ``read`` the sums of equation 5 as partial sums of the lanes; in reverse it is equation
    6, dh from after a tile to before it.

    Args:
        parts: pairs (name, offset) of ``STEP, IN, W`` (δ, and δu and B, or dy and C), with ``read``
            ``C, Y``.
    """
    vec = wp.types.vector(f.walks * f.held, wp.float32)
    arena_type, _, _ = arena_io(arena_size)
    offset = {"AT_C": 0, "AT_Y": 0} | {f"AT_{name}": start for name, start in parts}
    text = functools.partial(f.text, TOKENS=tokens, **macros(mode), **offset)

    @wp.func_native(text("recurrence.inl", UNROLL=UNROLL, READ=read, REVERSE=reverse))
    def advance(arena: arena_type, base: int, p: Position, a: vec, h: vec) -> vec: ...

    @wp.func_native(text("recurrence.inl", DECAY=True))
    def decay(arena: arena_type, base: int, p: Position, a: vec, h: vec) -> vec: ...

    return advance, decay
