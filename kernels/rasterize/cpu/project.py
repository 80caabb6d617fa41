"""The projection and its gradient on the CPU: sixteen Gaussians as lanes. README.md §1 and §4 have
the maths; the bits are those of the kernels of ``../project.py``.
"""

from pathlib import Path
from typing import Any, no_type_check

import torch
import warp as wp

from ...runtime.launch import parallel_launch
from ...runtime.native import native
from ...runtime.views import Packed
from ..constants import COMPENSATION_MIN, FRUSTUM_MARGIN
from ..project import STATUS_NAMES, Lens, Scene, Splats

wp.set_module_options({"enable_backward": False})

_RUN = 512  # Gaussians of a task, a multiple of 16
_PIECES_PER_THREAD = 8  # those that are culled cost less

_HERE = Path(__file__).parent
_DEFINES = {
    **{name.upper(): number for number, name in enumerate(STATUS_NAMES)},
    **{"RUN": _RUN, "MARGIN": FRUSTUM_MARGIN, "COMPENSATION_MIN": COMPENSATION_MIN},
}


@wp.func_native(native(_HERE / "project.inl", **_DEFINES))
def _project_run(
    task: int,
    views: int,
    num: int,
    colors_per_view: int,
    lens: Lens,
    scene: Scene,
    colors: wp.array2d[wp.float32],
    splats: Splats,
): ...


@wp.kernel
@no_type_check
def _project(
    offset: int,
    views: int,
    num: int,
    colors_per_view: int,
    lens: Lens,
    scene_in: Scene,
    colors_in: wp.array2d[wp.float32],
    splats_out: Splats,
):
    task = offset + wp.tid()
    _project_run(task, views, num, colors_per_view, lens, scene_in, colors_in, splats_out)


@wp.func_native(native(_HERE / "project_vjp.inl", **_DEFINES))
def _vjp_run(
    task: int,
    views: int,
    num: int,
    lens: Lens,
    scene: Scene,
    splats: Splats,
    v_splats: Splats,
    v_scene: Scene,
): ...


@wp.kernel
@no_type_check
def _project_vjp(
    offset: int,
    views: int,
    num: int,
    lens: Lens,
    scene_in: Scene,
    splats_in: Splats,
    v_splats_in: Splats,
    v_scene_out: Scene,
):
    task = offset + wp.tid()
    _vjp_run(task, views, num, lens, scene_in, splats_in, v_splats_in, v_scene_out)


def _launch(kernel: Any, rows: int, num: int, arguments: list) -> None:
    """Launches a task for each run of ``num`` Gaussians in each of so many rows of them."""
    tasks = rows * -(-num // _RUN)
    pieces = min(tasks, _PIECES_PER_THREAD * torch.get_num_threads())
    parallel_launch(kernel, tasks, arguments, pieces=pieces)


def project_on_lanes(
    images: int, views: int, num: int, colors_per_view: int, lens: Lens, inputs: list, outputs: list
) -> None:
    """Does what ``project_on_threads`` does, with the same arguments, on the lanes of a CPU."""
    *gaussians, colors, viewmats, Ks = inputs
    scene, splats = Packed(Scene, *gaussians, viewmats, Ks), Packed(Splats, *outputs)
    arguments = [views, num, colors_per_view, lens, scene, colors, splats]
    _launch(_project, images, num, arguments)


def vjp_on_lanes(batch: int, views: int, num: int, lens: Lens, inputs: list, outputs: list) -> None:
    """Runs the gradient for B objects.

    Args:
        batch: objects, B.
        views: of an object, at least 1.
        num: Gaussians of an object, at least 1.
        lens: from ``make_lens``; not of antialiasing.
        inputs: flat views of means, quats, scales, viewmats, Ks, conics, status, and of the
            gradients of means2d, conics, depths and opacities.
        outputs: of the gradients of means, quats, scales and opacities.
    """
    means, quats, scales, viewmats, Ks, conics, status, *v_splats = inputs
    arguments = [
        Packed(Scene, means, quats, scales, None, viewmats, Ks),
        Packed(Splats, None, conics, None, None, None, status),
        Packed(Splats, *v_splats, None, None),
        Packed(Scene, *outputs, None, None),
    ]
    _launch(_project_vjp, batch, num, [views, num, lens, *arguments])
