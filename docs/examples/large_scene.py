"""A hall of furniture in a million Gaussians, and the frames a second of its views on a CPU.

    gamba data furniture --out furniture
    python docs/examples/large_scene.py furniture --out out/hall.ply

The objects of a folder of meshes stand on a square floor. Each gets the same number of Gaussians,
at random places of its surface: flat ones along the surface, as wide as their distance from each
other, in the colour of the texture there. The same folder and options give the same bytes. Views
are timed from inside the hall, where most Gaussians are beside or behind the camera, and from
above, where all are in sight. The figures of docs/kernels-alone.md are its output.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.color_spaces import to_display, to_linear
from gamba_warp.errors import UserError
from gamba_warp.formats.catalogue import find_meshes
from gamba_warp.formats.gaussians.files import write_gaussians
from gamba_warp.formats.meshes import TexturedMesh, default_up, load_mesh
from gamba_warp.formats.read import read_gaussians
from gamba_warp.gaussians import Gaussians
from gamba_warp.render import render

CELL = 1.4  # of the floor; the longest side of an object is 1
WIDE, FLAT = 0.7, 0.1  # standard deviations along and across the surface, of the local spacing
SIZES = ((512, 512), (1920, 1080))


def texture_colors(mesh: TexturedMesh, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Display colours ``[P, 3]`` at points of faces: corner colour times material times texture."""
    colors = to_linear((mesh.colors[face][..., :3] / 255.0 * weights[..., None]).sum(1))
    uv = (mesh.uvs[face] * weights[..., None]).sum(1)
    for number, material in enumerate(mesh.materials):
        mine = mesh.material_ids[face] == number
        colors[mine] *= material.color[:3]
        if material.texture is not None and mine.any():
            height, width = material.texture.shape[:2]
            x = (uv[mine, 0] % 1 * width).astype(int).clip(0, width - 1)
            y = ((1 - uv[mine, 1] % 1) * height).astype(int).clip(0, height - 1)
            colors[mine] *= to_linear(material.texture[y, x, :3] / 255.0)
    return to_display(colors.clip(0, 1))


