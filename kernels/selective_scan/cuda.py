"""The scan on CUDA: operands, launches and sums around the kernels of ``cuda_kernels.py``."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from ..interop import cuda_launch, lane_contiguous, view
from .cuda_forward import forward_kernel
from .cuda_kernels import BLOCK, CHUNK, Sizes, carry, kernels
from .cuda_operands import Operands


class _Plan:
    """Shapes, launches and operands that forward and backward share."""

    def __init__(self, u, delta, A, B, C, D, z, delta_bias, softplus, discretization):
        self.batch, self.length, self.channels = u.shape
        self.states, self.groups, self.device = A.shape[1], B.shape[2], u.device
        sizes = Sizes()
        sizes.length, sizes.groups = self.length, self.groups
        sizes.group_width = self.channels // self.groups
        sizes.parts = self.parts = -(-sizes.group_width // BLOCK)
        sizes.chunks = self.chunks = -(-self.length // CHUNK)
        sizes.use_softplus, sizes.use_z = int(softplus), int(z is not None)
        self.sizes = sizes
        self.kernels = kernels(u.dtype, delta.dtype, discretization, self.states)
        self.vec = wp.types.vector(self.states, wp.float32)
        self.u, self.delta = lane_contiguous(u), lane_contiguous(delta)
        self.z = self.u if z is None else lane_contiguous(z)
        self.a = self.vectors(A)
        self.b, self.c = self.vectors(B), self.vectors(C)
        self.skip, self.bias = self.vector(D), self.vector(delta_bias)

    def vectors(self, x: Tensor):
        return view(x.float().contiguous(), self.vec)

    def vector(self, x: Tensor | None) -> Tensor:
        if x is None:
            return torch.zeros(self.channels, device=self.device)
        return x.float().contiguous()

    def per_chunk(self) -> Tensor:
        shape = (self.batch, self.chunks, self.channels, self.states)
        return torch.empty(shape, device=self.device)

    def launch(self, name: str, inputs: list, outputs: list) -> None:
        blocks = self.batch * self.chunks * self.groups * self.parts
        dim = (blocks, BLOCK)
        inputs = [self.sizes, *inputs]
        cuda_launch(self.kernels[name], dim, inputs, outputs, device=self.device, block_dim=BLOCK)

    def carry(self, reverse: bool, decay: Tensor, local: Tensor, state: Tensor) -> None:
        width = self.channels * self.states
        shape = (self.batch, self.chunks, width)
        arguments = [int(reverse), decay.view(shape), local.view(shape)]
        dim = (self.batch, width)
        outputs = [state.view(dim)]
        cuda_launch(carry, dim, arguments, outputs, device=self.device, block_dim=128)

    def total(self, parts: Tensor, dtype: torch.dtype) -> Tensor:
        """Sums ``[B·G·parts, L, N]`` over the parts of a group: ``[B, L, G, N]``."""
        shape = (self.batch, self.groups, self.parts, self.length, self.states)
        return parts.view(shape).sum(2).transpose(1, 2).to(dtype).contiguous()


def _state(plan: _Plan, x: Tensor | None) -> Tensor:
    if x is None:
        return torch.zeros(plan.batch, plan.channels, plan.states, device=plan.device)
    return x.float().contiguous().clone()


def forward(u, delta, A, B, C, D, z, delta_bias, initial_state, softplus, discretization, save):
    """Runs the scan on CUDA; arguments and results as ``cpu.forward``."""
    o = Operands(u, delta, A, B, C, D, z, delta_bias, initial_state, back=False)
    return _forward(o, softplus, discretization, save, True)


def final_state(u, delta, A, B, delta_bias, initial_state, softplus, discretization, save):
    """The last state ``[B, D, N]`` of ``forward`` alone, and the saved states."""
    o = Operands(u, delta, A, B, B, None, None, delta_bias, initial_state, back=False)
    _, last, saved = _forward(o, softplus, discretization, save, False)
    return last, saved


def _forward(o: Operands, softplus: bool, mode: str, save: bool, read: bool):
    out = torch.empty(
        (o.batch, o.length if read else 0, o.channels), dtype=o.u.dtype, device=o.device
    )
    saved = o.empty(o.batch, o.marks if save else 0, o.channels, o.states)
    if not o.u.numel():
        return out, o.state, saved
    inputs = [o.u, o.delta, o.z, o.A[None], o.B, o.C, o.skip, o.bias]
    flat = saved.view(-1, o.channels, o.states)
    first, decay = o.state, o.empty(0, 0, 0)
    if o.pieces > 1:
        first, decay = o.summary(mode)
        kernel = forward_kernel(o.dtypes, mode, o.frame, False, True, softplus, False)
        o.launch(kernel, [o.sizes(), *inputs, o.state], [first, decay, flat, out])
        o.carry(mode, False, first, decay)
    last = torch.empty_like(o.state)
    kernel = forward_kernel(o.dtypes, mode, o.frame, read, False, softplus, o.use_z and read)
    o.launch(kernel, [o.sizes(save), *inputs, first], [last, decay, flat, out])
    return out, last, saved


def backward(
    dout, dlast, u, delta, A, B, C, D, z, delta_bias, starts, softplus, discretization, needs
):
    """Gradients of ``forward``; arguments and results as ``cpu.backward``."""
    plan = _Plan(u, delta, A, B, C, D, z, delta_bias, softplus, discretization)
    need_u, need_delta, _, need_B, need_C, _, need_z, _, _ = needs
    plan.sizes.need_db, plan.sizes.need_dc = int(need_B), int(need_C)
    dstate = _state(plan, dlast)
    rows = plan.batch * plan.groups * plan.parts

    def like(x: Tensor, needed: bool) -> Tensor:
        return x.new_empty(x.shape if needed else (x.shape[0], 0, x.shape[2]))

    def sums(needed: bool) -> Tensor:
        return A.new_empty(rows if needed else 0, plan.length, plan.states)

    du, ddelta, dz = like(u, need_u), like(delta, need_delta), like(u, need_z)
    db, dc = sums(need_B), sums(need_C)
    decay, ends, da = plan.per_chunk(), plan.per_chunk(), plan.per_chunk()
    dskip, dbias = torch.empty(2, *da.shape[:3], device=u.device)
    s, vec = plan, plan.vec
    if dout.numel():
        dout = lane_contiguous(dout)
        plan.launch(
            "summarise_backward",
            [s.delta, s.z, s.a, s.c, s.bias, dout],
            [view(decay, vec), view(ends, vec)],
        )
        plan.carry(True, decay, ends, dstate)
        plan.launch(
            "scan_backward",
            [
                s.u, s.delta, s.z, s.a, s.b, s.c, s.skip, s.bias,
                view(starts, vec), view(ends, vec), dout,
            ],
            [du, ddelta, dz, view(da, vec), view(db, vec), view(dc, vec), dskip, dbias],
        )  # fmt: skip
    values = (
        lambda: du,
        lambda: ddelta,
        lambda: da.sum((0, 1)),
        lambda: plan.total(db, B.dtype),
        lambda: plan.total(dc, C.dtype),
        lambda: dskip.sum((0, 1)).to(D.dtype),
        lambda: dz,
        lambda: dbias.sum((0, 1)).to(delta_bias.dtype),
        lambda: dstate,
    )
    return [value() if needed else None for value, needed in zip(values, needs)]


def saved_shape(u: Tensor, A: Tensor, B: Tensor, save: bool) -> tuple[int, ...]:
    """The shape of the saved states that ``forward`` returns."""
    return (u.shape[0], -(-u.shape[1] // CHUNK) if save else 0, *A.shape)
