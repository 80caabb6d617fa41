"""The three registered operators and their gradients: project, bin, composite.

They hold no arithmetic: each calls the launchers of its file. ``function.py`` joins them.
"""

import torch
import warp as wp
from torch import Tensor

from ..runtime.views import vectors
from .cpu import bin as bin_cpu
from .cpu import composite as composite_cpu
from .cpu.tuning import Variant, current
from .cuda import bin as bin_cuda
from .cuda import composite as composite_cuda
from .project import make_lens, project_forward
from .project_vjp import project_backward
from .reduce import reduce_pairs
from .skip import UNASKED
from .tiles import (
    Bins,
    Walk,
    make_frame,
    make_grid,
    tile_grid,
)

_OP = "gamba_warp::rasterize_"
MAX_PAIRS = 2**31 - 1  # pairs are numbered in int32


def _compositor(device: torch.device):
    if device.type == "cpu":
        return composite_cpu
    if current() != Variant():
        raise ValueError(f"device is {device}: {current()} is for a CPU")
    return composite_cuda


@torch.library.custom_op(_OP + "project", mutates_args=())
def project(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    lens: list[float],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """``project_forward`` as an operator; ``lens`` holds ``make_lens``'s arguments."""
    return project_forward(means, quats, scales, opacities, colors, viewmats, Ks, make_lens(*lens))


@project.register_fake
def _(means, quats, scales, opacities, colors, viewmats, Ks, lens):
    shape = (*viewmats.shape[:2], means.shape[1])
    sizes = ((2,), (3,), (), (), (2,))
    floats = tuple(means.new_empty(*shape, *size) for size in sizes)
    return *floats, means.new_empty(shape, dtype=torch.int32)


@torch.library.custom_op(_OP + "project_vjp", mutates_args=())
def _project_vjp(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor,
    opacities: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    lens: list[float],
    conics: Tensor,
    status: Tensor,
    cotangents: list[Tensor],
    needs: list[bool],
) -> list[Tensor]:
    inputs = (means, quats, scales, opacities, viewmats, Ks)
    grads = project_backward(inputs, make_lens(*lens), conics, status, cotangents, needs)
    return [g for g in grads if g is not None]


@_project_vjp.register_fake
def _(means, quats, scales, opacities, viewmats, Ks, lens, conics, status, cotangents, needs):
    inputs = (means, quats, scales, opacities, viewmats)
    return [torch.empty_like(x) for x, need in zip(inputs, needs) if need]


def _project_setup(ctx, inputs, output):
    means, quats, scales, opacities, _, viewmats, Ks, ctx.lens = inputs
    _, conics, _, _, extents, status = output
    ctx.mark_non_differentiable(extents, status)
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(means, quats, scales, opacities, viewmats, Ks, conics, status)


def _project_backward(ctx, v_means2d, v_conics, v_depths, v_view_opacities, _extents, _status):
    *inputs, conics, status = ctx.saved_tensors
    needs = [ctx.needs_input_grad[i] for i in (0, 1, 2, 3, 5)]
    shape = status.shape
    cotangents = [
        conics.new_zeros(*shape, *size) if v is None else v.contiguous()
        for v, size in zip((v_means2d, v_conics, v_depths, v_view_opacities), ((2,), (3,), (), ()))
    ]
    grads = iter(_project_vjp(*inputs, ctx.lens, conics, status, cotangents, needs))
    v = [next(grads) if need else None for need in needs]
    return v[0], v[1], v[2], v[3], None, v[4], None, None


project.register_autograd(_project_backward, setup_context=_project_setup)


def bin_gaussians(
    means2d: Tensor,
    conics: Tensor,
    depths: Tensor,
    view_opacities: Tensor,
    extents: Tensor,
    width: int,
    height: int,
    alpha_min: float,
    skip: int,
) -> Bins:
    """Makes the tile lists of all views; reads the number of pairs back (the one synchronisation).

    Args:
        means2d: ``[I, N, 2]``, and so on as ``project_forward`` returns them, with I = B * V.
        conics: ``[I, N, 3]``.
        depths: ``[I, N]``.
        view_opacities: ``[I, N]``.
        extents: ``[I, N, 2]``, zero where culled.
        width: pixels.
        height: pixels.
        alpha_min: what is fainter than this is not drawn.
        skip: from ``Skip.bits``.

    Raises:
        ValueError: there are more than 2^31 - 1 pairs, or more tiles.
    """
    images, num = depths.shape
    tiles_x, tiles_y = tile_grid(width, height)
    tiles = images * tiles_x * tiles_y
    if max(tiles, depths.numel()) >= MAX_PAIRS:
        raise ValueError(f"{images} views of {tiles_x * tiles_y} tiles, {num} Gaussians: over 2^31")
    grid = make_grid(num, width, height, alpha_min, skip)
    inputs = [
        vectors(means2d, wp.vec2),
        vectors(conics, wp.vec3),
        view_opacities.view(-1),
        vectors(extents, wp.vec2),
    ]
    bin_views = (bin_cpu if depths.device.type == "cpu" else bin_cuda).bin_views
    return Bins(*bin_views(grid, depths, inputs, _refuse_too_many))


def _refuse_too_many(pairs: int) -> None:
    if pairs > MAX_PAIRS:
        raise ValueError(
            f"{pairs} pairs of tiles and Gaussians; at most 2^31 - 1 fit: fewer views, a smaller "
            "picture or smaller scales are needed"
        )


@torch.library.custom_op(_OP + "bin", mutates_args=())
def bin_op(
    means2d: Tensor,
    conics: Tensor,
    depths: Tensor,
    view_opacities: Tensor,
    extents: Tensor,
    width: int,
    height: int,
    alpha_min: float,
    skip: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """``bin_gaussians`` as an operator; the number of pairs is known only at run time."""
    per_view = means2d, conics, depths, view_opacities, extents
    return tuple(bin_gaussians(*per_view, width, height, alpha_min, skip))


@bin_op.register_fake
def _(means2d, conics, depths, view_opacities, extents, width, height, alpha_min, skip):
    def ints(*shape):
        return depths.new_empty(shape, dtype=torch.int32)

    tiles_x, tiles_y = tile_grid(width, height)
    count = depths.numel()
    pairs = torch.library.get_ctx().new_dynamic_size()
    starts = ints(depths.shape[0] * tiles_x * tiles_y + 1)
    box_pairs = depths.new_empty((), dtype=torch.int64)
    return ints(count), ints(count + 1), ints(pairs), ints(pairs), starts, box_pairs


@torch.library.custom_op(_OP + "composite", mutates_args=())
def composite(
    means2d: Tensor,
    conics: Tensor,
    view_opacities: Tensor,
    colors: Tensor,
    bins: list[Tensor],
    size: list[int],
    alpha_range: list[float],
    skipped: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Blends the pairs; ``size``: width, height, V, whether colours are per view, ``Skip.bits``.

    ``colors`` is ``[I * N, C]`` or, shared by the views, ``[B * N, C]``; ``bins`` is a ``Bins``.
    Backward counts the tiles that it skips into ``skipped``, int64 without dimensions.
    """
    renders, alphas, walk = _compositor(means2d.device).composite_forward(
        means2d, conics, view_opacities, colors, Bins(*bins), _frame(means2d, size, alpha_range)
    )
    return renders, alphas, *walk


def _frame(means2d: Tensor, size: list[int], alpha_range: list[float]):
    width, height, views, per_view, skip = size
    return make_frame(width, height, views, means2d.shape[1], bool(per_view), *alpha_range, skip)


@composite.register_fake
def _(means2d, conics, view_opacities, colors, bins, size, alpha_range, skipped):
    width, height = size[:2]
    tiles_x, tiles_y = tile_grid(width, height)
    images, pairs = means2d.shape[0], Bins(*bins).pairs
    tiles = images * tiles_x * tiles_y
    blocks = tiles * current().blocks
    return (
        colors.new_empty(images, height, width, colors.shape[1]),
        colors.new_empty(images, height, width, 1),
        colors.new_empty(blocks, 16),
        pairs.new_empty(blocks, 16),
        torch.empty_like(pairs),
        pairs.new_empty(tiles),
        pairs.new_empty(tiles, dtype=torch.int64),
    )


@torch.library.custom_op(_OP + "composite_vjp", mutates_args=())
def _composite_vjp(
    means2d: Tensor,
    conics: Tensor,
    view_opacities: Tensor,
    colors: Tensor,
    bins: list[Tensor],
    size: list[int],
    alpha_range: list[float],
    walk: list[Tensor],
    v_renders: Tensor,
    v_alphas: Tensor,
    geometry: bool,
) -> list[Tensor]:
    every = Bins(*bins)
    v_pairs, written, skipped = _compositor(means2d.device).composite_backward(
        means2d,
        conics,
        view_opacities,
        colors,
        every,
        _frame(means2d, size, alpha_range),
        Walk(*walk),
        v_renders,
        v_alphas,
        geometry,
    )
    grads = reduce_pairs(v_pairs, written, every, conics, view_opacities, geometry)
    return [skipped, *(g for g in grads if g is not None)]


@_composite_vjp.register_fake
def _(means2d, conics, view_opacities, colors, bins, size, alpha_range, walk, *rest):
    v_colors = colors.new_empty(*view_opacities.shape, colors.shape[1])
    skipped = torch.empty_like(Walk(*walk).walked)
    if not rest[-1]:
        return [skipped, v_colors]
    return [skipped, *map(torch.empty_like, (means2d, conics, view_opacities)), v_colors]


def _composite_setup(ctx, inputs, output):
    means2d, conics, view_opacities, colors, bins, ctx.size, ctx.alpha_range, ctx.skipped = inputs
    renders, alphas, *walk = output
    ctx.mark_non_differentiable(*walk)
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(means2d, conics, view_opacities, colors, *bins, *walk)
    ctx.shapes = renders.shape, alphas.shape


def _shaped(gradient: Tensor, value: Tensor) -> Tensor:
    # without a view there is nothing to sum
    return gradient.reshape(value.shape) if gradient.numel() else torch.zeros_like(value)


def _composite_backward(ctx, v_renders, v_alphas, *_):
    means2d, conics, view_opacities, colors, *rest = ctx.saved_tensors
    bins, walk = rest[: len(Bins._fields)], rest[len(Bins._fields) :]
    v_renders = colors.new_zeros(ctx.shapes[0]) if v_renders is None else v_renders
    v_alphas = colors.new_zeros(ctx.shapes[1]) if v_alphas is None else v_alphas
    needs = ctx.needs_input_grad
    geometry = any(needs[:3]) or not ctx.size[-1] & UNASKED
    skipped, *v_geometry, v_colors = _composite_vjp(
        means2d,
        conics,
        view_opacities,
        colors,
        bins,
        ctx.size,
        ctx.alpha_range,
        walk,
        v_renders.contiguous(),
        v_alphas.contiguous(),
        geometry,
    )
    v_means2d, v_conics, v_view_opacities = v_geometry if geometry else (None, None, None)
    if ctx.skipped is not None:
        ctx.skipped.copy_(skipped.sum())
    views, per_view = ctx.size[2:4]
    if not per_view and views:
        images, num, channels = v_colors.shape
        v_colors = v_colors.view(images // views, views, num, channels).sum(1)
    v_colors = _shaped(v_colors, colors) if needs[3] else None
    grads = (x if need else None for x, need in zip((v_means2d, v_conics, v_view_opacities), needs))
    return *grads, v_colors, [None] * len(bins), None, None, None


composite.register_autograd(_composite_backward, setup_context=_composite_setup)
