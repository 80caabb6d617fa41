"""3D Gaussians to 2D: culling, the EWA projection, and its gradient (README.md §1 and §4).

``project.h`` has the code of both devices. On a CPU sixteen Gaussians are lanes, in the forward
pass of one view. On CUDA each (view, Gaussian) has a thread. The gradient's lanes or thread loop
over the views: their sums are then in a fixed order.
"""

import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from ..runtime import gpu
from ..runtime.launch import launch
from ..runtime.memory import empty
from ..runtime.native import constants, native, native_kernel
from ..runtime.views import StructValue, as_struct, filled, struct, struct_of
from .constants import COMPENSATION_MIN, CONIC_MAX, FRUSTUM_MARGIN, RADIUS_MAX, TILE

_HERE = Path(__file__).parent
# Status of a (view, Gaussian).
VISIBLE, NEAR, FAR, NOT_FINITE, TRANSPARENT, OUTSIDE, SMALL = range(7)
STATUS_NAMES = ("visible", "near", "far", "not_finite", "transparent", "outside", "small")


class ProjectionOptions(NamedTuple):
    """Arguments of a projection without a gradient.

    Attributes:
        width: of the image, pixels.
        height: of the image, pixels.
        near_plane: as ``rasterization``, like the following three.
        far_plane: as ``rasterization``.
        radius_clip: as ``rasterization``.
        eps2d: as ``rasterization``.
        alpha_min: as ``rasterization``.
        antialiased: True for ``rasterize_mode="antialiased"``.
        skip_unused: True to leave out gradients that are zero, as ``Skip.unused``.
        rounded: True to cull by half sides of boxes that are rounded up to whole pixels, as gsplat
            does; a Gaussian that this keeps outside the image has no pair.
        original: True for the conventions of the first 3D Gaussian splatting code (README.md §7).
    """

    width: int
    height: int
    near_plane: float
    far_plane: float
    radius_clip: float
    eps2d: float
    alpha_min: float
    antialiased: bool
    skip_unused: bool
    rounded: bool = False
    original: bool = False


class Projected(NamedTuple):
    """N Gaussians of each of B objects in V views; one that is culled has opacity and extents 0.

    Attributes:
        means2d: ``[B, V, N, 2]`` centres in pixels.
        conics: ``[B, V, N, 3]``: a, k, e of README eq. 4.
        depths: ``[B, V, N]`` along the camera's axis, world units.
        view_opacities: ``[B, V, N]``, with the factor of antialiasing.
        extents: ``[B, V, N, 2]`` half sides of the box around alpha >= alpha_min, pixels. With the
            original's conventions both are its radius, also of a Gaussian that is transparent.
        status: ``[B, V, N]`` int32, an index of ``STATUS_NAMES``.
    """

    means2d: Annotated[Any, wp.array[wp.vec2]] = None
    conics: Annotated[Any, wp.array[wp.vec3]] = None
    depths: Annotated[Any, wp.array[wp.float32]] = None
    view_opacities: Annotated[Any, wp.array[wp.float32]] = None
    extents: Annotated[Any, wp.array[wp.vec2]] = None
    status: Annotated[Any, wp.array[wp.int32]] = None


# By device, the header of its lanes and the Gaussians of a task.
LANES = {"cpu": (_HERE / "cpu" / "project.h", 512), "cuda": (_HERE / "cuda" / "project.h", 1)}
_PIECES_PER_THREAD = 8  # of a CPU; those that are culled cost less
PROJECTED_SIZES = ((2,), (3,), (), (), (2,))  # of ``Projected``'s floats, after [B, V, N]


@struct
class ProjectionParams:
    """The scalars of a projection's launch: image size and thresholds."""

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
    original: int


vec6 = wp.types.vector(6, wp.float32)


@struct
class Scene:
    """Gaussians and cameras as a launch takes them, or their gradients."""

    means: wp.array[wp.vec3]
    quats: wp.array[wp.vec4]
    scales: wp.array[wp.vec3]
    covars: wp.array[vec6]  # in the place of quats and scales
    opacities: wp.array[wp.float32]
    viewmats: wp.array[wp.mat44]
    Ks: wp.array[wp.mat33]


@functools.cache
def _kernels(header: Path, run: int, covars: bool, original: bool) -> tuple[Any, Any]:
    config = constants(
        "Config",
        **{name.upper(): number for number, name in enumerate(STATUS_NAMES)},
        **{"RUN": run, "COVARS": covars, "ORIGINAL": original, "MARGIN": FRUSTUM_MARGIN},
        **{"COMPENSATION_MIN": COMPENSATION_MIN, "CONIC_MAX": CONIC_MAX},
        **{"RADIUS_MAX": RADIUS_MAX, "TILE": TILE},
    )
    text, splats = config + native(header), struct_of(Projected)
    scene = {"views": int, "num": int, "options": ProjectionParams, "scene": Scene}
    colors = {"colors_per_view": int, "colors": wp.array2d[wp.float32]}
    project = native_kernel(
        "project",
        "gamba::raster::project<Config>",
        inputs={**scene, **colors},
        outputs={"splats": splats},
        header=text,
        grid_stride=False,
    )
    project_vjp = native_kernel(
        "project_vjp",
        "gamba::raster::project_vjp<Config>",
        inputs={**scene, "splats": splats, "v_splats": splats},
        outputs={"v_scene": Scene, "v_viewmats": wp.array3d[wp.float32]},
        header=text,
    )
    return project, project_vjp


