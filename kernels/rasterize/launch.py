"""One launch call for kernels that run the same on both devices, and flat views of tensors."""

import torch
import warp as wp
from torch import Tensor

from ..interop import cuda_launch, parallel_launch, view


def vectors(tensor: Tensor | None, dtype):
    """A contiguous tensor as a flat Warp array of vectors or matrices; None stays None."""
    if tensor is None:
        return None
    return view(tensor.view(-1, *dtype._shape_), dtype)


def launch(kernel: wp.Kernel, dim: int, inputs, outputs, device: torch.device) -> None:
    """Launches a plain kernel whose first parameter is ``offset``; ``dim`` 0 is no launch."""
    if dim == 0:
        return
    if device.type == "cpu":
        parallel_launch(kernel, dim, inputs, outputs)
    else:
        cuda_launch(kernel, dim, [0, *inputs], outputs, device=device)
