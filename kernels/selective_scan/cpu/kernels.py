"""The CPU kernels: lanes are adjacent channels, tokens run in strips, states a few at a time.

A task is one batch element, a segment of its tokens, and lane groups of one channel group. In a
strip it holds what does not depend on the state n, and walks the tokens once per few n and lane
group: their h_n live in registers and N is free. The loops are C++ in the files beside this one.
Equations are those of README.md.
"""

import functools
from pathlib import Path
from typing import NamedTuple, no_type_check

import torch
import warp as wp

from ...runtime.lanes import (
    WARP_DTYPES,
    W,
    flush_denormals,
    lanes,
    prelude,
    restore_denormals,
)
from ...runtime.native import native
from ...runtime.rows import ROWS, settle
from ...runtime.views import struct
from ..problem import DISCRETIZATIONS, macros

SPAN = 32  # lane groups of a task at most: rows are read in long parts that fit a core's cache
BLOCKS = 4  # lane groups whose dB and dC are one partial sum, whatever the number of threads
FEW = 8  # states up to which the memory, and not the arithmetic, sets the time

# A chunk is walked with care for slow decays where |x| <= 1/128 in one channel of the sixteen at
# least, or 1/32 in all. Then all channels with |x| <= 1/32 count as slow. Chunks of more than 64
# tokens take smaller limits, by their length, so that a state does not leave its base far behind.
SLOWEST, MODERATE = 1 / 128, 1 / 32

# gradients that cost work inside the loops, as bits of ``needs``
NEEDS = {"NEED_DZ": 1, "NEED_DC": 2, "NEED_DB": 4, "NEED_DH": 8}

_HERE = Path(__file__).parent
_P = wp.constant(BLOCKS)
_W = wp.constant(W)


class Tuning(NamedTuple):
    """What is fixed when a kernel is compiled; ``make study WHAT=scan`` has what each choice costs.

    Attributes:
        chunk: tokens between saved states, which the gradient walks at once; a multiple of
            8 and of ``strip``.
        strip: tokens that the forward walks at once for one state.
        degree: of the polynomial for the decays' 2^x, 2 to 6; the relative error of a decay is
            at most 2e-3, 1e-4, 3e-6, 3e-7 and 7.5e-9.
        table: whether a table of 16 and a cubic make 2^x in place of the polynomial where the
            processor has AVX-512; the relative error of a decay is then at most 6e-8.
        walked: states that the forward walks at once; 0 for 2 where there are FEW, else 4. A walk
            fetches one tensor's rows of the next strip, so few states need shorter walks.
        walked_back: states that the gradient walks at once.
    """

    chunk: int = 64
    strip: int = 32
    degree: int = 5
    table: bool = True
    walked: int = 0
    walked_back: int = 4


class Kind(NamedTuple):
    """What a kernel is compiled for: the dtypes of u and delta, the rule, and the tuning."""

    io: torch.dtype
    delta_io: torch.dtype
    discretization: str
    tuning: Tuning

    def text(self, file: str, gradient: bool, output: bool = True) -> str:
        """A leaf's C++."""
        tuning, rule = self.tuning, DISCRETIZATIONS[self.discretization]
        tokens = tuning.chunk if gradient else tuning.strip
        at_once = tuning.walked_back if gradient else tuning.walked
        share = min(1.0, 64 / tuning.chunk)
        limits = {"SLOWEST": SLOWEST * share, "MODERATE": MODERATE * share}
        text = native(
            _HERE / file, **macros(self.discretization, True), **limits, **NEEDS, SCALE=rule.scale,
            GRADIENT=gradient, OUTPUT=output, TOKENS=tokens, AT_ONCE=at_once, BLOCKS=BLOCKS,
        )  # fmt: skip
        return prelude(tuning.degree, tuning.table) + ROWS + text


@struct
class Sizes:
    """What the kernels know: shapes, options, and which gradients are wanted."""

    length: int
    segment: int  # tokens of a segment, a multiple of the chunk
    segments: int
    batch: int
    states: int
    groups: int
    group_width: int
    group_blocks: int
    span: int
    use_softplus: int
    use_z: int
    needs: int
    stream: int  # whether results go past the caches


@struct
class Place:
    """Where a task works: first of a task, then of one lane group and strip."""

    sizes: Sizes
    b: int
    state: int  # row of the state arrays, which are ordered by segment, then batch element
    group: int
    begin: int  # tokens
    end: int
    first: int  # lane group of the task
    blocks: int  # its lane groups
    part: int  # row of the partial sums of dB and dC
    t0: int  # tokens of the strip
    count: int
    j: int  # lane group of the task, and of all
    k: int
    d: int  # channels
    width: int


