"""Effect of a texture: meshes of one object, rendered flat, compared with the Gaussians.

python docs/examples/mesh_quality.py out/photo.ply
python docs/examples/mesh_quality.py              # a ball with stripes, finer than any model makes

The figures of docs/formats.md are its output.
"""

import sys

import numpy as np
import torch

from gamba_warp.cameras import fibonacci_sphere
from gamba_warp.formats.read import read_gaussians
from gamba_warp.gaussians import Gaussians
from gamba_warp.render import render
from gamba_warp.surfaces.extract import Surface, extract_surface, unit_frame
from gamba_warp.surfaces.options import SurfaceOptions
from gamba_warp.surfaces.tsdf import sphere_cameras
from gamba_warp.versions import import_open3d

VIEWS, PIXELS, FINER = 9, 384, 2  # rays along a side of a pixel
KINDS = (  # voxels, most faces, side of the texture
    ("as many faces as 256 voxels give, vertex colours", 256, 0, 0),
    ("as many faces as 128 voxels give, vertex colours", 128, 0, 0),
    ("10,000 faces, vertex colours", 128, 10_000, 0),
    ("10,000 faces, texture of 1024", 128, 10_000, 1024),
)


def striped_ball(count=30_000, stripes=30):
    """Gaussians on a ball, red and blue in turn from pole to pole."""
    points = fibonacci_sphere(count)
    red = np.floor((points[:, 2:] + 1) / 2 * stripes).astype(int) % 2 == 1
    colors = np.where(red, [0.9, 0.2, 0.1], [0.1, 0.3, 0.8])
    return Gaussians(
        means=torch.from_numpy(0.5 * points).float(),
        quats=None,
        scales=torch.full((count, 3), 0.004),
        opacities=torch.full((count,), 0.95),
        colors=torch.from_numpy(colors).float(),
    )


def shade(surface: Surface, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Colours ``[P, 3]`` of points of faces: of the texture between texels, or of the corners."""
    if surface.texture is None:
        assert surface.colors is not None
        return (surface.colors[surface.faces[face]] * weights[..., None]).sum(1)
    image = torch.from_numpy(surface.texture.image).permute(2, 0, 1)[None]
    uv = (surface.texture.uvs[face] * weights[..., None]).sum(1)
    grid = torch.from_numpy(np.stack([uv[:, 0], 1 - uv[:, 1]], 1) * 2 - 1).float()[None, None]
    return torch.nn.functional.grid_sample(image, grid, align_corners=False)[0, :, 0].T.numpy()


def flat(surface: Surface, cameras) -> torch.Tensor:
    """Images ``[V, PIXELS, PIXELS, 3]`` of a mesh without light, on white."""
    o3d = import_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    vertices, faces = surface.vertices.astype(np.float32), surface.faces.astype(np.uint32)
    scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(faces))
    side, images = PIXELS * FINER, []
    for viewmat, K in zip(cameras.viewmats.double(), cameras.Ks.double()):
        fine = torch.cat([K[:2] * FINER, K[2:]])
        rays = scene.create_rays_pinhole(
            o3d.core.Tensor(fine.numpy()), o3d.core.Tensor(viewmat.numpy()), side, side
        )
        found = {name: value.numpy() for name, value in scene.cast_rays(rays).items()}
        hit = np.isfinite(found["t_hit"])
        last = found["primitive_uvs"][hit]
        weights = np.column_stack([1 - last.sum(1), last])
        image = np.ones((side, side, 3), np.float32)
        image[hit] = shade(surface, found["primitive_ids"][hit].astype(np.int64), weights)
        images.append(image.reshape(PIXELS, FINER, PIXELS, FINER, 3).mean((1, 3)))
    return torch.from_numpy(np.stack(images))


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    """Mean over the views, dB."""
    return float((-10 * ((a - b) ** 2).mean((1, 2, 3)).log10()).mean())


def main() -> None:
    """Print a row for each mesh."""
    gaussians = read_gaussians(sys.argv[1]) if len(sys.argv) > 1 else striped_ball()
    gaussians = gaussians.in_unit(*unit_frame(gaussians))
    cameras = sphere_cameras(VIEWS, 0.9, PIXELS)
    seen = render(gaussians, cameras)
    gt, first = seen.rgb + 1 - seen.alpha, None
    print("| mesh | faces | to the Gaussians, dB | to the first mesh, dB |")
    print("| --- | --- | --- | --- |", flush=True)
    for name, voxels, most, side in KINDS:
        options = SurfaceOptions(voxels=voxels, faces=most, colors=not side)
        surface = extract_surface(gaussians, options, side)
        image = flat(surface, cameras)
        first = image if first is None else first
        own = "" if first is image else f"{psnr(image, first):.2f}"
        faces = f"{len(surface.faces):,}"
        print(f"| {name} | {faces} | {psnr(image, gt):.2f} | {own} |", flush=True)


if __name__ == "__main__":
    main()
