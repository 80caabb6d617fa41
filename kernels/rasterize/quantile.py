"""Depth at which a ray's transmittance has fallen to a given value, from a rendering's own lists.

``render_mode="ED"`` is the mean of all depths that a ray meets, and where the front is half
transparent that is between front and back. A quantile is on one of the surfaces.
"""

import math
from typing import no_type_check

import torch
import warp as wp
from torch import Tensor

from ..runtime.launch import launch
from ..runtime.views import as_struct, struct_of
from .constants import ALPHA_MAX, ALPHA_MIN
from .meta import Meta
from .projection import Projected
from .tiles import Bins, Grid, Limits, Tiling, make_grid

wp.set_module_options({"enable_backward": False})


@wp.kernel(grid_stride=False)
@no_type_check
def _quantile(
    offset: wp.int32,
    grid: Grid,
    transmittance: wp.float32,
    limit: wp.float32,
    alpha_max: wp.float32,
    splats_in: struct_of(Projected),
    lists_in: struct_of(Bins),
    depths_out: wp.array[wp.float32],
    counts_out: wp.array[wp.int32],
):
    pixel = offset + wp.tid()
    image = pixel // (grid.width * grid.height)
    x = pixel % grid.width
    y = pixel // grid.width % grid.height
    tile = (
        image * grid.tiles_x * grid.tiles_y + (y >> grid.shift) * grid.tiles_x + (x >> grid.shift)
    )
    clear = wp.float32(1.0)  # a variable: plain literals would be constants in the loop
    depth = wp.float32(0.0)
    k = lists_in.starts[tile]
    end = lists_in.starts[tile + 1]
    while k < end:
        g = lists_in.pairs[k]
        conic = splats_in.conics[g]
        dy = float(y) + 0.5 - splats_in.means2d[g][1]
        dx = float(x) + 0.5 - splats_in.means2d[g][0] + conic[1] * dy
        q = conic[0] * dx * dx + conic[2] * dy * dy
        if q <= limit:
            alpha = wp.min(alpha_max, splats_in.view_opacities[g] * wp.exp(-0.5 * q))
            if alpha >= grid.alpha_min:
                clear *= 1.0 - alpha
                if clear <= transmittance:
                    depth = splats_in.depths[g]
                    k = end
                elif counts_out.shape[0] > 0:
                    wp.atomic_add(counts_out, g, 1)
        k += 1
    depths_out[pixel] = depth


def depth_quantile(
    meta: Meta,
    transmittance: float = 0.5,
    *,
    alpha_min: float = ALPHA_MIN,
    alpha_max: float = ALPHA_MAX,
) -> Tensor:
    """Depth of the first Gaussian behind which each pixel's transmittance is at most the given one.

    ``z_i`` of the least i with ``Π_{j<=i} (1 - α_j) <= transmittance``: 0.5 is the median depth of
    2DGS (Huang et al. 2024). Without gradient.

    Args:
        meta: as ``rasterization`` returned it, of any device and render mode.
        transmittance: in (0, 1).
        alpha_min: as in that call.
        alpha_max: as in that call.

    Returns:
        ``[.., V, H, W, 1]`` float32, world units along the camera's axis; 0 where the whole ray
        stays clearer than that.

    Raises:
        ValueError: the transmittance is out of range.
    """
    if not 0 < transmittance < 1:
        raise ValueError(f"transmittance must be in (0, 1), got {transmittance}")
    splats = Projected(*(meta[name] for name in ("means2d", "conics", "depths", "opacities")))
    return _traverse(
        splats, meta.bins, meta.tiling, transmittance, Limits(alpha_min, alpha_max, 0.0)
    )


def counts_in_front(
    splats: Projected, bins: Bins, tiling: Tiling, limits: Limits, transmittance: float = 0.5
) -> Tensor:
    """Number of pixels to which a Gaussian contributes in front of the depth of ``depth_quantile``.

    These are the pixels whose transmittance is above the given one behind the Gaussian, too.

    Args:
        splats: the projection.
        bins: the tile lists.
        tiling: the cut into tiles.
        limits: of alpha.
        transmittance: in (0, 1), and above ``limits.t_min``.

    Returns:
        ``[.., V, N]`` int32, without gradient.
    """
    counts = splats.depths.new_zeros(splats.depths.shape, dtype=torch.int32)
    _traverse(splats, bins, tiling, transmittance, limits, counts)
    return counts


def _traverse(
    splats: Projected,
    bins: Bins,
    tiling: Tiling,
    transmittance: float,
    limits: Limits,
    counts: Tensor | None = None,
) -> Tensor:
    """Depths of the quantile; adds to the counts of the Gaussians in front of it."""
    splats = Projected(*(x.detach().contiguous() for x in splats[:4]))
    num = splats.depths.shape[-1]
    depths = splats.depths.new_empty(*splats.depths.shape[:-1], tiling.height, tiling.width, 1)
    # where q is larger, no opacity reaches alpha_min
    limit = 2 * math.log(1 / limits.alpha_min) + 1e-3
    grid = make_grid(tiling, num=num, alpha_min=limits.alpha_min, skip=0)
    inputs = [grid, transmittance, limit, limits.alpha_max, as_struct(splats), as_struct(bins)]
    outputs = [depths.view(-1), None if counts is None else counts.view(-1)]
    threads = None if counts is None else 1  # an addition on a CPU is not atomic
    launch(_quantile, depths.numel(), inputs, outputs, depths.device, threads)
    return depths
