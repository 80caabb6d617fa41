"""Reading and writing images rendered by any method, matched with the true views.

Format (for users in docs/evaluate.md): one folder for each object, named as in the dataset,
with images,

- with a ``transforms.json``: an image belongs to the true view with the same camera;
- without one: an image belongs to the true view whose file has the same stem, or, if no stem
  matches, to the view of that number.

Images are not moved, rotated or cropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from gamba_warp.conventions import WHITE, over_another
from gamba_warp.data.dataset import ViewDataset
from gamba_warp.data.layouts import IMAGES, LAYOUTS, ObjectFiles
from gamba_warp.errors import UserError
from gamba_warp.files import sha256_of_all, visible
from gamba_warp.images import load_rgba8, open_image, save_image

from .compare import GroundTruth, Shown, shown

TRANSFORMS = "transforms.json"
CAMERA = 1e-3  # radians; fraction of the camera's distance; fraction of the image's side
FLAT = 8 / 255  # tolerance of a white background, and of a flat one
_MAX_NAMED = 5  # views named in a message
MEANING = (
    f"files of 8 bits; an image at a camera of its own belongs to the true view whose camera is "
    f"turned by at most {CAMERA:g} radians against it, moved by at most {CAMERA:g} of its distance "
    f"and has focal lengths and centre within {CAMERA:g} of the image's side; any other one to "
    f"the view of its name or number; alpha of the file, none where all images of an object are "
    f"opaque"
)


@dataclass
class Images:
    """Images under test of one object.

    Attributes:
        shown: the images.
        has_input: True if view 0 has an image; else it is white.
        record: details of the matching, for the object's record.
    """

    shown: Shown
    has_input: bool = True
    record: dict[str, Any] = field(default_factory=dict)


class ImagePredictions:
    """A folder with a folder of images for each object.

    Attributes:
        distance: of the input camera; only the unit of the report's cameras.
        source: kind, name, and the SHA-256 of the names and SHA-256s of all images and cameras.
    """

    def __init__(self, folder: Path, distance: float, device: str, resize: bool = False) -> None:
        """Open the folder, without decoding images.

        Args:
            folder: the folder.
            distance: as the attribute.
            device: torch device of the results.
            resize: resize images to the size of the true ones.
        """
        self.folder, self.distance, self.device, self.resize = folder, distance, device, resize
        files = (p for p in visible(folder, "*") if _is_image(p) or p.name == TRANSFORMS)
        content = sha256_of_all(files, folder)
        self.source = {"kind": "images", "path": folder.name, "sha256": content}

    def check(self, uids: Sequence[str]) -> None:
        """Raise UserError if no object has a folder, before any work."""
        if not any((self.folder / uid).is_dir() for uid in uids):
            raise UserError(
                f"{self.folder}: has no folder of images for any of the {len(uids)} objects; "
                f"the first would be {self.folder / uids[0]}"
            )

    def images(self, dataset: ViewDataset, gt: GroundTruth) -> Images:
        """Read the images of one object.

        Args:
            dataset: that the object belongs to.
            gt: the views to compare with; all but the input (the first) must have an image.

        Raises:
            UserError: the folder is missing, a view lacks its image or has two, or an image
                cannot be read, has another size, or a background that is not white.
        """
        folder = self.folder / gt.uid
        if not folder.is_dir():
            raise UserError(f"{folder}: no such folder")
        files, views = dataset.files(gt.uid), gt.views
        if (folder / TRANSFORMS).is_file():
            by, paths, count = "camera", *_match_by_camera(folder, files, views)
        else:
            by, paths, count = _match_by_name(folder, files, views)
        lacking = [view for view in views[1:] if view not in paths]
        if lacking or not paths:
            raise UserError(_missing_message(folder, lacking or views, views, by))
        rgba = torch.zeros(len(views), *gt.rgb.shape[1:3], 4)
        there = [view in paths for view in views]
        alphas, resized = {}, 0
        for row, view in enumerate(views):
            if view in paths:
                with open_image(paths[view]) as file:
                    alphas[view] = file.has_transparency_data
                image = load_rgba8(paths[view])
                fitted = self._resized(paths[view], image, gt, files, view)
                resized += fitted is not image
                rgba[row] = torch.from_numpy(fitted.astype(np.float32) / 255)
        if len(set(alphas.values())) > 1:
            odd = next(view for view, alpha in alphas.items() if not alpha)
            raise UserError(f"{paths[odd]}: has no alpha, but others of the object have")
        opaque = bool((rgba[there, ..., 3] == 1).all())
        if opaque:
            _check_white(folder, rgba[..., :3], gt, there)
        unused = count - len(paths)
        record = {"matched_by": by, "unused": unused, "resized": resized, "alpha": not opaque}
        images = shown(rgba.to(self.device))
        if opaque:
            images = Shown(images.rgb, None)
        return Images(images, there[0], record)

    def _resized(
        self, path: Path, image: np.ndarray, gt: GroundTruth, files: ObjectFiles, view: int
    ) -> np.ndarray:
        """Return the image at the compared size, resized like the true image if needed."""
        (height, width), (tall, wide) = image.shape[:2], gt.rgb.shape[1:3]
        if (width, height) == (wide, tall):
            return image
        true, size = files.images[view], files.sizes[view]  # a pack may not state the size
        if size is None and isinstance(true, Path):
            with open_image(true) as file:
                size = file.size
        if not self.resize and (width, height) != size:
            raise UserError(
                f"{path}: is {width}x{height}, the images compared are {wide}x{tall}; "
                "render it at this size, or give --resize-images"
            )
        if abs(width * tall - height * wide) > max(width, height) / 2:
            raise UserError(f"{path}: {width}x{height} has another aspect ratio than {wide}x{tall}")
        # Like the dataset: PIL premultiplies RGBA, and its box filter is the area average.
        kind = Image.Resampling.BOX if tall < height else Image.Resampling.BILINEAR
        return np.asarray(Image.fromarray(image).resize((wide, tall), kind))


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in IMAGES


def holds_images(folder: Path) -> bool:
    """True if a sub-folder holds an image."""
    return any(_is_image(p) and p.parent != folder for p in visible(folder, "*"))


def _match_by_camera(
    folder: Path, files: ObjectFiles, views: Sequence[int]
) -> tuple[dict[int, Path], int]:
    """Match images by their cameras; return them by view, and their number.

    Raises:
        UserError: the cameras cannot be read, or a view matches two or none; the message gives the
            distance of the nearest.
    """
    listed = LAYOUTS["transforms"][1](folder)
    intrinsics = np.stack([_intrinsics(listed, i) for i in range(len(listed.images))])
    paths, far = {}, {}
    for view in views:
        # The Frobenius norm of R - R' is sqrt(8) sin(angle / 2), accurate for small angles too.
        poses, pose = listed.camera_to_world, files.camera_to_world[view]
        chord = np.linalg.norm(poses[:, :3, :3] - pose[:3, :3], axis=(1, 2)) / np.sqrt(8)
        angle = 2 * np.arcsin(np.clip(chord, 0, 1))
        shift = np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1) / np.linalg.norm(pose[:3, 3])
        # radians; distances of the true camera from the origin; sides of the image
        off = np.stack([angle, shift, np.abs(intrinsics - _intrinsics(files, view)).max(1)], 1)
        near = np.flatnonzero((off <= CAMERA).all(1))
        if len(near) > 1:
            names = " and ".join(listed.images[i].name for i in near[:2])
            raise UserError(f"{folder}: {names} both have the camera of view {view}")
        if len(near):
            paths[view] = listed.images[near[0]]
        else:
            far[view] = off[off[:, :2].sum(1).argmin()]
    lacking = [view for view in views[1:] if view in far]
    if lacking:
        turn, move, difference = far[lacking[0]]
        raise UserError(
            f"{_missing_message(folder, lacking, views, 'camera')}; the nearest to view "
            f"{lacking[0]} is rotated by {np.degrees(turn):.3g} degrees, "
            f"moved by {move:.3g} of the distance, and "
            f"its intrinsics differ by {difference:.3g} of the image"
        )
    return paths, len(listed.images)


def _intrinsics(files: ObjectFiles, view: int) -> np.ndarray:
    """Return focal lengths and centre in units of the image's sides, ``[4]``."""
    size = np.array(files.sizes[view] or (1, 1), np.float64)
    K = files.Ks[view]
    return np.concatenate([np.diag(K)[:2] / size, K[:2, 2] / size])


