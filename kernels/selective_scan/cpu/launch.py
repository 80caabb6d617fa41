"""The scan on a CPU: operands, launches and sums around the kernels of ``kernels.py``."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from torch import Tensor

from ...runtime.lanes import W, lanes
from ...runtime.launch import parallel_launch
from ...runtime.memory import empty
from ...runtime.rows import streams
from ...runtime.views import lane_contiguous, view
from . import kernels
from .decays import SCALES
from .kernels import SPAN, Sizes
from .layout import Layout
from .recurrence import NEED_DB, NEED_DC, NEED_DH, NEED_DZ
from .tuning import Tuning

_FIELDS = tuple(Sizes.__annotations__)


def _sizes(
    layout: Layout, softplus: bool, use_z: bool, needs: int = 0, results: Sequence[Tensor] = ()
) -> Sizes:
    y = layout
    return _struct(
        *(y.length, y.segment, y.segments, y.batch, y.states, y.groups, y.group_width),
        *(y.group_blocks, y.span, int(softplus), int(use_z), needs),
        int(y.group_width % W == 0 and streams(results)),
    )


@functools.lru_cache(256)  # to fill one takes as long as a short scan
def _struct(*values: int) -> Sizes:
    sizes = Sizes()
    for name, value in zip(_FIELDS, values, strict=True):
        setattr(sizes, name, value)
    return sizes


def _pairs(states: Tensor) -> Tensor:
    """States as the kernels hold them, each with what it has rounded away, which is 0 at first."""
    return torch.constant_pad_nd(states, (0, 0, 0, states.shape[-2]))


def _values(pairs: Tensor) -> Tensor:
    """The states of ``_pairs``."""
    return pairs.narrow(-2, 0, pairs.shape[-2] // 2)


def _carry(first: Tensor, local: Tensor, product: Tensor) -> Tensor:
    """States before each segment (dimension 0): a segment turns h to local + product · h."""
    states = torch.empty_like(local)
    for s in range(len(local)):
        states[s] = first
        first = torch.addcmul(local[s], product[s], first)
    return states


def _entries(x: Tensor) -> Tensor:
    """B or C as the kernels read it: float32, the N entries of a token side by side."""
    x = x.float()
    return x if x.stride(-1) == 1 or x.shape[-1] == 1 else x.contiguous()


class _Operands:
    """What the launches of one call share, by name."""

    def __init__(self, layout, tuning, u, delta, A, z, delta_bias, discretization):
        self.layout = layout
        self.kinds = (tuning, u.dtype, delta.dtype, discretization)
        self.u, self.delta = lane_contiguous(u), lane_contiguous(delta)
        self.z = self.u if z is None else lane_contiguous(z)
        self.a, self.widest = view(layout.pack(A), lanes), view(layout.pack(A.abs().amax(1)), lanes)
        self.bias = view(layout.pack(delta_bias), lanes)

    def run(self, kernel, inputs: list, outputs: list, **options) -> None:
        """Launches a kernel of ``kernels.py``; inputs that are names are looked up here."""
        inputs = [getattr(self, x) if isinstance(x, str) else x for x in inputs]
        parallel_launch(kernel(*self.kinds, **options), self.layout.tasks, inputs, outputs)

    def states(self, fill: float = 0.0) -> Tensor:
        y = self.layout
        return torch.full((y.segments, y.batch, y.blocks, y.states, W), fill)

    def starts(self, save: bool) -> Tensor:
        y = self.layout
        return empty((y.batch, y.chunks if save else 0, y.blocks, y.states, W), torch.float32)


def _flat(states: Tensor):
    return view(states.flatten(0, 1), lanes)


def _accumulate(s: _Operands, sizes: Sizes, b: Tensor, h: Tensor, starts: Tensor) -> Tensor:
    """Brings the pairs ``h`` from before each segment to after it; returns the decays' products."""
    product = _pairs(s.states(1.0))
    s.run(
        kernels.forward_kernel,
        [sizes, "u", "delta", "u", "a", "widest", b, b, "bias", "bias"],
        [_flat(h), _flat(product), view(starts, lanes), s.u],
        output=False,
    )
    return _values(product)


def forward(
    u, delta, A, B, C, D, z, delta_bias, initial_state, softplus, discretization, save, tuning
):
    """Runs the scan on the CPU.

    Arguments as ``selective_scan`` with B, C ``[B, L, G, N]``; ``save`` keeps the states that
    ``backward`` starts from; ``tuning`` holds the numbers of a ``Tuning``, which ``backward`` must
    get as well; if it is empty, they are the default's.

    Returns:
        ``out [B, L, D]``, the last state ``[B, D, N]`` and the saved states (a private layout).
    """
    tuning = Tuning(*tuning).forward(A.shape[1])
    layout = Layout(u, A, B, SPAN, tuning.chunk)
    s = _Operands(layout, tuning, u, delta, A, z, delta_bias, discretization)
    b = _entries(B)
    h = layout.states_of(initial_state)[None]
    if layout.segments > 1:
        local = _pairs(s.states())
        sizes = _sizes(layout, softplus, z is not None)
        product = _accumulate(s, sizes, b, local, s.starts(False))
        h = _carry(h[0], _values(local), product)
    h, starts = _pairs(h), s.starts(save)
    out = empty(u.shape, u.dtype)
    sizes = _sizes(layout, softplus, z is not None, results=[out])
    s.run(
        kernels.forward_kernel,
        [
            sizes, "u", "delta", "z", "a", "widest", b, _entries(C),
            view(layout.pack(D), lanes), "bias",
        ],
        [_flat(h), _flat(h), view(starts, lanes), out],
        output=True,
    )  # fmt: skip
    return out, layout.unpack(_values(h)[-1], (layout.batch,)), starts


