"""Baselines without a model, which a single-view model has to beat.

A baseline maps a ``GroundTruth`` to images of all its views. It uses only the input view and the
cameras; the retrieval uses the training split too.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, grid_sample

from gamba_warp.batch import progress_bar
from gamba_warp.cameras import from_opengl, relative_to_reference
from gamba_warp.conventions import WHITE
from gamba_warp.data.dataset import ViewDataset
from gamba_warp.errors import UserError
from gamba_warp.formats.catalogue import find_meshes
from gamba_warp.formats.meshes import default_up, load_mesh
from gamba_warp.surfaces.extract import Surface
from gamba_warp.surfaces.files import save_mesh

from .compare import GroundTruth, Shown, shown

Baseline = Callable[[GroundTruth], Shown | None]

THUMBNAIL = 32  # pixels per side, for the retrieval
_CHUNK = 512  # thumbnails compared at once by colour
MEANING = {
    "background": "an empty image for every view",
    "input_copy": "the input image for every view",
    "billboard": "the input image, with its alpha, as a plane through the object's centre "
    "parallel to the input's image plane, seen from both sides; bilinear at pixel centres",
    "retrieval": f"the training view nearest to the input among all views of all other training "
    f"objects; distance: 1 - IoU of the alphas (sum of minima over sum of maxima) + mean absolute "
    f"colour difference weighted with the smaller alpha, at {THUMBNAIL}x{THUMBNAIL} pixels. In "
    f"place of the input it shows the view found, in place of a novel view the true view of that "
    f"object whose camera, relative to the view found, is turned least against the novel one's, "
    f"relative to the input",
}


def background(gt: GroundTruth) -> Shown:
    """Return an empty image for every view."""
    white = torch.full_like(gt.rgb[:1], WHITE).expand_as(gt.rgb)
    return Shown(white, torch.zeros_like(gt.images[..., 3]))


def input_copy(gt: GroundTruth) -> Shown:
    """Return the input image for every view."""
    alpha = gt.images[..., 3]
    return Shown(gt.rgb[:1].expand_as(gt.rgb), alpha[:1].expand_as(alpha))


def billboard(gt: GroundTruth) -> Shown:
    """Render the input image as a plane through the object's centre, parallel to its image plane.

    The centre is the origin and the input camera's axes are the world's, so the plane is
    z = 0. The intersection of each pixel's ray is projected into the input camera, which is exact.
    From behind the image is mirrored; edge-on the plane is invisible.
    """
    viewmats, Ks = gt.cameras.viewmats.double(), gt.cameras.Ks.double()
    count, height, width = gt.mask.shape
    x = torch.arange(width, device=Ks.device, dtype=Ks.dtype) + 0.5
    y = torch.arange(height, device=Ks.device, dtype=Ks.dtype) + 0.5
    pixels = torch.stack([*torch.meshgrid(x, y, indexing="xy"), x.new_ones(height, width)], -1)
    rotations = viewmats[:, :3, :3]
    # Row vectors: d_world = p K⁻ᵀ R, of depth 1; the camera's centre is -t R.
    rays = pixels.reshape(-1, 3) @ torch.linalg.inv(Ks).mT @ rotations
    centres = -viewmats[:, None, :3, 3] @ rotations
    depth = -centres[..., 2] / rays[..., 2]
    points = centres + depth[..., None] * rays
    projected = (points + viewmats[0, :3, 3]) @ Ks[0].mT  # input camera, without rotation
    size = projected.new_tensor([width, height])
    grid = projected[..., :2] / projected[..., 2:] / size * 2 - 1
    # Within 1e-5 of the plane's direction a ray sees less than a pixel, or rounding errors.
    hit = (depth > 0) & (rays[..., 2].abs() > 1e-5) & grid.isfinite().all(-1)
    hit &= projected[..., 2] > 0
    grid = torch.where(hit[..., None], grid, 2.0)  # outside the image
    rgba = gt.images[0].double()
    premultiplied = torch.cat([rgba[..., :3] * rgba[..., 3:], rgba[..., 3:]], -1)
    sampled = grid_sample(
        premultiplied.permute(2, 0, 1).expand(count, -1, -1, -1),
        grid.view(count, height, width, 2),
        align_corners=False,
    ).permute(0, 2, 3, 1)
    rgb, alpha = sampled[..., :3], sampled[..., 3:]
    return Shown((rgb + WHITE * (1 - alpha)).to(gt.rgb), alpha[..., 0].to(gt.rgb))


class NearestView(NamedTuple):
    """A training view, nearest to a query image.

    Attributes:
        uid: its object.
        view: its index.
        distance: from the query, in [0, 2]; see ``MEANING``.
    """

    uid: str
    view: int
    distance: float


class Retrieval:
    """Nearest training view of the input, with its object's views from the nearest cameras.

    Attributes:
        failures: reasons by uid, of training objects that cannot be read.
        found: nearest training views by uid of the query object.
    """

    def __init__(self, training: ViewDataset) -> None:
        """Read every view of every training object once, as thumbnails.

        Raises:
            UserError: none can be read.
        """
        self.training = training
        self.failures: dict[str, str] = {}
        self.found: dict[str, NearestView] = {}
        self._sources: list[tuple[str, int]] = []  # (uid, view) of each thumbnail
        quantized = []
        for uid in progress_bar(training.uids, desc="retrieval index", unit="object"):
            try:
                small = thumbnails(training.load(uid, size=THUMBNAIL).images)
            except UserError as error:
                self.failures[uid] = str(error)
                continue
            quantized.append((255 * small).round().byte())
            self._sources += [(uid, view) for view in range(len(small))]
        if not quantized:
            raise UserError("no training object can be read")
        self._thumbnails = torch.cat(quantized)  # [M, THUMBNAIL², 4]; 8 bits: 4 kB a view
        self._alphas = self._thumbnails[..., 3].float() / 255
        self._areas = self._alphas.sum(1)

    def nearest(self, image: Tensor, uid: str) -> NearestView | None:
        """Find the nearest view of an object other than ``uid``.

        Args:
            image: ``[H, W, 4]`` straight RGBA in [0, 1].
            uid: the object shown.

        Returns:
            The view; None without another object.
        """
        query = thumbnails(image[None])[0]
        both = torch.minimum(self._alphas, query[:, 3]).sum(1)
        either = (self._areas + query[:, 3].sum() - both).clamp(min=1e-6)
        shape = 1 - both / either  # 1 if both are empty
        shape[torch.tensor([source[0] == uid for source in self._sources])] = torch.inf
        best, at = torch.inf, -1
        # The colour term is never negative: sorted by the shape term, most views can be skipped.
        for part in shape.argsort().split(_CHUNK):
            if shape[part[0]] >= best:
                break
            rgba = self._thumbnails[part].float() / 255
            common = torch.minimum(rgba[..., 3], query[:, 3])
            apart = (rgba[..., :3] - query[:, :3]).abs().mean(-1)
            color = (common * apart).sum(1) / common.sum(1).clamp(min=1e-6)
            value, row = (shape[part] + color).min(0)
            if value < best:
                best, at = float(value), int(part[row])
        return None if at < 0 else NearestView(*self._sources[at], best)

    def __call__(self, gt: GroundTruth) -> Shown | None:
        """Return the images; None without another object. Raises UserError for a bad image."""
        nearest = self.nearest(gt.images[0].cpu(), gt.uid)
        if nearest is None:
            return None
        self.found[gt.uid] = nearest
        uid, view, _ = nearest
        poses = torch.from_numpy(self.training.files(uid).camera_to_world)
        viewmats = from_opengl(poses).double()
        relative, _ = relative_to_reference(viewmats, viewmats[view])
        rotations = gt.cameras.viewmats[:, :3, :3].cpu().double()
        # trace(R_a R_bᵀ) = 1 + 2 cos(angle between them)
        chosen = torch.einsum("vij,wij->vw", rotations, relative[:, :3, :3]).argmax(1)
        chosen[0] = view
        needed, rows = chosen.unique(return_inverse=True)
        images = self.training.load(uid, needed.tolist(), gt.rgb.shape[1]).images
        if images.shape[1:3] != gt.rgb.shape[1:3]:
            raise UserError(f"{uid}: its images have a different size")
        return shown(images[rows].to(gt.images.device))


def thumbnails(images: Tensor) -> Tensor:
    """Return area averages ``[V, THUMBNAIL², 4]`` of straight RGBA ``[V, H, W, 4]``."""
    premultiplied = torch.cat([images[..., :3] * images[..., 3:], images[..., 3:]], -1)
    small = adaptive_avg_pool2d(premultiplied.permute(0, 3, 1, 2), THUMBNAIL).flatten(2).mT
    return torch.cat([small[..., :3] / small[..., 3:].clamp(min=1e-6), small[..., 3:]], -1)


class TrainingMeshes:
    """Source meshes of a dataset's views, by uid.

    The dataset states the placement of a file's points in the world of its views. Without a
    placement the file is rotated as in ``catalogue.json``, turned to z-up by its suffix, its
    bounding box is centred, and its longest side becomes 1.
    """

    def __init__(self, folder: Path, training: ViewDataset) -> None:
        """Find the files, without reading them.

        Raises:
            UserError: the folder is missing, has no training object's mesh, or a bad catalogue.
        """
        self.training = training
        self.meshes = {mesh.uid: mesh for mesh in find_meshes(folder)}
        if not self.meshes.keys() & set(training.uids):
            raise UserError(f"{folder}: has no mesh of any of the {len(training)} training objects")

    def place(self, found: NearestView, distance: float) -> Surface:
        """Place an object's mesh so that its nearest view coincides with the input image.

        Args:
            found: the object and its nearest view.
            distance: from the input camera to the object's centre, in units of the result.

        Returns:
            Triangles in the input camera's world: its axes, the object's centre as the origin.

        Raises:
            UserError: the mesh is missing or not the one that was rendered, or it or the view
                cannot be read.
        """
        if found.uid not in self.meshes:
            raise UserError(f"no mesh of the training object {found.uid}")
        mesh = self.meshes[found.uid]
        loaded, placement = load_mesh(mesh.path), self.training.files(found.uid).placement
        if placement is None:
            vertices = loaded.normalized(default_up(mesh.path), mesh.rotation)[0].vertices
        elif placement.fits(loaded.vertices):
            vertices = placement.points(loaded.vertices)
        else:
            raise UserError(f"{mesh.path}: not the mesh that DATA's {found.uid} was rendered from")
        viewmat = self.training.load(found.uid, views=[found.view]).cameras.viewmats[0].double()
        _, scale = relative_to_reference(viewmat[None], viewmat, distance)
        return Surface(scale.item() * vertices @ viewmat[:3, :3].numpy().T, loaded.faces)

    def save(self, path: Path, found: NearestView, distance: float) -> None:
        """Write the result of ``place`` as a ``.ply``."""
        surface = self.place(found, distance)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_mesh(path, surface, "opencv")
