"""Pictures that some method rendered, matched with the true views; and such folders of our own.

The contract (docs/compare-methods.md has it in the words of a user): a folder with one folder for
each object, of the names that the dataset has. In it lie pictures,

- with a ``transforms.json``: a picture belongs to the true view at whose camera it was taken;
- without one: a picture belongs to the true view whose file has the same name without suffix, or,
  where not one name is that of a true file, to the view of that number.

No picture is moved, turned or cropped.
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
from gamba_warp.data.layouts import LAYOUTS, PICTURES, ObjectFiles
from gamba_warp.errors import UserError
from gamba_warp.files import sha256_of_all, visible
from gamba_warp.images import load_rgba8, open_picture, save_image

from .compare import Shown, Truth, shown

TRANSFORMS = "transforms.json"
CAMERA = 1e-3  # radians; share of the camera's distance; share of the picture's side
FLAT = 8 / 255  # how far a background may be from white, and from flat
_NAMED = 5  # views that a message names
MEANING = (
    f"files of 8 bits; a picture at a camera of its own belongs to the true view whose camera is "
    f"turned by at most {CAMERA:g} radians against it, moved by at most {CAMERA:g} of its distance "
    f"and has focal lengths and centre within {CAMERA:g} of the picture's side; any other one to "
    f"the view of its name or number; alpha of the file, none where all pictures of an object are "
    f"opaque"
)


@dataclass
class Pictures:
    """What is shown in place of the views of an object.

    Attributes:
        shown: the pictures.
        has_input: whether there is a picture of view 0; where not, it is white.
        record: how they were found, for the object's record.
    """

    shown: Shown
    has_input: bool = True
    record: dict[str, Any] = field(default_factory=dict)


class PicturePredictions:
    """A folder with a folder of pictures for each object.

    Attributes:
        distance: of the input camera; it is only the unit in which a report states cameras.
        source: kind, name, and the SHA-256 of the names and SHA-256s of all pictures and cameras.
    """

    def __init__(self, folder: Path, distance: float, device: str, resize: bool = False) -> None:
        """Opens the folder; no picture is decoded yet.

        Args:
            folder: the folder.
            distance: as the attribute.
            device: torch device of the results.
            resize: whether pictures of another size than those compared are resized to it.
        """
        self.folder, self.distance, self.device, self.resize = folder, distance, device, resize
        files = (p for p in visible(folder, "*") if _is_picture(p) or p.name == TRANSFORMS)
        content = sha256_of_all(files, folder)
        self.source = {"kind": "pictures", "path": folder.name, "sha256": content}

    def check(self, uids: Sequence[str]) -> None:
        """Raises UserError where not one of the objects has a folder, so that nothing begins."""
        if not any((self.folder / uid).is_dir() for uid in uids):
            raise UserError(
                f"{self.folder}: has a folder of pictures for none of the {len(uids)} objects; "
                f"the first would be {self.folder / uids[0]}"
            )

    def pictures(self, dataset: ViewDataset, truth: Truth) -> Pictures:
        """Reads the pictures of one object.

        Args:
            dataset: that the object belongs to.
            truth: the views to compare with; all but the input (the first) must have a picture.

        Raises:
            UserError: there is no folder, a view lacks its picture or has two, a picture cannot be
                read, is of another size, or has a background that is not white.
        """
        folder = self.folder / truth.uid
        if not folder.is_dir():
            raise UserError(f"{folder}: no such folder")
        files, views = dataset.files(truth.uid), truth.views
        if (folder / TRANSFORMS).is_file():
            by, found, given = "camera", *_by_camera(folder, files, views)
        else:
            by, found, given = _by_name(folder, files, views)
        lacking = [view for view in views[1:] if view not in found]
        if lacking or not found:
            raise UserError(_lacks(folder, lacking or views, views, by))
        rgba = torch.zeros(len(views), *truth.rgb.shape[1:3], 4)
        there = [view in found for view in views]
        alphas, resized = {}, 0
        for row, view in enumerate(views):
            if view in found:
                with open_picture(found[view]) as image:
                    alphas[view] = image.has_transparency_data
                picture = load_rgba8(found[view])
                fitted = self._fitted(found[view], picture, truth, files, view)
                resized += fitted is not picture
                rgba[row] = torch.from_numpy(fitted.astype(np.float32) / 255)
        if len(set(alphas.values())) > 1:
            odd = next(view for view, alpha in alphas.items() if not alpha)
            raise UserError(f"{found[odd]}: has no alpha, and others of the object have")
        opaque = bool((rgba[there, ..., 3] == 1).all())
        if opaque:
            _check_white(folder, rgba[..., :3], truth, there)
        unused = given - len(found)
        record = {"matched_by": by, "unused": unused, "resized": resized, "alpha": not opaque}
        pictures = shown(rgba.to(self.device))
        if opaque:
            pictures = Shown(pictures.rgb, None)
        return Pictures(pictures, there[0], record)

    def _fitted(
        self, path: Path, picture: np.ndarray, truth: Truth, files: ObjectFiles, view: int
    ) -> np.ndarray:
        """The picture at the size compared: as it is, or resized as the true picture is."""
        (height, width), (tall, wide) = picture.shape[:2], truth.rgb.shape[1:3]
        if (width, height) == (wide, tall):
            return picture
        true, size = files.images[view], files.sizes[view]  # a pack may not say the size
        if size is None and isinstance(true, Path):
            with open_picture(true) as image:
                size = image.size
        if not self.resize and (width, height) != size:
            raise UserError(
                f"{path}: is {width}x{height}, the pictures compared are {wide}x{tall}; "
                "render it at this size, or give --resize-pictures"
            )
        if abs(width * tall - height * wide) > max(width, height) / 2:
            raise UserError(f"{path}: {width}x{height} has not the shape of {wide}x{tall}")
        # As the dataset resizes: PIL premultiplies RGBA, and its box filter is the area average.
        kind = Image.Resampling.BOX if tall < height else Image.Resampling.BILINEAR
        return np.asarray(Image.fromarray(picture).resize((wide, tall), kind))


def _is_picture(path: Path) -> bool:
    return path.suffix.lower() in PICTURES


def holds_pictures(folder: Path) -> bool:
    """Whether there is any picture in the folders of a folder."""
    return any(_is_picture(p) and p.parent != folder for p in visible(folder, "*"))


def _by_camera(
    folder: Path, files: ObjectFiles, views: Sequence[int]
) -> tuple[dict[int, Path], int]:
    """Pictures by view, of a folder with cameras; and how many pictures there are.

    Raises:
        UserError: the cameras cannot be read, two are at the camera of one view, or none is at
            that of a view; the message says how far the nearest is away.
    """
    given = LAYOUTS["transforms"][1](folder)
    lenses = np.stack([_lens(given, i) for i in range(len(given.images))])
    found, far = {}, {}
    for view in views:
        # The Frobenius norm of R - R' is sqrt(8) sin(angle / 2): exact for small angles too.
        poses, pose = given.camera_to_world, files.camera_to_world[view]
        chord = np.linalg.norm(poses[:, :3, :3] - pose[:3, :3], axis=(1, 2)) / np.sqrt(8)
        angle = 2 * np.arcsin(np.clip(chord, 0, 1))
        way = np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1) / np.linalg.norm(pose[:3, 3])
        # radians; distances of the true camera from the origin; sides of the picture
        off = np.stack([angle, way, np.abs(lenses - _lens(files, view)).max(1)], 1)
        near = np.flatnonzero((off <= CAMERA).all(1))
        if len(near) > 1:
            names = " and ".join(given.images[i].name for i in near[:2])
            raise UserError(f"{folder}: {names} are both at the camera of view {view}")
        if len(near):
            found[view] = given.images[near[0]]
        else:
            far[view] = off[off[:, :2].sum(1).argmin()]
    lacking = [view for view in views[1:] if view in far]
    if lacking:
        turn, move, lens = far[lacking[0]]
        raise UserError(
            f"{_lacks(folder, lacking, views, 'camera')}; the nearest to view {lacking[0]} is "
            f"turned by {np.degrees(turn):.3g} degrees, moved by {move:.3g} of the distance, and "
            f"its lens differs by {lens:.3g} of the picture"
        )
    return found, len(given.images)


def _lens(files: ObjectFiles, view: int) -> np.ndarray:
    """Focal lengths and centre in sides of the picture, ``[4]``."""
    size = np.array(files.sizes[view] or (1, 1), np.float64)
    K = files.Ks[view]
    return np.concatenate([np.diag(K)[:2] / size, K[:2, 2] / size])


def _by_name(
    folder: Path, files: ObjectFiles, views: Sequence[int]
) -> tuple[str, dict[int, Path], int]:
    """Whether it goes by "name" or "number", the pictures by view, and how many there are.

    Raises:
        UserError: two pictures are of one view.
    """
    given: dict[str, Path] = {}
    for path in sorted(filter(_is_picture, folder.iterdir())):
        if not path.name.startswith(".") and given.setdefault(path.stem, path) is not path:
            raise UserError(f"{path}: {given[path.stem].name} has the same name; keep one")
    stems = [path.stem for path in files.images]
    if len(set(stems)) == len(stems) and set(stems) & set(given):
        found = {view: given[stems[view]] for view in views if stems[view] in given}
        return "name", found, len(given)
    numbers: dict[int, Path] = {}
    for stem, path in given.items():
        if stem.isascii() and stem.isdigit() and numbers.setdefault(int(stem), path) is not path:
            raise UserError(f"{path}: {numbers[int(stem)].name} has the same number; keep one")
    return "number", {view: numbers[view] for view in views if view in numbers}, len(given)


def _lacks(folder: Path, lacking: Sequence[int], views: Sequence[int], by: str) -> str:
    some = ", ".join(map(str, lacking[:_NAMED])) + (", ..." if len(lacking) > _NAMED else "")
    word = {"camera": "at the camera", "name": "of the name", "number": "of the number"}[by]
    plural = "" if len(lacking) == 1 else "s"
    return (
        f"{folder}: no picture {word} of view{plural} {some} "
        f"({len(lacking)} of the {len(views)} compared)"
    )


def _check_white(folder: Path, rgb: Tensor, truth: Truth, found: list[bool]) -> None:
    """Refuses opaque pictures on a flat background of another colour than white.

    A method's fog is not flat, so this does not hide what a method does badly.

    Raises:
        UserError: over half of what is empty in the true pictures has one such colour.
    """
    empty = (truth.images[..., 3] == 0).cpu() & torch.tensor(found)[:, None, None]
    pixels = rgb[empty]
    if not len(pixels):
        return
    colour = pixels.median(0).values
    flat = ((pixels - colour).abs().amax(1) <= FLAT).float().mean().item()
    if flat > 0.5 and (colour - WHITE).abs().amax() > FLAT:
        named = ", ".join(str(round(255 * c)) for c in colour.tolist())
        raise UserError(
            f"{folder}: its pictures have no alpha and the background rgb({named}); "
            "render them with alpha, or on white"
        )


def save_pictures(folder: Path, files: ObjectFiles, views: Sequence[int], pictures: Shown) -> None:
    """Writes pictures as ``PicturePredictions`` reads them, named as the true files are.

    Args:
        folder: of one object; made if need be.
        files: of the true views, whose names the pictures get, or their numbers where two true
            files have one name.
        views: numbers of the views.
        pictures: with alpha.

    Raises:
        UserError: a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    stems = [path.stem for path in files.images]
    names = stems if len(set(stems)) == len(stems) else [str(i) for i in range(len(stems))]
    assert pictures.alpha is not None
    alpha = pictures.alpha[..., None].cpu()
    premultiplied = over_another(pictures.rgb.cpu(), alpha, WHITE, 0.0)
    straight = torch.where(alpha > 0, premultiplied / alpha.clamp(min=1e-6), 1.0)
    for view, picture in zip(views, torch.cat([straight.clamp(0, 1), alpha], -1)):
        save_image(folder / f"{names[view]}.png", picture.numpy())
