"""Datasets of posed views rendered from Gaussians, and evaluations of files."""

import json
from pathlib import Path

import torch
from torch import Tensor

from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.cli import run
from gamba_warp.gaussians import Gaussians
from gamba_warp.images import save_image
from gamba_warp.render import render

_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


def to_opengl(viewmats: Tensor) -> Tensor:
    """Convert world-to-camera OpenCV matrices to camera-to-world OpenGL ones, ``[.., 4, 4]``."""
    return torch.linalg.inv(_FLIP @ viewmats.double()).to(viewmats.dtype)


def around(azimuths, elevation=0.0, distance=1.5, size=32, fov=49.1) -> Cameras:
    """Square cameras on a circle about the origin."""
    viewmats = orbit(torch.as_tensor(azimuths, dtype=torch.float32), elevation, distance)
    Ks = intrinsics(size, size, fov).expand(len(viewmats), 3, 3)
    return Cameras(viewmats, Ks, size, size)


def cloud_of(means, scale, opacity, colors) -> Gaussians:
    """Round Gaussians, not turned, of one size and opacity."""
    means = torch.as_tensor(means, dtype=torch.float32)
    return Gaussians(
        means=means,
        quats=None,
        scales=torch.full((len(means), 3), scale),
        opacities=torch.full((len(means),), opacity),
        colors=torch.as_tensor(colors, dtype=torch.float32).expand(len(means), 3).clone(),
    )


def straight(gaussians: Gaussians, cameras: Cameras) -> Tensor:
    """Render straight RGBA ``[V, H, W, 4]``, as in files."""
    with torch.no_grad():
        out = render(gaussians, cameras)  # on black: the colour is premultiplied
    return torch.cat([out.rgb / out.alpha.clamp(min=1e-6), out.alpha], -1)


def transforms(names, cameras: Cameras) -> str:
    """The text of ``transforms.json``."""
    poses = to_opengl(cameras.viewmats).tolist()
    frames = [{"file_path": n, "transform_matrix": p} for n, p in zip(names, poses)]
    focal = float(cameras.Ks[0, 0, 0])
    size = {"w": cameras.width, "h": cameras.height, "fl_x": focal, "fl_y": focal}
    return json.dumps({**size, "frames": frames})


def write_views(folder: Path, rgba: Tensor, cameras: Cameras) -> None:
    """Write an object: images ``000.png`` and so on, and their cameras."""
    folder.mkdir(parents=True)
    names = [f"{v:03d}.png" for v in range(len(rgba))]
    for name, image in zip(names, rgba):
        save_image(folder / name, image.numpy())
    (folder / "transforms.json").write_text(transforms(names, cameras))


def evaluated(command: str, out: Path, *words: object) -> tuple[int, dict | None]:
    """Run ``eval-views`` or ``eval-geometry``; return the exit code and the report, if any."""
    code = run(command, [*map(str, words), "--out", str(out)])
    path = out / "report.json"
    return code, json.loads(path.read_text()) if path.exists() else None


def eval_views(pred: Path, data: Path, out: Path, *options: object) -> tuple[int, dict | None]:
    """Runs ``eval-views`` on the CPU, without LPIPS."""
    words = ("--checkpoint", pred, "--data", data, "--lpips", "off", "--device", "cpu", *options)
    return evaluated("eval-views", out, *words)
