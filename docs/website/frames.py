"""Draws docs/images/frames.webp: the frames of docs/cameras.md, by the project's own renderer.

    python docs/website/frames.py

Everything in it is 3D Gaussians: the object, reconstructed by the shipped model from an image of
the starter set, the cube, the camera of the image, and the axes. Only the names are drawn on top.
"""

from __future__ import annotations

from pathlib import Path

import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from gamba_warp import Cameras, Gaussians, load_model, reconstruct, render
from gamba_warp.cameras import intrinsics, orbit
from gamba_warp.conventions import DEFAULT_DISTANCE, DEFAULT_FOV
from gamba_warp.files import STARTER, atomic_path
from gamba_warp.images import to_uint8

IMAGE = Path(__file__).parents[1] / "images" / "frames.webp"
OBJECT = "blendswap-cc-0-teddybear"  # CC0
SIDE = 420  # pixels of a panel
RED, GREEN, BLUE = (0.85, 0.1, 0.1), (0.05, 0.6, 0.1), (0.1, 0.25, 0.9)
GREY, DARK = (0.62, 0.62, 0.62), (0.25, 0.25, 0.25)
# Title, and where x, y and z point in the frame of the input's camera (x right, y down, z forward).
PANELS = (
    ("opencv: Gaussians, .ply, .splat", ((1, 0, 0), (0, 1, 0), (0, 0, 1))),
    ("opengl: meshes, .glb, .spz", ((1, 0, 0), (0, -1, 0), (0, 0, -1))),
    ("datasets: z up", ((1, 0, 0), (0, 0, 1), (0, -1, 0))),
)
Line = tuple[tuple[float, ...], tuple[float, ...], tuple[float, float, float]]


def main() -> None:
    """Write the image."""
    viewmat = orbit(torch.tensor([48.0]), elevation=20.0, distance=3.0)
    viewmat[:, :3, 3] += viewmat[:, :3, :3] @ torch.tensor([0.0, 0.0, 0.45])  # looks between both
    cameras = Cameras(viewmat, intrinsics(SIDE, SIDE, 44.0)[None], SIDE, SIDE)
    thing = reconstruct(load_model(), STARTER / "icons" / f"{OBJECT}.png")
    sheet = Image.new("RGB", (SIDE * len(PANELS), SIDE), "white")
    for number, (title, axes) in enumerate(PANELS):
        arrows = [
            ((0, 0, 0), tuple(0.75 * x for x in a), c) for a, c in zip(axes, (RED, GREEN, BLUE))
        ]
        drawn = joined(thing, lines(cube() + camera(), 0.006), lines(arrows, 0.012))
        image = render(drawn, cameras, background=torch.ones(3)).rgb[0]
        panel = Image.fromarray(to_uint8(image.numpy()))
        write_names(panel, title, axes, cameras)
        sheet.paste(panel, (SIDE * number, 0))
    with atomic_path(IMAGE) as path:
        sheet.save(path, "WEBP", quality=90, method=6)


def cube() -> list[Line]:
    """Twelve edges of the object's cube, of side 1 about the origin."""
    found: list[Line] = []
    for axis in range(3):
        for a in (-0.5, 0.5):
            for b in (-0.5, 0.5):
                start, end = [a, b], [a, b]
                start.insert(axis, -0.5)
                end.insert(axis, 0.5)
                found.append((tuple(start), tuple(end), GREY))
    return found


def camera(depth: float = 0.35) -> list[Line]:
    """The reference camera: its centre, and the rays of its corners up to a depth."""
    half = depth * torch.tan(torch.deg2rad(torch.tensor(DEFAULT_FOV / 2))).item()
    centre = (0.0, 0.0, -DEFAULT_DISTANCE)
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    corners = [(x * half, y * half, depth - DEFAULT_DISTANCE) for x, y in signs]
    edges = zip(corners, corners[1:] + corners[:1])
    return [(centre, corner, DARK) for corner in corners] + [(a, b, DARK) for a, b in edges]


def lines(segments: list[Line], width: float) -> Gaussians:
    """Gaussians in rows along segments.

    Args:
        segments: start, end and colour of each.
        width: standard deviation of a Gaussian, object units.
    """
    steps = torch.linspace(0, 1, 90)[:, None]
    means, colors = [], []
    for start, end, color in segments:
        means.append(torch.lerp(torch.tensor(start).float(), torch.tensor(end).float(), steps))
        colors.append(torch.tensor(color).expand(len(steps), 3))
    points = torch.cat(means)
    count = len(points)
    return Gaussians(
        points, None, torch.full((count, 3), width), torch.full((count,), 0.9), torch.cat(colors)
    )


def joined(*parts: Gaussians) -> Gaussians:
    """Concatenate sets of Gaussians; those without rotations get the identity."""
    none = torch.tensor([1.0, 0, 0, 0])
    quats = [none.expand(p.num, 4) if p.quats is None else p.quats for p in parts]
    names = ("means", "scales", "opacities", "colors")
    together = {name: torch.cat([getattr(p, name) for p in parts]) for name in names}
    return Gaussians(quats=torch.cat(quats), **together)


def write_names(panel: Image.Image, title: str, axes, cameras: Cameras) -> None:
    """Write a title, and the axes' names at their ends."""
    draw = ImageDraw.Draw(panel)
    draw.text((14, 10), title, fill="black", font=ImageFont.load_default(20))
    for name, axis, color in zip("xyz", axes, (RED, GREEN, BLUE)):
        x, y = pixel(torch.tensor(axis).float() * 0.86, cameras)
        fill = tuple(int(255 * c) for c in color)
        draw.text((x, y), name, fill=fill, anchor="mm", font=ImageFont.load_default(26))
    _, y = pixel(torch.tensor([0.0, 0.3, -DEFAULT_DISTANCE]), cameras)
    draw.text((14, y), "camera of the\ninput image", fill="black",
              font=ImageFont.load_default(15))  # fmt: skip


def pixel(point: Tensor, cameras: Cameras) -> tuple[float, float]:
    """Project a point ``[3]`` to pixels."""
    t = cameras.viewmats[0, :3, :3] @ point + cameras.viewmats[0, :3, 3]
    u = cameras.Ks[0] @ (t / t[2])
    return u[0].item(), u[1].item()


if __name__ == "__main__":
    main()
