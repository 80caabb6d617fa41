"""Pictures to take for an example, the cut-out of one, and the strokes that mend its mask."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..conventions import over_background
from ..errors import UserError
from ..files import STARTER

if TYPE_CHECKING:
    from ..photo.cutout import Ways


SIDE = 720  # longer side of the picture that is painted on, pixels
KEEP, REMOVE = "#2f6fed", "#e8590c"  # colours of the brush: blue and orange, told apart by all eyes
STROKE = 0.6  # opacity of a stroke, so that the picture shows through
MAX_STROKES = 4 << 20  # pixels of a layer; the page's own have SIDE x SIDE
_TILE = 12  # side of the checkerboard's squares, pixels
_LIGHT, _DARK = 0.97, 0.86
_GHOST = 0.22  # how much of what is cut away still shows, so that it can be painted back
_NAME = re.compile(r"[^\w-]+")
FOLDER = STARTER / "icons"  # the examples


@dataclass(frozen=True, eq=False)
class Cut:
    """A picture and the mask of its object.

    Attributes:
        name: fit for a file.
        rgb: ``[H, W, 3]`` float32 in [0, 1], the picture at its working size.
        mask: ``[H, W]`` float32 in [0, 1], 1 on the object.
        first: the mask as it was found, before any stroke.
        found: ``[S, S, 4]`` float32, the object cut out and centred as it was found, whose colours
            along the edge hold no background; None where no object was found.
        ghost: whether there is a picture to be seen where the mask is 0.
        note: how the object was found, for the page.
    """

    name: str
    rgb: np.ndarray
    mask: np.ndarray
    first: np.ndarray
    found: np.ndarray | None
    ghost: bool
    note: str


def cut_picture(path: Path, name: str, ways: Ways) -> Cut:
    """Reads a picture and finds its object; where none is found, the mask is empty.

    Args:
        path: the file of a stranger.
        name: what the stranger calls it.
        ways: how objects may be found.

    Raises:
        UserError: the picture cannot be read; the message names it as the stranger does.
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
        cut = cut_out(path, ways)
    except UserError as error:  # the picture is sound, so the object can be painted by hand
        reason = str(error).removeprefix(f"{path}: ")
        mask = np.zeros(rgba.shape[:2], np.float32)
        note = f"No object was found ({reason}). Paint over the object with the blue brush."
        return Cut(stem(name), rgba[..., :3], mask, mask, None, True, note)
    ghost = cut.method != "alpha"  # what a file holds where it is transparent is no picture
    rgb = _clean_edge(cut.source_rgb, cut.mask, cut.rgba)
    return Cut(stem(name), rgb, cut.mask, cut.mask, cut.rgba, ghost, cut.how)


def _clean_edge(rgb: np.ndarray, mask: np.ndarray, found: np.ndarray) -> np.ndarray:
    """The picture with the found object's own colours, so that a mended one has no fringe."""
    from ..data.preprocess import PRESENT

    present = mask > PRESENT
    rows, columns = np.flatnonzero(present.any(1)), np.flatnonzero(present.any(0))
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    top, left = ((found.shape[0] - size) // 2 for size in mask[box].shape)
    height, width = mask[box].shape
    inner = found[top : top + height, left : left + width]
    out = rgb.copy()
    out[box] = np.where(present[box][..., None], inner[..., :3], rgb[box])
    return out


def stem(name: str) -> str:
    """The name of a stranger's file as a plain stem of ours: letters, digits, ``_`` and ``-``."""
    return _NAME.sub("-", Path(name).stem).strip("-_")[:60] or "object"


def editor_picture(cut: Cut) -> np.ndarray:
    """The cut-out over a checkerboard, and faintly what is cut away, to paint on.

    Returns:
        ``[h, w, 3]`` uint8, the longer side ``SIDE`` pixels whatever the picture's own size.
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
    """Height and width of ``editor_picture``."""
    height, width = cut.mask.shape
    factor = SIDE / max(height, width)
    return max(1, round(height * factor)), max(1, round(width * factor))


def read_strokes(path: Path) -> np.ndarray:
    """One layer of the editor as the page sends it.

    Returns:
        ``[h, w, 4]`` uint8, straight alpha.

    Raises:
        UserError: it is no PNG, or larger than any canvas.
    """
    from ..images import open_picture

    with open_picture(path, "the strokes", MAX_STROKES, ("PNG",)) as image:
        return np.asarray(image.convert("RGBA"))


def mended(cut: Cut, layers: Sequence[np.ndarray]) -> Cut:
    """The cut-out after the strokes: blue ones are object, orange ones are not.

    Args:
        cut: before the strokes.
        layers: ``[h, w, 4]`` uint8 each, straight alpha, of any size; they cover the whole picture.

    Returns:
        The same object where nothing is painted.
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


def restarted(cut: Cut) -> Cut:
    """The cut-out with the mask as it was found."""
    return replace(cut, mask=cut.first)


def model_picture(cut: Cut) -> np.ndarray:
    """The object as the model takes it.

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
    """``[H, W]`` or ``[H, W, C]`` float32 at another size."""
    from PIL import Image

    planes = values[..., None] if values.ndim == 2 else values
    smaller = height < planes.shape[0]
    # A mean over what a new pixel covers: a wider filter would smear a stroke over its border.
    kind = Image.Resampling.BOX if smaller else Image.Resampling.BILINEAR
    out = [
        np.asarray(Image.fromarray(plane).resize((width, height), kind))
        for plane in np.moveaxis(np.ascontiguousarray(planes, np.float32), -1, 0)
    ]
    return out[0] if values.ndim == 2 else np.stack(out, -1)


def examples() -> list[tuple[Path, str]]:
    """The pictures that come with the package, sorted by name, each with what it shows.

    An installed package has two, a checkout more.
    """
    found = []
    for path in sorted(FOLDER.glob("*.png")):
        # ``scopia-dog-house`` is "dog house": what comes first is who made it.
        title = re.sub("^(blendswap-cc-(0|by)|katorlegaz|scopia)-", "", path.stem)
        found.append((path, re.sub("[-_]", " ", title.rstrip("0123456789"))))
    return found
