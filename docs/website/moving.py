"""Draws docs/images/turntables.webp: turning objects outside the shipped model's training set.

    python docs/website/moving.py data/furniture128 out/scanned/views

Left of each pair is the input, right of it the shipped model's reconstruction of that image. The
objects are of furniture's test split and of Google Scanned Objects (``make scanned`` renders them),
one of a kind, chosen by eye; docs/images/held-out.webp has the best, the middle and the worst of
furniture by PSNR, docs/images/scanned.webp all scanned objects.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from gamba_warp.conventions import GREY, over_background
from gamba_warp.files import atomic_path
from gamba_warp.images import load_rgba, to_uint8

OBJECTS = (
    *("TZX_Runner", "Room_Essentials_Mug_White_Yellow", "CHICKEN_RACER"),
    *("blendswap-cc-0-teddybear", "Schleich_Hereford_Bull", "scopia-dog-house"),
)
COLUMNS = 3
SIDE = 200  # pixels of the input and of the turntable
CROP = 10  # empty pixels left out at each edge
FRAMES = 40
MILLISECONDS = 100  # duration of a frame
IMAGE = Path(__file__).parents[1] / "images" / "turntables.webp"


def main(*data: Path) -> None:
    """Write the image.

    Args:
        data: folders made by `gamba data render`, which together have the objects.
    """
    from gamba_warp import load_model
    from gamba_warp.pipeline import reconstruct_object
    from gamba_warp.trajectories.movies import turntable_frames

    model = load_model()
    cells = []
    for name in OBJECTS:
        path = next(path for folder in data if (path := folder / name / "000.webp").exists())
        rgba = load_rgba(path)
        seen = Image.fromarray(to_uint8(over_background(rgba, GREY)))
        still = np.asarray(seen.resize((SIDE, SIDE), Image.Resampling.BICUBIC))
        result = reconstruct_object(model, name, rgba)
        view = result.view.changed(elevation=10.0)
        turn = turntable_frames(result.gaussians, view, size=SIDE, frames=FRAMES)
        pair = np.stack([np.broadcast_to(still, turn.shape), turn])[:, :, CROP:-CROP, CROP:-CROP]
        cells.append(np.concatenate([*pair], 2))
    rows = [np.concatenate(cells[i : i + COLUMNS], 2) for i in range(0, len(cells), COLUMNS)]
    frames = [Image.fromarray(frame) for frame in np.concatenate(rows, 1)]
    with atomic_path(IMAGE) as path:
        options = {"duration": MILLISECONDS, "loop": 0, "quality": 80, "method": 6}
        frames[0].save(path, "WEBP", save_all=True, append_images=frames[1:], **options)
    print(f"{IMAGE}: {IMAGE.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
