"""Tile lists of views of many Gaussians on the CPU: written in the order of index, then sorted.

A sort of a million Gaussians by depth, and every later step in that random order, wait for memory.
Here each step but the last goes through the Gaussians as they lie: ``_record`` finds the tiles of
those that are seen, sixteen at a time, ``_scatter`` writes their pairs to the lists, and ``_sort``
puts each list, which fits the nearest cache, in order of depth. README.md §2 holds the maths.
"""

from collections.abc import Callable
from typing import no_type_check

import torch
import warp as wp
from torch import Tensor

from ...runtime.launch import parallel_launch
from ...runtime.memory import empty
from ..skip import TILE_TEST
from ..tiles import SLACK, SLACK_ABS, Bins, Grid
from .lanes import TYPES, take

wp.set_module_options({"enable_backward": False})

MANY = 1 << 15  # Gaussians of a view from which these lists are the faster ones
_PARTS_PER_THREAD = 4
# An entry of a Gaussian that is seen: its index, the bits of its depth, its first row of tiles,
# their number, and the columns of the first rows, two numbers of 16 bits each.
_ENTRY = 8
_ROWS = 4

# Lanes are Gaussians, or rows of tiles of one Gaussian. The same code counts and writes.
_SPANS = (
    TYPES
    + """
auto splat = [](float x) -> F { return F{} + x; };
auto ints_ = [](F x) -> I { return __builtin_convertvector(x, I); };
auto floats_ = [](I x) -> F { return __builtin_convertvector(x, F); };
auto root_ = [](F x) -> F { return __builtin_elementwise_sqrt(x); };
const float wide = (float)(width - 1), high = (float)(height - 1);
// clamped before the cast: a footprint may be larger than an int32
auto tile_ = [&](F x, float most) -> I {
    return ints_(min_(max_(x, F{}), splat(most))) >> shift;
};
// log(x) for x >= 1 to 2e-7 of itself or 1e-7: the limit has a slack of 1e-4
auto log_ = [&](F x) -> F {
    const I bits = (I)x;
    const I n = (bits - 0x3f3504f3) >> 23;
    const F m = (F)(bits - (n << 23));
    const F s = (m - 1.0f) / (m + 1.0f), w = s * s;
    F p = fma_(w, splat(0.2222222f), splat(0.2857143f));
    p = fma_(p, w, splat(0.4f));
    p = fma_(p, w, splat(0.6666667f));
    p = fma_(p, w, splat(2.0f));
    return fma_(floats_(n), splat(0.69314718f), p * s);
};
struct Ellipse { F x, y, k, e, limit, over_a, reach, top, extent; };
auto ellipse_ = [&](F x, F y, F a, F k, F e, F opacity, F extent) -> Ellipse {
    const F limit = log_(opacity / alpha_min) * (2.0f * SLACK) + SLACK_ABS;
    const F top = -k * a * root_(limit / (a * (a * k * k + e) * e));
    return {x, y, k, e, limit, splat(1.0f) / a, root_(limit / e), top, extent};
};
// README eq. 6: first and last column of rows ``ty``; first > last: none
auto spans_ = [&](const Ellipse& E, I ty, I& first, I& last) {
    if (!test) {
        first = tile_(E.x - E.extent, wide);
        last = tile_(E.x + E.extent, wide);
        return;
    }
    // exact numbers first, the mean once: rounding must not turn one row of pixels into none
    const F y0 = max_(floats_(ty << shift) + 0.5f - E.y, -E.reach);
    const I below = (ty + 1) << shift;
    const F end = floats_(below < height ? below : I{} + height) - 0.5f;
    const F y1 = min_(end - E.y, E.reach);
    // convex, so clamping finds the extremes
    const F right = min_(max_(E.top, y0), y1), left = min_(max_(-E.top, y0), y1);
    F x1 = root_(max_(E.limit - E.e * right * right, F{}) * E.over_a);
    F x0 = root_(max_(E.limit - E.e * left * left, F{}) * E.over_a);
    x1 = E.x - E.k * right + x1;
    x0 = E.x - E.k * left - x0;
    const I none = (y0 > y1) | (x1 < 0.5f) | (x0 > (float)width - 0.5f);
    // a tile spans pixel centres 0.5 to 15.5; a gap between two tiles belongs to neither
    first = none ? I{} : tile_(x0 + 0.5f, wide);
    last = none ? I{} - 1 : tile_(x1 - 0.5f, wide);
};
const I lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
""".replace("SLACK_ABS", f"{SLACK_ABS}f").replace("SLACK", f"{SLACK}f")
)

