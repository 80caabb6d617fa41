"""Lower bounds for the time of kernels on a GPU, from counts of their instructions.

An estimate, not a measurement: each unit of a multiprocessor is assumed to work in every cycle, and
the busiest one determines the time. Stalls, barriers and cache misses are ignored, so real times
are longer.
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
        clock: highest cycles per second, from the float32 operations in the data sheet.
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
# Counts beside instructions: their memory accesses.
ASKED = ("bytes", "sectors", "first", "own", "passes", "conflicts", "together")


def every(counts: Mapping[str, float]) -> float:
    """Total number of instructions."""
    return sum(number for kind, number in counts.items() if kind not in ASKED)


def cycles(device: Device, counts: Mapping[str, float]) -> dict[str, float]:
    """Least number of cycles of one multiprocessor for each of its units.

    Args:
        device: the GPU.
        counts: instructions of warps by kind ("float", "special", …) and ``ASKED``, as in
            ``counting.Executed``. A "routine" counts as one instruction.

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
    """Name of the largest."""
    return max(found, key=lambda name: found[name])


@dataclass(frozen=True)
class Work:
    """Work of one launch of a kernel.

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
    """Work of one of the scan's kernels; None for a negligible one.

    With segments, ``scan_forward`` is the pass for a segment's last state, like
    ``summarise_backward`` for the gradient; the last segment needs neither.
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
    """Convert warp counts of a launch to those of a thread per (batch, token, channel, state)."""
    scale = LANES / (work.blocks * work.elements)
    found = {kind: number * scale for kind, number in sorted(counts.items())}
    return {"all": every(found)} | found


def estimate(device: Device, work: Work, each: Mapping[str, float]) -> dict[str, float | str]:
    """Least time of a launch, milliseconds, per unit; "ms" and "limit" are the largest.

    The multiprocessor with the most blocks determines it, except for "dram", which is of the whole
    device.

    Args:
        device: the GPU.
        work: of the launch.
        each: result of ``per_element``.
    """
    warps = -(-work.blocks // device.multiprocessors) * work.elements / LANES
    counts = {kind: number * warps for kind, number in each.items() if kind != "all"}
    found = {k: 1e3 * x / device.clock for k, x in cycles(device, counts).items()}
    found["dram"] = 1e3 * work.traffic / device.bandwidth
    return found | {"ms": max(found.values()), "limit": limit(found)}
