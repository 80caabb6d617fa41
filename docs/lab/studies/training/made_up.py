"""Shared parts of the cases of a training step: models, weights of the losses, and views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.data.dataset import ObjectViews, ViewDataset, open_dataset
from gamba_warp.kernels.bench.core.case import Settings
from gamba_warp.model.checkpoint import shipped_model
from gamba_warp.model.config import PRESETS, GambaConfig
from gamba_warp.model.gamba import Gamba
from gamba_warp.train.batches import Batches, TrainingData
from gamba_warp.train.config import DataConfig, TrainConfig
from gamba_warp.train.ddp import World

from .. import data_of

OP, BOTH = "step", "forward+backward"
BATCH, NOVEL, SIZE = 4, 3, 128
SLIM = "rays, slim"  # as wide and deep as preset tiny
LOWER = ", bfloat16"  # products of the network and of LPIPS in bfloat16
WEIGHTS = {"rgb": 1.0, "mask": 1.0, "ssim": 0.2, "lpips": 0.0, "rdist": 0.0}
SPREAD = (0.6, 0.85, 1.1, 1.45)  # sizes of the objects of a batch, as they differ in real ones
_COVERED = 0.22  # of a made-up view by its object, which then lies in 28 % of the patches of 8²


class _MadeUp(ViewDataset):
    """Objects of smooth noise whose silhouette is an ellipse, in views from all around."""

    def __init__(self, shares: Sequence[float], size: int) -> None:
        """Make objects that cover the given ``shares`` of a view."""
        super().__init__({}, "made up", cache=False)
        self.uids = [f"object{number}" for number in range(len(shares))]
        self.views = NOVEL + 3
        noise = torch.rand(len(shares) * self.views, 3, size // 8, size // 8)
        color = interpolate(noise, size=(size, size), mode="bilinear").permute(0, 2, 3, 1)
        drawn = [_ellipse(share, size, 0.7 + 0.2 * i) for i, share in enumerate(shares)]
        alphas = torch.stack(drawn)[:, None].expand(-1, self.views, -1, -1, -1)
        self.drawn = torch.cat([color.unflatten(0, alphas.shape[:2]), alphas], -1)

    def num_views(self, index: int | str) -> int:
        """The number of views of each object."""
        return self.views

    def load(
        self, index: int | str, views: Sequence[int] | None = None, size: int | None = None,
        depths: int | None = None,
    ) -> ObjectViews:  # fmt: skip
        """Views of one object, as from ``ViewDataset.load``; ``size`` is that of all."""
        chosen = list(range(self.views) if views is None else views)
        images = self.drawn[int(index), chosen].clone()
        side = images.shape[1]
        viewmats = orbit(360 * torch.tensor(chosen) / self.views, distance=2.5)
        K = intrinsics(side, side, 40.0).expand(len(chosen), 3, 3)
        cameras = Cameras(viewmats, K, side, side)
        return ObjectViews(self.uids[int(index)], "made up", images, cameras, None, {})


def _ellipse(share: float, size: int, stretch: float) -> Tensor:
    """A silhouette in the middle that covers a share of the picture: ``[size, size, 1]``."""
    if share >= 1:
        return torch.ones(size, size, 1)
    x = torch.linspace(-1, 1, size)
    distance = (x[:, None] / stretch) ** 2 + (x * stretch) ** 2  # of all pixels, the nearest ones
    limit = distance.flatten().sort().values[max(0, round(share * size**2) - 1)]
    return (distance <= limit).float()[..., None]


def step_config(name: str, settings: Settings) -> GambaConfig:
    """The configuration of a variant, by its name; a quick run's is small."""
    name = name.removesuffix(LOWER)
    tiny, config = PRESETS["tiny"], PRESETS["tiny" if name == "tiny" else "rays"]
    if name == SLIM:
        config = replace(config, width=tiny.width, depth=tiny.depth)
    if settings.level == "quick":
        config = replace(config, image_size=32, width=16, depth=1)
    return config


def step_model(name: str, settings: Settings) -> tuple[Gamba, bool]:
    """Make a model to train, with seed 0; also return True if it has the shipped weights.

    Args:
        name: of a variant; those of the presets may have such weights, but not in a quick run.
        settings: of the cases.
    """
    torch.manual_seed(0)
    shipped = None if settings.level == "quick" else shipped_model(name, settings.device)
    if shipped is None:
        return Gamba(step_config(name, settings)).to(settings.device), False
    return shipped.train().requires_grad_(), True


def step_source(
    config: GambaConfig, settings: Settings, batch: int, covered: float = _COVERED
) -> Batches:
    """Batches of the given folder, or of made-up views with the same silhouettes."""
    spread = (SPREAD[i % len(SPREAD)] if covered < 1 else 1.0 for i in range(batch))
    shares = [min(1.0, covered * factor) for factor in spread]
    size = min(SIZE, config.image_size)
    data = _MadeUp(shares, size)
    if (folder := data_of(settings)) is not None:
        data = open_dataset(folder, cache=True)
    views = DataConfig(size=size, mirror=0.5, recolor=0.3)
    objects = list(range(len(data.uids)))
    made = Batches(
        TrainingData(data, objects, batch_size=batch),
        TrainConfig(data=Path("made-up"), views=views),
        World(0, 1, torch.device("cpu")),
    )
    made.model = config
    return made


def views(settings: Settings, count: int) -> Tensor:
    """RGBA views of made-up objects, ``[count, side, side, 4]`` on the CPU."""
    side = 32 if settings.level == "quick" else SIZE
    data = _MadeUp([min(1.0, _COVERED * SPREAD[i % len(SPREAD)]) for i in range(count)], side)
    return data.drawn[:, 0]
