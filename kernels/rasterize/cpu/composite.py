"""Compositing on the CPU: threads take tile after tile, 16 lanes = the pixels of a 4 x 4 block.

A tile of 16 x 16 pixels is 16 such blocks (``tuning.py`` has other sizes). The gradient walks back
to front and writes one row per (tile, Gaussian) intersection; rows are summed by Gaussian
afterwards, by one thread and without atomics: the same bits every time. README.md §3 and §5 hold
the maths.
"""

import functools
from pathlib import Path
from types import SimpleNamespace
from typing import Any, no_type_check

import torch
import warp as wp
from torch import Tensor

from ...runtime.launch import parallel_launch
from ...runtime.memory import empty
from ...runtime.native import native
from ...runtime.views import Packed, struct
from ..skip import BLOCK_TEST, EMPTY_TILES, STOPPED, UNUSED, ZERO_UPSTREAM
from ..tiles import SLACK, SLACK_ABS, Bins, Lists, PairGradients, Picture, Walk
from .tuning import Tuning

_HERE = Path(__file__).parent
_OPTIONS = {"enable_backward": False}
_RUN = 1024  # Gaussians of a task of the sums
_PIECES_PER_THREAD = 8

# The coefficients of 2^f by degree of the polynomial, those of the highest power first.
_EXP2 = {
    2: (0.23842893540859222, 0.7034479975700378, 1.0004431009292603),
    3: (0.0551716685295105, 0.2426111251115799, 0.6932609677314758, 0.9999280571937561),
    4: (
        *(9.570102207362652e-3, 5.591785907745361e-2, 0.240247443318367),
        *(0.6931217908859253, 0.9999992847442627),
    ),
    5: (
        *(1.32764715e-3, 9.67554133e-3, 5.55071327e-2),
        *(0.240221197, 0.693146967, 1.00000007),
    ),
}


def _polynomial(degree: int) -> str:
    """C++ that makes p of f; degree 5 goes in pairs, which is a shorter chain than Horner's."""
    c = [f"(F{{}} + {value!r}f)" for value in _EXP2[degree]]
    if degree < 5:
        steps = "".join(f" p = fma_(p, f, {value});" for value in c[1:])
        return f"F p = {c[0]};{steps}"
    high, middle, low = (f"fma_({c[i]}, f, {c[i + 1]})" for i in (0, 2, 4))
    return f"const F f2 = f * f; const F p = fma_(fma_({high}, f2, {middle}), f2, {low});"


@struct
class Gaussians:
    """What is composited: the Gaussians of I views, and their colours; or their gradients."""

    means2d: wp.array[wp.vec2]
    conics: wp.array[wp.vec3]
    opacities: wp.array[wp.float32]
    colors: wp.array2d[wp.float32]


@struct
class Walked:
    """``Walk``, in its order."""

    transmittances: wp.array2d[wp.float32]
    stops: wp.array2d[wp.int32]
    blocks: wp.array[wp.int32]
    walked: wp.array[wp.int32]
    blocks_walked: wp.array[wp.int64]


@struct
class Pixels:
    """The pictures, or their gradients."""

    renders: wp.array[wp.float32]
    alphas: wp.array[wp.float32]


@struct
class Workers:
    """What the workers of a launch share, the next tile to take, and what each has of its own."""

    counter: wp.array[wp.int32]
    workspace: wp.array[wp.float32]


@struct
class Rows:
    """The sums of each intersection: six moments of h (README eq. 11) and the colours."""

    sums: wp.array2d[wp.float32]  # [P, 6 + C]
    written: wp.array[wp.uint8]  # [P], 0 where a row was not written and is not read
    skipped: wp.array[wp.int32]  # [tiles], 1 where a tile was not walked
    geometry: int  # whether anything but colours is asked for


