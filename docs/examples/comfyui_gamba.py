"""Node for ComfyUI: a picture to 3D Gaussians and a turntable.

Copy this file into ``ComfyUI/custom_nodes/`` and install the checkout into ComfyUI's Python
(docs/formats.md, "ComfyUI"). The node is "Gamba: picture to 3D" in the category 3d.
"""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import torch

from gamba_warp import Cameras, load_model, reconstruct, render
from gamba_warp.cameras import intrinsics, orbit
from gamba_warp.formats.ply import save_ply
from gamba_warp.images import save_image


@cache
def shipped_model():
    """Return the shipped model, loaded once."""
    return load_model(device="cuda" if torch.cuda.is_available() else "cpu")


def output_folder() -> Path:
    """Return ComfyUI's folder of results."""
    import folder_paths

    return Path(folder_paths.get_output_directory())


class GambaPictureTo3D:
    """Reconstructs each picture of a batch.

    A mask is 1 where the picture is background, as ComfyUI's "Load Image" makes it of alpha. An
    empty mask counts as none: the object is then cut out by its background.
    """

    CATEGORY = "3d"
    FUNCTION = "run"
    RETURN_TYPES = ("STRING", "IMAGE")
    RETURN_NAMES = ("ply_path", "turntable")
    OUTPUT_NODE = True

    @classmethod
    def INPUT_TYPES(cls) -> dict:
        """Return the node's inputs."""
        return {
            "required": {
                "image": ("IMAGE",),
                "name": ("STRING", {"default": "gamba"}),
                "frames": ("INT", {"default": 24, "min": 1, "max": 240}),
                "size": ("INT", {"default": 256, "min": 64, "max": 1024, "step": 8}),
                "elevation": ("FLOAT", {"default": 10.0, "min": -89.0, "max": 89.0}),
            },
            "optional": {"mask": ("MASK",)},
        }

    def run(self, image, name, frames, size, elevation, mask=None):
        """Write a .ply for each picture.

        Args:
            image: ``[B, H, W, 3]`` in [0, 1].
            name: of the files.
            frames: of each turntable.
            size: of its frames, pixels.
            elevation: of its camera, degrees.
            mask: ``[B or 1, H, W]``, 1 on the background.

        Returns:
            The paths of the files, one a line, and all frames ``[B * frames, size, size, 3]``.
        """
        folder, device = output_folder(), next(shipped_model().parameters()).device
        stem = Path(name).name or "gamba"
        viewmats = orbit(torch.arange(frames) * (360.0 / frames), elevation=elevation)
        Ks = intrinsics(size, size).expand(frames, 3, 3)
        cameras = Cameras(viewmats, Ks, width=size, height=size).to(device)
        paths, pictures = [], []
        for number, rgb in enumerate(image):
            shown = None if mask is None else mask[min(number, len(mask) - 1)]
            with tempfile.TemporaryDirectory(prefix="gamba-") as temporary:
                picture = Path(temporary) / "picture.png"
                save_image(picture, _with_alpha(rgb, shown))
                gaussians = reconstruct(shipped_model(), picture)
            path = _free(folder, stem)
            save_ply(path, gaussians)
            paths.append(str(path))
            white = torch.ones(3, device=device)
            pictures.append(render(gaussians, cameras, background=white).rgb.cpu())
        text = "\n".join(paths)
        return {"ui": {"text": [text]}, "result": (text, torch.cat(pictures))}


def _with_alpha(rgb: torch.Tensor, mask: torch.Tensor | None) -> np.ndarray:
    """Return a picture ``[H, W, 3 or 4]`` with the alpha of its mask, if it has one."""
    picture = rgb[..., :3].cpu().float().clamp(0, 1)
    if mask is not None and mask.shape == picture.shape[:2] and mask.max() > 0:
        picture = torch.cat([picture, 1 - mask.cpu().float().clamp(0, 1)[..., None]], -1)
    return np.asarray(picture)


def _free(folder: Path, stem: str) -> Path:
    """Return the first name of the folder that is not taken."""
    number = 1
    while (path := folder / f"{stem}_{number:05}.ply").exists():
        number += 1
    return path


NODE_CLASS_MAPPINGS = {"GambaPictureTo3D": GambaPictureTo3D}
NODE_DISPLAY_NAME_MAPPINGS = {"GambaPictureTo3D": "Gamba: picture to 3D"}
