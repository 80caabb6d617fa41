"""Where the pairs of each tile and each part of the Gaussians go: one running sum over both.

The lists of all views lie one after the other, a list has its parts in turn, and each part writes
its own pairs. What the parts counted becomes where they begin.
"""

from collections.abc import Callable
from typing import NamedTuple, no_type_check

import warp as wp
from torch import Tensor

from ...runtime.launch import parallel_launch

wp.set_module_options({"enable_backward": False})


@wp.kernel
@no_type_check
def _places(
    offset: wp.int32,
    tiles_x: wp.int32,
    totals_in: wp.array[wp.int64],
    boxes_in: wp.array[wp.int64],
    counts_out: wp.array4d[wp.int32],
    numbers_out: wp.array[wp.int32],
    starts_out: wp.array[wp.int32],
    offsets_out: wp.array[wp.int32],
    pairs_out: wp.array[wp.int64],
    boxes_out: wp.array[wp.int64],
):
    """One task. Too many pairs overflow here and are refused by their sum, of 64 bits."""
    pairs = wp.int64(0)
    for task in range(totals_in.shape[0]):
        numbers_out[task] = wp.int32(pairs)
        pairs += totals_in[task]
    boxes = wp.int64(0)
    for task in range(boxes_in.shape[0]):
        boxes += boxes_in[task]
    pairs_out[0] = pairs
    boxes_out[0] = boxes
    offsets_out[offsets_out.shape[0] - 1] = wp.int32(pairs)
    place = wp.int32(0)
    tile = wp.int32(0)
    for image in range(counts_out.shape[0]):
        for ty in range(counts_out.shape[2]):
            for tx in range(tiles_x):
                starts_out[tile] = place
                tile += 1
                for part in range(counts_out.shape[1]):
                    count = counts_out[image, part, ty, tx]
                    counts_out[image, part, ty, tx] = place
                    place += count
    starts_out[tile] = place


class Places(NamedTuple):
    """Running sums of I views; int32 unless it is said.

    Attributes:
        total: pairs of all views.
        numbers: ``[tasks]`` the number of the first pair of each part.
        starts: ``[I * tiles + 1]`` where each tile begins in the lists.
        count: ``[]`` int64, ``total``.
        box_pairs: ``[]`` int64, pairs of boxes.
    """

    total: int
    numbers: Tensor
    starts: Tensor
    count: Tensor
    box_pairs: Tensor


def place_pairs(
    counts: Tensor,
    totals: Tensor,
    boxes: Tensor,
    offsets: Tensor,
    tiles_x: int,
    check: Callable[[int], None],
) -> Places:
    """Turns counts into places.

    Args:
        counts: ``[I, parts, tiles_y, columns]`` int32, columns >= ``tiles_x``, pairs of each tile;
            becomes where each part writes its first pair of it.
        totals: ``[I * parts]`` int64, pairs of each part.
        boxes: int64, pairs of boxes, cut into parts in some way.
        offsets: ``[I * N + 1]`` int32, whose last number is set.
        tiles_x: tiles in a row.
        check: raises if there are too many.
    """
    images, _, tiles_y, _ = counts.shape
    numbers = counts.new_empty(totals.shape[0])
    starts = counts.new_empty(images * tiles_y * tiles_x + 1)
    count, box_pairs = (totals.new_empty(()) for _ in range(2))
    outputs = [counts, numbers, starts, offsets, count.view(1), box_pairs.view(1)]
    parallel_launch(_places, 1, [tiles_x, totals, boxes], outputs)
    total = int(count)
    check(total)
    return Places(total, numbers, starts, count, box_pairs)