def quats_from_normals(normals: np.ndarray) -> np.ndarray:
    """Rotations ``[P, 4]`` wxyz that turn the z axis to unit normals ``[P, 3]``."""
    x, y, z = normals.T
    quats = np.stack([1 + z, -y, x, np.zeros_like(x)], 1)
    quats[z < -0.9999] = (0, 1, 0, 0)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def sample(mesh: TexturedMesh, count: int, rng: np.random.Generator) -> Gaussians:
    """Gaussians on the surface of a mesh, in OpenCV's axes, with the lowest point at y = 0."""
    corners = mesh.vertices[mesh.faces]
    areas = (
        np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        / 2
    )
    if not areas.sum() > 0:
        raise UserError("the mesh has no surface")
    face = np.sort(rng.choice(len(areas), count, p=areas / areas.sum()))
    side = np.sqrt(rng.random(count))
    along = rng.random(count)
    weights = np.stack([1 - side, side * (1 - along), side * along], 1)
    points = (corners[face] * weights[..., None]).sum(1)
    normals = (mesh.normals[face] * weights[..., None]).sum(1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    points[:, 2] -= points[:, 2].min()
    points, normals = (x[:, [0, 2, 1]] * [1, -1, 1] for x in (points, normals))
    spacing = math.sqrt(areas.sum() / count)
    scales = np.broadcast_to(np.array([WIDE, WIDE, FLAT]) * spacing, (count, 3))
    arrays = points, quats_from_normals(normals), scales, texture_colors(mesh, face, weights)
    means, quats, scales, colors = (torch.from_numpy(np.array(x, dtype=np.float32)) for x in arrays)
    return Gaussians(means, quats, scales, torch.full((count,), 0.95), colors)


def make_hall(folder: Path, count: int, objects: int, seed: int) -> Gaussians:
    """``count`` Gaussians of the first ``objects`` meshes that can be read, on a floor."""
    parts: list[Gaussians] = []
    meshes = find_meshes(folder)
    columns = math.ceil(math.sqrt(min(objects, len(meshes))))
    for entry in meshes:
        if len(parts) == objects:
            break
        try:
            mesh, _, _ = load_mesh(entry.path).normalized(default_up(entry.path), entry.rotation)
            number = len(parts)
            mine = count * (number + 1) // objects - count * number // objects
            part = sample(mesh, mine, np.random.default_rng([seed, number]))
        except UserError as error:
            print(f"skipped {entry.uid}: {error}")
            continue
        cell = torch.tensor([number % columns, 0, number // columns], dtype=torch.float32)
        middle = torch.tensor([(columns - 1) / 2, 0, (columns - 1) / 2])
        part.means = part.means + (cell - middle) * CELL
        parts.append(part)
    if not parts:
        raise UserError(f"{folder}: no mesh could be read")
    names = ("means", "quats", "scales", "opacities", "colors")
    return Gaussians(*(torch.cat([getattr(part, name) for part in parts]) for name in names))


def views(gaussians: Gaussians, number: int, width: int, height: int) -> dict[str, Cameras]:
    """Cameras that fly through the hall, and from above."""
    half = float(gaussians.means[:, ::2].abs().max())
    azimuths = torch.arange(number) * (360 / number)
    Ks = intrinsics(width, height).expand(number, 3, 3)
    return {
        "inside": Cameras(orbit(azimuths, 14.0, 0.55 * half), Ks, width, height),
        "from above": Cameras(orbit(azimuths, 40.0, 2.6 * half), Ks, width, height),
    }


@torch.no_grad()
def frames_a_second(
    gaussians: Gaussians, cameras: Cameras, turns: int
) -> tuple[float, Tensor, dict]:
    """The frames a second of the median view, rendered one by one, the first image and counts."""
    white = torch.ones(3)
    first = render(gaussians, cameras[:1], white)
    times = []
    for _ in range(turns):
        for v in range(len(cameras.viewmats)):
            start = time.perf_counter()
            render(gaussians, cameras[v : v + 1], white)
            times.append(time.perf_counter() - start)
    culled = sum(first.meta["culled"].values())
    counts = {"seen": gaussians.num - culled, "pairs": first.meta["pairs"]}
    return 1 / statistics.median(times), first.rgb[0], counts


def save_image(path: Path, rgb: Tensor) -> None:
    """Write an image ``[H, W, 3]`` as PNG."""
    from PIL import Image

    Image.fromarray((rgb.clamp(0, 1) * 255).round().byte().numpy()).save(path)


def main() -> None:
    """Read the options from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="folder of meshes, or the .ply of an earlier run")
    parser.add_argument("--out", type=Path, help="output .ply")
    parser.add_argument("--images", type=Path, help="folder for an image of each kind of view")
    parser.add_argument("--count", type=int, default=1 << 20, help="Gaussians")
    parser.add_argument("--objects", type=int, default=256)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.folder.suffix == ".ply":
        hall = read_gaussians(options.folder)
    else:
        hall = make_hall(options.folder, options.count, options.objects, options.seed)
    if options.out:
        write_gaussians(options.out, hall, "ply")
    print(f"{hall.num:,} Gaussians, {options.threads} threads")
    for width, height in SIZES:
        for name, cameras in views(hall, options.views, width, height).items():
            rate, image, counts = frames_a_second(hall, cameras, options.turns)
            print(
                f"  {width} x {height} {name:<10} {rate:6.1f} frames/s"
                f"   ({counts['seen']:,} seen and {counts['pairs']:,} pairs in the first view)"
            )
            if options.images:
                options.images.mkdir(parents=True, exist_ok=True)
                save_image(options.images / f"{name.replace(' ', '-')}-{height}.png", image)


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        raise SystemExit(f"error: {error}") from None
