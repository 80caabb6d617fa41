"""3D Gaussians to 2D: culling and the EWA projection.

One thread per (view, Gaussian). README.md §1 holds the maths; ``project_vjp.py`` the gradient.
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple, no_type_check

import torch
import warp as wp
from torch import Tensor

from ..runtime.launch import launch
from ..runtime.memory import empty
from ..runtime.views import struct, vectors
from .constants import COMPENSATION_MIN, FRUSTUM_MARGIN

wp.set_module_options({"enable_backward": False})

mat23 = wp.types.matrix((2, 3), wp.float32)

# What becomes of a (view, Gaussian).
VISIBLE, NEAR, FAR, NOT_FINITE, TRANSPARENT, OUTSIDE, SMALL = range(7)
STATUS_NAMES = ("visible", "near", "far", "not_finite", "transparent", "outside", "small")

_MARGIN = wp.constant(FRUSTUM_MARGIN)
COMPENSATION_FLOOR = wp.constant(COMPENSATION_MIN)
_VISIBLE = wp.constant(VISIBLE)
_NEAR = wp.constant(NEAR)
_FAR = wp.constant(FAR)
_NOT_FINITE = wp.constant(NOT_FINITE)
_TRANSPARENT = wp.constant(TRANSPARENT)
_OUTSIDE = wp.constant(OUTSIDE)
_SMALL = wp.constant(SMALL)


class LensOptions(NamedTuple):
    """What makes a ``Lens``, as numbers that fit in a list of floats.

    Attributes:
        width: of the picture, pixels.
        height: of the picture, pixels.
        near_plane: as ``rasterization``, like the following three.
        far_plane: as ``rasterization``.
        radius_clip: as ``rasterization``.
        eps2d: as ``rasterization``.
        alpha_min: as ``rasterization``.
        antialiased: not 0 for ``rasterize_mode="antialiased"``.
        skip_unused: not 0 to leave out gradients that are zero, as ``Skip.unused``.
        rounded: not 0 to cull by half sides of boxes that are rounded up to whole pixels, as gsplat
            does; a Gaussian that this keeps beside the picture has no pair.
    """

    width: float
    height: float
    near_plane: float
    far_plane: float
    radius_clip: float
    eps2d: float
    alpha_min: float
    antialiased: float
    skip_unused: float
    rounded: float = 0.0

    def numbers(self) -> list[float]:
        """The attributes in their order; ``LensOptions(*numbers)`` is the way back."""
        return [float(x) for x in self]


class Projected(NamedTuple):
    """N Gaussians of each of B objects in V views; one that is culled has opacity and extents 0.

    Attributes:
        means2d: ``[B, V, N, 2]`` centres in pixels.
        conics: ``[B, V, N, 3]``: a, k, e of README eq. 4.
        depths: ``[B, V, N]`` along the camera's axis, world units.
        view_opacities: ``[B, V, N]``, with the factor of antialiasing.
        extents: ``[B, V, N, 2]`` half sides of the box around alpha >= alpha_min, pixels.
        status: ``[B, V, N]`` int32, an index of ``STATUS_NAMES``.
    """

    means2d: Tensor
    conics: Tensor
    depths: Tensor
    view_opacities: Tensor
    extents: Tensor
    status: Tensor


@struct
class Lens:
    """The scalars of a projection's launch: picture size and thresholds."""

    width: float
    height: float
    near_plane: float
    far_plane: float
    radius_clip: float
    eps2d: float
    alpha_min: float
    antialiased: int
    skip_unused: int
    rounded: int


@wp.func
def rotation_of(viewmat: wp.mat44) -> wp.mat33:
    return wp.mat33(
        viewmat[0, 0],
        viewmat[0, 1],
        viewmat[0, 2],
        viewmat[1, 0],
        viewmat[1, 1],
        viewmat[1, 2],
        viewmat[2, 0],
        viewmat[2, 1],
        viewmat[2, 2],
    )


@wp.func
def translation_of(viewmat: wp.mat44) -> wp.vec3:
    return wp.vec3(viewmat[0, 3], viewmat[1, 3], viewmat[2, 3])


@wp.func
@no_type_check
def quat_size(q: wp.vec4) -> wp.float32:
    # scaled by the largest entry, so that neither tiny nor huge quaternions leave float32's range
    m = wp.max(wp.max(wp.abs(q[0]), wp.abs(q[1])), wp.max(wp.abs(q[2]), wp.abs(q[3])))
    size = wp.float32(0.0)
    if m > 0.0:
        size = m * wp.length(q / m)
    return size