def _match_by_name(
    folder: Path, files: ObjectFiles, views: Sequence[int]
) -> tuple[str, dict[int, Path], int]:
    """Match images by name or number; return which, the images by view, and their number.

    Raises:
        UserError: two images match one view.
    """
    by_stem: dict[str, Path] = {}
    for path in sorted(filter(_is_image, folder.iterdir())):
        if not path.name.startswith(".") and by_stem.setdefault(path.stem, path) is not path:
            raise UserError(f"{path}: {by_stem[path.stem].name} has the same name; keep one")
    stems = [path.stem for path in files.images]
    if len(set(stems)) == len(stems) and set(stems) & set(by_stem):
        paths = {view: by_stem[stems[view]] for view in views if stems[view] in by_stem}
        return "name", paths, len(by_stem)
    by_number: dict[int, Path] = {}
    for stem, path in by_stem.items():
        if stem.isascii() and stem.isdigit() and by_number.setdefault(int(stem), path) is not path:
            raise UserError(f"{path}: {by_number[int(stem)].name} has the same number; keep one")
    return "number", {view: by_number[view] for view in views if view in by_number}, len(by_stem)


def _missing_message(folder: Path, lacking: Sequence[int], views: Sequence[int], by: str) -> str:
    some = ", ".join(map(str, lacking[:_MAX_NAMED])) + (
        ", ..." if len(lacking) > _MAX_NAMED else ""
    )
    word = {"camera": "at the camera", "name": "of the name", "number": "of the number"}[by]
    plural = "" if len(lacking) == 1 else "s"
    return (
        f"{folder}: no image {word} of view{plural} {some} "
        f"({len(lacking)} of the {len(views)} compared)"
    )


