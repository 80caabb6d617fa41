"""Steps from an image to the model's input: masks, centring, compositing.

``photo/cutout.py`` chooses the steps for an image.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import Tensor

from ..conventions import over_background
from ..errors import UserError, first_line
from ..images import image_size, load_rgba, to_uint8
from ..untrusted.torch_files import read_torch

BORDER_RATIO = 0.2  # fraction of the square left free around the object's longer side
WORKING_SIZE = 1024  # pixels; larger images are reduced first, since no model uses more

SAM_FILES = (
    "published are sam_vit_b_01ec64.pth (375 MB; ViT-L and ViT-H are larger) at "
    "https://github.com/facebookresearch/segment-anything, and mobile_sam.pt (40 MB) at "
    "https://github.com/ChaoningZhang/MobileSAM"
)

_TRANSPARENT = 0.5  # a pixel of lower alpha is outside of a cut-out object
# Transparent fractions of an image's border or of the whole from which it is a cut-out: the rounded
# corners of a screenshot are less.
_CUT_BORDER, _CUT_FRACTION = 0.15, 0.05
PRESENT = 0.05  # least alpha of a pixel within the object's bounds
_MIN_OBJECT = 16  # least size of an object, pixels
# A mask holds labels if its channels differ by more than this, or if no grey is brighter.
_COLORED, _DARK = 0.1, 0.25


def has_alpha(rgba: np.ndarray, any_fraction: bool = False) -> bool:
    """True if the object of an image ``[H, W, 4]`` is cut out.

    A real fraction of its border or of the whole is transparent; or, with ``any_fraction``, a
    pixel.
    """
    clear = rgba[..., 3] < _TRANSPARENT
    fractions = border_of(clear).mean() >= _CUT_BORDER or clear.mean() >= _CUT_FRACTION
    return bool(clear.any() and (any_fraction or fractions))


def border_of(image: np.ndarray) -> np.ndarray:
    """Return the pixels ``[P, ..]`` of the border of ``[H, W, ..]``, those of the corners twice."""
    return np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])


def planes_of(image: np.ndarray) -> Tensor:
    """Return ``[H, W, C]`` as ``[1, C, H, W]`` float32."""
    return torch.from_numpy(np.ascontiguousarray(image, np.float32)).permute(2, 0, 1)[None]


def read_mask(mask: str | Path, path: str | Path) -> np.ndarray:
    """Read alpha ``[H, W]`` in [0, 1] from a mask file, reduced like the image in ``load_rgba``.

    The object is brighter than the rest, by whatever two values, or it is the mask's own alpha.

    Raises:
        UserError: the mask, or the image's size, cannot be read, they differ in size, or the mask
            has several labels.
    """
    sizes = [image_size(file) for file in (mask, path)]
    if sizes[0] != sizes[1]:
        stated = [f"{width}x{height}" for width, height in sizes]
        raise UserError(f"{mask}: the mask is {stated[0]} but {path} is {stated[1]}")
    values = load_rgba(mask, longest=WORKING_SIZE)
    colors, alpha = values[..., :3], values[..., 3]
    grey = colors.mean(-1)
    inside = grey[alpha > PRESENT]
    if alpha.min() < 1 and not (len(inside) and np.ptp(inside) > 1 / 255):
        return alpha
    if grey.max() < _DARK or np.ptp(colors, axis=-1).max() > _COLORED:
        count = len(np.unique(to_uint8(colors).reshape(-1, 3), axis=0))
        if count > 2:
            raise UserError(f"{mask}: has {count} labels; a mask is bright on the object alone")
    grey = grey * alpha
    low, high = grey.min(), grey.max()
    return (grey - low) / (high - low) if low < high else grey


def without_specks(alpha: np.ndarray) -> np.ndarray:
    """Clear parts of ``[H, W]`` under 1 % of the largest: dust would move the object's bounds."""
    from skimage.measure import label

    parts = cast(np.ndarray, label(alpha > 0))
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    return np.where(sizes[parts] >= 0.01 * sizes.max(), alpha, 0.0)


