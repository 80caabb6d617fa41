"""The three registered operators and their gradients: project, bin, composite.

They hold no arithmetic: each calls the launchers of its file. ``api.py`` joins them. An
operator takes tensors and plain numbers only, so a named tuple comes as its values.
"""

import math
from collections.abc import Callable, Sequence
from typing import get_type_hints

import torch
from torch import Tensor

from ..runtime import gpu
from ..runtime.operator import operator
from .constants import BLOCKS
from .cpu import bin as bin_cpu
from .cpu import composite as composite_cpu
from .cuda import bin as bin_cuda
from .cuda import composite as composite_cuda
from .projection import (
    PROJECTED_SIZES,
    Projected,
    ProjectionOptions,
    project_backward,
    project_forward,
    projection_params,
)
from .skip import UNASKED
from .tiles import (
    MAX_PAIRS,
    Bins,
    Limits,
    Saved,
    Size,
    Splats2D,
    Tiling,
    make_grid,
    raster_params,
    record_size,
)

_OP = "gamba_warp::rasterize_"


def _compositor(device: torch.device):
    return composite_cpu if gpu.kind_of(device) == "cpu" else composite_cuda


def _schema(record: type) -> str:
    """The fields of a named tuple of numbers, as arguments of an operator."""
    return ", ".join(f"{kind.__name__} {name}" for name, kind in get_type_hints(record).items())


@torch.library.custom_op(
    _OP + "project",
    mutates_args=(),
    schema="(Tensor means, Tensor? quats, Tensor? scales, Tensor? covars, Tensor opacities, "
    f"Tensor colors, Tensor viewmats, Tensor Ks, {_schema(ProjectionOptions)})"
    " -> (Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)",
)
def project(means, quats, scales, covars, opacities, colors, viewmats, Ks, *options):
    """``project_forward`` as an operator; the options are those of ``ProjectionOptions``."""
    inputs = means, quats, scales, covars, opacities, colors, viewmats, Ks
    params = projection_params(ProjectionOptions(*options))
    p = project_forward(inputs, params)
    return p.means2d, p.conics, p.depths, p.view_opacities, p.extents, p.status


@project.register_fake
def _(means, quats, scales, covars, opacities, colors, viewmats, Ks, *options):
    shape = (*viewmats.shape[:-2], means.shape[-2])
    floats = tuple(means.new_empty(*shape, *size) for size in PROJECTED_SIZES)
    return *floats, means.new_empty(shape, dtype=torch.int32)


@torch.library.custom_op(
    _OP + "project_vjp",
    mutates_args=(),
    schema="(Tensor?[] inputs, Tensor conics, Tensor status, Tensor[] cotangents, bool[] wanted, "
    f"{_schema(ProjectionOptions)}) -> Tensor[]",
)
def _project_vjp(inputs, conics, status, cotangents, wanted, *options):
    params = projection_params(ProjectionOptions(*options))
    grads = project_backward(inputs, params, conics, status, cotangents, wanted)
    return [g for g in grads if g is not None]


@_project_vjp.register_fake
def _(inputs, conics, status, cotangents, wanted, *options):
    return [torch.empty_like(x) for x, want in zip(inputs[:6], wanted) if want]


def _project_setup(ctx, inputs, output):
    means, quats, scales, covars, opacities, _, viewmats, Ks, *ctx.options = inputs
    projected = Projected(*output)
    ctx.mark_non_differentiable(projected.extents, projected.status)
    ctx.set_materialize_grads(False)
    gaussians = means, quats, scales, covars, opacities
    ctx.save_for_backward(*gaussians, viewmats, Ks, projected.conics, projected.status)


def _project_backward(ctx, *cotangents):
    *inputs, conics, status = ctx.saved_tensors
    needs = ctx.needs_input_grad
    wanted = [*needs[:5], needs[6]]  # all but the colors and Ks
    given = [
        conics.new_zeros(*status.shape, *size) if v is None else v.contiguous()
        for v, size in zip(cotangents, PROJECTED_SIZES[:4])
    ]
    grads = iter(_project_vjp(inputs, conics, status, given, wanted, *ctx.options))
    *v_gaussians, v_viewmats = (next(grads) if want else None for want in wanted)
    return *v_gaussians, None, v_viewmats, None, *[None] * len(ctx.options)


