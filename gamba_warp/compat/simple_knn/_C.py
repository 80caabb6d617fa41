"""The one function of simple_knn's extension module."""

from __future__ import annotations

import torch
from torch import Tensor

from ..shared import check_tensor


@torch.no_grad()
def distCUDA2(points: Tensor) -> Tensor:
    """Compute each point's mean squared distance to its three nearest others.

    Args:
        points: ``[N, 3]`` of finite numbers.

    Returns:
        ``[N]`` float32, infinite where there are less than three others.

    Raises:
        TypeError: it is not a tensor.
        ValueError: the shape is not as above, or a number is not finite.
        ImportError: scipy is not installed.
    """
    from scipy.spatial import KDTree

    check_tensor("points", points, ("N", 3))
    if not points.isfinite().all():
        raise ValueError("points has numbers that are not finite")
    if not len(points):
        return points.new_zeros(0, dtype=torch.float32)
    places = points.double().cpu().numpy()
    distances = torch.from_numpy(KDTree(places).query(places, 4)[0])  # the first is the point
    return distances[:, 1:].square().mean(1).float().to(points.device)
