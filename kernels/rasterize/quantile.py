"""Depth at which a ray's transmittance has fallen to a given value, from a rendering's own lists.

``render_mode="ED"`` is the mean of all depths that a ray meets, and where the front is half
transparent that lies between front and back. A quantile lies on one of the surfaces.
"""

import math
from typing import no_type_check

import warp as wp
from torch import Tensor

from ..runtime.launch import launch
from ..runtime.views import vectors
from .constants import ALPHA_MAX, ALPHA_MIN
from .meta import Meta

wp.set_module_options({"enable_backward": False})


@wp.kernel
@no_type_check
def _quantile(
    offset: wp.int32,
    width: wp.int32,
    height: wp.int32,
    tiles_x: wp.int32,
    tiles: wp.int32,
    num: wp.int32,
    shift: wp.int32,
    transmittance: wp.float32,
    limit: wp.float32,
    alpha_min: wp.float32,
    alpha_max: wp.float32,
    means2d_in: wp.array[wp.vec2],
    conics_in: wp.array[wp.vec3],
    view_opacities_in: wp.array[wp.float32],
    depths_in: wp.array[wp.float32],
    pairs_in: wp.array[wp.int32],
    starts_in: wp.array[wp.int32],
    order_in: wp.array[wp.int32],
    offsets_in: wp.array[wp.int32],
    count_in: wp.array[wp.int64],
    depths_out: wp.array[wp.float32],
):
    pixel = offset + wp.tid()
    image = pixel // (width * height)
    x = pixel % width
    y = pixel // width % height
    tile = image * tiles + (y >> shift) * tiles_x + (x >> shift)
    clear = wp.float32(1.0)  # a variable: plain literals would be constants in the loop
    depth = wp.float32(0.0)
    k = starts_in[tile]
    end = starts_in[tile + 1]
    # where the pairs had no room, the list is that of all Gaussians of the view
    listed = count_in[0] <= wp.int64(pairs_in.shape[0])
    if not listed:
        k = image * num
        end = k + num
    while k < end:
        g = wp.int32(-1)
        if listed:
            g = pairs_in[k]
        elif offsets_in[k] != offsets_in[k + 1]:
            g = order_in[k]
        if g < 0:
            k += 1
            continue
        conic = conics_in[g]
        dy = float(y) + 0.5 - means2d_in[g][1]
        dx = float(x) + 0.5 - means2d_in[g][0] + conic[1] * dy
        q = conic[0] * dx * dx + conic[2] * dy * dy
        if q <= limit:
            alpha = wp.min(alpha_max, view_opacities_in[g] * wp.exp(-0.5 * q))
            if alpha >= alpha_min:
                clear *= 1.0 - alpha
                if clear <= transmittance:
                    depth = depths_in[g]
                    k = end
        k += 1
    depths_out[pixel] = depth


def depth_quantile(
    meta: Meta,
    transmittance: float = 0.5,
    *,
    alpha_min: float = ALPHA_MIN,
    alpha_max: float = ALPHA_MAX,
) -> Tensor:
    """Depth of the first Gaussian behind which each pixel's transmittance is no larger than asked.

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
        raise ValueError(f"transmittance is {transmittance}, allowed is 0 < transmittance < 1")
    cut, centers = meta.tiling, meta["depths"].detach()
    depths = centers.new_empty(*centers.shape[:-1], cut.height, cut.width, 1)
    limit = 2 * math.log(1 / alpha_min) + 1e-3  # where q is larger, no opacity reaches alpha_min
    sizes = [cut.width, cut.height, cut.tiles_x, cut.count, centers.shape[-1], cut.shift]
    limits = [transmittance, limit, alpha_min, alpha_max]
    splats = [
        vectors(meta["means2d"].detach().contiguous(), wp.vec2),
        vectors(meta["conics"].detach().contiguous(), wp.vec3),
        meta["opacities"].detach().flatten(),
        centers.flatten(),
    ]
    bins = meta.bins
    lists = [bins.pairs, bins.starts, bins.order, bins.offsets, bins.count.view(1)]
    inputs = [*sizes, *limits, *splats, *lists]
    launch(_quantile, depths.numel(), inputs, [depths.view(-1)], depths.device)
    return depths
