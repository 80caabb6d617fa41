"""Example images, the cut-out of an image, and strokes that correct its mask."""

from __future__ import annotations

import re
import secrets
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..conventions import over_background
from ..errors import UserError
from ..files import STARTER

if TYPE_CHECKING:
    from ..photo.cutout import CutoutOptions


SIDE = 720  # longer side of the editor's image, pixels
KEEP, REMOVE = "#2f6fed", "#e8590c"  # brush colours: blue and orange, safe for colour-blind users
STROKE = 0.6  # opacity of a stroke, so that the image shows through
MAX_STROKES = 4 << 20  # pixels of a layer; the page sends SIDE x SIDE
_TILE = 12  # side of the checkerboard's squares, pixels
_LIGHT, _DARK = 0.97, 0.86
_GHOST = 0.22  # opacity of the removed parts, so that they can be painted back
# Options of the command line in the words of photo/cutout.py.
_OPTIONS = re.compile(r" \(--keep-holes[^)]*\)|; give an image with .*")
_NAME = re.compile(r"[^\w-]+")
FOLDER = STARTER / "icons"  # the examples


@dataclass(frozen=True, eq=False)
class Cut:
    """An image and the mask of its object.

    Attributes:
        name: valid as a file name.
        rgb: ``[H, W, 3]`` float32 in [0, 1], the image at its working size.
        mask: ``[H, W]`` float32 in [0, 1], 1 on the object.
        first: the mask before any stroke.
        found: ``[S, S, 4]`` float32, the object cut out and centred before any stroke, without
            background colour along its edge; None if no object was found.
        ghost: True if the image has colours where the mask is 0.
        note: method of the cut-out and doubts, for the page, before any stroke.
        warning: the doubts alone.
        path: file of the image.
        network: label of a button that cuts the image out again by a network; empty without one.
        areas: ``[H, W]`` bool, enclosed areas of a plain background's colour.
        key: unpredictable name of the image.
    """

    name: str
    rgb: np.ndarray
    mask: np.ndarray
    first: np.ndarray
    found: np.ndarray | None
    ghost: bool
    note: str
    warning: str
    areas: np.ndarray
    path: Path
    network: str = ""
    key: str = field(default_factory=lambda: secrets.token_hex(8))


def cut_image(path: Path, name: str, options: CutoutOptions) -> Cut:
    """Read an image and find its object; the mask is empty if none is found.

    Args:
        path: an untrusted file.
        name: the user's name of it.
        options: options of the cut-out.

    Raises:
        UserError: the image cannot be read; the message has the user's name.
    """
    from ..data.preprocess import WORKING_SIZE, shrink
    from ..images import load_rgba
    from ..photo.cutout import cut_out

    try:
        rgba = shrink(load_rgba(path, longest=WORKING_SIZE), WORKING_SIZE)
    except UserError as error:
        shown = name if len(name) <= 60 else f"{name[:40]}...{name[-15:]}"
        raise UserError(str(error).replace(str(path), shown)) from error
    try:
        cut = cut_out(path, options)
    except UserError as error:  # the image is valid, so the object can be painted by hand
        reason = _OPTIONS.sub("", str(error).removeprefix(f"{path}: "))
        mask = np.zeros(rgba.shape[:2], np.float32)
        note = f"No object was found ({reason}). Paint over the object with the blue brush."
        nothing = np.zeros(mask.shape, bool)
        label = _network(options)
        return Cut(
            stem(name), rgba[..., :3], mask, mask, None, True, note, note, nothing, path, label
        )
    ghost = cut.method != "alpha"  # colours of transparent pixels are arbitrary
    rgb = _clean_edge(cut.source_rgb, cut.mask, cut.rgba)
    note, label = _OPTIONS.sub("", cut.how), ""
    if cut.doubt:
        label = _network(options) if cut.method in ("plain", "grabcut") else ""
        note += f" {cut.doubt} Paint what to keep or remove{', or use a network' if label else ''}."
    fields = cut.rgba, ghost, note, cut.doubt, cut.areas, path, label
    return Cut(stem(name), rgb, cut.mask, cut.mask, *fields)


def _network(options: CutoutOptions) -> str:
    """Return the label of a button for the matting network; empty where it cannot help."""
    from ..photo import models

    if options.cutout != "auto" or options.matte_model is not None:
        return ""  # it was used
    if find_spec("onnxruntime") is None:
        return ""
    best = models.PUBLISHED[0]
    if (here := models.cached()) is not None:
        return f"Cut out with a network ({here.stem})"
    if not (options.fetch and models.may_fetch() and find_spec("pooch")):
        return ""
    return f"Cut out with a network ({best.name}, {best.megabytes} MB, fetched once)"


def cut_by_network(cut: Cut, options: CutoutOptions) -> Cut:
    """Return the cut-out of the same image by the matting network, which may be fetched.

    Raises:
        UserError: the network cannot be fetched or run, or finds no object.
    """
    from ..photo import models

    best, options = models.PUBLISHED[0], replace(options, cutout="matte")
    try:
        if models.cached() is None:
            models.fetch(best, best.address)
    except UserError as error:
        raise UserError(f"the network cannot be fetched: {error}") from None
    again = cut_image(cut.path, cut.name, options)
    if again.found is None:
        raise UserError(f"the network does not help: {again.note.partition('. Paint')[0]}")
    return replace(again, key=cut.key)