@functools.cache
def _kernels(tuning: Tuning) -> SimpleNamespace:
    """The kernels ``forward`` and ``backward`` of a tuning."""
    lanes = range(16)
    starts_x = [4 * (b % tuning.columns) // tuning.width * tuning.width for b in lanes]
    starts_y = [4 * (b // tuning.columns) // tuning.height * tuning.height for b in lanes]
    defines: dict[str, Any] = {
        **{"TILE": tuning.tile, "WIDTH": tuning.width, "HEIGHT": tuning.height},
        "COLUMN_STARTS": f"{{{', '.join(map(str, starts_x))}}}",
        "ROW_STARTS": f"{{{', '.join(map(str, starts_y))}}}",
        "POLYNOMIAL": _polynomial(tuning.degree),
        **{"SLACK": SLACK, "SLACK_ABS": SLACK_ABS, "BLOCK_TEST": BLOCK_TEST, "STOPPED": STOPPED},
        **{"EMPTY_TILES": EMPTY_TILES, "ZERO_UPSTREAM": ZERO_UPSTREAM, "UNUSED": UNUSED},
    }

    @wp.func_native(native(_HERE / "composite.inl", **defines))
    def blend(
        worker: int,
        picture: Picture,
        splats: Gaussians,
        lists: Lists,
        walk: Walked,
        pixels: Pixels,
        workers: Workers,
    ): ...

    @wp.func_native(native(_HERE / "composite_vjp.inl", **defines))
    def unblend(
        worker: int,
        picture: Picture,
        splats: Gaussians,
        lists: Lists,
        walk: Walked,
        pixels: Pixels,
        workers: Workers,
        rows: Rows,
    ): ...

    @wp.kernel(module="unique", module_options=_OPTIONS)
    @no_type_check
    def composite(
        offset: int,
        picture: Picture,
        splats_in: Gaussians,
        lists_in: Lists,
        walk_out: Walked,
        pixels_out: Pixels,
        workers_out: Workers,
    ):
        worker = offset + wp.tid()
        blend(worker, picture, splats_in, lists_in, walk_out, pixels_out, workers_out)

    @wp.kernel(module="unique", module_options=_OPTIONS)
    @no_type_check
    def composite_vjp(
        offset: int,
        picture: Picture,
        splats_in: Gaussians,
        lists_in: Lists,
        walk_in: Walked,
        v_pixels_in: Pixels,
        workers_out: Workers,
        rows_out: Rows,
    ):
        worker = offset + wp.tid()
        unblend(worker, picture, splats_in, lists_in, walk_in, v_pixels_in, workers_out, rows_out)

    return SimpleNamespace(forward=composite, backward=composite_vjp)


@wp.func_native(native(_HERE / "sums.inl", RUN=_RUN))
def _sum_run(begin: int, splats: Gaussians, lists: Lists, rows: Rows, v: Gaussians): ...


@wp.kernel(enable_backward=False)
@no_type_check
def _sum_rows(offset: int, splats_in: Gaussians, lists_in: Lists, rows_in: Rows, v_out: Gaussians):
    _sum_run((offset + wp.tid()) * wp.static(_RUN), splats_in, lists_in, rows_in, v_out)


def _workers(size: int) -> Packed:
    """Room for ``size`` lanes of each worker."""
    workspace = torch.empty(torch.get_num_threads() * size * 16)
    return Packed(Workers, torch.zeros(1, dtype=torch.int32), workspace)


def composite_forward(
    means2d: Tensor,
    conics: Tensor,
    view_opacities: Tensor,
    colors: Tensor,
    bins: Bins,
    picture: Picture,
    tuning: Tuning,
) -> tuple[Tensor, Tensor, Walk]:
    """Blends I views; float32, contiguous tensors on the CPU.

    Args:
        means2d: ``[I, N, 2]``.
        conics: ``[I, N, 3]``.
        view_opacities: ``[I, N]``.
        colors: ``[rows, C]``, rows = B * N, or I * N if ``picture.colors_per_view``.
        bins: from ``bin_gaussians``.
        picture: from ``make_picture``, with the tuning's tile.
        tuning: the choice of kernels; the lists were made with its tile.

    Returns:
        ``renders [I, H, W, C]``, ``alphas [I, H, W, 1]`` and a ``Walk``.
    """
    images, channels = means2d.shape[0], colors.shape[1]
    tiles = images * picture.tiles_x * picture.tiles_y
    renders = colors.new_zeros(images, picture.height, picture.width, channels)
    alphas = colors.new_zeros(images, picture.height, picture.width, 1)
    blocks = tuning.blocks
    walk = Walk(
        transmittances=colors.new_empty(tiles * blocks, 16),
        stops=bins.pairs.new_empty(tiles * blocks, 16),
        blocks=torch.zeros_like(bins.pairs),
        walked=bins.pairs.new_empty(tiles),
        blocks_walked=bins.pairs.new_empty(tiles, dtype=torch.int64),
    )
    arguments = [
        picture,
        Packed(Gaussians, means2d, conics, view_opacities, colors),
        Packed(Lists, *bins),
        Packed(Walked, *walk),
        Packed(Pixels, renders, alphas),
        _workers(tuning.blocks * channels),
    ]
    parallel_launch(_kernels(tuning).forward, torch.get_num_threads(), arguments)
    return renders, alphas, walk


def composite_backward(
    means2d: Tensor,
    conics: Tensor,
    view_opacities: Tensor,
    colors: Tensor,
    bins: Bins,
    picture: Picture,
    tuning: Tuning,
    walk: Walk,
    v_renders: Tensor,
    v_alphas: Tensor,
    geometry: bool,
) -> tuple[PairGradients, Tensor]:
    """Gradients of ``composite_forward`` by (view, Gaussian), from a row of sums for each pair.

    Args:
        means2d: as forward.
        conics: as forward.
        view_opacities: as forward.
        colors: as forward.
        bins: as forward.
        picture: as forward.
        tuning: as forward.
        walk: as returned forward.
        v_renders: ``[I, H, W, C]``.
        v_alphas: ``[I, H, W, 1]``.
        geometry: whether anything but colours is asked for.

    Returns:
        The gradients and ``skipped [tiles]`` int32, 1 where a tile was not walked.
    """
    channels = colors.shape[1]
    sums = empty([bins.pairs.numel(), 6 + channels], torch.float32)
    written = bins.pairs.new_zeros(bins.pairs.numel(), dtype=torch.uint8)
    skipped = torch.empty_like(walk.walked)
    arguments = [
        picture,
        Packed(Gaussians, means2d, conics, view_opacities, colors),
        Packed(Lists, *bins),
        Packed(Walked, *walk),
        Packed(Pixels, v_renders, v_alphas),
        _workers(channels + tuning.blocks * (channels + 1)),
        Packed(Rows, sums, written, skipped, int(geometry)),
    ]
    parallel_launch(_kernels(tuning).backward, torch.get_num_threads(), arguments)
    return reduce_rows(sums, written, bins, conics, view_opacities, geometry), skipped


def reduce_rows(
    sums: Tensor,
    written: Tensor,
    bins: Bins,
    conics: Tensor,
    view_opacities: Tensor,
    geometry: bool,
) -> PairGradients:
    """Sums rows by (view, Gaussian), in the order in which intersections are numbered.

    Args:
        sums: ``[P, 6 + C]``: six moments of h (README eq. 11), then the colours.
        written: ``[P]`` uint8, 0 where a row was not written and is not read.
        bins: as forward.
        conics: ``[I, N, 3]``.
        view_opacities: ``[I, N]``.
        geometry: whether anything but colours is asked for.
    """
    lead, channels = view_opacities.shape, sums.shape[1] - 6
    v_means2d, v_conics, v_opacities = (
        empty([*lead, *size], torch.float32) if geometry else None for size in ((2,), (3,), ())
    )
    v = PairGradients(v_means2d, v_conics, v_opacities, empty([*lead, channels], torch.float32))
    arguments = [
        Packed(Gaussians, None, conics, view_opacities, None),
        Packed(Lists, *bins),
        Packed(Rows, sums, written, None, int(geometry)),
        Packed(Gaussians, *v),
    ]
    tasks = -(-bins.order.numel() // _RUN)
    pieces = min(tasks, _PIECES_PER_THREAD * torch.get_num_threads())
    parallel_launch(_sum_rows, tasks, arguments, pieces=pieces)
    return v
