"""Every ``gamba`` command with parts of one's own; docs/train-your-own.md explains it.

python docs/examples/own_parts.py train DATA --preset tiny --schedule linear
"""

import json

import numpy as np
import torch
from torch import nn

from gamba_warp.cli import main
from gamba_warp.data.layouts import LAYOUTS, ObjectFiles
from gamba_warp.gaussians import Gaussians
from gamba_warp.image_metrics import METRICS, Metric
from gamba_warp.model.encoders import ENCODERS
from gamba_warp.model.gamba import DECODERS
from gamba_warp.train.objective.losses import TERMS, Term
from gamba_warp.train.optim import SCHEDULES


def edge_error(inputs):
    """Mean error of the differences between neighbours in a row, ``[B, V+1]``."""
    got, want = inputs.rgb.diff(dim=-2), inputs.target.diff(dim=-2)
    return (got - want).abs().mean((-3, -2, -1))


def mean_error(a, b):
    """Mean absolute error of images ``[V, H, W, 3]``, ``[V]``."""
    return (a.double() - b.double()).abs().mean((-3, -2, -1))


def read_orbit(folder):
    """Object of ``orbit.json``: images on a ring, ``{"distance", "focal", "images"}``."""
    about = json.loads((folder / "orbit.json").read_text())
    count = len(about["images"])
    angles = 2 * np.pi * np.arange(count) / count
    poses = np.tile(np.eye(4), (count, 1, 1))  # OpenGL: the camera looks along -z, y is up
    poses[:, 0, 0] = poses[:, 2, 2] = np.cos(angles)
    poses[:, 0, 2], poses[:, 2, 0] = np.sin(angles), -np.sin(angles)
    poses[:, :3, 3] = about["distance"] * poses[:, :3, 2]
    focal = about["focal"]  # in sides of the image
    Ks = np.tile([[focal, 0, 0.5], [0, focal, 0.5], [0, 0, 1]], (count, 1, 1))
    return ObjectFiles([folder / name for name in about["images"]], poses, Ks, [None] * count)


def build_patches(config, weights):
    """Image tokens of 8x8 pixels by one convolution, trained with the model."""

    class Patches(nn.Module):
        def __init__(self):
            super().__init__()
            self.convolution = nn.Conv2d(3, 32, 8, stride=8)

        def forward(self, images):
            return self.convolution(images.permute(0, 3, 1, 2)).flatten(2).mT

    return Patches(), 32


class Cloud(nn.Module):
    """Decoder of one Gaussian a token, anywhere in the cube."""

    def __init__(self, config):
        super().__init__()
        self.head = nn.Linear(config.width, 8)

    def forward(self, tokens):
        """Map tokens ``[B, L, width]`` to Gaussians ``[B, L]``."""
        values = self.head(tokens.float())
        size = 0.05 * torch.sigmoid(values[..., 3:4]).expand(*values.shape[:-1], 3)
        return Gaussians(
            means=0.5 * torch.tanh(values[..., :3]),
            quats=None,
            scales=size,
            opacities=torch.sigmoid(values[..., 4]),
            colors=torch.sigmoid(values[..., 5:]),
        )


def linear(optim, step, warmup, total):
    """Fall along a line from the end of the warm-up to the end of the run."""
    return (total - step) / (total - warmup)


TERMS["edges"] = Term(lambda loss, at: 0.5, edge_error, "edges")
METRICS["mae"] = Metric("MAE", mean_error, digits=4, more_is_better=False)
LAYOUTS["orbit"] = "orbit.json", read_orbit
ENCODERS["patches"] = build_patches
DECODERS["cloud"] = Cloud
SCHEDULES["linear"] = linear

if __name__ == "__main__":
    main()
