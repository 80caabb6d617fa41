"""Changes of an object's views that keep them true: another object, seen by its own cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from gamba_warp.cameras import Cameras
from gamba_warp.data.dataset import ObjectViews

MAX_GAMMA = 1.5  # colours become value^gamma, gamma between 1 / MAX_GAMMA and this


@dataclass(frozen=True)
class Change:
    """What is done with the views of one sample.

    Attributes:
        mirror: whether left and right are exchanged.
        channels: the order of the colour channels.
        gamma: exponent of the colours, > 0.
    """

    mirror: bool = False
    channels: tuple[int, int, int] = (0, 1, 2)
    gamma: float = 1.0

    def __call__(self, views: ObjectViews) -> ObjectViews:
        """Returns the changed views."""
        if self.mirror:
            views = mirrored(views)
        if self.channels == (0, 1, 2) and self.gamma == 1.0:
            return views  # most samples of most trainings
        color = views.images[..., list(self.channels)] ** self.gamma
        return replace(views, images=torch.cat([color, views.images[..., 3:]], -1))


def draw_change(rng: np.random.Generator, mirror: float, recolor: float) -> Change:
    """Draws a change.

    Args:
        rng: source of chance.
        mirror: chance that the object is mirrored.
        recolor: chance that its colours change.
    """
    # As many numbers whatever the chances, so that one does not change what the other draws.
    first, second, power = rng.random(3)
    order = rng.permutation(3)
    change = Change(mirror=bool(first < mirror))
    if second < recolor:
        gamma = float(MAX_GAMMA ** (2 * power - 1))
        change = replace(
            change, channels=(int(order[0]), int(order[1]), int(order[2])), gamma=gamma
        )
    return change


def mirrored(views: ObjectViews) -> ObjectViews:
    """The views of the object's mirror image: x of the world and of every picture turned round.

    A point p at the pixel (x, y) becomes M p at (W - x, y), M = diag(-1, 1, 1): with the viewmat
    M R M, M t and the principal point W - cx. Both R and M R M are rotations.
    """
    cameras = views.cameras
    flip = cameras.viewmats.new_tensor([-1.0, 1.0, 1.0, 1.0]).diag()
    Ks = cameras.Ks.clone()
    Ks[..., 0, 2] = cameras.width - Ks[..., 0, 2]
    made = Cameras(flip @ cameras.viewmats @ flip, Ks, cameras.width, cameras.height)
    depths, backs = (None if d is None else d.flip(-1) for d in (views.depths, views.backs))
    return replace(views, images=views.images.flip(-2), cameras=made, depths=depths, backs=backs)
