"""Plugin with one addition of each kind; docs/change-the-training.md explains it.

gamba train DATA --preset tiny --plugin docs/examples/plugin.py edges=0.5 --schedule linear
"""

import json

import numpy as np
import torch
from torch import nn

from gamba_warp.data.layouts import ObjectFiles
from gamba_warp.gaussians import Gaussians
from gamba_warp.image_metrics import Metric


def edge_error(inputs):
    """Mean error of the differences between neighbours in a row, ``[B, V+1]``."""
    got, want = inputs.rgb.diff(dim=-2), inputs.target.diff(dim=-2)
    return (got - want).abs().mean((-3, -2, -1))


def mean_error(a, b):
    """Mean absolute error of pictures ``[V, H, W, 3]``, ``[V]``."""
    return (a.double() - b.double()).abs().mean((-3, -2, -1))


def read_orbit(folder):
    """Object of ``orbit.json``: pictures on a ring, ``{"distance", "focal", "pictures"}``."""
    about = json.loads((folder / "orbit.json").read_text())
    count = len(about["pictures"])
    angles = 2 * np.pi * np.arange(count) / count
    poses = np.tile(np.eye(4), (count, 1, 1))  # OpenGL: the camera looks along -z, y is up
    poses[:, 0, 0] = poses[:, 2, 2] = np.cos(angles)
    poses[:, 0, 2], poses[:, 2, 0] = np.sin(angles), -np.sin(angles)
    poses[:, :3, 3] = about["distance"] * poses[:, :3, 2]
    focal = about["focal"]  # in sides of the picture
    Ks = np.tile([[focal, 0, 0.5], [0, focal, 0.5], [0, 0, 1]], (count, 1, 1))
    return ObjectFiles([folder / name for name in about["pictures"]], poses, Ks, [None] * count)


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


def hard_first(rng, uids):
    """Names in their order, every second one twice, for an epoch of the same length."""
    order = np.concatenate([np.arange(len(uids)), np.arange(0, len(uids), 2)])
    return rng.permutation(order)[: len(uids)]


def register(plugin, edges=0.1):
    """Add all of them; ``edges`` is the weight of the loss term."""
    plugin.loss_term("edges", edge_error, weight=edges)
    plugin.image_metric("mae", Metric("MAE", mean_error, digits=4, more_is_better=False))
    plugin.dataset_layout("orbit", "orbit.json", read_orbit)
    plugin.encoder("patches", build_patches)
    plugin.decoder("cloud", Cloud)
    plugin.sampler("hard_first", hard_first)
    plugin.scheduler("linear", lambda done: 1 - done)
