"""What the scan's kernels would take at the least on a GPU, from counts of their instructions.

An estimate, never a measurement: each unit of a multiprocessor is taken to work in every cycle, and
the busiest one sets the time. Stalls, barriers, branches that not all warps take, bank conflicts
and misses of the caches are not in it, so a real time is longer.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass

from gamba_warp.kernels.selective_scan.cuda import backward, forward
from gamba_warp.kernels.selective_scan.cuda.blocks import MARK, SUB, UNROLL, BlockShape, block_shape
from gamba_warp.kernels.selective_scan.cuda.launch import choose

from .sass import Turns


@dataclass(frozen=True)
class Device:
    """A GPU (its data sheet, and the CUDA C++ Programming Guide on throughputs).

    Attributes:
        name: of the product.
        multiprocessors: their number; each starts 4 instructions of a warp per cycle.
        clock: cycles per second, the highest: from the float32 operations that the sheet tells.
        bandwidth: of device memory, bytes per second.
        float_lanes: float32 additions or products of a multiprocessor per cycle.
    """

    name: str
    multiprocessors: int
    clock: float
    bandwidth: float
    float_lanes: int


DEVICES = {
    80: Device("A100 SXM 80 GB", 108, 1.41e9, 2.039e12, 64),
    90: Device("H200 SXM", 132, 1.98e9, 4.8e12, 128),
}
LANES, SPECIAL, INTEGER, MEMORY = 32, 16, 64, 32  # of a warp; of a multiprocessor's units
SCHEDULERS = 4


@dataclass(frozen=True)
class Work:
    """What one launch of a kernel does.

    Attributes:
        blocks: of threads.
        warps: of a block.
        turns: of the loops, for ``sass.executed``.
        elements: (batch, token, channel, state) of a block.
        traffic: bytes of device memory of the launch, each counted once.
    """

    blocks: int
    warps: int
    turns: tuple[Turns, ...]
    elements: int
    traffic: float


@dataclass(frozen=True)
class Shape:
    """A scan: ``u`` is ``[batch, length, channels]`` of ``bytes`` each; one group."""

    batch: int
    length: int
    channels: int
    states: int
    bytes: int
    outputs: bool = True  # else the last state alone


def scan_work(kernel: str, shape: Shape, multiprocessors: int) -> Work | None:
    """The work of one of the scan's kernels; None for one whose time does not matter."""
    tuning = choose(shape.batch, shape.length, shape.channels, shape.states, 1, multiprocessors)
    back = kernel != "scan_forward"
    per_thread = (tuning.back_channels, tuning.back_states)
    segments = tuning.back_segments
    if not back:
        per_thread, segments = (tuning.channels, tuning.states), tuning.segments
    f = block_shape(tuning.block, *per_thread, shape.states)
    tokens = -(-shape.length // MARK // segments) * MARK
    parts = -(-shape.channels // f.span)
    turns = {
        "scan_forward": _forward_turns,
        "summarise_backward": _summary_turns,
        "scan_backward": _backward_turns,
    }.get(kernel)
    if turns is None:
        return None
    summary = kernel == "summarise_backward"
    return Work(
        blocks=shape.batch * parts * -(-shape.length // tokens),
        warps=tuning.block // LANES,
        turns=turns(f, tokens),
        elements=tokens * f.span * shape.states,
        traffic=_traffic(shape, back, summary, parts),
    )


def _traffic(shape: Shape, back: bool, summary: bool, parts: int) -> float:
    """u, delta, z, out or dout, and the gradients; B and C; saved states; sums for dB and dC."""
    tensors = 2 if not shape.outputs else 4
    if summary:
        tensors = 3 if shape.outputs else 1
    elif back:
        tensors = 7 if shape.outputs else 4
    of_channel = tensors * shape.bytes + (0 if summary else 4 * shape.states / MARK)
    matrices = 2 if shape.outputs and not summary else 1
    of_token = matrices * shape.states * (shape.bytes + (4 * parts if back and not summary else 0))
    return shape.batch * shape.length * (shape.channels * of_channel + of_token)


def _walked(f: BlockShape, turns: tuple[Turns, ...]) -> tuple[Turns, ...]:
    return ((f.walks, turns),) if f.walks > 1 else turns


def _forward_turns(f: BlockShape, tokens: int) -> tuple[Turns, ...]:
    tile = forward.tile_tokens(f)
    return ((tokens // tile, _walked(f, ((tile // UNROLL, ()),))),)


def _summary_turns(f: BlockShape, tokens: int) -> tuple[Turns, ...]:
    return ((tokens // 16, _walked(f, ((16 // UNROLL, ()),))),)


def _backward_turns(f: BlockShape, tokens: int) -> tuple[Turns, ...]:
    mark, tile = backward.MARK_TILE, backward.TILE
    walked = (MARK - SUB) / MARK * (mark / SUB)  # the last few tokens need no mark after them
    marks = (MARK // mark, _walked(f, ((walked, ()),)))
    back = (MARK // tile, _walked(f, ((tile // SUB, ()),)))
    return ((tokens // MARK, (marks, back)),)


@dataclass(frozen=True)
class Estimate:
    """The least time of a launch, milliseconds, and what sets it.

    Attributes:
        issue: 4 instructions of a warp start per cycle.
        special: exponentials and reciprocals, 16 per cycle.
        float32: additions, products and moves by the float unit.
        integer: the other arithmetic, 64 per cycle.
        memory: words through the load and store unit, 32 per cycle; those that several threads
            read together are counted for each, so this is more than it takes.
        dram: device memory.
    """

    issue: float
    special: float
    float32: float
    integer: float
    memory: float
    dram: float

    @property
    def ms(self) -> float:
        """The largest, ``memory`` left out, as it is a bound from above."""
        return max(self.issue, self.special, self.float32, self.integer, self.dram)

    @property
    def limit(self) -> str:
        """The name of the largest."""
        return next(name for name, value in vars(self).items() if value == self.ms)


def estimate(device: Device, work: Work, executed: Mapping[str, float]) -> Estimate:
    """The least time of a launch from what each warp of it executes.

    The multiprocessor with the most blocks sets it.
    """
    counts = defaultdict(float, executed)
    warps = -(-work.blocks // device.multiprocessors) * work.warps
    milliseconds = 1e3 * warps / device.clock
    every = sum(executed.values()) - counts["passes"]
    moves = counts["multiply"] * LANES / INTEGER
    return Estimate(
        issue=every / SCHEDULERS * milliseconds,
        special=counts["special"] * LANES / SPECIAL * milliseconds,
        float32=(counts["float"] * LANES / device.float_lanes + moves) * milliseconds,
        integer=(counts["integer"] + counts["convert"]) * LANES / INTEGER * milliseconds,
        memory=counts["passes"] * LANES / MEMORY * milliseconds,
        dram=1e3 * work.traffic / device.bandwidth,
    )


def per_element(work: Work, executed: Mapping[str, float]) -> dict[str, float]:
    """Instructions of a thread, by kind and "all", for one (batch, token, channel, state)."""
    scale = work.warps * LANES / work.elements
    found = {kind: number * scale for kind, number in executed.items() if kind != "passes"}
    return {"all": sum(found.values())} | dict(sorted(found.items()))