def _run(of: int, rows: int, num: int, arguments: list, device: torch.device) -> None:
    """Launch the projection, 0, or its gradient, 1, of ``num`` Gaussians in each of so many rows.

    Covariances and the original's conventions have kernels of their own, for fewer registers.
    """
    (header, run), params, scene = LANES[gpu.kind_of(device)], *arguments[2:4]
    kernel = _kernels(header, run, scene.values[3] is not None, bool(params.original))[of]
    pieces = _PIECES_PER_THREAD * torch.get_num_threads()
    launch(kernel, rows * -(-num // run), arguments, [], device, pieces=pieces)


def projection_params(options: ProjectionOptions) -> ProjectionParams:
    """The scalars of a projection as one kernel argument, which is shared: do not modify it."""
    return filled(ProjectionParams, *options[:7], *map(int, options[7:]))


def empty_on(device: torch.device, shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    """An empty tensor; a large one on the CPU is of large pages, since it is read at random."""
    if device.type == "cpu":
        return empty(shape, dtype)
    return torch.empty(*shape, dtype=dtype, device=device)


def project_forward(inputs: Sequence[Any], params: ProjectionParams) -> Projected:
    """Project objects of N Gaussians into V views each; float32, contiguous tensors.

    Args:
        inputs: means ``[.., N, 3]``, quats ``[.., N, 4]`` or None, scales ``[.., N, 3]`` and covars
            None, or these two None and covars ``[.., N, 6]`` (xx, xy, xz, yy, yz, zz; positive
            semidefinite), opacities ``[.., N]``; colors ``[.., N, C]`` or ``[.., V, N, C]``, only
            to cull values that are not finite; viewmats ``[.., V, 4, 4]`` and Ks
            ``[.., V, 3, 3]``.
        params: from ``projection_params``.
    """
    *gaussians, colors, viewmats, Ks = inputs
    shape, num, device = viewmats.shape[:-2], colors.shape[-2], colors.device
    projected = Projected(
        *(empty_on(device, [*shape, num, *size], torch.float32) for size in PROJECTED_SIZES),
        status=empty_on(device, [*shape, num], torch.int32),
    )
    if projected.status.numel():
        scene = StructValue(Scene, *gaussians, viewmats, Ks)
        per_view = int(colors.dim() > gaussians[0].dim())
        arguments = [shape[-1], num, params, scene, per_view, colors.flatten(0, -2)]
        _run(0, shape.numel(), num, [*arguments, as_struct(projected)], device)
    return projected


def project_backward(
    inputs: Sequence[Any],
    params: ProjectionParams,
    conics: Tensor,
    status: Tensor,
    cotangents: Sequence[Tensor],
    wanted: Sequence[bool],
) -> list[Tensor | None]:
    """Gradients of ``project_forward`` by means, quats, scales, covars, opacities and viewmats.

    Args:
        inputs: as given forward, without the colors.
        params: as given forward.
        conics: as returned forward.
        status: as returned forward.
        cotangents: of means2d, conics, depths and view_opacities; contiguous.
        wanted: True for the needed gradients of the six; the others are None.
    """
    *gaussians, viewmats, Ks = inputs
    (*lead, views, num), means = status.shape, gaussians[0]
    batch = math.prod(lead)
    # the kernel writes all of a gradient, where there is a view
    grads = [
        None
        if x is None or not want
        else empty_on(x.device, x.shape, x.dtype)
        if status.numel()
        else torch.zeros_like(x)
        for x, want in zip(gaussians, wanted)
    ]
    v_viewmats = means.new_zeros(batch * views, num, 12) if wanted[5] else None  # by Gaussians
    if status.numel():
        arguments = [
            *(views, num, params, StructValue(Scene, *gaussians, viewmats, Ks)),
            as_struct(Projected(conics=conics, status=status)),
            as_struct(Projected(*cotangents)),
            StructValue(Scene, *grads, None, None),
            v_viewmats,
        ]
        _run(1, batch, num, arguments, means.device)
    if v_viewmats is not None:
        v_viewmats = v_viewmats.sum(1).view(*lead, views, 3, 4)
        v_viewmats = torch.nn.functional.pad(v_viewmats, (0, 0, 0, 1))
    return [*grads, v_viewmats]