def _clean_edge(rgb: np.ndarray, mask: np.ndarray, cutout: np.ndarray) -> np.ndarray:
    """Return the image with the found object's edge colours, so that strokes leave no fringe."""
    from ..data.preprocess import PRESENT

    present = mask > PRESENT
    rows, columns = np.flatnonzero(present.any(1)), np.flatnonzero(present.any(0))
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    top, left = ((cutout.shape[0] - size) // 2 for size in mask[box].shape)
    height, width = mask[box].shape
    inner = cutout[top : top + height, left : left + width]
    out = rgb.copy()
    out[box] = np.where(present[box][..., None], inner[..., :3], rgb[box])
    return out


def stem(name: str) -> str:
    """Reduce an untrusted file name to a stem of letters, digits, ``_`` and ``-``."""
    return _NAME.sub("-", Path(name).stem).strip("-_")[:60] or "object"


def editor_image(cut: Cut) -> np.ndarray:
    """Draw the cut-out over a checkerboard, with the removed parts faint, for the editor.

    Returns:
        ``[h, w, 3]`` uint8, the longer side ``SIDE`` pixels for any image.
    """
    from ..images import to_uint8

    height, width = painted_size(cut)
    rgb = _resized(cut.rgb, height, width)
    mask = _resized(cut.mask, height, width)[..., None]
    y, x = np.ogrid[:height, :width]
    board = np.where((y // _TILE + x // _TILE) % 2 == 0, _LIGHT, _DARK)[..., None]
    below = board + (_GHOST if cut.ghost else 0.0) * (rgb - board)
    return to_uint8(over_background(np.concatenate([rgb, mask], -1), below))


def painted_size(cut: Cut) -> tuple[int, int]:
    """Return height and width of ``editor_image``."""
    height, width = cut.mask.shape
    factor = SIDE / max(height, width)
    return max(1, round(height * factor)), max(1, round(width * factor))


def read_strokes(path: Path) -> np.ndarray:
    """Read one layer of the editor, as sent by the page.

    Returns:
        ``[h, w, 4]`` uint8, straight alpha.

    Raises:
        UserError: it is not a PNG, or larger than any canvas.
    """
    from ..images import open_image

    with open_image(path, "the strokes", MAX_STROKES, ("PNG",)) as image:
        return np.asarray(image.convert("RGBA"))


def apply_strokes(cut: Cut, layers: Sequence[np.ndarray]) -> Cut:
    """Apply strokes to the mask: blue adds to the object, orange removes.

    Args:
        cut: before the strokes.
        layers: ``[h, w, 4]`` uint8 each, straight alpha, of any size, covering the whole image.

    Returns:
        The argument itself if nothing is painted.
    """
    mask = cut.mask
    for layer in layers:
        if layer.ndim != 3 or layer.shape[2] != 4 or not layer[..., 3].any():
            continue
        painted = np.clip(layer[..., 3] / (255.0 * STROKE), 0.0, 1.0)
        keep = np.where(layer[..., 2] >= layer[..., 0], painted, 0.0)
        weights = np.stack([painted, keep], -1).astype(np.float32)
        weights = _resized(weights, *mask.shape)
        mask = mask * (1.0 - weights[..., 0]) + weights[..., 1]
    if mask is cut.mask:
        return cut
    return replace(cut, mask=np.clip(mask, 0.0, 1.0).astype(np.float32))


def note_of(cut: Cut) -> str:
    """Return the note on a cut-out with its present mask, for the page."""
    from ..photo.cutout import doubts_of

    if cut.mask is cut.first:
        return cut.note
    doubts = doubts_of(cut.rgb, cut.mask)
    return "The cut-out is edited." + (f" It may be wrong: {'; '.join(doubts)}." if doubts else "")


def reset_mask(cut: Cut) -> Cut:
    """Return the cut-out with its first mask."""
    return replace(cut, mask=cut.first)


def switch_areas(cut: Cut) -> Cut:
    """Return the cut-out with all enclosed areas cleared; filled if none of them is left."""
    cleared = np.where(cut.areas, 0.0, cut.mask).astype(np.float32)
    left = cut.mask[cut.areas].any()
    return replace(cut, mask=cleared if left else np.maximum(cleared, cut.areas))


def model_image(cut: Cut) -> np.ndarray:
    """Return the object as the model's input.

    Returns:
        ``[S, S, 4]`` float32 RGBA with the object in the middle.

    Raises:
        UserError: the mask is empty.
    """
    from ..data.preprocess import recenter

    if cut.found is not None and cut.mask is cut.first:
        return cut.found
    try:
        return recenter(np.dstack([cut.rgb, cut.mask]).astype(np.float32))
    except ValueError as error:
        raise UserError(f"{error}; paint over the object with the blue brush") from error


def _resized(values: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resize ``[H, W]`` or ``[H, W, C]`` float32."""
    from PIL import Image

    planes = values[..., None] if values.ndim == 2 else values
    smaller = height < planes.shape[0]
    # The area average; a wider filter would smear strokes over their borders.
    kind = Image.Resampling.BOX if smaller else Image.Resampling.BILINEAR
    out = [
        np.asarray(Image.fromarray(plane).resize((width, height), kind))
        for plane in np.moveaxis(np.ascontiguousarray(planes, np.float32), -1, 0)
    ]
    return out[0] if values.ndim == 2 else np.stack(out, -1)


def examples() -> list[tuple[Path, str]]:
    """Return the shipped images, sorted by name, each with a title.

    An installed package has two, a checkout more.
    """
    images = []
    for path in sorted(FOLDER.glob("*.png")):
        # ``scopia-dog-house`` becomes "dog house": the author comes first.
        title = re.sub("^(blendswap-cc-(0|by)|katorlegaz|scopia)-", "", path.stem)
        images.append((path, re.sub("[-_]", " ", title.rstrip("0123456789"))))
    return images