# One Gaussian's rows of tiles, 16 at a time; ``each(ty, first, last)`` for each row.
_ONE = """
auto rows_ = [&](int i, int first_row, int count, auto each) {
    const float* const m = (const float*)means2d.data + (size_t)i * 2;
    const float* const c = (const float*)conics.data + (size_t)i * 3;
    const Ellipse one = ellipse_(splat(m[0]), splat(m[1]), splat(c[0]), splat(c[1]), splat(c[2]),
        splat(opacities.data[i]), splat(((const float*)extents.data)[(size_t)i * 2]));
    for (int r = 0; r < count; r += 16) {
        I first, last;
        spans_(one, lane + (first_row + r), first, last);
        for (int l = 0; l < 16 && r + l < count; ++l) each(first_row + r + l, first[l], last[l]);
    }
};
"""

_RECORD = (
    _SPANS
    + _ONE
    + """
int* entry = entries.data + (size_t)begin * ENTRY;
int* const steps_ = steps.data + (size_t)task * steps.shape[1];
long long pairs = 0, boxes = 0;
auto note = [&](int ty, int first, int last) {
    int* const row = steps_ + (size_t)ty * (tiles_x + 1);
    row[first] += 1;
    row[last + 1] -= 1;
    pairs += last - first + 1;
};
for (int i = begin; i < end; i += 16) {
    const int n = end - i < 16 ? end - i : 16;
    const float* const m = (const float*)means2d.data + (size_t)i * 2;
    const float* const c = (const float*)conics.data + (size_t)i * 3;
    const float* const r = (const float*)extents.data + (size_t)i * 2;
    float part[8][16] = {};
    auto load = [&](int count) {
        for (int l = 0; l < count; ++l) {
            part[0][l] = m[2 * l];
            part[1][l] = m[2 * l + 1];
            part[2][l] = c[3 * l];
            part[3][l] = c[3 * l + 1];
            part[4][l] = c[3 * l + 2];
            part[5][l] = opacities.data[i + l];
            part[6][l] = r[2 * l];
            part[7][l] = r[2 * l + 1];
        }
    };
    if (n == 16) load(16); else load(n);
    auto get = [&](int k) -> F { return *(const F*)part[k]; };
    const F rx = get(6), ry = get(7);
    const I bit = I{} + 1 << lane;
    unsigned seen = __builtin_reduce_or((I)(rx > 0.0f) & bit);
    if (!seen) continue;
    // first and last row with a pixel centre (at +0.5) in reach, with a pixel to spare
    const I top = tile_(get(1) - ry - 1.0f, high), bottom = tile_(get(1) + ry + 1.0f, high);
    const I count = bottom - top + 1;
    const I box = tile_(get(0) + rx, wide) - tile_(get(0) - rx, wide) + 1;
    const Ellipse E = ellipse_(get(0), get(1), get(2), get(3), get(4), get(5), rx);
    // 16 times two rows of 16 tiles at most, unless a Gaussian is large: then its rows are lanes
    int spans[ROWS][16];
    const I few = ((rx > 0.0f) & (count <= ROWS)) ? count : I{};
    const int most = __builtin_reduce_max(few);
    I any = I{}, first, last;
    for (int t = 0; t < most; ++t) {
        spans_(E, top + t, first, last);
        const I inside = (I)(first <= last) & (I)(t < few);
        any |= inside;
        *(I*)spans[t] = inside ? first | last << 16 : I{} + 1;  // 1 is none: from 1 to 0
    }
    const unsigned large = __builtin_reduce_or((I)(count > ROWS) & bit);
    const unsigned touching = __builtin_reduce_or(any & bit);
    while (seen) {
        const int l = __builtin_ctz(seen);
        seen &= seen - 1;
        boxes += (long long)count[l] * box[l];
        const bool is_large = large >> l & 1;
        if (!is_large && !(touching >> l & 1)) continue;
        entry[0] = i + l;
        entry[1] = ((const int*)depths.data)[i + l];
        entry[2] = top[l];
        entry[3] = count[l];
        const long long before = pairs;
        if (is_large)
            rows_(i + l, top[l], count[l], [&](int ty, int a, int b) { if (a <= b) note(ty, a, b); });
        else
            for (int t = 0; t < count[l]; ++t) {
                const int span = spans[t][l];
                entry[4 + t] = span;
                if (span != 1) note(top[l] + t, span & 0xffff, span >> 16);
            }
        if (pairs > before) entry += ENTRY;
    }
}
totals.data[3 * task] = (entry - entries.data) / ENTRY - begin;
totals.data[3 * task + 1] = pairs;
totals.data[3 * task + 2] = boxes;
"""
).replace("ENTRY", str(_ENTRY)).replace("ROWS", str(_ROWS))

