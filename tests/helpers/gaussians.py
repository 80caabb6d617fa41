"""Random Gaussians for tests of files and pages."""

import torch

from gamba_warp.gaussians import Gaussians


def some(n=37, rotated=True, degree=0):
    """Draws ``n`` Gaussians; the quaternions are not normalised, or None if not ``rotated``.

    With harmonics of a ``degree`` over 0, some base colours lie outside [0, 1].
    """
    quats = torch.randn(n, 4) * 3 if rotated else None
    K = (degree + 1) ** 2 - 1
    return Gaussians(
        means=torch.rand(n, 3) - 0.5,
        quats=quats,
        scales=torch.rand(n, 3) * 0.1 + 1e-4,
        opacities=torch.rand(n) * 0.98 + 0.01,
        colors=torch.rand(n, 3) * (1.4 if degree else 1) - (0.2 if degree else 0),
        harmonics=torch.rand(n, K, 3) * 1.8 - 0.9 if degree else None,
    )
