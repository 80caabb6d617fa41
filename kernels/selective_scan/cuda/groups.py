"""A thread's own elements of a tile in the gradient: four adjacent tokens of one channel at a time.

In shared memory these four are one vector, ``[token / 4, channel, 4]``, so that a thread stores and
loads them at once, and so does the recurrence. ``row`` takes every ``rows``-th group of tokens.
"""

import dataclasses
import functools

import torch
import warp as wp

from ...runtime.lanes import WARP_DTYPES
from ...runtime.scalars import WIDE
from .blocks import BITS, BlockShape, arena_io

FOUR = 4  # tokens of a vector

# A place in device memory as one number: the compiler would otherwise find it again at each access,
# from the tensor's address and two strides.
_PLACE = """
#if defined(__CUDA_ARCH__)
unsigned long long r;
asm("add.s64 %0, %1, %2;" : "=l"(r) : "l"(at), "l"(wide_(b, x_in.strides[0])));
return r;
#else
return (wp::uint64)at + wide_(b, x_in.strides[0]);
#endif
"""
_GLOBAL = """
#if defined(__CUDA_ARCH__)
__builtin_assume(__isGlobal(at));
#endif
"""


@dataclasses.dataclass(frozen=True)
class Groups:
    """How the tokens of a tile are shared out among the threads of a channel."""

    shape: BlockShape
    tokens: int  # of a tile, a multiple of FOUR and of the rows

    @property
    def count(self) -> int:
        """Elements of a thread."""
        return self.tokens // self.shape.rows

    @property
    def adjacent(self) -> int:
        """Of these so many tokens are adjacent."""
        return min(FOUR, self.count)

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
    """Access to a thread's elements of ``[B, L, D]``, whose place is found once, as 64 bits.

    ``fetch`` loads bits, as ``blocks.channel_io`` does, from the thread's token ``t`` on. In place
    of tokens after ``last`` it loads that one: this costs less than conditions, and what comes of
    them is masked. ``store`` does nothing unless ``inside``.
    """
    scalar = WARP_DTYPES[io]
    element, word, _ = BITS[io]
    raw = wp.types.vector(g.count, wp.uint32)

    @wp.func_native(f"{WIDE} const {element}* at = ({element}*)x_in.data + d; {_PLACE}")
    def place(x_in: wp.array3d(dtype=scalar), b: int, d: int) -> wp.uint64: ...

    loads = "".join(
        f"r.c[{i}] = *(const {word}*)(at + wide_(near_(t + {g.token(i)}), x_in.strides[1]));\n"
        for i in range(g.count)
    )

    load = f"""{WIDE}
auto near_ = [&](int i) -> int {{ return i < last ? i : last; }};
const char* at = (const char*)origin;
{_GLOBAL}
wp::vec_t<{g.count}, unsigned> r;
{loads}
return r;
"""
    write = f"""{WIDE}
char* at = (char*)origin;
{_GLOBAL}
at += wide_(t, x_out.strides[1]);
const {element} rounded = ({element})v;
if (inside) *({element}*)at = rounded;
"""

    @wp.func_native(load)
    def fetch(x_in: wp.array3d(dtype=scalar), origin: wp.uint64, t: int, last: int) -> raw: ...

    @wp.func_native(write)
    def store(
        x_out: wp.array3d(dtype=scalar), origin: wp.uint64, t: int, inside: bool, v: float
    ): ...

    return raw, place, fetch, store


@functools.cache
def row_io(f: BlockShape, io: torch.dtype, tokens: int):
    """As ``group_io`` for a block's tile of B or C, ``[B, L, G, N]``; for ``blocks.matrix_io``."""
    scalar = WARP_DTYPES[io]
    size = tokens * f.padded
    count = -(-size // f.block)
    raw = wp.types.vector(count, wp.uint32)

    @wp.func_native(
        f"{WIDE} const char* at = (char*)x_in.data + wide_(g, x_in.strides[2]); {_PLACE}"
    )
    def place(x_in: wp.array4d(dtype=scalar), b: int, g: int) -> wp.uint64: ...

    load = f"""{WIDE}
const char* at = (const char*)origin;
{_GLOBAL}
wp::vec_t<{count}, unsigned> r;
WP_PRAGMA_UNROLL
for (int i = 0; i < {count}; ++i) {{
    const int e = {f.block} * i + lane, n = e % {f.padded};
    int t = t0 + e / {f.padded};
    t = t < last ? t : last;
    const char* from = at + wide_(n, x_in.strides[3]);
    if (n < states && e < {size})
        r.c[i] = *(const {BITS[io][1]}*)(from + wide_(t, x_in.strides[1]));
}}
return r;
"""

    @wp.func_native(load)
    def fetch(
        x_in: wp.array4d(dtype=scalar),
        origin: wp.uint64,
        lane: int,
        states: int,
        t0: int,
        last: int,
    ) -> raw: ...

    return place, fetch


@functools.cache
def group_shared(g: Groups, arena_size: int):
    """``put`` and ``get`` of a thread's elements in shared memory; ``sum_lanes`` of lanes' sums."""
    f = g.shape
    own = wp.types.vector(g.count, wp.float32)
    arena_type, _, _ = arena_io(arena_size)
    n = g.adjacent

    def loop(body: str, step: int) -> str:
        at = f"((k * {f.rows} + row) * {n}) / {FOUR} * {FOUR * step} + row * {n} % {FOUR}"
        return f"""
#if defined(__CUDA_ARCH__)
struct alignas({4 * n}) Vector {{ float v[{n}]; }};
#else
struct Vector {{ float v[{n}]; }};
#endif
WP_PRAGMA_UNROLL
for (int k = 0; k < {g.count // n}; ++k) {{
    float* p = arena.data.ptr + at + {at};
    {body}
}}
"""

    @wp.func_native(
        loop(
            f"""Vector v;
    WP_PRAGMA_UNROLL
    for (int m = 0; m < {n}; ++m) v.v[m] = x.c[k * {n} + m];
    *(Vector*)(p + c * {FOUR}) = v;""",
            f.span,
        )
    )
    def put(arena: arena_type, at: int, c: int, row: int, x: own): ...

    @wp.func_native(
        f"wp::vec_t<{g.count}, float> x;"
        + loop(
            f"""const Vector v = *(const Vector*)(p + c * {FOUR});
    WP_PRAGMA_UNROLL
    for (int m = 0; m < {n}; ++m) x.c[k * {n} + m] = v.v[m];""",
            f.span,
        )
        + "return x;"
    )
    def get(arena: arena_type, at: int, c: int, row: int) -> own: ...

    @wp.func_native(
        f"wp::vec_t<{g.count}, float> x;"
        + loop(
            f"""p += (c % {f.channels} * {g.step} + c / {f.channels}) * {FOUR};
    WP_PRAGMA_UNROLL
    for (int q = 0; q < {f.lanes}; ++q) {{
        const Vector v = *(const Vector*)(p + q * {g.lane_stride});
        WP_PRAGMA_UNROLL
        for (int m = 0; m < {n}; ++m)
            x.c[k * {n} + m] = q > 0 ? x.c[k * {n} + m] + v.v[m] : v.v[m];
    }}""",
            f.channels * g.step,
        )
        + "return x;"
    )
    def sum_lanes(arena: arena_type, at: int, c: int, row: int) -> own: ...

    return own, put, get, sum_lanes
