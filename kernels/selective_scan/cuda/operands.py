"""What the forward and the gradient on CUDA share: views of the tensors, sizes, launches, carry."""

from __future__ import annotations

import functools

import torch
import warp as wp
from torch import Tensor

from ...runtime.launch import cuda_launch
from ...runtime.scalars import LOG2E, exp2
from ...runtime.views import lane_contiguous
from .blocks import MARK, Frame, Sizes, frame
from .tuning import scan_variant


@functools.cache
def _carry_kernel(exponential: bool, reverse: bool):
    @wp.kernel(enable_backward=False, module="unique")
    def carry(
        # in
        pieces: int,
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
        for k in range(pieces):
            piece = k
            if wp.static(reverse):
                piece = pieces - 1 - k
            at = b * pieces + piece
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

    ``state`` is a new, dense ``[B, D, N]``: the first state, or the gradient of the last.
    """

    def __init__(self, u, delta, A, B, C, D, z, delta_bias, state, back: bool):
        self.batch, self.length, self.channels = u.shape
        self.states, self.groups, self.device = A.shape[1], B.shape[2], u.device
        variant = scan_variant(u.shape, self.states, self.groups, u.device)
        self.block = variant.block
        per_thread = (variant.channels, variant.states)
        pieces = variant.pieces
        if back:
            per_thread = (variant.back_channels, variant.back_states)
            pieces = variant.back_pieces
        self.frame: Frame = frame(variant.block, *per_thread, self.states)
        marks = -(-self.length // MARK)
        self.piece = -(-max(marks, 1) // pieces) * MARK
        self.pieces = -(-self.length // self.piece)
        self.marks = marks
        self.parts = -(-(self.channels // self.groups) // self.frame.span)

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
        sizes.parts, sizes.pieces, sizes.piece = self.parts, self.pieces, self.piece
        sizes.save = int(save)
        return sizes

    def empty(self, *shape: int) -> Tensor:
        return torch.empty(shape, device=self.device)

    def launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        blocks = self.batch * self.pieces * self.groups * self.parts
        dim = (blocks, self.block)
        cuda_launch(kernel, dim, inputs, outputs, device=self.device, block_dim=self.block)

    def summary(self, mode: str) -> tuple[Tensor, Tensor]:
        """For what each piece adds to a state that enters it, and its decay."""
        rows = self.batch * self.pieces
        local = self.empty(rows, self.channels, self.states)
        if mode == "bilinear":
            return local, torch.empty_like(local)
        return local, self.empty(rows, self.frame.rows, self.channels)

    def carry(self, mode: str, reverse: bool, local: Tensor, decay: Tensor) -> None:
        """Turns what each piece adds into the state that enters it."""
        width = self.channels * self.states
        cuda_launch(
            _carry_kernel(mode != "bilinear", reverse),
            (self.batch, width),
            [self.pieces, self.states, self.A, decay],
            [local.view(-1, width), self.state.view(-1, width)],
            device=self.device,
            block_dim=128,
        )
