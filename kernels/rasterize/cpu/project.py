"""The projection and its gradient on the CPU: sixteen Gaussians as lanes. README.md §1 and §4 have
the maths, ``../project.h`` the code, and ``project.h`` the lanes.
"""

from pathlib import Path

import torch
from torch import Tensor

from ...runtime.launch import parallel_launch
from ..projection import projection_kernels

_RUN = 512  # Gaussians of a task, a multiple of 16
_PIECES_PER_THREAD = 8  # those that are culled cost less
_HEADER = Path(__file__).with_name("project.h")


def _launch(of: int, rows: int, num: int, arguments: list) -> None:
    """Launches a task for each run of ``num`` Gaussians in each of so many rows of them."""
    kernel = projection_kernels(_HEADER, _RUN, *arguments[2:4])[of]
    tasks = rows * -(-num // _RUN)
    pieces = min(tasks, _PIECES_PER_THREAD * torch.get_num_threads())
    parallel_launch(kernel, tasks, arguments, pieces=pieces)


def project_on_lanes(images: int, num: int, arguments: list, device: torch.device) -> None:
    """Run the projection as ``project_on_threads``, with the same arguments, on a CPU's lanes."""
    _launch(0, images, num, arguments)


def vjp_on_lanes(batch: int, num: int, arguments: list, v_viewmats: Tensor | None) -> None:
    """Run the gradient for B objects; see ``projection.project_backward``."""
    _launch(1, batch, num, [*arguments, v_viewmats])
