"""The last step of a pair's gradient: sums of its lanes are added up and stored in a row."""

import functools

import warp as wp

from .leaves import load, store
from .warp import CHUNK, PITCH, RECORD, WARP, Gaussians, shared_memory

wp.set_module_options({"enable_backward": False})


def shared_size(channels: int, geometry: bool) -> int:
    """Floats of a warp's shared memory: records, rows, and sums of the pairs of a completion."""
    values = channels + (6 if geometry else 0)
    return WARP * RECORD + WARP + WARP // values * values * PITCH


@wp.func
def columns_of_moments(channels: int) -> int:
    # six for each chunk of channels: a chunk is a launch, and has its own sums of h
    return (channels + wp.static(CHUNK - 1)) / wp.static(CHUNK) * 6


def row_length(channels: int) -> int:
    """Values in a row: the moments of each chunk, then the channels."""
    return -(-channels // CHUNK) * 6 + channels


@functools.cache
def completing(channels: int, geometry: bool, listed: bool):
    """How many pairs wait for the sums of their lanes, and the functions that leave and add these.

    A row has six moments for each chunk of channels, then the channels. If ``listed``, it is a
    pair's and is written; else it is a Gaussian's, and the pair is added to it.
    """
    moments = 6 if geometry else 0
    values = moments + channels  # how many sums a pair has
    slots = WARP // values  # pairs whose sums are completed at once, with a lane for each sum
    rows_at = WARP * RECORD
    sums_at = rows_at + WARP
    memory = shared_memory(shared_size(channels, geometry))
    arena_type = memory.arena
    values_type = wp.types.vector(values, wp.float32)

    @wp.func
    def leave(arena: arena_type, lane: wp.int32, slot: wp.int32, row: wp.int32, sums: values_type):
        # stores a lane's sums of a pair, to be completed together with those of other pairs
        at = wp.static(sums_at) + slot * wp.static(values * PITCH) + lane
        for v in range(wp.static(values)):
            memory.put(arena, at + wp.static(v * PITCH), sums[v])
        memory.put_int(arena, wp.static(rows_at) + slot, row)

    @wp.func
    def complete(
        arena: arena_type,
        gaussians: Gaussians,
        lane: wp.int32,
        count: wp.int32,
        v_pairs: wp.array2d[wp.float32],
    ):
        # each lane adds up one value of one of the stored pairs, over the 32 lanes
        if lane < count * wp.static(values):
            at = wp.static(sums_at) + lane * PITCH
            total = memory.get4(arena, at)
            for i in range(1, wp.static(WARP // 4)):
                total += memory.get4(arena, at + 4 * i)
            value = (total[0] + total[1]) + (total[2] + total[3])
            row = wp.int64(memory.get_int(arena, wp.static(rows_at) + lane / wp.static(values)))
            before = columns_of_moments(gaussians.channels)
            row *= wp.int64(before + gaussians.channels)
            column = lane % wp.static(values)
            if column >= wp.static(moments):
                column += before - wp.static(moments) + gaussians.first
            else:
                column += columns_of_moments(gaussians.first)
            if wp.static(not listed):
                value += load(v_pairs, row, column)
            store(v_pairs, row, column, value)

    return slots, leave, complete
