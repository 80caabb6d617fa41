"""The projection and its gradient on CUDA, a thread each. README.md §1 and §4 have the maths,
``../project.h`` the code.

Forward has a thread for each (view, Gaussian). The gradient has one for each Gaussian, which loops
over its views: sums over views are then in a fixed order.
"""

from pathlib import Path

import torch
from torch import Tensor

from ...runtime.launch import launch
from ..projection import projection_kernels

_HEADER = Path(__file__).with_name("project.h")


def project_on_threads(images: int, num: int, arguments: list, device: torch.device) -> None:
    """Run the projection of ``num`` Gaussians into so many views, a thread for each of a view."""
    kernel, _ = projection_kernels(_HEADER, 1, *arguments[2:4])
    launch(kernel, images * num, arguments, [], device)


def vjp_on_threads(batch: int, num: int, arguments: list, v_viewmats: Tensor | None) -> None:
    """Run the gradient for B objects; see ``projection.project_backward``."""
    _, kernel = projection_kernels(_HEADER, 1, *arguments[2:4])
    launch(kernel, batch * num, [*arguments, v_viewmats], [], arguments[3].values[0].device)