def final_state(u, delta, A, B, delta_bias, initial_state, softplus, discretization, save, tuning):
    """The last state alone, ``[B, D, N]``, and the saved states; arguments as ``forward``."""
    tuning = Tuning(*tuning).forward(A.shape[1])
    layout = Layout(u, A, B, SPAN, tuning.chunk, split=not save)
    s = _Operands(layout, tuning, u, delta, A, None, delta_bias, discretization)
    h, starts = layout.states_of(initial_state)[None], s.starts(save)
    if layout.segments > 1:
        first, h = h[0], s.states()
    h = _pairs(h)
    product = _accumulate(s, _sizes(layout, softplus, False), _entries(B), h, starts)
    h = _values(h)
    if layout.segments > 1:
        h = torch.addcmul(h[-1:], product[-1:], _carry(first, h, product)[-1:])
    return layout.unpack(h[-1], (layout.batch,)), starts


def _carry_back(s: _Operands, sizes: Sizes, c: Tensor, dout: Tensor, dlast) -> Tensor:
    """The gradient of the state after each segment; that after the last one is ``dlast``."""
    dh = s.layout.states_of(dlast)[None]
    if s.layout.segments == 1:
        return dh
    if not sizes.needs & NEED_DH:
        return s.states()
    local, product = _pairs(s.states()), _pairs(s.states(1.0))
    s.run(
        kernels.gradient_states_kernel,
        [sizes, "u", "delta", "z", "a", "widest", c, "bias", dout],
        [_flat(local), _flat(product)],
    )
    local, product = _values(local), _values(product)
    return _carry(dh[0], local.flip(0), product.flip(0)).flip(0).contiguous()


def backward(
    dout, dlast, u, delta, A, B, C, D, z, delta_bias, starts, softplus, discretization, needs,
    tuning,
):  # fmt: skip
    """Gradients of ``forward`` from those of its output and last state.

    Args:
        needs: nine booleans for u, delta, A, B, C, D, z, delta_bias, initial_state.
        tuning: that of ``forward``.

    Returns:
        Nine tensors, None where not needed.
    """
    tuning = Tuning(*tuning)
    layout = Layout(u, A, B, SPAN, tuning.chunk)
    s = _Operands(layout, tuning, u, delta, A, z, delta_bias, discretization)
    need_u, need_delta, need_A, need_B, need_C, _, need_z, need_bias, need_h = needs
    through = need_u or need_delta or need_A or need_B or need_bias or need_h
    flags = NEED_DZ * need_z + NEED_DC * need_C + NEED_DB * need_B + NEED_DH * through
    dout = lane_contiguous(dout)
    b, c = _entries(B), _entries(C)

    def like(x: Tensor, needed: bool) -> Tensor:
        return empty(x.shape if needed else (x.shape[0], 0, x.shape[2]), x.dtype)

    def partial(needed: bool) -> tuple[Tensor, Tensor]:
        rows = layout.states if needed else 0
        sums = torch.empty(layout.tasks, rows * tuning.chunk, W)
        return sums, empty((layout.parts, rows * layout.length), torch.float32)

    du, ddelta, dz = like(u, need_u), like(delta, need_delta), like(u, need_z)
    sizes = _sizes(layout, softplus, z is not None, flags, [du, ddelta, dz])
    dh = _pairs(_carry_back(s, sizes, c, dout, dlast))
    da = s.states()
    dskip, dbias = torch.empty(2, layout.batch, layout.chunks, layout.blocks, W)
    db_lanes, db = partial(need_B)
    dc_lanes, dc = partial(need_C)
    s.run(
        kernels.backward_kernel,
        [
            sizes, "u", "delta", "z", "a", "widest", b, c, view(layout.pack(D), lanes), "bias",
            view(starts, lanes), dout,
        ],
        [
            view(db_lanes, lanes), view(dc_lanes, lanes), _flat(dh), du, ddelta, dz,
            _flat(da), db, dc, view(dskip, lanes), view(dbias, lanes),
        ],
    )  # fmt: skip
    values = (
        lambda: du,
        lambda: ddelta,
        lambda: layout.unpack(da.sum((0, 1))) / SCALES[discretization],
        lambda: layout.total(db, B.dtype),
        lambda: layout.total(dc, C.dtype),
        lambda: layout.unpack(dskip.sum((0, 1))).to(D.dtype),
        lambda: dz,
        lambda: layout.unpack(dbias.sum((0, 1))).to(delta_bias.dtype),
        lambda: layout.unpack(_values(dh)[0], (layout.batch,)),
    )
    return [value() if needed else None for value, needed in zip(values, needs)]


def final_state_backward(
    dlast, u, delta, A, B, delta_bias, starts, softplus, discretization, needs, tuning
):
    """Gradients of ``final_state``; ``needs`` for u, delta, A, B, delta_bias, initial_state."""
    dout = u.new_zeros(1, 1, u.shape[2]).expand_as(u)
    need_u, need_delta, need_A, need_B, need_bias, need_h = needs
    grads = backward(
        dout, dlast, u, delta, A, B, torch.zeros_like(B), None, None, delta_bias, starts,
        softplus, discretization,
        (need_u, need_delta, need_A, need_B, False, False, False, need_bias, need_h), tuning,
    )  # fmt: skip
    return [grads[i] for i in (0, 1, 2, 3, 7, 8)]


def saved_shape(u: Tensor, A: Tensor, B: Tensor, save: bool, tuning) -> tuple[int, ...]:
    """The shape of the saved states that ``forward`` returns."""
    layout = Layout(u, A, B, SPAN, Tuning(*tuning).chunk)
    return (layout.batch, layout.chunks if save else 0, layout.blocks, layout.states, W)
