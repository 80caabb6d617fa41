"""The scan on CUDA: operands, launches and sums around the kernels.

All runs on torch's current stream, without synchronisation, in memory from torch's allocator. One
pass over the whole sequence computes each exponential once, but gives the machine only batch x
channels to do at once. Cut into segments, all run at once, and each but the last is computed
twice: first from zero, then from its first state.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple, no_type_check

import torch
import warp as wp
from torch import Tensor

from ...runtime import gpu
from ...runtime.launch import cuda_launch
from ...runtime.packed import count_slots
from ...runtime.scalars import LOG2E, exp2
from ...runtime.views import lane_contiguous
from ..problem import DISCRETIZATIONS, Inputs, Scan, like_inputs
from .kernels import (
    CHUNK,
    RUN,
    Rules,
    Sizes,
    backward_kernel,
    block_shape,
    forward_kernel,
    summary_kernel,
)

MOST_SEGMENTS = 256  # the carry between them is serial
RESIDENT = (3, 2)  # blocks of a multiprocessor, by their registers: forward, gradient
OVERHEAD = 16  # tokens


class Tuning(NamedTuple):
    """A choice of kernels; results differ between choices by rounding only.

    Attributes:
        segments: of the sequence in the forward, at most; 1 is one launch, more are three.
        channels: of a thread in the forward.
        states: of a thread in the forward; 16 / states threads share a channel.
        back_segments: as ``segments``, of the gradient.
        back_channels: as ``channels``, of the gradient.
        back_states: as ``states``, of the gradient.
        block: threads of a block, a multiple of 32.
    """

    segments: int = 1
    channels: int = 2
    states: int = 4
    back_segments: int = 1
    back_channels: int = 2
    back_states: int = 4
    block: int = 128


@functools.cache
def choose(
    batch: int, length: int, channels: int, states: int, groups: int, multiprocessors: int
) -> Tuning:
    """The tuning for a shape on a device with that many multiprocessors.

    The model: a multiprocessor holds ``RESIDENT`` blocks at a time, and k blocks at once take
    k + 1/2 times as long as one would take at its full rate. P segments take (2 - 1/P) times the
    work in the forward; the gradient's own kernel is longer, so that it is (4 - 1/P) / 3. Beginning
    and ending a segment costs as much as ``OVERHEAD`` tokens. In one pass the forward has twice
    the threads, of half as many states: docs/gpu.md has the times.
    """
    tuning = Tuning()
    if not batch or not length:
        return tuning
    units = -(-length // CHUNK)

    def segments(per_thread: tuple[int, int], resident: int, work: float) -> int:
        shape = block_shape(tuning.block, *per_thread, states)
        blocks = batch * groups * -(-(channels // groups) // shape.span)

        def cost(count: int) -> float:
            load = -(-blocks * count // multiprocessors)
            rounds = -(-load // resident)
            each = (work + 1 - 1 / count) / work / count
            return each * (load + 0.5 * rounds) * (1 + OVERHEAD * count / length)

        return min(range(1, min(units, MOST_SEGMENTS) + 1), key=cost)

    forward = segments((tuning.channels, tuning.states), RESIDENT[0], 1.0)
    return tuning._replace(
        segments=forward,
        states=2 if forward == 1 else tuning.states,
        back_segments=segments((tuning.back_channels, tuning.back_states), RESIDENT[1], 3.0),
    )


@functools.cache
def _carry_kernel(exponential: bool, reverse: bool):
    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    @no_type_check
    def carry(
        # in
        segments: int,
        states: int,
        A_in: wp.array2d(dtype=float),
        decay_in: wp.array3d(dtype=float),
        # in and out
        local_out: wp.array2d(dtype=float),
        state_out: wp.array2d(dtype=float),
    ):
        b, i = wp.tid()
        h = state_out[b, i]
        d = i / states
        n = i % states
        for k in range(segments):
            segment = k
            if wp.static(reverse):
                segment = segments - 1 - k
            at = b * segments + segment
            own = local_out[at, i]
            local_out[at, i] = h
            decay = wp.float32(0.0)
            if wp.static(exponential):
                total = wp.float32(0.0)
                for row in range(decay_in.shape[1]):
                    total += decay_in[at, row, d]
                decay = exp2(wp.static(LOG2E) * A_in[d, n] * total)
            else:
                decay = decay_in[at, d, n]
            h = decay * h + own

    return carry


@wp.kernel(enable_backward=False, grid_stride=False)
@no_type_check
def _sum_parts(
    # in
    groups: int,
    parts: int,
    parts_in: wp.array2d(dtype=float),
    # out
    sums_out: wp.array4d(dtype=float),
):
    row, i = wp.tid()
    first = row * parts
    # one after the other, as ``problem.sum_parts``
    total = parts_in[first, i]
    for part in range(1, parts):
        total += parts_in[first + part, i]
    states = sums_out.shape[3]
    sums_out[row / groups, i / states, row % groups, i % states] = total


class _Operands:
    """Tensors of one scan as the kernels take them, and its segments.

    ``state`` is new and dense, ``[B, D, N]`` or of packed rows ``[S, D, N]``: the first state, or
    the gradient of the last. ``output`` says that there are outputs, ``back`` that the gradient
    runs. Packed sequences, whose lengths are on the device, are cut as if these were equal: each
    into at most ``segments``, a short one into fewer.
    """

    def __init__(self, scan: Scan, state: Tensor | None, output: bool, back: bool):
        x, options = scan
        self.batch, self.length, self.channels = x.u.shape
        self.states, self.groups, self.device = x.A.shape[1], x.B.shape[2], x.u.device
        self.sequences, self.packed = scan.sequences, options.packed
        tokens = -(-self.batch * self.length // max(self.sequences, 1))
        shape = self.sequences, tokens, self.channels, self.states, self.groups
        tuning = choose(*shape, gpu.multiprocessors_of(self.device))
        per_thread, segments = (tuning.channels, tuning.states), tuning.segments
        if back:
            per_thread = (tuning.back_channels, tuning.back_states)
            segments = tuning.back_segments
        self.shape = block_shape(tuning.block, *per_thread, self.states)
        self.chunks = -(-self.length // CHUNK)
        self.segment = -(-max(self.chunks, 1) // segments) * CHUNK
        self.segments = min(segments, self.chunks)
        self.parts = -(-(self.channels // self.groups) // self.shape.span)
        if self.packed is None:
            self.segments = -(-self.length // self.segment)
            self.packed = torch.empty(0, 3, dtype=torch.int32, device=self.device)

        C = x.B if x.C is None else x.C
        matrix = x.B.dtype if x.B.dtype == C.dtype else torch.float32
        self.rules = Rules(
            (x.u.dtype, x.delta.dtype, matrix),
            self.shape,
            options.discretization,
            options.softplus,
            x.z is not None,
            output,
        )
        self.exponential = DISCRETIZATIONS[options.discretization].exponential
        self.u, self.delta = lane_contiguous(x.u), lane_contiguous(x.delta)
        self.z = self.u if x.z is None else lane_contiguous(x.z)
        self.A = x.A.float().contiguous()
        self.B, self.C = x.B.to(matrix), C.to(matrix)
        zero = torch.zeros(self.channels, dtype=torch.float32, device=self.device)
        self.D, self.bias = (
            zero if v is None else v.float().contiguous() for v in (x.D, x.delta_bias)
        )
        if state is None:
            shape = self.sequences, self.channels, self.states
            self.state = torch.zeros(shape, dtype=torch.float32, device=self.device)
        else:
            self.state = state.to(torch.float32, memory_format=torch.contiguous_format, copy=True)

    def empty(self, *shape: int) -> Tensor:
        return torch.empty(shape, dtype=torch.float32, device=self.device)

    def sizes(self, save: bool = False) -> Sizes:
        sizes = Sizes()
        sizes.length, sizes.states, sizes.groups = self.length, self.states, self.groups
        sizes.group_width = self.channels // self.groups
        sizes.parts, sizes.segments, sizes.segment = self.parts, self.segments, self.segment
        sizes.save = int(save)
        return sizes

    def inputs(self, save: bool = False) -> list:
        """Return the arguments that the forward and the gradient begin with."""
        tensors = self.u, self.delta, self.z, self.A[None], self.B, self.C, self.D, self.bias
        return [self.sizes(save), self.packed, *tensors]

    def launch(self, kernel: Any, inputs: list, outputs: list) -> None:
        blocks = self.sequences * self.segments * self.groups * self.parts
        threads = self.shape.block
        dim = (blocks, threads)
        cuda_launch(kernel, dim, inputs, outputs, device=self.device, block_dim=threads)

    def carried(self, kernel: Any, inputs: list, outputs: list, reverse: bool):
        """The state before each segment, from the last state from zero and the decay of each."""
        rows, width = self.sequences * self.segments, self.channels * self.states
        local = self.empty(rows, self.channels, self.states)
        decay = torch.empty_like(local)
        if self.exponential:
            decay = self.empty(rows, self.shape.rows, self.channels)
        self.launch(kernel, inputs, [local, decay, *outputs])
        cuda_launch(
            _carry_kernel(self.exponential, reverse),
            (self.sequences, width),
            [self.segments, self.states, self.A, decay],
            [local.view(-1, width), self.state.view(-1, width)],
            device=self.device,
        )
        return local


def saved_shape(x: Scan) -> tuple[int, ...]:
    """The shape of the saved states that ``forward`` returns, whatever the tuning."""
    (batch, length, _), packed = x.inputs.u.shape, x.options.packed
    rows = batch * -(-length // CHUNK)
    if packed is not None:
        rows = count_slots(packed, batch, length, CHUNK)
    return (rows if x.options.save else 0, *x.inputs.A.shape)


def forward(scan: Scan) -> tuple[Tensor, Tensor, Tensor]:
    """Runs the scan on CUDA; results as on the CPU."""
    x, options = scan
    o = _Operands(scan, x.initial_state, x.C is not None, back=False)
    shape = (o.batch, o.length if o.rules.output else 0, o.channels)
    out = torch.empty(shape, dtype=o.u.dtype, device=o.device)
    saved = o.empty(*saved_shape(scan))
    if not o.u.numel():
        return out, o.state, saved
    first, none = o.state, o.empty(0, 0, 0)
    if o.segments > 1:
        kernel = forward_kernel(o.rules._replace(gate=False, output=False), summary=True)
        first = o.carried(kernel, [*o.inputs(), o.state], [saved, out], False)
    last = torch.empty_like(o.state)
    outputs = [last, none, saved, out]
    kernel = forward_kernel(o.rules, summary=False)
    o.launch(kernel, [*o.inputs(options.save), first], outputs)
    return out, last, saved


def backward(
    dout: Tensor | None, dlast: Tensor | None, scan: Scan, saved: Tensor, needs: Inputs
) -> Inputs:
    """Gradients of ``forward``; arguments and results as on the CPU."""
    x, options = scan
    o = _Operands(scan, dlast, dout is not None, back=True)
    wanted = {
        "du": needs.u,
        "ddelta": needs.delta,
        "dz": needs.z and o.rules.gate and o.rules.output,
        "dB": needs.B,
        "dC": needs.C and o.rules.output,
        "dh": any(needs._replace(C=False, D=False, z=False)),
    }
    computed = frozenset(name for name, on in wanted.items() if on)

    def like(x: Tensor, name: str) -> Tensor:
        shape = x.shape if name in computed else (0, 0, 0)
        return torch.empty(shape, dtype=x.dtype, device=o.device)

    def sums(name: str) -> Tensor:
        rows = o.batch * o.groups * o.parts if name in computed else 0
        return o.empty(rows, o.length, o.states)

    def total(parts: Tensor) -> Tensor:
        total = o.empty(o.batch, o.length, o.groups, o.states)
        if total.numel():
            inputs = [o.groups, o.parts, parts.flatten(1)]
            dim = o.batch * o.groups, o.length * o.states
            cuda_launch(_sum_parts, dim, inputs, [total], device=o.device)
        return total

    du, ddelta, dz = like(o.u, "du"), like(o.delta, "ddelta"), like(o.u, "dz")
    dB, dC = sums("dB"), sums("dC")
    runs = o.batch * o.segments * -(-o.segment // (RUN * CHUNK))
    if options.packed is not None:
        runs = o.batch * o.length // (RUN * CHUNK) + o.sequences * o.segments
    dfirst = torch.empty_like(o.state)
    dA = o.state.new_zeros(runs, o.channels, o.states)
    dD, dbias = o.state.new_zeros(2, runs, o.shape.rows, o.channels)
    if o.u.numel():
        dout = o.u if dout is None else lane_contiguous(dout)
        last = o.state
        if o.segments > 1:  # the gradient of the state after each segment
            kernel = summary_kernel(o.rules)
            inputs = [o.sizes(), o.packed, o.delta, o.z, o.A[None], o.C, o.bias, dout]
            last = o.carried(kernel, inputs, [], True)
        kernel = backward_kernel(o.rules, computed)
        outputs = [dfirst, du, ddelta, dz, dA, dB, dC, dD, dbias]
        o.launch(kernel, [*o.inputs(), dout, saved, last], outputs)
    else:
        dfirst = o.state
    gradients = Inputs(
        u=du,
        delta=ddelta,
        A=dA.sum(0) if needs.A else None,
        B=total(dB) if needs.B else None,
        C=total(dC) if needs.C else None,
        D=dD.sum((0, 1)) if needs.D else None,
        z=dz,
        delta_bias=dbias.sum((0, 1)) if needs.delta_bias else None,
        initial_state=dfirst,
    )
    return like_inputs(gradients, x, needs)
