"""Draws docs/pictures/made.webp: 48 objects of `gamba data made`, each from its front.

    python docs/website/made.py

They are the first 48 of a seed, not chosen.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from gamba_warp.conventions import GREY, over_background
from gamba_warp.files import atomic_path
from gamba_warp.formats.meshes import TexturedMesh
from gamba_warp.images import to_uint8
from gamba_warp.train.data.made import make_object
from gamba_warp.train.data.poses import sample_poses
from gamba_warp.train.data.raycast import Lights, RayCaster

SEED = 7
COLUMNS, ROWS = 8, 6
SIDE = 160  # pixels of an object
FOV = 40.0  # degrees
PICTURE = Path(__file__).parents[1] / "pictures" / "made.webp"


def front_view(mesh: TexturedMesh, rng: np.random.Generator) -> np.ndarray:
    """One view ``[SIDE, SIDE, 3]`` uint8 of an object that is y up, on grey."""
    model = mesh.normalized("y")[0]
    caster = RayCaster(model, Lights.sample(rng, varied=True))
    pose = sample_poses(model.vertices, 1, FOV, rng)[0]
    picture, _ = caster.render(pose, SIDE, FOV)
    return to_uint8(over_background(picture, GREY))


def main(path: Path) -> None:
    """Write the picture."""
    cells = []
    for number in range(COLUMNS * ROWS):
        rng = np.random.default_rng([SEED, number])
        cells.append(front_view(make_object(rng), rng))
    rows = [np.concatenate(cells[i : i + COLUMNS], 1) for i in range(0, len(cells), COLUMNS)]
    with atomic_path(path) as temporary:
        Image.fromarray(np.concatenate(rows)).save(temporary, "WEBP", quality=80, method=6)
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if sys.argv[1:] else PICTURE)
