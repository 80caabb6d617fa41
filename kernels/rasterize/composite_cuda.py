"""Compositing on CUDA: one warp per tile of 16 x 16 pixels, eight pixels per lane.

Lane l owns column l % 16 and every second row from l // 16 on, so that a sum over a tile is
eight additions in registers and one warp reduction per (tile, Gaussian) pair. Channels go in chunks
of four: a chunk is a launch, and the geometry's gradients of chunks add up. Sums are written per
pair and reduced by Gaussian afterwards: no atomics on floats. README.md §3 and §5 hold the maths.
"""

import torch
import warp as wp
from torch import Tensor

from ..constants import T_MIN, TILE
from ..interop import cuda_launch, view
from .bin import Bins
from .frame import Frame, Walk, color_row
from .launch import vectors

wp.set_module_options({"enable_backward": False})

WARP = 32
CHUNK = 4  # channels of a launch
_PIXELS = TILE * TILE // WARP  # of a lane

_TILE = wp.constant(TILE)
_ROWS = wp.constant(WARP // TILE)  # rows of a tile that a warp covers at once
_T_MIN = wp.constant(T_MIN)
_NEVER = wp.constant(2**31 - 1)
_EXP2 = wp.constant(-0.72134752044)  # exp(-q/2) = 2^(_EXP2 q)

vec8 = wp.types.vector(_PIXELS, wp.float32)
vec8i = wp.types.vector(_PIXELS, wp.int32)
mat84 = wp.types.matrix((_PIXELS, CHUNK), wp.float32)
vec10 = wp.types.vector(6 + CHUNK, wp.float32)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float y;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
#else
    return exp2f(x);
#endif
""")
def _exp2(x: wp.float32) -> wp.float32:
    """2^x, to 2 units in the last place."""
    ...


@wp.func
def _alpha(frame: Frame, q: wp.float32, opacity: wp.float32) -> wp.float32:
    alpha = opacity * _exp2(_EXP2 * q)
    if not (alpha >= frame.alpha_min):
        alpha = 0.0
    return wp.min(alpha, frame.alpha_max)


@wp.kernel
def _composite(
    frame: Frame,
    chunk: wp.int32,
    means2d_in: wp.array[wp.vec2],
    conics_in: wp.array[wp.vec3],
    view_opacities_in: wp.array[wp.float32],
    colors_in: wp.array2d[wp.vec4],
    pairs_in: wp.array[wp.int32],
    starts_in: wp.array[wp.int32],
    transmittances_out: wp.array2d[wp.float32],
    stops_out: wp.array2d[wp.int32],
    blocks_out: wp.array[wp.int32],
    walked_out: wp.array[wp.int32],
    renders_out: wp.array4d[wp.vec4],
    alphas_out: wp.array4d[wp.float32],
):
    tile, lane = wp.tid()
    image = tile // (frame.tiles_x * frame.tiles_y)
    px = tile % frame.tiles_x * _TILE + lane % _TILE
    py = tile // frame.tiles_x % frame.tiles_y * _TILE + lane // _TILE
    x = float(px) + 0.5
    y = float(py) + 0.5
    # a pixel outside the picture has stopped before it began
    T = vec8()
    stops = vec8i()
    sums = mat84()
    alive = wp.int32(0)
    for j in range(_PIXELS):
        T[j] = -1.0
        stops[j] = _NEVER
        if px < frame.width and py + j * _ROWS < frame.height:
            T[j] = 1.0
            alive += 1

    k = starts_in[tile]
    while k < starts_in[tile + 1] and alive > 0:
        g = pairs_in[k]
        mean = means2d_in[g]
        conic = conics_in[g]
        opacity = view_opacities_in[g]
        color = colors_in[color_row(frame, g), chunk]
        for j in range(_PIXELS):
            dy = y + float(j * _ROWS) - mean[1]
            u = x - mean[0] + conic[1] * dy
            alpha = _alpha(frame, conic[0] * u * u + conic[2] * dy * dy, opacity)
            if T[j] > 0.0 and alpha > 0.0:
                blocks_out[k] = 1
                after = T[j] - T[j] * alpha
                if after > _T_MIN:
                    for c in range(CHUNK):
                        sums[j, c] += T[j] * alpha * color[c]
                    T[j] = after
                else:
                    T[j] = -T[j]
                    stops[j] = k
                    alive -= 1
        k += 1
    wp.atomic_max(walked_out, tile, k - starts_in[tile])

    for j in range(_PIXELS):
        transmittances_out[tile, j * WARP + lane] = T[j]
        stops_out[tile, j * WARP + lane] = stops[j]
        if px < frame.width and py + j * _ROWS < frame.height:
            alphas_out[image, py + j * _ROWS, px, 0] = 1.0 - wp.abs(T[j])
            renders_out[image, py + j * _ROWS, px, chunk] = wp.vec4(
                sums[j, 0], sums[j, 1], sums[j, 2], sums[j, 3]
            )


@wp.kernel
def _composite_vjp(
    frame: Frame,
    chunk: wp.int32,
    means2d_in: wp.array[wp.vec2],
    conics_in: wp.array[wp.vec3],
    view_opacities_in: wp.array[wp.float32],
    colors_in: wp.array2d[wp.vec4],
    pairs_in: wp.array[wp.int32],
    rows_in: wp.array[wp.int32],
    starts_in: wp.array[wp.int32],
    transmittances_in: wp.array2d[wp.float32],
    stops_in: wp.array2d[wp.int32],
    blocks_in: wp.array[wp.int32],
    walked_in: wp.array[wp.int32],
    v_renders_in: wp.array4d[wp.vec4],
    v_alphas_in: wp.array4d[wp.float32],
    v_pairs_out: wp.array2d[wp.float32],
    skipped_out: wp.array[wp.int32],
):
    tile, lane = wp.tid()
    image = tile // (frame.tiles_x * frame.tiles_y)
    px = tile % frame.tiles_x * _TILE + lane % _TILE
    py = tile // frame.tiles_x % frame.tiles_y * _TILE + lane // _TILE
    x = float(px) + 0.5
    y = float(py) + 0.5
    T = vec8()
    R = vec8()
    stops = vec8i()
    v_sums = mat84()
    v_alphas = vec8()
    largest = wp.float32(0.0)
    for j in range(_PIXELS):
        T[j] = wp.abs(transmittances_in[tile, j * WARP + lane])
        # a pixel outside the picture takes no part
        stops[j] = -1
        if px < frame.width and py + j * _ROWS < frame.height:
            stops[j] = stops_in[tile, j * WARP + lane]
            v = v_renders_in[image, py + j * _ROWS, px, chunk]
            for c in range(CHUNK):
                v_sums[j, c] = v[c]
                largest = wp.max(largest, wp.abs(v[c]))
            if chunk == 0:
                v_alphas[j] = v_alphas_in[image, py + j * _ROWS, px, 0]
                largest = wp.max(largest, wp.abs(v_alphas[j]))
    # NaN gradients must not be taken for zero
    some = wp.int32(0)
    if not (largest <= 0.0):
        some = 1
    walked = walked_in[tile] * wp.tile_extract(wp.tile_max(wp.tile(some)), 0)
    if lane == 0 and walked > 0:
        skipped_out[tile] = 0

    k = starts_in[tile] + walked - 1
    while k >= starts_in[tile]:
        if blocks_in[k] != 0:
            g = pairs_in[k]
            mean = means2d_in[g]
            conic = conics_in[g]
            opacity = view_opacities_in[g]
            color = colors_in[color_row(frame, g), chunk]
            sums = vec10()
            for j in range(_PIXELS):
                dy = y + float(j * _ROWS) - mean[1]
                u = x - mean[0] + conic[1] * dy
                alpha = _alpha(frame, conic[0] * u * u + conic[2] * dy * dy, opacity)
                if k < stops[j] and alpha > 0.0:
                    T[j] = T[j] / (1.0 - alpha)
                    weight = T[j] * alpha
                    diff = v_alphas[j] - R[j]
                    for c in range(CHUNK):
                        diff += color[c] * v_sums[j, c]
                        sums[6 + c] += weight * v_sums[j, c]
                    R[j] = R[j] + alpha * diff
                    if alpha < frame.alpha_max:
                        h = weight * diff
                        sums[0] += h
                        sums[1] += h * u
                        sums[2] += h * dy
                        sums[3] += h * u * u
                        sums[4] += h * u * dy
                        sums[5] += h * dy * dy
            total = wp.tile_extract(wp.tile_sum(wp.tile(sums, preserve_type=True)), 0)
            if lane == 0:
                row = rows_in[k]
                for c in range(6):
                    v_pairs_out[row, c] += total[c]
                for c in range(CHUNK):
                    v_pairs_out[row, 6 + chunk * CHUNK + c] = total[6 + c]
        k -= 1


def _in_chunks(values: Tensor) -> Tensor:
    """Zero channels up to the next multiple of a chunk."""
    return torch.nn.functional.pad(values, (0, -values.shape[-1] % CHUNK)).contiguous()


def _chunk_view(values: Tensor):
    return view(values.view(*values.shape[:-1], -1, CHUNK), wp.vec4)


def composite_forward(
    means2d: Tensor,
    conics: Tensor,
    view_opacities: Tensor,
    colors: Tensor,
    bins: Bins,
    frame: Frame,
) -> tuple[Tensor, Tensor, Walk]:
    """As ``composite_cpu.composite_forward``; a ``Walk``'s pixels are in the order of the lanes."""
    images, channels = means2d.shape[0], colors.shape[1]
    tiles = images * frame.tiles_x * frame.tiles_y
    colors = _in_chunks(colors)
    renders = colors.new_empty(images, frame.height, frame.width, colors.shape[1])
    alphas = colors.new_empty(images, frame.height, frame.width, 1)
    walk = Walk(
        colors.new_empty(tiles * 16, 16),
        bins.pairs.new_empty(tiles * 16, 16),
        torch.zeros_like(bins.pairs),
        bins.pairs.new_zeros(tiles),
    )
    for chunk in range(colors.shape[1] // CHUNK if tiles else 0):
        cuda_launch(
            _composite,
            (tiles, WARP),
            [
                frame,
                chunk,
                vectors(means2d, wp.vec2),
                vectors(conics, wp.vec3),
                view_opacities.view(-1),
                _chunk_view(colors),
                bins.pairs,
                bins.starts,
            ],
            [
                walk.transmittances.view(tiles, -1),
                walk.stops.view(tiles, -1),
                walk.blocks,
                walk.walked,
                _chunk_view(renders),
                alphas,
            ],
            device=colors.device,
            block_dim=WARP,
        )
    return renders[..., :channels].contiguous(), alphas, walk


def composite_backward(
    means2d: Tensor,
    conics: Tensor,
    view_opacities: Tensor,
    colors: Tensor,
    bins: Bins,
    frame: Frame,
    walk: Walk,
    v_renders: Tensor,
    v_alphas: Tensor,
    geometry: bool,
) -> tuple[Tensor, Tensor]:
    """As ``composite_cpu.composite_backward``; ``geometry`` changes nothing here."""
    tiles, channels = walk.walked.numel(), colors.shape[1]
    colors, v_renders = _in_chunks(colors), _in_chunks(v_renders)
    v_pairs = colors.new_zeros(bins.pairs.numel(), 6 + colors.shape[1])
    skipped = torch.ones_like(walk.walked)
    for chunk in range(colors.shape[1] // CHUNK if tiles else 0):
        cuda_launch(
            _composite_vjp,
            (tiles, WARP),
            [
                frame,
                chunk,
                vectors(means2d, wp.vec2),
                vectors(conics, wp.vec3),
                view_opacities.view(-1),
                _chunk_view(colors),
                bins.pairs,
                bins.rows,
                bins.starts,
                walk.transmittances.view(tiles, -1),
                walk.stops.view(tiles, -1),
                walk.blocks,
                walk.walked,
                _chunk_view(v_renders),
                v_alphas,
            ],
            [v_pairs, skipped],
            device=colors.device,
            block_dim=WARP,
        )
    return v_pairs[:, : 6 + channels], skipped
