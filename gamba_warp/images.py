"""Reading and writing pictures; any common file becomes float RGBA, and errors name the file."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from .errors import UserError
from .files import atomic_path

MAX_PIXELS = 64 * 1024 * 1024
PICTURE_SUFFIXES = {".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".gif"}


def load_rgba(path: str | Path) -> np.ndarray:
    """Reads one still picture.

    Grey, palette, RGB and RGBA files of 8 and 16 bits are converted, and EXIF rotation is applied.

    Returns:
        ``[H, W, 4]`` float32 in [0, 1], colour not premultiplied; alpha 1 where the file has none.

    Raises:
        UserError: the file is missing, empty, not a picture, truncated, animated or over 64
            megapixels.
    """
    path = Path(path)
    if path.is_dir():
        raise UserError(f"{path}: is a folder, not a picture")
    if not path.exists():
        raise UserError(f"{path}: no such file")
    try:
        if path.stat().st_size == 0:
            raise UserError(f"{path}: the file is empty")
        with Image.open(path) as image:
            # An MPO is a phone's JPEG, followed by a preview or a depth map.
            frames = 1 if image.format == "MPO" else getattr(image, "n_frames", 1)
            if frames > 1:
                raise UserError(f"{path}: animated picture ({frames} frames); give one frame")
            if image.width * image.height > MAX_PIXELS:
                raise UserError(f"{path}: {image.width}x{image.height} is over 64 megapixels")
            return _to_rgba(image)
    except UserError:
        raise
    except UnidentifiedImageError as error:
        raise UserError(f"{path}: not a picture that can be read") from error
    except Exception as error:  # decoders raise errors of nearly any type on damaged files
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise UserError(f"{path}: cannot be decoded ({reason})") from error


def _to_rgba(image: Image.Image) -> np.ndarray:
    from PIL import ImageOps

    image = ImageOps.exif_transpose(image)
    if image.mode.startswith(("I", "F")):  # 16-bit grey (PIL reads 16-bit colour as 8-bit)
        grey = np.asarray(image, dtype=np.float32)
        top = 65535.0
        if image.mode == "F":
            top = max(1.0, float(grey.max(where=np.isfinite(grey), initial=0.0)))
        grey = np.clip(np.nan_to_num(grey) / top, 0.0, 1.0)
        return np.dstack([grey, grey, grey, np.ones_like(grey)])
    return np.asarray(image.convert("RGBA"), dtype=np.float32) / 255.0


def over_background(rgba, background):
    """Composites straight-alpha RGBA, an array or a tensor, over a colour.

    Args:
        rgba: ``[.., H, W, 4]`` in [0, 1], colour not premultiplied.
        background: a grey value, or RGB that broadcasts with ``[.., H, W, 3]``, in [0, 1].

    Returns:
        ``[.., H, W, 3]``.
    """
    alpha = rgba[..., 3:]
    return rgba[..., :3] * alpha + background * (1 - alpha)


def to_uint8(picture: np.ndarray) -> np.ndarray:
    """Rounds ``[.., C]`` float values in [0, 1] to 8 bits; NaN becomes 0."""
    return (np.clip(np.nan_to_num(picture), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def save_image(path: str | Path, picture: np.ndarray, **options) -> None:
    """Writes ``[H, W]`` or ``[H, W, 1|3|4]`` floats in [0, 1], in the format of the suffix.

    Raises:
        UserError: the file cannot be written.
    """
    pixels = to_uint8(np.asarray(picture))
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[..., 0]
    with atomic_path(path) as temporary:
        Image.fromarray(pixels).save(temporary, **options)


def find_pictures(images: Sequence[Path]) -> tuple[list[Path], list[tuple[Path, str]]]:
    """Resolves files and folders to picture files.

    Args:
        images: files, which are taken as they are, and folders, whose files with a picture's
            suffix are taken in sorted order, without sub-folders.

    Returns:
        The files, each once; and the folders that give no file, with the reason.
    """
    pictures: dict[Path, None] = {}
    failures = []
    for path in images:
        if not path.is_dir():
            pictures[path] = None
            continue
        try:
            inside = sorted(p for p in path.iterdir() if p.suffix.lower() in PICTURE_SUFFIXES)
        except OSError as error:
            failures.append((path, error.strerror))
            continue
        pictures.update(dict.fromkeys(inside))
        if not inside:
            failures.append((path, "the folder holds no pictures"))
    return list(pictures), failures