_SCATTER = (
    _SPANS
    + _ONE
    + """
const int* entry = entries.data + (size_t)begin * ENTRY;
const int* const stop = entry + (size_t)totals.data[3 * task] * ENTRY;
int* const cursor = cursors.data + (size_t)task * cursors.shape[1];
struct Pair { int key, gaussian, number; };
Pair* const pairs = (Pair*)staged.data;
int p = number, next = begin;
for (; entry < stop; entry += ENTRY) {
    const int i = entry[0], key = entry[1], top = entry[2], count = entry[3];
    while (next <= i) offsets.data[next++] = p;
    auto put = [&](int ty, int first, int last) {
        int* const row = cursor + ty * tiles_x;
        for (int tx = first; tx <= last; ++tx) pairs[row[tx]++] = {key, i, p++};
    };
    if (count > ROWS) {
        rows_(i, top, count, put);
        continue;
    }
    for (int t = 0; t < count; ++t) put(top + t, entry[4 + t] & 0xffff, entry[4 + t] >> 16);
}
while (next < end) offsets.data[next++] = p;
"""
).replace("ENTRY", str(_ENTRY)).replace("ROWS", str(_ROWS))

# A list holds its pairs in order of index; a stable sort by depth. Sorted are words of the key and
# the place; digits of at most 8 bits from the bits in which the keys of the list differ.
_SORT = """
typedef unsigned long long Word;
struct Pair { int key, gaussian, number; };
const Pair* const from = (const Pair*)staged.data + begin;
Word* now = (Word*)room.data + (size_t)worker * room.shape[1];
Word* then = now + room.shape[1] / 2;
const int n = end - begin;
unsigned least = ~0u, most = 0;
for (int j = 0; j < n; ++j) {
    const unsigned key = from[j].key;
    least = key < least ? key : least;
    most = key > most ? key : most;
}
for (int j = 0; j < n; ++j) now[j] = (Word)(from[j].key - least) << 32 | (unsigned)j;
if (n <= 24) {
    for (int j = 1; j < n; ++j) {
        const Word word = now[j];
        int k = j;
        for (; k > 0 && now[k - 1] > word; --k) now[k] = now[k - 1];
        now[k] = word;
    }
} else if (most > least) {
    const int bits = 32 - __builtin_clz(most - least);
    const int longest = n < 6000 ? 8 : 11;
    const int turns = (bits + longest - 1) / longest, size = (bits + turns - 1) / turns;
    const unsigned mask = (1u << size) - 1;
    int counts[4][2048];
    for (int t = 0; t < turns; ++t)
        for (unsigned d = 0; d <= mask; ++d) counts[t][d] = 0;
    for (int j = 0; j < n; ++j) {
        const unsigned key = now[j] >> 32;
        for (int t = 0; t < turns; ++t) ++counts[t][key >> t * size & mask];
    }
    for (int t = 0; t < turns; ++t) {
        int place = 0;
        for (unsigned d = 0; d <= mask; ++d) {
            const int count = counts[t][d];
            counts[t][d] = place;
            place += count;
        }
        for (int j = 0; j < n; ++j) {
            const Word word = now[j];
            then[counts[t][(unsigned)(word >> 32) >> t * size & mask]++] = word;
        }
        Word* const other = now;
        now = then;
        then = other;
    }
}
for (int j = 0; j < n; ++j) {
    const Pair& pair = from[(unsigned)now[j]];
    pairs.data[begin + j] = pair.gaussian;
    rows.data[begin + j] = pair.number;
}
"""


