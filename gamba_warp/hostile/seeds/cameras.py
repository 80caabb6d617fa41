"""Sound files of cameras in each form that is read, and what sound cameras are."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from .datasets import transforms
from .pictures import Files


def camera_files() -> dict[str, Files]:
    """Two cameras as a file of each form holds them."""
    poses = [np.eye(4), np.eye(4)]
    poses[1][:3, 3] = 0.5, -1.5, 2.0
    head = {"format": "gamba-cameras", "version": 1, "width": 8, "height": 6, "fps": 24, "fov": 50}
    K = [[9.0, 0, 4], [0, 9.0, 3], [0, 0, 1]]
    frames = [{"viewmat": poses[0].tolist(), "K": K}, {"viewmat": poses[1].tolist()}]
    path = [{"camera_to_world": p.ravel().tolist(), "fov": 50.0, "aspect": 1.3} for p in poses]
    views = [
        {"id": i, "img_name": "a", "width": 8, "height": 6, "fx": 9.0, "fy": 9.0}
        | {"position": p[:3, 3].tolist(), "rotation": p[:3, :3].tolist()}
        for i, p in enumerate(poses)
    ]
    nerfstudio = {"camera_type": "perspective", "render_height": 6, "render_width": 8}
    nerfstudio |= {"fps": 24, "seconds": 4, "keyframes": [], "camera_path": path}
    forms = {"ours": head | {"frames": frames}, "nerfstudio": nerfstudio, "splatting": views}
    made: dict[str, Files] = {
        name: {"cameras.json": json.dumps(value).encode()} for name, value in forms.items()
    }
    dataset = transforms("chair")["chair/transforms.json"]
    return made | {"transforms": {"transforms.json": dataset}}


def read(path: Path, out: Path) -> Any:
    """The cameras as ``gamba render`` reads them, in the file's size and in another."""
    from ...trajectories.files import load_path

    load_path(path, (32, 24))
    return load_path(path)


def sound(result: Any, path: Path, out: Path) -> str | None:
    """Finite cameras that turn rigidly, with focal lengths above 0 and pictures of bounded size."""
    cameras, rate = result.cameras, result.fps
    rotations = cameras.viewmats[:, :3, :3]
    if not (cameras.viewmats.isfinite().all() and cameras.Ks.isfinite().all()):
        return "cameras that are not finite"
    if float((rotations @ rotations.mT - np.eye(3)).abs().max()) > 0.03:
        return "a camera that is scaled"
    if float(cameras.Ks[:, [0, 1], [0, 1]].min()) <= 0:
        return "a focal length that is not above 0"
    if not (1 <= cameras.width <= 16_384 and 1 <= cameras.height <= 16_384):
        return f"pictures of {cameras.width}x{cameras.height}"
    if rate is not None and not 0 < rate <= 1000:
        return f"{rate} pictures a second"
    return None