def _check_white(folder: Path, rgb: Tensor, gt: GroundTruth, there: list[bool]) -> None:
    """Refuse opaque images on a flat background that is not white.

    Fog is not flat, so it still counts against the method.

    Raises:
        UserError: over half of the empty pixels of the true images have one such colour.
    """
    empty = (gt.images[..., 3] == 0).cpu() & torch.tensor(there)[:, None, None]
    pixels = rgb[empty]
    if not len(pixels):
        return
    colour = pixels.median(0).values
    flat = ((pixels - colour).abs().amax(1) <= FLAT).float().mean().item()
    if flat > 0.5 and (colour - WHITE).abs().amax() > FLAT:
        named = ", ".join(str(round(255 * c)) for c in colour.tolist())
        raise UserError(
            f"{folder}: its images have no alpha and the background rgb({named}); "
            "render them with alpha, or on white"
        )


def save_images(folder: Path, files: ObjectFiles, views: Sequence[int], images: Shown) -> None:
    """Write images as ``ImagePredictions`` reads them, named like the true files.

    Args:
        folder: of one object; made if need be.
        files: of the true views, which give the names; numbers if two have the same stem.
        views: numbers of the views.
        images: with alpha.

    Raises:
        UserError: a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    stems = [path.stem for path in files.images]
    names = stems if len(set(stems)) == len(stems) else [str(i) for i in range(len(stems))]
    assert images.alpha is not None
    alpha = images.alpha[..., None].cpu()
    premultiplied = over_another(images.rgb.cpu(), alpha, WHITE, 0.0)
    straight = torch.where(alpha > 0, premultiplied / alpha.clamp(min=1e-6), 1.0)
    for view, image in zip(views, torch.cat([straight.clamp(0, 1), alpha], -1)):
        save_image(folder / f"{names[view]}.png", image.numpy())
