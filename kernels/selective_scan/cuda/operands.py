"""What the forward and the gradient on CUDA share: views of the tensors, sizes, launches, carry."""

from __future__ import annotations

import functools
from typing import Any, no_type_check

import torch
import warp as wp
from torch import Tensor

from ...runtime.launch import cuda_launch
from ...runtime.scalars import LOG2E, exp2
from ...runtime.views import lane_contiguous
from .blocks import MARK, BlockShape, Sizes, block_shape
from .tuning import scan_tuning


@functools.cache
def _carry_kernel(exponential: bool, reverse: bool):
    @wp.kernel(enable_backward=False, module="unique")
    @no_type_check
    def carry(
        # in
        segments: int,
        states: int,
        a_in: wp.array2d(dtype=float),
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
                decay = exp2(wp.static(LOG2E) * a_in[d, n] * total)
            else:
                decay = decay_in[at, d, n]
            h = decay * h + own

    return carry


class Operands:
    """The tensors of one scan as the kernels take them, and how it is cut.

    ``state`` is a new, dense ``[B, D, N]``: the first state, or the gradient of the last. ``shape``
    is the block shape. ``tuning`` holds the numbers that ``scan_tuning`` takes, ``back`` says that
    the gradient runs.
    """

    def __init__(self, u, delta, A, B, C, D, z, delta_bias, state, tuning, back: bool):
        self.batch, self.length, self.channels = u.shape
        self.states, self.groups, self.device = A.shape[1], B.shape[2], u.device
        tuning = scan_tuning(u.shape, self.states, self.groups, u.device, tuning)
        per_thread = (tuning.channels, tuning.states)
        segments = tuning.segments
        if back:
            per_thread = (tuning.back_channels, tuning.back_states)
            segments = tuning.back_segments
        self.shape: BlockShape = block_shape(tuning.block, *per_thread, self.states)
        self.marks = -(-self.length // MARK)
        self.segment = -(-max(self.marks, 1) // segments) * MARK
        self.segments = -(-self.length // self.segment)
        self.parts = -(-(self.channels // self.groups) // self.shape.span)

        matrix = B.dtype if B.dtype == C.dtype else torch.float32
        self.dtypes = (u.dtype, delta.dtype, matrix)
        self.u, self.delta = lane_contiguous(u), lane_contiguous(delta)
        self.z = self.u if z is None else lane_contiguous(z)
        self.A = A.float().contiguous()
        self.B, self.C = B.to(matrix), C.to(matrix)
        self.skip, self.bias = self._vector(D), self._vector(delta_bias)
        self.use_z = z is not None
        shape = (self.batch, self.channels, self.states)
        if state is None:
            self.state = torch.zeros(shape, device=self.device)
        else:
            self.state = state.to(torch.float32, memory_format=torch.contiguous_format, copy=True)

    def _vector(self, x: Tensor | None) -> Tensor:
        if x is None:
            return torch.zeros(self.channels, device=self.device)
        return x.float().contiguous()

    def sizes(self, save: bool = False) -> Sizes:
        sizes = Sizes()
        sizes.length, sizes.states, sizes.groups = self.length, self.states, self.groups
        sizes.group_width = self.channels // self.groups
        sizes.parts, sizes.segments, sizes.segment = self.parts, self.segments, self.segment
        sizes.save = int(save)
        return sizes

    def empty(self, *shape: int) -> Tensor:
        return torch.empty(shape, device=self.device)

    def launch(self, kernel: Any, inputs: list, outputs: list) -> None:
        blocks = self.batch * self.segments * self.groups * self.parts
        threads = self.shape.block
        dim = (blocks, threads)
        cuda_launch(kernel, dim, inputs, outputs, device=self.device, block_dim=threads)

    def summary(self, mode: str) -> tuple[Tensor, Tensor]:
        """Empty tensors: what each segment adds to the state that enters it, and its decay."""
        rows = self.batch * self.segments
        local = self.empty(rows, self.channels, self.states)
        if mode == "bilinear":
            return local, torch.empty_like(local)
        return local, self.empty(rows, self.shape.rows, self.channels)

    def carry(self, mode: str, reverse: bool, local: Tensor, decay: Tensor) -> None:
        """Turns what each segment adds into the state that enters it."""
        width = self.channels * self.states
        cuda_launch(
            _carry_kernel(mode != "bilinear", reverse),
            (self.batch, width),
            [self.segments, self.states, self.A, decay],
            [local.view(-1, width), self.state.view(-1, width)],
            device=self.device,
            block_dim=128,
        )
