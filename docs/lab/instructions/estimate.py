"""What kernels would take at the least on a GPU, from counts of what they execute.

An estimate, never a measurement: each unit of a multiprocessor is taken to work in every cycle, and
the busiest one sets the time. Stalls, barriers and misses of the caches are not in it, so a real
time is longer.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass

from gamba_warp.kernels.selective_scan.cuda.blocks import MARK, block_shape
from gamba_warp.kernels.selective_scan.cuda.launch import Tuning


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
LANES, SPECIAL, INTEGER = 32, 16, 64  # of a warp; of a multiprocessor's units
SCHEDULERS, SECTOR = 4, 32
LINE = 128  # bytes of the L1 cache or of shared memory, which is a part of it, per cycle
# What the counts hold beside instructions: what these ask of memory.
ASKED = ("bytes", "sectors", "first", "own", "passes", "conflicts", "together")


def every(counts: Mapping[str, float]) -> float:
    """All instructions of the counts."""
    return sum(number for kind, number in counts.items() if kind not in ASKED)


def cycles(device: Device, counts: Mapping[str, float]) -> dict[str, float]:
    """Cycles of one multiprocessor that each of its units needs at the least.

    Args:
        device: whose.
        counts: instructions of warps by kind ("float", "special", …) and ``ASKED``, as
            ``counting.Executed`` has them. A "routine" counts as one instruction.

    Returns:
        ``issue``: 4 instructions start per cycle. ``special``: exponentials, roots and reciprocals.
        ``float32``: additions, products and moves by the float unit, and products of integers.
        ``integer``: the other arithmetic, comparisons and conversions. ``L1``: passes of shared
        memory, and sectors of the cache of which it is a part. ``dram``: each sector once.
    """
    found = defaultdict(float, counts)
    of_memory = device.bandwidth / device.clock / device.multiprocessors
    moves = found["multiply"] * LANES / INTEGER
    return {
        "issue": every(counts) / SCHEDULERS,
        "special": found["special"] * LANES / SPECIAL,
        "float32": found["float"] * LANES / device.float_lanes + moves,
        "integer": (found["integer"] + found["convert"]) * LANES / INTEGER,
        "L1": found["together"] + (found["sectors"] + found["own"]) * SECTOR / LINE,
        "dram": found["first"] * SECTOR / of_memory,
    }


def limit(found: Mapping[str, float]) -> str:
    """The name of the largest."""
    return max(found, key=lambda name: found[name])


@dataclass(frozen=True)
class Work:
    """What one launch of a kernel does.

    Attributes:
        blocks: of threads.
        elements: (batch, token, channel, state) of a block.
        traffic: bytes of device memory of the launch, each counted once.
    """

    blocks: int
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


def scan_work(kernel: str, shape: Shape, tuning: Tuning) -> Work | None:
    """The work of one of the scan's kernels; None for one whose time does not matter.

    In segments ``scan_forward`` is the walk that gives a segment's last state, as
    ``summarise_backward`` is of the gradient; the last segment needs none.
    """
    if kernel not in ("scan_forward", "summarise_backward", "scan_backward"):
        return None
    back = kernel != "scan_forward"
    per_thread = (tuning.back_channels, tuning.back_states)
    segments = tuning.back_segments
    if not back:
        per_thread, segments = (tuning.channels, tuning.states), tuning.segments
    f = block_shape(tuning.block, *per_thread, shape.states)
    tokens = -(-shape.length // MARK // segments) * MARK
    parts = -(-shape.channels // f.span)
    summary = kernel != "scan_backward" and segments > 1
    return Work(
        blocks=shape.batch * parts * (-(-shape.length // tokens) - summary),
        elements=tokens * f.span * shape.states,
        traffic=_traffic(shape, back, summary, parts),
    )


def _traffic(shape: Shape, back: bool, summary: bool, parts: int) -> float:
    """u, delta, z, out or dout, and the gradients; B and C; saved states; sums for dB and dC."""
    tensors = 2 if not shape.outputs else 4
    if summary:
        tensors = (3 if shape.outputs else 1) if back else 2
    elif back:
        tensors = 7 if shape.outputs else 4
    of_channel = tensors * shape.bytes + (0 if summary else 4 * shape.states / MARK)
    matrices = 2 if shape.outputs and not summary else 1
    of_token = matrices * shape.states * (shape.bytes + (4 * parts if back and not summary else 0))
    return shape.batch * shape.length * (shape.channels * of_channel + of_token)


def per_element(counts: Mapping[str, float], work: Work) -> dict[str, float]:
    """Counts of a launch, of warps, as those of a thread for one (batch, token, channel, state)."""
    scale = LANES / (work.blocks * work.elements)
    found = {kind: number * scale for kind, number in sorted(counts.items())}
    return {"all": every(found)} | found


def estimate(device: Device, work: Work, each: Mapping[str, float]) -> dict[str, float | str]:
    """The least time of a launch, milliseconds, by what sets it; "ms" and "limit" are the largest.

    The multiprocessor with the most blocks sets it, but for "dram", which is the whole device's.

    Args:
        device: that it runs on.
        work: of the launch.
        each: of ``per_element``.
    """
    warps = -(-work.blocks // device.multiprocessors) * work.elements / LANES
    counts = {kind: number * warps for kind, number in each.items() if kind != "all"}
    found = {k: 1e3 * x / device.clock for k, x in cycles(device, counts).items()}
    found["dram"] = 1e3 * work.traffic / device.bandwidth
    return found | {"ms": max(found.values()), "limit": limit(found)}
