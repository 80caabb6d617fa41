"""Made-up posed views, for the studies of a training step and of the loader."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import torch

from gamba_warp.cameras import orbit
from gamba_warp.images import save_image

_SPREAD = (0.6, 0.85, 1.1, 1.45)  # areas of the objects of a batch, as they differ in real ones
_COVERED = 0.22  # of a view by its object, which then lies in 28 % of the patches of 8²


def write_views(folder: Path, objects: int, views: int, size: int) -> None:
    """Write objects of smooth colours behind ellipses, in the layout ``transforms``, as WebP."""
    x = np.linspace(-1, 1, size)
    for number in range(objects):
        rng, here = np.random.default_rng(number), folder / f"object{number:02d}"
        here.mkdir(parents=True)
        # The area of an ellipse with half axes 1.4 s and s is 1.4 π s², that of the view is 4.
        s = math.sqrt(4 * _COVERED * _SPREAD[number % len(_SPREAD)] / (1.4 * math.pi))
        inside = (x[:, None] / (1.4 * s)) ** 2 + (x / s) ** 2 < 1
        frames = []
        for view in range(views):
            waves = np.sin(rng.uniform(2, 20, (2, 3)) @ rng.uniform(-1, 1, (3, 3)))
            color = np.sin(9 * waves[0] * x[:, None, None] + 9 * waves[1] * x[None, :, None])
            rgba = np.dstack([(0.5 + 0.5 * color) * inside[..., None], inside])
            save_image(here / f"{view}.webp", rgba, lossless=True)
            angle = torch.tensor([360.0 * view / views])
            pose = torch.linalg.inv(orbit(angle, 20.0, 1.8)[0].double())
            pose[:, 1:3] *= -1  # OpenCV to OpenGL
            frames.append({"file_path": f"{view}.webp", "transform_matrix": pose.tolist()})
        values = {"w": size, "h": size, "fl_x": 1.1 * size, "frames": frames}
        (here / "transforms.json").write_text(json.dumps(values), encoding="utf-8")