@wp.func
@no_type_check
def _place(sizes: Sizes, task: int) -> Place:
    spans = (sizes.group_blocks + sizes.span - 1) / sizes.span
    first = task % spans * sizes.span
    rest = task / spans
    group = rest % sizes.groups
    rest = rest / sizes.groups
    p = Place()
    p.sizes = sizes
    p.b = rest % sizes.batch
    p.state = rest
    p.group = group
    parts = (sizes.group_blocks + _P - 1) / _P
    p.part = (p.b * sizes.groups + group) * parts + first / _P
    p.begin = rest / sizes.batch * sizes.segment
    p.end = wp.min(p.begin + sizes.segment, sizes.length)
    p.blocks = wp.min(sizes.span, sizes.group_blocks - first)
    p.first = first
    return p


@wp.func
@no_type_check
def _at(place: Place, t0: int, tokens: int, j: int) -> Place:
    """The place of a strip of so many tokens, or fewer, and a lane group."""
    p = place
    p.t0 = t0
    p.count = wp.min(tokens, p.end - t0)
    p.j = j
    p.k = p.group * p.sizes.group_blocks + p.first + j
    p.d = p.group * p.sizes.group_width + (p.first + j) * _W
    p.width = wp.min(_W, p.sizes.group_width - (p.first + j) * _W)
    return p


