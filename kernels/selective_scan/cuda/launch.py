"""The scan on CUDA: launches and sums around the kernels of ``forward.py`` and ``backward.py``.

``tuning.py`` chooses among them: a ``tuning`` is empty or holds the numbers of a ``Tuning``. All
runs on torch's current stream, without synchronisation, in memory from torch's allocator.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ...runtime.views import lane_contiguous
from .backward import RUN, backward_kernel
from .blocks import MARK
from .forward import forward_kernel
from .operands import Operands
from .summary import summary_kernel


def forward(
    u, delta, A, B, C, D, z, delta_bias, initial_state, softplus, discretization, save, tuning
):
    """Runs the scan on CUDA; arguments and results as ``cpu.forward``."""
    o = Operands(u, delta, A, B, C, D, z, delta_bias, initial_state, tuning, back=False)
    return _forward(o, softplus, discretization, save, True)


def final_state(u, delta, A, B, delta_bias, initial_state, softplus, discretization, save, tuning):
    """The last state ``[B, D, N]`` of ``forward`` alone, and the saved states."""
    o = Operands(u, delta, A, B, B, None, None, delta_bias, initial_state, tuning, back=False)
    _, last, saved = _forward(o, softplus, discretization, save, False)
    return last, saved


def _forward(o: Operands, softplus: bool, mode: str, save: bool, read: bool):
    shape = (o.batch, o.length if read else 0, o.channels)
    out = torch.empty(shape, dtype=o.u.dtype, device=o.device)
    saved = o.empty(o.batch, o.marks if save else 0, o.channels, o.states)
    if not o.u.numel():
        return out, o.state, saved
    inputs = [o.u, o.delta, o.z, o.A[None], o.B, o.C, o.skip, o.bias]
    flat = saved.view(-1, o.channels, o.states)
    first, decay = o.state, o.empty(0, 0, 0)
    if o.segments > 1:
        first, decay = o.summary(mode)
        kernel = forward_kernel(o.dtypes, mode, o.shape, False, True, softplus, False)
        o.launch(kernel, [o.sizes(), *inputs, o.state], [first, decay, flat, out])
        o.carry(mode, False, first, decay)
    last = torch.empty_like(o.state)
    kernel = forward_kernel(o.dtypes, mode, o.shape, read, False, softplus, o.use_z and read)
    o.launch(kernel, [o.sizes(save), *inputs, first], [last, decay, flat, out])
    return out, last, saved


def backward(
    dout, dlast, u, delta, A, B, C, D, z, delta_bias, saved, softplus, discretization, needs,
    tuning,
):  # fmt: skip
    """Gradients of ``forward``; arguments and results as ``cpu.backward``."""
    o = Operands(u, delta, A, B, C, D, z, delta_bias, dlast, tuning, back=True)
    grads = _backward(o, dout, saved, softplus, discretization, needs)
    dtypes = [None if x is None else x.dtype for x in (u, delta, A, B, C, D, z, delta_bias, A)]
    return _wanted(grads, needs, dtypes)


def final_state_backward(
    dlast, u, delta, A, B, delta_bias, saved, softplus, discretization, needs, tuning
):
    """Gradients of ``final_state``: six, for u, delta, A, B, delta_bias and the initial state."""
    o = Operands(u, delta, A, B, B, None, None, delta_bias, dlast, tuning, back=True)
    u_, delta_, A_, B_, bias_, state_ = needs
    needs = (u_, delta_, A_, B_, False, False, False, bias_, state_)
    grads = _backward(o, None, saved, softplus, discretization, needs)
    dtypes = [None if x is None else x.dtype for x in (u, delta, A, B, B, u, u, delta_bias, A)]
    grads = _wanted(grads, needs, dtypes)
    return [grads[i] for i in (0, 1, 2, 3, 7, 8)]


def _wanted(grads: list, needs, dtypes: list) -> list:
    """Nine gradients in the types of their tensors, None where not needed."""
    return [
        grad().to(dtype) if needed else None for grad, needed, dtype in zip(grads, needs, dtypes)
    ]


def _flags(needs, read: bool, use_z: bool) -> frozenset:
    """What the kernel computes; see ``backward_kernel``."""
    u, delta, A, B, C, _, z, bias, state = needs
    flags = {
        "read": read,
        "du": u,
        "ddelta": delta,
        "dz": z,
        "y": z and use_z and read,
        "dB": B,
        "dC": C and read,
        "through": u or delta or A or B or bias or state,
    }
    return frozenset(name for name, on in flags.items() if on)


def _backward(o: Operands, dout: Tensor | None, saved, softplus: bool, mode: str, needs) -> list:
    """Nine functions that give the gradients."""
    flags = _flags(needs, dout is not None, o.use_z)

    def like(x: Tensor, flag: str) -> Tensor:
        return torch.empty(x.shape if flag in flags else (0, 0, 0), dtype=x.dtype, device=o.device)

    def sums(flag: str) -> Tensor:
        rows = o.batch * o.groups * o.parts if flag in flags else 0
        return o.empty(rows, o.length, o.states)

    def total(parts: Tensor) -> Tensor:
        shape = (o.batch, o.groups, o.parts, o.length, o.states)
        return parts.view(shape).sum(2).transpose(1, 2).contiguous()

    du, ddelta, dz = like(o.u, "du"), like(o.delta, "ddelta"), like(o.u, "y")
    db, dc = sums("dB"), sums("dC")
    runs = o.batch * o.segments * -(-o.segment // (RUN * MARK))
    dfirst = torch.empty_like(o.state)
    da = torch.zeros(runs, o.channels, o.states, device=o.device)
    dskip, dbias = torch.zeros(2, runs, o.shape.rows, o.channels, device=o.device)
    if o.u.numel():
        dout = o.u if dout is None else lane_contiguous(dout)
        last = o.state
        if o.segments > 1:
            last = _carry_back(o, dout, softplus, mode, "read" in flags)
        kernel = backward_kernel(o.dtypes, mode, o.shape, softplus, o.use_z, flags)
        o.launch(
            kernel,
            [
                o.sizes(), o.u, o.delta, o.z, o.A[None], o.B, o.C, o.skip, o.bias, dout,
                saved.view(-1, o.channels, o.states), last,
            ],
            [dfirst, du, ddelta, dz, da, db, dc, dskip, dbias],
        )  # fmt: skip
    else:
        dfirst = o.state
    return [
        lambda: du,
        lambda: ddelta,
        lambda: da.sum(0),
        lambda: total(db),
        lambda: total(dc),
        lambda: dskip.sum((0, 1)),
        lambda: dz,
        lambda: dbias.sum((0, 1)),
        lambda: dfirst,
    ]


def _carry_back(o: Operands, dout: Tensor, softplus: bool, mode: str, read: bool) -> Tensor:
    """The gradient of the state after each segment."""
    last, decay = o.summary(mode)
    kernel = summary_kernel(o.dtypes, mode, o.shape, softplus, o.use_z, read)
    o.launch(kernel, [o.sizes(), o.delta, o.z, o.A[None], o.C, o.bias, dout], [last, decay])
    o.carry(mode, True, last, decay)
    return last


def saved_shape(u: Tensor, A: Tensor, B: Tensor, save: bool, tuning) -> tuple[int, ...]:
    """The shape of the saved states that ``forward`` returns, whatever the tuning."""
    return (u.shape[0], -(-u.shape[1] // MARK) if save else 0, *A.shape)