@wp.func_native(_RECORD)
def _record_part(
    task: int,
    begin: int,
    end: int,
    width: int,
    height: int,
    tiles_x: int,
    shift: int,
    test: int,
    alpha_min: float,
    means2d: wp.array[wp.vec2],
    conics: wp.array[wp.vec3],
    opacities: wp.array[wp.float32],
    extents: wp.array[wp.vec2],
    depths: wp.array[wp.float32],
    entries: wp.array2d[wp.int32],
    steps: wp.array2d[wp.int32],
    totals: wp.array2d[wp.int64],
):
    """Entries of the Gaussians [begin, end), and how their pairs change from tile to tile."""
    ...


@wp.func_native(_SCATTER)
def _scatter_part(
    task: int,
    begin: int,
    end: int,
    number: int,
    width: int,
    height: int,
    tiles_x: int,
    shift: int,
    test: int,
    alpha_min: float,
    means2d: wp.array[wp.vec2],
    conics: wp.array[wp.vec3],
    opacities: wp.array[wp.float32],
    extents: wp.array[wp.vec2],
    entries: wp.array2d[wp.int32],
    totals: wp.array2d[wp.int64],
    cursors: wp.array2d[wp.int32],
    offsets: wp.array[wp.int32],
    staged: wp.array2d[wp.int32],
):
    """Writes the pairs of the entries of [begin, end), the first one with that number."""
    ...


@wp.func_native(_SORT)
def _sort_list(
    worker: int,
    begin: int,
    end: int,
    staged: wp.array2d[wp.int32],
    room: wp.array2d[wp.int64],
    pairs: wp.array[wp.int32],
    rows: wp.array[wp.int32],
):
    """Writes the list [begin, end) front to back; ``room[worker]`` holds it twice."""
    ...


@wp.func
@no_type_check
def _begin(num: wp.int32, parts: wp.int32, task: wp.int32) -> wp.int32:
    # where the Gaussians of a task begin; num * part may not fit an int32
    part = wp.int64(num) * wp.int64(task % parts) / wp.int64(parts)
    return task // parts * num + wp.int32(part)


