"""Shared by the tests: from test_rasterize."""

import torch

from gamba_warp.cameras import orbit

NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")


PICTURE = 1e-5  # float32 sums of some hundred terms in [0, 1]


GRADIENT = 1e-4  # as above, with factors up to 1 / (1 - alpha_max)


def look(batch, views, width, height):
    """Cameras around the origin: rotated, off-centre, with two focal lengths."""
    azimuths = torch.arange(batch * views) * 47.0
    viewmats = orbit(azimuths, elevation=20.0, distance=1.6).view(batch, views, 4, 4)
    K = torch.tensor([[1.3 * width, 0, 0.55 * width], [0, 0.9 * height, 0.45 * height], [0, 0, 1]])
    return viewmats, K.expand(batch, views, 3, 3).clone()


def make(batch=2, views=3, num=60, width=37, height=53, channels=3, size=0.06):
    viewmats, Ks = look(batch, views, width, height)
    return dict(
        means=0.3 * torch.randn(batch, num, 3),
        quats=torch.randn(batch, num, 4),
        scales=size * torch.exp(0.5 * torch.randn(batch, num, 3)),
        opacities=0.05 + 0.9499 * torch.rand(batch, num),
        colors=torch.rand(batch, num, channels),
        viewmats=viewmats,
        Ks=Ks,
        width=width,
        height=height,
        backgrounds=torch.rand(batch, views, channels),
    )


def mapped(scene, function):
    return {k: function(v) if isinstance(v, torch.Tensor) else v for k, v in scene.items()}


def leaves(scene, dtype):
    scene = mapped(scene, lambda v: v.detach().to(dtype).clone().requires_grad_())
    scene["Ks"].requires_grad_(False)
    return scene
