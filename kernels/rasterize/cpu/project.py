"""The projection and its gradient on the CPU: sixteen Gaussians as lanes. README.md §1 and §4 have
the maths, ``project.h`` the code; the results equal ``../cuda/project.py``'s to the last bit.
"""

from pathlib import Path
from typing import Any

import torch
import warp as wp

from ...runtime.launch import parallel_launch
from ...runtime.native import constants, native, native_kernel
from ...runtime.views import struct_of
from ..constants import COMPENSATION_MIN, CONIC_MAX, FRUSTUM_MARGIN, RADIUS_MAX, TILE
from ..projection import STATUS_NAMES, Projected, ProjectionParams, Scene

_RUN = 512  # Gaussians of a task, a multiple of 16
_PIECES_PER_THREAD = 8  # those that are culled cost less

_CONFIG = constants(
    "Config",
    **{name.upper(): number for number, name in enumerate(STATUS_NAMES)},
    **{"RUN": _RUN, "MARGIN": FRUSTUM_MARGIN, "COMPENSATION_MIN": COMPENSATION_MIN},
    **{"CONIC_MAX": CONIC_MAX, "RADIUS_MAX": RADIUS_MAX, "TILE": TILE},
)
_HEADER = _CONFIG + native(Path(__file__).with_name("project.h"))
_SCENE = {"views": int, "num": int, "options": ProjectionParams, "scene": Scene}

_project = native_kernel(
    "project",
    "gamba::raster::project<Config>",
    inputs={**_SCENE, "colors_per_view": int, "colors": wp.array2d[wp.float32]},
    outputs={"splats": struct_of(Projected)},
    header=_HEADER,
)
_project_vjp = native_kernel(
    "project_vjp",
    "gamba::raster::project_vjp<Config>",
    inputs={**_SCENE, "splats": struct_of(Projected), "v_splats": struct_of(Projected)},
    outputs={"v_scene": Scene},
    header=_HEADER,
)


def _launch(kernel: Any, rows: int, num: int, arguments: list) -> None:
    """Launches a task for each run of ``num`` Gaussians in each of so many rows of them."""
    tasks = rows * -(-num // _RUN)
    pieces = min(tasks, _PIECES_PER_THREAD * torch.get_num_threads())
    parallel_launch(kernel, tasks, arguments, pieces=pieces)


def project_on_lanes(images: int, num: int, arguments: list, device: torch.device) -> None:
    """Run the projection as ``project_on_threads``, with the same arguments, on a CPU's lanes."""
    _launch(_project, images, num, arguments)


def vjp_on_lanes(batch: int, num: int, arguments: list, v_viewmats: None) -> None:
    """Run the gradient for B objects; not by viewmats, and not of antialiasing."""
    _launch(_project_vjp, batch, num, arguments)