@wp.kernel
@no_type_check
def _record(
    offset: wp.int32,
    grid: Grid,
    parts: wp.int32,
    means2d_in: wp.array[wp.vec2],
    conics_in: wp.array[wp.vec3],
    view_opacities_in: wp.array[wp.float32],
    extents_in: wp.array[wp.vec2],
    depths_in: wp.array[wp.float32],
    entries_out: wp.array2d[wp.int32],
    steps_out: wp.array2d[wp.int32],
    totals_out: wp.array2d[wp.int64],
):
    """Tasks are parts of the Gaussians of a view; totals: entries, pairs and pairs of boxes."""
    task = offset + wp.tid()
    end = (task // parts + 1) * grid.num
    if (task + 1) % parts != 0:
        end = _begin(grid.num, parts, task + 1)
    _record_part(
        task,
        _begin(grid.num, parts, task),
        end,
        grid.width,
        grid.height,
        grid.tiles_x,
        grid.shift,
        grid.skip & _TILE_TEST,
        grid.alpha_min,
        means2d_in,
        conics_in,
        view_opacities_in,
        extents_in,
        depths_in,
        entries_out,
        steps_out,
        totals_out,
    )


_TILE_TEST = wp.constant(TILE_TEST)


@wp.kernel
@no_type_check
def _scatter(
    offset: wp.int32,
    grid: Grid,
    parts: wp.int32,
    means2d_in: wp.array[wp.vec2],
    conics_in: wp.array[wp.vec3],
    view_opacities_in: wp.array[wp.float32],
    extents_in: wp.array[wp.vec2],
    entries_in: wp.array2d[wp.int32],
    totals_in: wp.array2d[wp.int64],
    numbers_in: wp.array[wp.int32],
    cursors_out: wp.array2d[wp.int32],
    offsets_out: wp.array[wp.int32],
    staged_out: wp.array2d[wp.int32],
):
    """Cursors hold, at first, the place of the first pair of each (task, tile)."""
    task = offset + wp.tid()
    end = (task // parts + 1) * grid.num
    if (task + 1) % parts != 0:
        end = _begin(grid.num, parts, task + 1)
    _scatter_part(
        task,
        _begin(grid.num, parts, task),
        end,
        numbers_in[task],
        grid.width,
        grid.height,
        grid.tiles_x,
        grid.shift,
        grid.skip & _TILE_TEST,
        grid.alpha_min,
        means2d_in,
        conics_in,
        view_opacities_in,
        extents_in,
        entries_in,
        totals_in,
        cursors_out,
        offsets_out,
        staged_out,
    )


@wp.kernel
@no_type_check
def _sort(
    offset: wp.int32,
    tiles: wp.int32,
    starts_in: wp.array[wp.int32],
    staged_in: wp.array2d[wp.int32],
    counter_out: wp.array[wp.int32],
    room_out: wp.array2d[wp.int64],
    pairs_out: wp.array[wp.int32],
    rows_out: wp.array[wp.int32],
):
    """``counter`` is the next tile to take, ``room`` holds a worker's list twice."""
    worker = offset + wp.tid()
    tile = take(counter_out)
    while tile < tiles:
        begin = starts_in[tile]
        end = starts_in[tile + 1]
        if begin < end:
            _sort_list(worker, begin, end, staged_in, room_out, pairs_out, rows_out)
        tile = take(counter_out)


def bin_many(grid: Grid, depths: Tensor, inputs: list, check: Callable[[int], None]) -> Bins:
    """As ``bin_views``, with the same lists; pairs are numbered in the order of the Gaussians.

    Args:
        grid: from ``make_grid``.
        depths: ``[I, N]``, not negative.
        inputs: flat views of means2d, conics, opacities and extents.
        check: raises if there are too many.
    """
    (images, num), tiles, workers = depths.shape, grid.tiles_x * grid.tiles_y, torch.get_num_threads()
    parts = _PARTS_PER_THREAD * workers
    tasks = images * parts
    entries = empty([images * num, _ENTRY], torch.int32)
    steps = entries.new_zeros(tasks, grid.tiles_y * (grid.tiles_x + 1))
    totals = entries.new_zeros(tasks, 3, dtype=torch.int64)
    outputs = [entries, steps, totals]
    parallel_launch(_record, tasks, [grid, parts, *inputs, depths.view(-1)], outputs, pieces=tasks)
    ends = totals[:, 1].cumsum(0)
    total = int(ends[-1])
    check(total)
    numbers = torch.nn.functional.pad(ends, (1, 0)).int()
    # running sums in the order of the pairs: view, tile, part
    in_tiles = steps.view(images, parts, grid.tiles_y, -1).cumsum(3, dtype=torch.int32)
    in_tiles = in_tiles[..., :-1].reshape(images, parts, tiles)
    begins = in_tiles.transpose(1, 2).reshape(-1).cumsum(0).int()
    begins = torch.nn.functional.pad(begins, (1, 0))
    starts = begins[::parts].clone()  # the cursors, which are changed, share the memory
    cursors = begins[:-1].view(images, tiles, parts).transpose(1, 2).contiguous().flatten(0, 1)
    offsets = entries.new_empty(images * num + 1)
    offsets[-1] = total
    staged = empty([total, 3], torch.int32)
    inputs = [grid, parts, *inputs, entries, totals, numbers[:-1]]
    parallel_launch(_scatter, tasks, inputs, [cursors, offsets, staged], pieces=tasks)
    pairs, rows = (empty([total], torch.int32) for _ in range(2))
    longest = int(starts.diff().max())
    room = totals.new_empty(workers, 2 * max(longest, 1))
    outputs = [entries.new_zeros(1), room, pairs, rows]
    parallel_launch(_sort, workers, [images * tiles, starts, staged], outputs)
    order = torch.arange(images * num, dtype=torch.int32)
    return Bins(order, offsets, pairs, rows, starts, box_pairs=totals[:, 2].sum())
