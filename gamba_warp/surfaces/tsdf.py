"""Rendered depth of many views, fused in a truncated signed distance field by Open3D."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..cameras import Cameras, fibonacci_sphere, intrinsics
from ..errors import UserError
from ..formats.parts import merged
from ..gaussians import Gaussians
from ..kernels.rasterize import depth_quantile
from ..render import render
from ..versions import import_open3d
from .options import SurfaceOptions

CLEAR = 1e5  # depth of a ray that misses
_CHUNK_PIXELS = 1 << 20  # pixels rendered in one launch


@dataclass
class Views:
    """Images and depth maps of cameras around an object, on the CPU.

    Attributes:
        cameras: ``[V]``.
        depth: ``[V, H, W]`` float32, object units along the camera's axis; 0 is unknown, and
            ``CLEAR`` where a ray misses.
        rgb: ``[V, H, W, 3]`` float32 in [0, 1], not multiplied by alpha; 0 without a depth.
    """

    cameras: Cameras
    depth: Tensor
    rgb: Tensor

    def hit(self) -> Tensor:
        """Return the pixels that see a surface, ``[V, H, W]`` bool."""
        return (self.depth > 0) & (self.depth < CLEAR)


def sphere_cameras(count: int, radius: float, pixels: int) -> Cameras:
    """Return cameras around the origin, each with the whole sphere of ``radius`` in view."""
    forward = -fibonacci_sphere(count)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    distance = 3.0 * radius
    viewmats = np.tile(np.eye(4), (count, 1, 1))
    viewmats[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    viewmats[:, 2, 3] = distance
    fov = 2 * np.degrees(np.arcsin(radius / distance))
    K = intrinsics(pixels, pixels, float(fov)).expand(count, 3, 3)
    return Cameras(torch.from_numpy(viewmats).float(), K, pixels, pixels)


@torch.no_grad()
def look_around(gaussians: Gaussians, options: SurfaceOptions) -> Views:
    """Render an object from all around, on a Fibonacci sphere.

    On slanted surfaces the depth belongs to a Gaussian's near edge, which would enlarge the object.
    So pixels of a surface steeper than ``max_slope`` have no depth.

    Args:
        gaussians: one object, about the origin, on the device that renders.
        options: with the number and side of the images, and the thresholds of depth.

    Raises:
        UserError: no pixel of any view is covered.
    """
    reach = gaussians.means.norm(dim=-1) + 2 * gaussians.scales.amax(-1)
    # Quantile, because a single far Gaussian would shrink all others in the images.
    radius = float(torch.quantile(reach.cpu()[:: 1 + gaussians.num // 2**20], 0.999)) * 1.05
    count = options.views
    cameras = sphere_cameras(count, radius, options.pixels)
    chunk = max(1, _CHUNK_PIXELS // options.pixels**2)
    depth, rgb = [], []
    for start in range(0, count, chunk):
        seen = render(gaussians, cameras[start : start + chunk].to(gaussians.means.device))
        part = depth_quantile(seen.meta, options.transmittance)
        covered = (seen.alpha > options.min_alpha) & (part > 0)
        part = torch.where(covered, part, 0.0)
        depth.append(torch.where(seen.alpha < options.clear_alpha, CLEAR, part)[..., 0].cpu())
        rgb.append(torch.where(covered, seen.rgb / seen.alpha, 0.0).cpu())
    views = Views(cameras, torch.cat(depth), torch.cat(rgb))
    for k in range(count):
        views.depth[k][_slope(views, k) > options.max_slope] = 0.0
    if not views.hit().any():
        raise UserError(f"no pixel of {count} views has alpha above {options.min_alpha}")
    return views


def _slope(views: Views, k: int) -> Tensor:
    """Return the slope ``[H, W]`` of the plane through a pixel's 5 x 5 neighbours in view ``k``.

    The plane is a least-squares fit to the neighbours with a depth, from their moments. Pixels
    without a plane have slope 0.
    """
    depth = views.depth[k]
    hit = ((depth > 0) & (depth < CLEAR)).float()  # one view at a time, to save memory
    depth = depth * hit
    step = torch.arange(-2.0, 3.0).expand(5, 5)
    x, y, one = step, step.T, torch.ones(5, 5)
    kernels = torch.stack([one, x, y, x * x, y * y, x * y])[:, None]
    kernels = torch.cat([kernels, kernels[:3]])
    inputs = torch.stack([hit, depth])[None]
    hits, depths = inputs[:, :1], inputs[:, 1:]
    count, sx, sy, sxx, syy, sxy = torch.conv2d(hits, kernels[:6], padding=2)[0]
    sz, sxz, syz = torch.conv2d(depths, kernels[6:], padding=2)[0]
    count = count.clamp_min(1)
    sxx, syy, sxy = sxx - sx * sx / count, syy - sy * sy / count, sxy - sx * sy / count
    sxz, syz = sxz - sx * sz / count, syz - sy * sz / count
    # A single row of pixels defines no plane.
    over = torch.where(sxx * syy - sxy * sxy > 1e-3, 1 / (sxx * syy - sxy * sxy), 0.0)
    dx, dy = (syy * sxz - sxy * syz) * over, (sxx * syz - sxy * sxz) * over
    width = depth / views.cameras.Ks[k, 0, 0]  # width of a pixel at the surface
    return torch.where(hit > 0, torch.hypot(dx, dy) / width.clamp_min(1e-9), 0.0)


def fuse(
    views: Views, voxels: int, truncation: float, support: float
) -> tuple[np.ndarray, np.ndarray]:
    """Fuse depth maps: the zero level of the mean signed distance of each voxel over the views.

    Args:
        views: to fuse.
        voxels: number of voxels per unit.
        truncation: largest distance behind a surface, in voxels.
        support: voxels seen by fewer views are left out.

    Returns:
        Vertices ``[V, 3]`` float64 and faces ``[F, 3]`` int64, outside in front.

    Raises:
        UserError: the surface is empty.
    """
    o3d = import_open3d()
    grid = o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight"),
        attr_dtypes=(o3d.core.float32, o3d.core.float32),
        attr_channels=((1,), (1,)),
        voxel_size=1.0 / voxels,
        block_resolution=8,
        block_count=20000,
    )
    K = o3d.core.Tensor(views.cameras.Ks[0].double().numpy())
    poses = [o3d.core.Tensor(viewmat.double().numpy()) for viewmat in views.cameras.viewmats]
    reach = {"depth_scale": 1.0, "depth_max": 2 * CLEAR, "trunc_voxel_multiplier": truncation}
    for depth, hit, pose in zip(views.depth, views.hit(), poses, strict=True):
        if hit.any():
            near = _image(torch.where(hit, depth, 0.0))
            # It samples every fourth pixel, and raises if none of these has a depth.
            with contextlib.suppress(RuntimeError):
                blocks = grid.compute_unique_block_coordinates(near, K, pose, **reach)
                grid.hashmap().activate(blocks)
    if not grid.hashmap().size():
        raise UserError("the fused depth has no surface")
    # Every view is fused into every block, because views through empty space clear it.
    blocks = grid.hashmap().key_tensor()
    blocks = blocks[grid.hashmap().active_buf_indices().to(o3d.core.int64)]
    for depth, pose in zip(views.depth, poses):
        grid.integrate(blocks, _image(depth), K, pose, **reach)
    mesh = grid.extract_triangle_mesh(weight_threshold=support)
    if "indices" not in mesh.triangle or len(mesh.triangle["indices"]) == 0:
        raise UserError("the fused depth has no surface")
    positions, indices = mesh.vertex["positions"], mesh.triangle["indices"]
    return _in_order(positions.numpy().astype(np.float64), indices.numpy().astype(np.int64))


def _in_order(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sort vertices and faces, whose order varies with Open3D's threads."""
    vertices, index = merged(vertices)
    faces = index[faces]
    first = faces.argmin(1)[:, None] + np.arange(3)
    faces = np.take_along_axis(faces, first % 3, 1)
    return vertices, faces[np.lexsort(faces.T[::-1])]


def _image(depth: Tensor):
    o3d = import_open3d()
    return o3d.t.geometry.Image(o3d.core.Tensor(depth.numpy()[..., None]))
