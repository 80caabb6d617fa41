"""Arguments of the kernels of both devices."""

import warp as wp

from ...runtime.views import struct

SHORTEST = 1e-12  # a vector that is shorter is divided by this in place of its length


@struct
class Size:
    """Gaussians and points of an object; ``per_view``: each point has its own coefficients."""

    num: int
    views: int
    per_view: int


@struct
class Arrays:
    """The arrays of a launch, or their gradients; rows of coefficients are ``[K, D]``."""

    coefficients: wp.array3d[wp.float32]
    means: wp.array[wp.vec3]
    centers: wp.array[wp.vec3]
    colors: wp.array2d[wp.float32]