project = operator(project, "rasterization", _project_setup, _project_backward)
_project_vjp = operator(_project_vjp, "rasterization")


def _bin_views(device: torch.device) -> Callable[..., Bins]:
    return bin_cpu.bin_views if gpu.kind_of(device) == "cpu" else bin_cuda.bin_views


def _refuse_too_many(pairs: int) -> None:
    if pairs > MAX_PAIRS:
        raise ValueError(
            f"{pairs} pairs of tiles and Gaussians; at most 2^31 - 1 fit: fewer views, a smaller "
            "image or smaller scales are needed"
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
    """Make the tile lists of all views, ``Bins``; on CUDA the host waits for the number of pairs.

    A CUDA graph takes a capacity instead: ``cuda/capacity.py``. The length of the lists is known
    only at run time.

    Args:
        means2d: ``[.., N, 2]``, and so on as ``project_forward`` returns them, of I views.
        conics: ``[.., N, 3]``.
        depths: ``[.., N]``.
        view_opacities: ``[.., N]``.
        extents: ``[.., N, 2]``, zero where culled.
        width: pixels.
        height: pixels.
        alpha_min: fainter contributions are not drawn.
        skip: from ``Skip.bits``.

    Raises:
        ValueError: there are more than 2^31 - 1 pairs, or more tiles.
        RuntimeError: a CUDA graph is captured, and these shapes were never rendered.
    """
    given = means2d, conics, depths, view_opacities, extents
    splats = Projected(*(x.flatten(0, depths.dim() - 2) for x in given))
    images, num = splats.depths.shape
    tiling = Tiling(width, height)
    if max(images * tiling.count, depths.numel()) >= MAX_PAIRS:
        raise ValueError(f"{images} views of {tiling.count} tiles, {num} Gaussians: over 2^31")
    grid = make_grid(tiling, num=num, alpha_min=alpha_min, skip=skip)
    b = _bin_views(depths.device)(grid, splats, _refuse_too_many)
    return b.order, b.offsets, b.pairs, b.rows, b.starts, b.count


@bin_op.register_fake
def _(means2d, conics, depths, *rest):
    def ints(*shape, dtype=torch.int32):
        return depths.new_empty(shape, dtype=dtype)

    width, height = rest[2], rest[3]
    tiles = depths.shape[:-1].numel() * Tiling(width, height).count
    count, pairs = depths.numel(), torch.library.get_ctx().new_dynamic_size()
    return tuple(
        Bins(
            order=ints(count),
            offsets=ints(count + 1),
            pairs=ints(pairs),
            rows=ints(pairs),
            starts=ints(tiles + 1),
            count=ints(dtype=torch.int64),
        )
    )


bin_op = operator(bin_op, "rasterization")


@torch.library.custom_op(
    _OP + "composite",
    mutates_args=(),
    schema="(Tensor means2d, Tensor conics, Tensor view_opacities, Tensor colors, Tensor[] bins, "
    f"Tensor? skipped, Tensor? absolute, {_schema(Size)}, {_schema(Limits)})"
    " -> (Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)",
)
def composite(means2d, conics, view_opacities, colors, bins, skipped, absolute, *options):
    """Blend the pairs: images, their final transmittances and the fields of a ``Saved``.

    ``means2d`` is ``[.., N, 2]``, of I views, and so on. ``colors`` has a row for each of these
    Gaussians or, shared by the views, one for each of an object's. ``bins`` has the tensors of
    ``Bins``; the options are those of ``Size``, then of ``Limits``. Backward raises the numbers of
    tiles in ``skipped``, ``[I * tiles]`` int32, to 1 if it skips a tile and to 2 if it traverses
    it. Where it has a gradient of the geometry, it sets ``absolute``, ``[.., N, 2]``, to the sums
    over pixels of the absolute values of their gradients of ``means2d``.
    """
    splats = Splats2D(means2d, conics, view_opacities, colors.flatten(0, -2))
    params = raster_params(*_records(options), num=means2d.shape[-2])
    forward = _compositor(means2d.device).composite_forward
    renders, transmittances, saved = forward(splats, Bins(*bins), params)
    return renders, transmittances, *saved


def _records(options: Sequence) -> tuple[Size, Limits]:
    """The options of an operator as records."""
    count = len(Size._fields)
    return Size(*options[:count]), Limits(*options[count:])


@composite.register_fake
def _(means2d, conics, opacities, colors, bins, skipped, absolute, width, height, *rest):
    images, pairs = means2d.shape[:-2], Bins(*bins).pairs
    tiles = images.numel() * Tiling(width, height).count
    on_cpu = gpu.kind_of(colors.device) == "cpu"
    record_shape = (0, 0) if on_cpu else (opacities.numel(), record_size(colors.shape[-1]))
    saved = Saved(
        transmittances=colors.new_empty(tiles * BLOCKS, 16),
        stops=pairs.new_empty(tiles * BLOCKS, 16),
        blocks=torch.empty_like(pairs),
        traversed=pairs.new_empty(tiles),
        blocks_traversed=pairs.new_empty(tiles, dtype=torch.int64),
        records=colors.new_empty(*record_shape),
    )
    renders = colors.new_empty(*images, height, width, colors.shape[-1])
    return renders, colors.new_empty(*images, height, width, 1), *saved


# It changes ``skipped`` and ``absolute``, which is not declared: compilers, which would have to
# know, pass None.
@torch.library.custom_op(
    _OP + "composite_vjp",
    mutates_args=(),
    schema="(Tensor[] splats, Tensor[] bins, Tensor[] saved, Tensor[] v_pixels, Tensor? skipped, "
    f"bool geometry, Tensor? absolute, {_schema(Size)}, {_schema(Limits)}) -> Tensor[]",
)
def _composite_vjp(splats, bins, saved, v_pixels, skipped, geometry, absolute, *options):
    if skipped is None:
        skipped = torch.zeros_like(Saved(*saved).traversed)
    size, limits = _records(options)
    drawn = Splats2D(*splats)
    drawn = drawn._replace(colors=drawn.colors.flatten(0, -2))
    params = raster_params(size, limits, num=splats[0].shape[-2])
    backward = _compositor(splats[0].device).composite_backward
    sums = absolute if geometry else None
    given = drawn, Bins(*bins), params, Saved(*saved), v_pixels, skipped, geometry, sums
    return [g for g in backward(*given, limits.straight_through) if g is not None]


@_composite_vjp.register_fake
def _(splats, bins, saved, v_pixels, skipped, geometry, *rest):
    *geometries, colors = splats
    v_colors = colors.new_empty(*splats[2].shape, colors.shape[-1])
    return [*(map(torch.empty_like, geometries) if geometry else ()), v_colors]


def _composite_setup(ctx, inputs, output):
    *splats, bins, ctx.skipped, ctx.absolute = inputs[:7]
    ctx.options = inputs[7:]
    renders, transmittances, *saved = output
    ctx.mark_non_differentiable(*saved)
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*splats, *bins, *saved)
    ctx.shapes = renders.shape, transmittances.shape


