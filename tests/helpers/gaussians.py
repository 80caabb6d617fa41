"""Random Gaussians for tests of files and pages."""

import torch

from gamba_warp.gaussians import Gaussians


def some(n=37, rotated=True):
    """Draws ``n`` Gaussians; the quaternions are not normalised, or None if not ``rotated``."""
    quats = torch.randn(n, 4) * 3 if rotated else None
    return Gaussians(
        means=torch.rand(n, 3) - 0.5,
        quats=quats,
        scales=torch.rand(n, 3) * 0.1 + 1e-4,
        opacities=torch.rand(n) * 0.98 + 0.01,
        colors=torch.rand(n, 3),
    )