def recenter(rgba: np.ndarray, border_ratio: float | None = BORDER_RATIO) -> np.ndarray:
    """Put the object's bounding box in the middle of a square, without resampling.

    Args:
        rgba: ``[H, W, 4]`` in [0, 1].
        border_ratio: fraction of the square's side that the box's longer side leaves free, [0, 1);
            None uses the whole image instead of the box.

    Returns:
        ``[S, S, 4]`` float32; S = longer side / (1 - border_ratio), or the image's longer side.

    Raises:
        ValueError: hardly any pixel is opaque.
    """
    present = rgba[..., 3] > PRESENT
    count = np.count_nonzero(present)
    if count < _MIN_OBJECT:
        raise ValueError(
            f"no object found; pixels that are not background: {count}, needed: {_MIN_OBJECT}"
        )
    rows, columns = np.flatnonzero(present.any(1)), np.flatnonzero(present.any(0))
    box = rgba[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    if border_ratio is None:
        box, border_ratio = rgba, 0.0
    height, width = box.shape[:2]
    side = math.ceil(max(height, width) / (1 - border_ratio))
    out = np.zeros((side, side, 4), np.float32)
    top, left = (side - height) // 2, (side - width) // 2
    out[top : top + height, left : left + width] = box
    return out


def shrink(rgba: np.ndarray, longest: int) -> np.ndarray:
    """Reduce ``[H, W, 4]``, weighted by alpha, to at most ``longest`` pixels a side."""
    height, width = rgba.shape[:2]
    if max(height, width) <= longest:
        return rgba
    factor = longest / max(height, width)
    return resize_rgba(rgba, max(1, round(height * factor)), max(1, round(width * factor)))


def resize_rgba(rgba: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resize ``[H, W, 4]`` in [0, 1], straight alpha, with colours weighted by alpha."""
    alpha = rgba[..., 3:]
    small = resize(np.dstack([rgba[..., :3] * alpha, alpha]), height, width)
    small[..., :3] /= np.maximum(small[..., 3:], 1e-6)
    return small.clip(0.0, 1.0)


def composite(rgba: np.ndarray, size: int, background: float = 1.0) -> Tensor:
    """Composite ``[S, S, 4]`` on a grey value (1 is white) and resize it.

    Returns:
        ``[size, size, 3]`` float32 in [0, 1].
    """
    flat = over_background(rgba, background)
    return torch.from_numpy(resize(flat, size, size)).clamp(0, 1)


def resize(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resize ``[H, W, C]``, bilinear and antialiased, to float32."""
    out = torch.nn.functional.interpolate(
        planes_of(image), (height, width), mode="bilinear", align_corners=False, antialias=True
    )
    return out[0].permute(1, 2, 0).contiguous().numpy()


class SamSegmenter:
    """Segment Anything through kornia, with weights from a file.

    The object is assumed in the middle: the prompt is a box without a tenth of the image on each
    side.

    Args:
        checkpoint: the released ``.pth`` or ``.pt`` of ViT-B, ViT-L, ViT-H or MobileSAM.
        device: device of the network.

    Raises:
        UserError: the file is missing or not such a checkpoint, or kornia is older than 0.9.
    """

    _WIDTHS = {768: "vit_b", 1024: "vit_l", 1280: "vit_h"}

    def __init__(self, checkpoint: str | Path, device: str | torch.device = "cpu") -> None:
        path = Path(checkpoint)
        if not path.is_file():
            raise UserError(f"--sam {path}: no such file; {SAM_FILES}")
        try:
            from kornia.contrib.visual_prompter import VisualPrompter
            from kornia.models.sam.model import SamConfig
        except ImportError as error:
            raise UserError("--sam needs kornia 0.9, and so Python 3.11 or newer") from error
        try:
            # Checks the sizes of the tensors before kornia reads the file.
            positions = read_torch(path).get("image_encoder.pos_embed")
            kind = "mobile_sam" if positions is None else self._WIDTHS[positions.shape[-1]]
            config = SamConfig(model_type=kind, checkpoint=str(path))
            self._prompter = VisualPrompter(config, device=torch.device(device))
        except Exception as error:  # torch.load raises errors of many types on other files
            reason = first_line(error)
            raise UserError(
                f"--sam {path}: not a Segment Anything checkpoint ({reason})"
            ) from error

    def __call__(self, rgb: np.ndarray) -> np.ndarray:
        """Return alpha ``[H, W]`` float32, 0 or 1, from RGB ``[H, W, 3]`` in [0, 1]."""
        height, width = rgb.shape[:2]
        box = torch.tensor([[0.1 * width, 0.1 * height, 0.9 * width, 0.9 * height]])
        with torch.inference_mode():
            self._prompter.set_image(planes_of(rgb)[0].to(self._prompter.device))
            result = self._prompter.predict(
                boxes=box.to(self._prompter.device), multimask_output=False
            )
        return result.binary_masks[0, 0].float().cpu().numpy()