@wp.func
@no_type_check
def rotation(q: wp.vec4) -> wp.mat33:
    # q is a unit quaternion (w, x, y, z)
    w, x, y, z = q[0], q[1], q[2], q[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


@wp.func
def unit(q: wp.vec4) -> wp.vec4:
    size = quat_size(q)
    if size > 0.0:
        return q / size
    return wp.vec4(1.0, 0.0, 0.0, 0.0)


@wp.func
def slope_bounds(center: wp.float32, size: wp.float32, focal: wp.float32) -> wp.vec2:
    # README eq. 2: the picture and a margin around it
    margin = _MARGIN * 0.5 * size / focal
    return wp.vec2(-(center / focal + margin), (size - center) / focal + margin)


@wp.func
@no_type_check
def slope(p: wp.float32, center: wp.float32, size: wp.float32, focal: wp.float32) -> wp.float32:
    # x/z kept within these bounds
    bounds = slope_bounds(center, size, focal)
    return wp.clamp(p, bounds[0], bounds[1])


@wp.func
@no_type_check
def jacobian(t: wp.vec3, K: wp.mat33, lens: Lens) -> mat23:
    sx = slope(t[0] / t[2], K[0, 2], lens.width, K[0, 0])
    sy = slope(t[1] / t[2], K[1, 2], lens.height, K[1, 1])
    fx = K[0, 0] / t[2]
    fy = K[1, 1] / t[2]
    return mat23(fx, 0.0, -fx * sx, 0.0, fy, -fy * sy)


@wp.func
def row_of(M: mat23, i: int) -> wp.vec3:
    return wp.vec3(M[i, 0], M[i, 1], M[i, 2])


@wp.func
@no_type_check
def _finite3(v: wp.vec3) -> bool:
    # a sum is finite only if every term is (or the terms overflow, which is as bad)
    return wp.isfinite(wp.abs(v[0]) + wp.abs(v[1]) + wp.abs(v[2]))


@wp.kernel
@no_type_check
def _project(
    offset: wp.int32,
    views: wp.int32,
    num: wp.int32,
    colors_per_view: wp.int32,
    lens: Lens,
    means_in: wp.array[wp.vec3],
    quats_in: wp.array[wp.vec4],
    scales_in: wp.array[wp.vec3],
    opacities_in: wp.array[wp.float32],
    colors_in: wp.array2d[wp.float32],
    viewmats_in: wp.array[wp.mat44],
    Ks_in: wp.array[wp.mat33],
    means2d_out: wp.array[wp.vec2],
    conics_out: wp.array[wp.vec3],
    depths_out: wp.array[wp.float32],
    view_opacities_out: wp.array[wp.float32],
    extents_out: wp.array[wp.vec2],
    status_out: wp.array[wp.int32],
):
    i = offset + wp.tid()
    image = i // num
    g = (image // views) * num + i % num
    means2d_out[i] = wp.vec2(0.0, 0.0)
    conics_out[i] = wp.vec3(1.0, 0.0, 1.0)
    depths_out[i] = 0.0
    view_opacities_out[i] = 0.0
    extents_out[i] = wp.vec2(0.0, 0.0)

    mean = means_in[g]
    scale = scales_in[g]
    opacity = opacities_in[g]
    viewmat = viewmats_in[image]
    t = rotation_of(viewmat) * mean + translation_of(viewmat)
    finite = _finite3(mean) and _finite3(scale) and wp.isfinite(opacity) and _finite3(t)
    if quats_in:
        q = quats_in[g]
        finite = finite and wp.isfinite(wp.dot(wp.abs(q), wp.vec4(0.25, 0.25, 0.25, 0.25)))
    row = g
    if colors_per_view != 0:
        row = i
    for c in range(colors_in.shape[1]):
        finite = finite and wp.isfinite(colors_in[row, c])
    # Every cull is written so that NaN fails it, and comes before the first division by z.
    if not finite:
        status_out[i] = _NOT_FINITE
        return
    if not (t[2] >= lens.near_plane):
        status_out[i] = _NEAR
        return
    if not (t[2] <= lens.far_plane):
        status_out[i] = _FAR
        return
    if not (opacity >= lens.alpha_min):
        status_out[i] = _TRANSPARENT
        return

    K = Ks_in[image]
    M = jacobian(t, K, lens) * rotation_of(viewmat)
    if quats_in:
        M = M * rotation(unit(quats_in[g]))
    M = M * wp.diag(scale)
    m0 = row_of(M, 0)
    m1 = row_of(M, 1)
    n = wp.cross(m0, m1)
    det0 = wp.dot(n, n)
    det = det0 + lens.eps2d * (wp.dot(m0, m0) + wp.dot(m1, m1)) + lens.eps2d * lens.eps2d
    sxx = wp.dot(m0, m0) + lens.eps2d
    sxy = wp.dot(m0, m1)
    syy = wp.dot(m1, m1) + lens.eps2d
    a = syy / det
    center = wp.vec2(K[0, 0] * t[0] / t[2] + K[0, 2], K[1, 1] * t[1] / t[2] + K[1, 2])
    if not (wp.isfinite(det) and a > 0.0 and wp.isfinite(center[0]) and wp.isfinite(center[1])):
        status_out[i] = _NOT_FINITE
        return
    if lens.antialiased != 0:
        opacity *= wp.max(COMPENSATION_FLOOR, wp.sqrt(det0 / det))
        if not (opacity >= lens.alpha_min):
            status_out[i] = _TRANSPARENT
            return
    cut = wp.sqrt(2.0 * wp.log(opacity / lens.alpha_min))
    extent = wp.vec2(cut * wp.sqrt(sxx), cut * wp.sqrt(syy))
    reach = extent
    if lens.rounded != 0:
        reach = wp.vec2(wp.ceil(extent[0]), wp.ceil(extent[1]))
    if reach[0] <= lens.radius_clip and reach[1] <= lens.radius_clip:
        status_out[i] = _SMALL
        return
    inside_x = center[0] + reach[0] >= 0.0 and center[0] - reach[0] <= lens.width
    inside_y = center[1] + reach[1] >= 0.0 and center[1] - reach[1] <= lens.height
    if not (inside_x and inside_y):
        status_out[i] = _OUTSIDE
        return
    status_out[i] = _VISIBLE
    means2d_out[i] = center
    conics_out[i] = wp.vec3(a, -sxy / syy, 1.0 / syy)
    depths_out[i] = t[2]
    view_opacities_out[i] = opacity
    extents_out[i] = extent


@functools.lru_cache(maxsize=256)
def make_lens(options: LensOptions) -> Lens:
    """The scalars of a projection as one kernel argument, which is shared: not to be changed."""
    lens = Lens()
    lens.width, lens.height = options.width, options.height
    lens.near_plane, lens.far_plane = options.near_plane, options.far_plane
    lens.radius_clip, lens.eps2d = options.radius_clip, options.eps2d
    lens.alpha_min = options.alpha_min
    lens.antialiased, lens.skip_unused = int(options.antialiased), int(options.skip_unused)
    lens.rounded = int(options.rounded)
    return lens


def empty_on(device: torch.device, shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    """An empty tensor; a large one on the CPU is of large pages, since it is read at random."""
    if device.type == "cpu":
        return empty(shape, dtype)
    return torch.empty(*shape, dtype=dtype, device=device)


def project_on_threads(
    images: int,
    views: int,
    num: int,
    colors_per_view: int,
    lens: Lens,
    inputs: list,
    outputs: list,
    *,
    device: torch.device,
) -> None:
    """Runs the projection of B objects into V views each, a thread for each (view, Gaussian).

    Args:
        images: I = B * V.
        views: of an object, V.
        num: Gaussians of an object, at least 1.
        colors_per_view: 1 if each view has colours of its own, otherwise 0.
        lens: from ``make_lens``.
        inputs: of the kernel, from the means on.
        outputs: of the kernel.
        device: of the tensors.
    """
    numbers = [views, num, colors_per_view, lens]
    launch(_project, images * num, [*numbers, *inputs], outputs, device)


def project_forward(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    lens: Lens,
    run: Callable[..., None],
) -> Projected:
    """Projects B objects of N Gaussians into V views each; float32, contiguous tensors.

    Args:
        means: ``[B, N, 3]``.
        quats: ``[B, N, 4]`` or None.
        scales: ``[B, N, 3]``.
        opacities: ``[B, N]``.
        colors: ``[B, N, C]`` or ``[B, V, N, C]``, only to cull what is not finite.
        viewmats: ``[B, V, 4, 4]``.
        Ks: ``[B, V, 3, 3]``.
        lens: from ``make_lens``.
        run: launcher of the device, ``project_on_threads`` or ``cpu/project.py``'s.
    """
    (batch, views), num = viewmats.shape[:2], means.shape[1]
    shape = (batch, views, num)
    sizes, device = ((2,), (3,), (), (), (2,)), means.device
    floats = (empty_on(device, [*shape, *size], torch.float32) for size in sizes)
    means2d, conics, depths, view_opacities, extents = floats
    status = empty_on(device, shape, torch.int32)
    inputs = [
        vectors(means, wp.vec3),
        vectors(quats, wp.vec4),
        vectors(scales, wp.vec3),
        opacities.view(-1),
        colors.view(-1, colors.shape[-1]),
        vectors(viewmats, wp.mat44),
        vectors(Ks, wp.mat33),
    ]
    outputs = [
        vectors(means2d, wp.vec2),
        vectors(conics, wp.vec3),
        depths.view(-1),
        view_opacities.view(-1),
        vectors(extents, wp.vec2),
        status.view(-1),
    ]
    if status.numel():
        run(batch * views, views, num, int(colors.dim() == 4), lens, inputs, outputs)
    return Projected(means2d, conics, depths, view_opacities, extents, status)