def _composite_backward(ctx, *cotangents):
    splats, rest = list(ctx.saved_tensors[:4]), ctx.saved_tensors[4:]
    bins, saved = list(rest[: len(Bins._fields)]), list(rest[len(Bins._fields) :])
    colors, needs, (size, _) = splats[3], ctx.needs_input_grad, _records(ctx.options)
    v_pixels = [
        colors.new_zeros(shape) if v is None else v.contiguous()
        for v, shape in zip(cotangents, ctx.shapes)
    ]
    geometry = any(needs[:3]) or not size.skip & UNASKED
    given = splats, bins, saved, v_pixels, ctx.skipped, geometry, ctx.absolute
    *grads, v_colors = _composite_vjp(*given, *ctx.options)
    if not size.colors_per_view and size.views > 1:
        *images, num, channels = v_colors.shape
        objects = math.prod(images) // size.views
        v_colors = v_colors.view(objects, size.views, num, channels).sum(1)
    # without a view there is nothing to sum
    v_colors = v_colors.reshape(colors.shape) if v_colors.numel() else torch.zeros_like(colors)
    grads = [*(grads or [None] * 3), v_colors]
    grads = (x if need else None for x, need in zip(grads, needs))
    return *grads, [None] * len(bins), None, None, *[None] * len(ctx.options)


composite = operator(composite, "rasterization", _composite_setup, _composite_backward)
_composite_vjp = operator(_composite_vjp, "rasterization")