@functools.cache
def forward_kernel(kind: Kind, output: bool):
    """Brings the states in ``h_out`` from before each segment to after it.

    States, gradients of states and products of decays are pairs: N values, then for each what it
    has rounded away (``states.h``). ``channel_in`` has for each lane group the N rates of A, then
    the greatest |A|, D and the bias.

    With ``output`` it computes y; else it multiplies the decays into ``product_out``, and z, C and
    D are not used.
    """
    scalar, delta_scalar = WARP_DTYPES[kind.io], WARP_DTYPES[kind.delta_io]
    chunk_size, strip_size = kind.tuning.chunk, kind.tuning.strip

    @wp.func_native(kind.text("forward.inl", False, output))
    def walk(
        p: Place,
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        z_in: wp.array3d(dtype=scalar),
        channel_in: wp.array(dtype=lanes),
        b_in: wp.array4d(dtype=wp.float32),
        c_in: wp.array4d(dtype=wp.float32),
        h_out: wp.array(dtype=lanes),
        product_out: wp.array(dtype=lanes),
        y_out: wp.array3d(dtype=scalar),
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    @no_type_check
    def scan_forward(
        offset: int,
        # in
        sizes: Sizes,
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        z_in: wp.array3d(dtype=scalar),
        channel_in: wp.array2d(dtype=lanes),
        b_in: wp.array4d(dtype=wp.float32),
        c_in: wp.array4d(dtype=wp.float32),
        # out
        h_out: wp.array3d(dtype=lanes),
        product_out: wp.array3d(dtype=lanes),
        starts_out: wp.array4d(dtype=lanes),
        y_out: wp.array3d(dtype=scalar),
    ):
        task = _place(sizes, offset + wp.tid())
        before = flush_denormals()
        for strip in range((task.end - task.begin + strip_size - 1) / strip_size):
            t0 = task.begin + strip * strip_size
            for j in range(task.blocks):
                p = _at(task, t0, strip_size, j)
                h = h_out[p.state, p.k]
                if starts_out.shape[1] > 0 and t0 % chunk_size == 0:
                    for n in range(sizes.states):
                        starts_out[p.b, t0 / chunk_size, p.k, n] = h[n]
                walk(
                    p, u_in, delta_in, z_in, channel_in[p.k], b_in, c_in, h,
                    product_out[p.state, p.k], y_out,
                )  # fmt: skip
        restore_denormals(before)
        settle()

    return scan_forward


@functools.cache
def gradient_states_kernel(kind: Kind):
    """What a segment's outputs send back to the state before it, and the products of the decays."""
    scalar, delta_scalar = WARP_DTYPES[kind.io], WARP_DTYPES[kind.delta_io]
    chunk_size = kind.tuning.chunk

    @wp.func_native(kind.text("gather.inl", True))
    def gather(
        p: Place,
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        z_in: wp.array3d(dtype=scalar),
        channel_in: wp.array(dtype=lanes),
        c_in: wp.array4d(dtype=wp.float32),
        dout_in: wp.array3d(dtype=scalar),
        dh_out: wp.array(dtype=lanes),
        product_out: wp.array(dtype=lanes),
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    @no_type_check
    def scan_gradient_states(
        offset: int,
        # in
        sizes: Sizes,
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        z_in: wp.array3d(dtype=scalar),
        channel_in: wp.array2d(dtype=lanes),
        c_in: wp.array4d(dtype=wp.float32),
        dout_in: wp.array3d(dtype=scalar),
        # out
        dh_out: wp.array3d(dtype=lanes),
        product_out: wp.array3d(dtype=lanes),
    ):
        task = _place(sizes, offset + wp.tid())
        before = flush_denormals()
        for chunk in range((task.end - task.begin + chunk_size - 1) / chunk_size):
            for j in range(task.blocks):
                p = _at(task, task.begin + chunk * chunk_size, chunk_size, j)
                gather(
                    p, u_in, delta_in, z_in, channel_in[p.k], c_in, dout_in, dh_out[p.state, p.k],
                    product_out[p.state, p.k],
                )  # fmt: skip
        restore_denormals(before)

    return scan_gradient_states


@functools.cache
def backward_kernel(kind: Kind):
    """Computes all gradients from those of the states after each segment, in ``dh_out``."""
    scalar, delta_scalar = WARP_DTYPES[kind.io], WARP_DTYPES[kind.delta_io]
    chunk_size = kind.tuning.chunk

    @wp.func_native(kind.text("backward.inl", True))
    def walk(
        p: Place,
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        z_in: wp.array3d(dtype=scalar),
        channel_in: wp.array(dtype=lanes),
        b_in: wp.array4d(dtype=wp.float32),
        c_in: wp.array4d(dtype=wp.float32),
        starts_in: wp.array(dtype=lanes),
        dout_in: wp.array3d(dtype=scalar),
        sums_out: wp.array(dtype=lanes),
        dh_out: wp.array(dtype=lanes),
        du_out: wp.array3d(dtype=scalar),
        ddelta_out: wp.array3d(dtype=delta_scalar),
        dz_out: wp.array3d(dtype=scalar),
        da_out: wp.array(dtype=lanes),
        dchannel_out: wp.array2d(dtype=lanes),
    ): ...

    @wp.func_native(native(_HERE / "sum_lanes.inl", TOKENS=chunk_size, **NEEDS))
    def sum_lanes(
        p: Place,
        sums_in: wp.array(dtype=lanes),
        db_out: wp.array(dtype=wp.float32),
        dc_out: wp.array(dtype=wp.float32),
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    @no_type_check
    def scan_backward(
        offset: int,
        # in
        sizes: Sizes,
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        z_in: wp.array3d(dtype=scalar),
        channel_in: wp.array2d(dtype=lanes),
        b_in: wp.array4d(dtype=wp.float32),
        c_in: wp.array4d(dtype=wp.float32),
        starts_in: wp.array4d(dtype=lanes),
        dout_in: wp.array3d(dtype=scalar),
        # workspace
        sums_out: wp.array2d(dtype=lanes),
        # out
        dh_out: wp.array3d(dtype=lanes),
        du_out: wp.array3d(dtype=scalar),
        ddelta_out: wp.array3d(dtype=delta_scalar),
        dz_out: wp.array3d(dtype=scalar),
        da_out: wp.array3d(dtype=lanes),
        db_out: wp.array2d(dtype=wp.float32),
        dc_out: wp.array2d(dtype=wp.float32),
        dchannel_out: wp.array4d(dtype=lanes),
    ):
        index = offset + wp.tid()
        task = _place(sizes, index)
        before = flush_denormals()
        chunks = (task.end - task.begin + chunk_size - 1) / chunk_size
        for again in range(chunks):
            t0 = task.begin + (chunks - 1 - again) * chunk_size
            chunk = t0 / chunk_size
            for j in range(task.blocks):
                p = _at(task, t0, chunk_size, j)
                walk(
                    p, u_in, delta_in, z_in, channel_in[p.k], b_in, c_in,
                    starts_in[p.b, chunk, p.k], dout_in, sums_out[index], dh_out[p.state, p.k],
                    du_out, ddelta_out, dz_out, da_out[p.state, p.k], dchannel_out[p.b, chunk],
                )  # fmt: skip
                if j % _P == _P - 1 or j == p.blocks - 1:
                    part = p.part + j / _P
                    sum_lanes(p, sums_out[index], db_out[part], dc_out[part])
        restore_denormals(before)
        settle()

    return scan_backward
