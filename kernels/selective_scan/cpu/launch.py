"""The scan on a CPU: operands, launches and sums around the kernels of ``kernels.py``."""

from __future__ import annotations

import functools
from typing import NamedTuple

import torch
from torch import Tensor

from ...runtime.launch import parallel_launch
from ...runtime.memory import empty, empty_like
from ...runtime.native import W, lanes, streams
from ...runtime.packed import count_slots, slots
from ...runtime.views import dense, filled, is_transposed, view
from ..problem import DISCRETIZATIONS, Inputs, Scan, like_inputs, sum_parts
from . import kernels
from .kernels import BLOCKS, FEW, NEEDS, SPAN, Kind, Sizes, Tuning

TUNING = Tuning()
SEGMENT = 4  # chunks of a segment at least


class Extent(NamedTuple):
    """Sizes of a scan, and the threads that may share it."""

    batch: int
    length: int
    channels: int
    states: int
    groups: int
    threads: int

    @classmethod
    def of(cls, x: Inputs) -> Extent:
        """Return the extent of a scan's inputs, with torch's threads."""
        batch, length, channels = x.u.shape
        sizes = batch, length, channels, x.A.shape[1], x.B.shape[2]
        return cls(*sizes, torch.get_num_threads())

    def chunks(self, packed: Tensor | None, chunk: int) -> int:
        """Chunks of so many tokens in all sequences; an upper bound where they are packed."""
        if packed is None:
            return self.batch * -(-self.length // chunk)
        return count_slots(packed, self.batch, self.length, chunk)


class Layout:
    """Map of channels to lanes: D = groups × group_width, each group in blocks of W, padded.

    A task is a segment of one sequence's tokens and a span of blocks of one group. The blocks
    of a span are traversed side by side, so that rows are read in long parts. Segments are for
    inputs with too few channels for torch's threads; their first states cost a second traversal.
    Packed sequences are each cut as if alone, so that their bits are the same; those with
    fewer segments than others have empty ones behind.
    """

    def __init__(
        self,
        extent: Extent,
        packed: Tensor | None,
        chunk: int,
        span: int = SPAN,
        split: bool = True,
    ):
        """Cut a scan.

        Args:
            extent: of the scan.
            packed: the sequences of packed rows, or None.
            chunk: tokens; a state is saved at the start of each chunk.
            span: blocks of a task at most; segments do not depend on it, nor do bits.
            split: True to allow several segments.
        """
        self.batch, self.length, self.channels, self.states, self.groups, threads = extent
        self.sequences = self.batch if packed is None else len(packed)
        self.group_width = self.channels // self.groups
        self.group_blocks = -(-self.group_width // W)
        self.blocks = self.groups * self.group_blocks

        def spans(sequences: int, most: int) -> tuple[int, int]:  # blocks of one, how many of them
            per_thread = max(1, min(self.group_blocks, -(-sequences * self.blocks // threads)))
            span = min(most, -(-per_thread // BLOCKS) * BLOCKS)
            return span, sequences * self.groups * -(-self.group_blocks // span)

        _, alone = spans(self.batch if packed is None else 1, SPAN)
        self.span, count = spans(self.sequences, span)
        most = -(-threads // alone) if split and 0 < alone < threads else 1

        def segment(length: int) -> int:  # its tokens
            cuts = max(1, min(most, length // (SEGMENT * chunk)))
            return max(1, -(-length // (cuts * chunk))) * chunk

        self.chunks = extent.chunks(packed, chunk)
        if packed is None:
            self.segment = segment(self.length)
            self.segments = max(1, -(-self.length // self.segment))
            self.rows, self.last = None, -1
        else:
            self.segment = self.length
            b, begin, end = packed.unbind(1)
            lengths = torch.tensor([*map(segment, (end - begin).tolist())], dtype=torch.int32)
            counts = (-(-(end - begin) // lengths)).clamp(min=1)
            self.segments = int(counts.max()) if len(counts) else 1
            step = torch.arange(self.segments, dtype=torch.int32)[:, None]
            first = torch.minimum(begin + step * lengths, end)
            place = slots(packed, self.length, chunk) + step * (lengths // chunk)
            rows = b.expand_as(first), first, torch.minimum(first + lengths, end), place
            self.rows = torch.stack(rows, 2).flatten(0, 1)
            self.last = -1
            if self.segments > 1:
                self.last = counts.long() - 1, torch.arange(len(counts))
        self.tasks = self.segments * count
        self.parts = self.batch * self.groups * -(-self.group_blocks // BLOCKS)

    def unpack(self, x: Tensor) -> Tensor:
        """Brings ``[blocks, W]`` to ``[D]``."""
        return x.view(self.groups, self.group_blocks * W)[:, : self.group_width].flatten()

    def total(self, parts: Tensor) -> Tensor:
        """Sums ``[B·G·parts, N·L]`` over the parts of a group: ``[B, L, G, N]``."""
        of_group = -(-self.group_blocks // BLOCKS)
        x = parts.view(self.batch, self.groups, of_group, self.states, self.length)
        return sum_parts(x).permute(0, 3, 1, 2)


def _carry(first: Tensor | None, local: Tensor, product: Tensor) -> Tensor:
    """States before each segment (dimension 0): a segment turns h to local + product · h."""
    states = torch.empty_like(local)
    states[0] = 0 if first is None else first
    for s in range(len(local) - 1):
        torch.addcmul(local[s], product[s], states[s], out=states[s + 1])
    return states


def _entries(x: Tensor) -> Tensor:
    """B or C as the kernels read it: float32, the N entries of a token side by side."""
    x = x.float()
    return x if x.stride(-1) == 1 or x.shape[-1] == 1 else x.contiguous()


def _rows(states: Tensor | None):
    """States ``[.., D, N]`` as the kernels take them; None has no rows."""
    if states is None:
        return None
    return states.contiguous().view(-1, *states.shape[-2:])


_unpacked = functools.lru_cache(1024)(Layout)  # shared: not to be changed


class _Operands:
    """Operands that the launches of one call share."""

    def __init__(self, scan: Scan, dout: Tensor | None = None, split: bool = True):
        x, options = scan
        states = x.A.shape[1]
        tuning = TUNING._replace(at_once=TUNING.at_once or (2 if states <= FEW else 4))
        u, delta = dense(x.u), dense(x.delta)
        z = u if x.z is None else dense(x.z)
        transposed = is_transposed(u) or is_transposed(delta) or is_transposed(z)
        transposed = transposed or (dout is not None and is_transposed(dout))
        span = SPAN if not transposed else 1 if dout is None else BLOCKS
        make = _unpacked if options.packed is None else Layout
        self.layout = y = make(Extent.of(x), options.packed, tuning.chunk, span, split)
        self.kind = Kind(x.u.dtype, x.delta.dtype, options.discretization, tuning, transposed)
        self.options = int(options.softplus), int(x.z is not None)
        skip, bias = (None if v is None else v.float().contiguous() for v in (x.D, x.delta_bias))
        self.inputs = [y.rows, u, delta, z, x.A.contiguous(), skip, bias]
        self.b = _entries(x.B)
        self.c = self.b if x.C is None else _entries(x.C)
        # whole lines of transposed results begin at a multiple of W tokens
        self.whole = y.group_width % W == 0 and not (transposed and options.packed is not None)

    def run(self, kernel, inputs: list, outputs: list, needs=0, results=()) -> None:
        """Launches a kernel of ``kernels.py``; ``results`` may go past the caches."""
        y = self.layout
        stream = int(self.whole and streams(results))
        sizes = filled(
            Sizes,
            *(y.length, y.segment, y.segments, y.sequences, y.states, y.groups, y.group_width),
            *(y.group_blocks, y.span, *self.options, needs, stream),
        )
        parallel_launch(kernel, y.tasks, [sizes, *self.inputs, *inputs], outputs)

    def memory(self, values: int):
        """Memory of that many lanes for each piece of a launch."""
        pieces = max(1, min(torch.get_num_threads(), self.layout.tasks))
        return view(torch.empty(pieces, values, W, dtype=torch.float32), lanes)

    def work(self, rows: int):
        """Memory of a task's lane groups: ``rows`` of the states, A, and three values."""
        y = self.layout
        return self.memory(y.span * ((rows + 1) * y.states + 3))

    def states(self) -> Tensor:
        y = self.layout
        return torch.empty(y.segments, y.sequences, y.channels, y.states, dtype=torch.float32)

    def advance(self, first: Tensor | None, last: Tensor, product: Tensor | None, starts: Tensor):
        """Runs without outputs: states after each segment, and the products of the decays."""
        kernel = kernels.forward_kernel(self.kind, output=False)
        outputs = [_rows(last), _rows(product), view(starts, lanes), None]
        work = self.work(4)
        self.run(kernel, [self.b, self.b, _rows(first)], [work, *outputs])


def saved_shape(x: Scan) -> tuple[int, ...]:
    """The shape of the saved states that ``forward`` returns."""
    extent = Extent.of(x.inputs)
    blocks = extent.groups * -(-(extent.channels // extent.groups) // W)
    chunks = extent.chunks(x.options.packed, TUNING.chunk) if x.options.save else 0
    return chunks, blocks, extent.states, W


def forward(scan: Scan) -> tuple[Tensor, Tensor, Tensor]:
    """Runs the scan on the CPU.

    Returns:
        ``out [B, L, D]``, without tokens where there is no C, the last state ``[B, D, N]``, and
        the saved states that ``backward`` starts from (a private layout).
    """
    x, options = scan
    read = x.C is not None
    s = _Operands(scan, split=read or not options.save)
    y, starts = s.layout, empty(saved_shape(scan), torch.float32)
    out = empty_like(x.u) if read else empty((y.batch, 0, y.channels), x.u.dtype)
    first, last = x.initial_state, s.states()
    if y.segments > 1:
        product = s.states()
        s.advance(None, last, product, starts[:0])
        first = _carry(first, last, product)
        if not read:
            return out, torch.addcmul(last[y.last], product[y.last], first[y.last]), starts
    if read:
        kernel = kernels.forward_kernel(s.kind, output=True)
        outputs = [s.work(2), _rows(last), _rows(None), view(starts, lanes), out]
        s.run(kernel, [s.b, s.c, _rows(first)], outputs, results=[out])
    else:
        s.advance(first, last, None, starts)
    return out, last[y.last] if y.segments > 1 else last.squeeze(0), starts


def backward(
    dout: Tensor | None, dlast: Tensor | None, scan: Scan, starts: Tensor, needs: Inputs
) -> Inputs:
    """Gradients of ``forward`` from the gradients of its output and last state.

    Args:
        dout: of the output; None for 0.
        dlast: of the last state; None for 0.
        scan: the argument of ``forward``, of which the first state is not read.
        starts: the saved states.
        needs: True where a gradient is needed; the others are None.
    """
    x, options = scan
    dout = dense(x.u.new_zeros(1, 1, x.u.shape[2]).expand_as(x.u) if dout is None else dout)
    s = _Operands(scan, dout)
    y, chunk = s.layout, s.kind.tuning.chunk
    through = any(needs._replace(C=False, D=False, z=False))  # gradients of the states
    wanted = {"NEED_DZ": needs.z, "NEED_DC": needs.C, "NEED_DB": needs.B, "NEED_DH": through}
    flags = sum(NEEDS[name] for name, need in wanted.items() if need)
    if x.C is None:
        s.c = s.b.new_zeros(1, 1, 1, y.states).expand_as(s.b)

    def like(x: Tensor, needed: bool) -> Tensor | None:
        return empty_like(x) if needed else None

    def parts(needed: bool) -> Tensor | None:
        return empty((y.parts, y.states * y.length), torch.float32) if needed else None

    if y.segments > 1 and through:  # the gradient of the state after each segment
        local, product = s.states(), s.states()
        kernel = kernels.gradient_states_kernel(s.kind)
        s.run(kernel, [s.c, dout], [s.work(4), _rows(local), _rows(product)])
        dlast = _carry(dlast, local.flip(0), product.flip(0)).flip(0)
    dh = s.states() if needs.initial_state else None
    da = s.states() if needs.A else None
    du, ddelta = like(x.u, needs.u), like(x.delta, needs.delta)
    dz = like(x.u if x.z is None else x.z, needs.z)
    db, dc = parts(needs.B), parts(needs.C)
    make = torch.empty if options.packed is None else torch.zeros  # some have no chunk
    dchannel = make(y.chunks, 2, y.blocks, W, dtype=torch.float32)
    s.run(
        kernels.backward_kernel(s.kind),
        [s.b, s.c, view(starts, lanes), dout, _rows(dlast if through else None)],
        [
            s.work(3), s.memory(2 * y.states * chunk), _rows(dh),
            du, ddelta, dz, _rows(da), db, dc, view(dchannel, lanes),
        ],
        flags,
        [x for x in (du, ddelta, dz) if x is not None],
    )  # fmt: skip
    scale = DISCRETIZATIONS[options.discretization].scale
    gradients = Inputs(
        u=du,
        delta=ddelta,
        A=None if da is None else da.sum((0, 1)) / scale,
        B=None if db is None else y.total(db),
        C=None if dc is None else y.total(dc),
        D=y.unpack(dchannel[:, 0].sum(0)) if needs.D else None,
        z=dz,
        delta_bias=y.unpack(dchannel[:, 1].sum(0)) if needs.delta_bias else None,
        initial_state=None if dh is None else dh[0],
    )
    return like_inputs(gradients, x, needs)
