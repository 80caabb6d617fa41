"""Reading and writing images; common formats become RGBA, and errors name the file.

``open_image`` opens every untrusted image: few formats, size checked before decoding.
``to_rgba`` converts it to sRGB with alpha.
"""

import functools
import io
import os
import stat
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from PIL import Image, UnidentifiedImageError, features

from .color_spaces import Convert, conversion
from .errors import FileWarning, UserError, first_line
from .files import atomic_path, other_kinds
from .versions import to_install

MAX_PIXELS = 64 * 1024 * 1024
MAX_SIDE = 32_768  # pixels; panoramas are shorter, and padding to a square stays possible
# Pillow knows thirty more; one of them (EPS) starts another program, and none is for photos.
# JPEG includes MPO.
FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "GIF", "PPM")
IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".gif"}
IMAGE_SUFFIXES |= {".heic", ".heif", ".avif"}

_COUNT_FRAMES_UP_TO = 16 << 20  # bytes of a file; counting frames reads all of it
_BAND = 1 << 22  # pixels converted at once
_PLAIN = ("L", "LA", "RGB", "RGBA", "CMYK")  # modes of 8 bits without a palette
_ORIENTATION = 0x0112  # of EXIF
_UPRIGHT = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
# Pillow keeps the high bytes of PNGs of 16 bits a channel; these raw modes give the low ones.
_LOW_BYTES = {"RGB;16B": "RGB;16L", "RGBA;16B": "RGBA;16L", "LA;16B": "RGBA"}
# Tags of TIFF, which raw photographs are; of the second, bit 1 marks a reduced copy.
_DNG_VERSION, _SUBFILE_TYPE = 0xC612, 0xFE
_QUIET = threading.Lock()  # warning filters are process-wide


@contextmanager
def open_image(
    source: str | Path | BinaryIO,
    name: object = None,
    max_pixels: int = MAX_PIXELS,
    formats: Sequence[str] = FORMATS,
) -> Iterator[Image.Image]:
    """Open an image; its size is checked before anything is decoded.

    Errors of the decoder inside the ``with`` block become one line too.

    Args:
        source: path, or a binary file that can seek.
        name: for error messages; by default the path.
        max_pixels: largest width times height.
        formats: Pillow's names of the allowed formats, whatever the file's suffix.

    Yields:
        The image, not decoded yet. EXIF rotation is not applied.

    Raises:
        UserError: it is missing, empty, not a plain file or image of these formats, a raw
            photograph, larger than ``max_pixels`` or ``MAX_SIDE``, or damaged.
    """
    name = source if name is None else name
    if isinstance(source, (str, Path)):
        _check_file(source, name)
    try:
        with _without_warnings():
            image = Image.open(source, formats=tuple(formats))
        with image:
            tags: Any = getattr(image, "tag_v2", {})
            raw = _DNG_VERSION in tags or tags.get(_SUBFILE_TYPE, 0) & 1
            if image.format == "TIFF" and raw:  # Pillow sees only a preview
                raise UserError(
                    f"{name}: a raw photograph, of which only a preview of "
                    f"{image.width}x{image.height} can be read; export it as JPEG, PNG or TIFF"
                )
            check_size(image.width, image.height, name, max_pixels)
            yield image
    except UserError:
        raise
    except UnidentifiedImageError as error:
        raise UserError(f"{name}: not an image that can be read") from error
    except Image.DecompressionBombError as error:
        raise UserError(f"{name}: is over {max_pixels >> 20} megapixels") from error
    except Exception as error:  # decoders raise errors of nearly any type on damaged files
        reason = first_line(error)
        raise UserError(f"{name}: cannot be decoded ({reason})") from error


def check_size(width: int, height: int, name: object, max_pixels: int = MAX_PIXELS) -> None:
    """Refuse an image that is larger than ``max_pixels``, or longer than ``MAX_SIDE``.

    Raises:
        UserError: it is too large; the message begins with ``name``.
    """
    if width * height > max_pixels:
        raise UserError(f"{name}: {width}x{height} is over {max_pixels >> 20} megapixels")
    if max(width, height) > MAX_SIDE:
        raise UserError(f"{name}: {width}x{height} is over {MAX_SIDE} pixels long")


def _check_file(path: str | Path, name: object) -> None:
    try:
        status = os.stat(path)
    except FileNotFoundError as error:
        raise UserError(f"{name}: no such file") from error
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise UserError(f"{name}: {getattr(error, 'strerror', None) or error}") from error
    if stat.S_ISDIR(status.st_mode):
        raise UserError(f"{name}: is a folder, not an image")
    if not stat.S_ISREG(status.st_mode):
        raise UserError(f"{name}: not a plain file")
    if status.st_size == 0:
        raise UserError(f"{name}: the file is empty")


@contextmanager
def _without_warnings() -> Iterator[None]:
    """Silence Pillow's warnings about headers and size; the size is checked in this module."""
    with _QUIET, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def load_rgba(
    path: str | Path, longest: int | None = None, warn: Callable[[str], None] | None = None
) -> np.ndarray:
    """Read one still image.

    Grey, palette, RGB, CMYK and RGBA files of 8 and 16 bits are converted to sRGB
    (``color_spaces``), and EXIF rotation is applied. HEIC needs pillow-heif.

    Args:
        path: the file.
        longest: pixels; an image at least four times as long is reduced by a whole factor,
            weighted by alpha, to no less than twice this. None keeps its size.
        warn: as for ``to_rgba``.

    Returns:
        ``[H, W, 4]`` float32 in [0, 1], colour not premultiplied; alpha is 1 if the file has none.

    Raises:
        UserError: the file is missing, empty, not an image, truncated, animated or too large.
    """
    with _still(path) as image:
        return to_rgba(image, path, np.float32, longest, turned=True, warn=warn)


def load_rgba8(path: str | Path, content: bytes | None = None) -> np.ndarray:
    """Read an image of a posed set like ``load_rgba``, but ``[H, W, 4]`` uint8, as stored.

    EXIF rotation is not applied: the cameras of COLMAP and others are for the stored pixels.

    Args:
        path: the file, or the name of ``content``.
        content: bytes of a file; None reads it.
    """
    with _still(path, content) as image:
        return to_rgba(image, path, np.uint8)


def image_size(path: str | Path, turned: bool = True) -> tuple[int, int]:
    """Return width and height of a still image, without decoding it.

    Args:
        path: the file.
        turned: apply EXIF rotation.

    Raises:
        UserError: as ``load_rgba``, but for damaged pixels.
    """
    with _still(path) as image:
        width, height = image.size
        return (height, width) if turned and _orientation(image) >= 5 else (width, height)


@contextmanager
def _still(path: str | Path, content: bytes | None = None) -> Iterator[Image.Image]:
    if content is None:
        _check_file(path, path)  # opening a pipe would wait for its writer
    formats = (*FORMATS, *_phone_formats(path, content))
    source = path if content is None else io.BytesIO(content)
    with open_image(source, path, max_pixels=MAX_PIXELS, formats=formats) as image:
        # Phones append a preview or a depth map to a JPEG (MPO) or a HEIC.
        if image.format not in ("MPO", "HEIF") and getattr(image, "is_animated", False):
            size = os.path.getsize(path) if content is None else len(content)
            small = size <= _COUNT_FRAMES_UP_TO
            frames = getattr(image, "n_frames", 1) if small else "many"
            kind, part = ("a TIFF", "page") if image.format == "TIFF" else ("an animation", "frame")
            raise UserError(f"{path}: {kind} of {frames} {part}s; give one {part}")
        yield image


def _phone_formats(path: str | Path, content: bytes | None) -> tuple[str, ...]:
    """Return AVIF or HEIF if the file is one. Raises UserError if no reader is installed."""
    head = content or b""
    try:
        if content is None:
            with open(path, "rb") as file:
                head = file.read(12)
    except OSError:
        return ()  # ``open_image`` reports it
    if head[4:8] != b"ftyp":
        return ()
    if head[8:12] in (b"avif", b"avis"):
        if not features.check("avif"):
            raise UserError(f"{path}: an AVIF, which this build of Pillow cannot read")
        return ("AVIF",)
    try:
        from pillow_heif import register_heif_opener
    except ImportError as error:
        raise UserError(
            f"{path}: if it is a HEIC, it needs pillow-heif: {to_install('photo')}"
        ) from error
    register_heif_opener(thumbnails=False)
    return ("HEIF",)


def _orientation(image: Image.Image) -> int:
    """Return EXIF's orientation, 1 to 8; 1 (upright) if EXIF is invalid."""
    try:
        with _without_warnings():
            value = image.getexif().get(_ORIENTATION, 1)
    except Exception:  # as decoders, it raises errors of many types
        return 1
    return value if value in _UPRIGHT else 1


def to_rgba(
    image: Image.Image,
    name: object,
    dtype: type = np.uint8,
    longest: int | None = None,
    *,
    turned: bool = False,
    profiled: bool = True,
    warn: Callable[[str], None] | None = None,
) -> np.ndarray:
    """Decode an image of ``open_image``, and free it on the way.

    Args:
        image: not decoded yet.
        name: for warnings.
        dtype: float32 or uint8 of the result.
        longest: as for ``load_rgba``.
        turned: apply EXIF rotation.
        profiled: convert colours to sRGB by the profile or the numbers in the file.
        warn: called with a line if these cannot be used and colours are taken for sRGB.
            None: Python's warnings, once per line.

    Returns:
        ``[H, W, 4]`` float32 in [0, 1] or uint8, colour not premultiplied.
    """
    warn = warn or _warn_once
    convert = conversion(image, lambda line: warn(f"{name}: {line}")) if profiled else None
    plain = _with_alpha(image)
    orientation = _orientation(image) if turned else 1
    factor = 1 if longest is None else max(plain.size) // (2 * longest)
    if factor > 1:
        plain = (plain.convert("I") if plain.mode.startswith("I") else plain).reduce(factor)
    if orientation in _UPRIGHT:
        plain = plain.transpose(_UPRIGHT[orientation])
    if plain is not image:
        image.close()  # frees memory for the floats
    return _pixels(plain, dtype, convert)


def _with_alpha(image: Image.Image) -> Image.Image:
    """Return the image in a mode of ``_PLAIN``, I or F, with a transparent value made alpha."""
    key, tiles = image.info.get("transparency"), getattr(image, "tile", None)
    raw = tiles[0][3] if tiles else None  # Pillow's mode of the pixels in the file
    raw = raw if isinstance(raw, str) else ""
    if raw in _LOW_BYTES and image.format == "PNG":
        return _rounded(image, raw, key)
    if key is None or image.mode in ("P", "PA"):
        grey = image.mode.startswith(("I", "F"))
        if image.mode == "1":
            return image.convert("L")
        return image if grey or image.mode in _PLAIN else image.convert("RGBA")
    if image.mode.startswith("I"):  # Pillow would clip 16 bits at 255, and lose alpha
        values = np.asarray(image).astype(np.uint32)
        alpha = np.where(values == key, 0, 255).astype(np.uint8)
        grey = ((values + 128) // 257).astype(np.uint8)
        return Image.merge("LA", [Image.fromarray(x) for x in (grey, alpha)])
    if raw in ("L;2", "L;4"):  # Pillow scales the pixels to 8 bits, but not the value
        image.info["transparency"] = key * {"L;2": 85, "L;4": 17}[raw]
    return image.convert("RGBA")


def _rounded(image: Image.Image, raw: str, key: Sequence[int] | None) -> Image.Image:
    """Round a PNG of 16 bits a channel to 8 bits, with alpha 0 where it has the colour ``key``.

    Its pixels are decoded twice, for the high and for the low bytes.
    """
    file = cast(Any, image).fp
    start = file.tell()
    file.seek(0)
    with _without_warnings():
        other = cast(Any, Image.open(io.BytesIO(file.read()), formats=("PNG",)))
    file.seek(start)
    other.tile = [other.tile[0]._replace(args=_LOW_BYTES[raw])]
    low = np.asarray(other)
    high = np.array(image)
    if raw == "LA;16B":  # bytes of grey and of alpha, which ``high`` has as RGBA
        low = low[..., [1, 1, 1, 3]]
    alpha = None
    if key is not None:
        other_color = [
            (high[..., i] != k >> 8) | (low[..., i] != k & 255) for i, k in enumerate(key)
        ]
        alpha = Image.fromarray(np.where(np.any(other_color, 0), 255, 0).astype(np.uint8))
    # (256 high + low) / 257 = high + (low - high) / 257, to the nearest.
    up, down = (low > high) & (low - high > 128), (high > low) & (high - low > 128)
    high += up
    high -= down
    image = Image.fromarray(high)
    if alpha is not None:
        image.putalpha(alpha)
    return image


def _pixels(image: Image.Image, dtype: type, convert: Convert | None) -> np.ndarray:
    """Return ``[H, W, 4]`` float32 in [0, 1] or uint8, converted in bands to save memory."""
    out = np.empty((image.height, image.width, 4), dtype)
    grey, top = image.mode.startswith(("I", "F")), 65535.0  # PIL reads 16-bit colour as 8-bit
    rows = max(1, _BAND // image.width)
    starts = range(0, image.height, rows)
    bands = ((0, y, image.width, min(y + rows, image.height)) for y in starts)
    if image.mode == "F":
        values = np.asarray(image, dtype=np.float32)
        top = max(1.0, float(values.max(where=np.isfinite(values), initial=0.0)))
        del values
    for box in bands:
        band, part = image.crop(box), out[box[1] : box[3]]
        if grey:
            values = np.clip(np.nan_to_num(np.asarray(band, dtype=np.float32)) / top, 0.0, 1.0)
            if convert is None:
                part[..., :3] = (values if dtype == np.float32 else to_uint8(values))[..., None]
                part[..., 3] = 1.0 if dtype == np.float32 else 255
                continue
            band = Image.fromarray(to_uint8(values))
        band = band if convert is None else convert(band)
        if dtype == np.float32:
            np.divide(np.asarray(band.convert("RGBA")), np.float32(255.0), out=part)
        else:
            part[...] = np.asarray(band.convert("RGBA"))
    return out


@functools.lru_cache(1024)
def _warn_once(line: str) -> None:
    with _QUIET:  # else another thread's filter could drop it
        warnings.warn(line, FileWarning, stacklevel=2)


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Round ``[.., C]`` float values in [0, 1] to 8 bits; NaN becomes 0."""
    return (np.clip(np.nan_to_num(image), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def save_image(path: str | Path, image: np.ndarray, **options) -> None:
    """Write ``[H, W]`` or ``[H, W, 1|3|4]`` floats in [0, 1], in the format of the suffix.

    Raises:
        UserError: the file cannot be written.
    """
    pixels = to_uint8(np.asarray(image))
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[..., 0]
    with atomic_path(path) as temporary:
        Image.fromarray(pixels).save(temporary, **options)


def find_images(
    images: Sequence[Path], recursive: bool = False
) -> tuple[list[Path], list[tuple[Path, str]]]:
    """Resolve files and folders to image files.

    Args:
        images: files, which are kept unchanged, and folders, whose files with an image's suffix
            follow in sorted order.
        recursive: also take those in their sub-folders; links to folders are not followed.

    Returns:
        The files, each once; and the folders without images, with the reason.
    """
    paths: dict[Path, None] = {}
    failures = []
    for path in images:
        if not path.is_dir():
            paths[path] = None
            continue
        try:
            files = _inside(path, recursive)[0]
        except OSError as error:
            failures.append((path, error.strerror))
            continue
        inside = sorted(p for p in files if p.suffix.lower() in IMAGE_SUFFIXES)
        paths.update(dict.fromkeys(inside))
        if not inside:
            note = left_out(path, recursive)
            failures.append((path, "the folder holds no images" + (f" ({note})" if note else "")))
    return list(paths), failures


def left_out(path: Path, recursive: bool = False) -> str:
    """Return the entries of a folder that ``find_images`` leaves out; none for a file."""
    try:
        files, folders = _inside(path, recursive) if path.is_dir() else ([], [])
    except OSError:
        return ""
    counts, hint = [other_kinds(files, IMAGE_SUFFIXES)], ""
    if folders and not recursive:
        counts.append(f"{len(folders)} folder{'s' * (len(folders) > 1)}")
        hint = "; --recursive takes the folders"
    skipped = ", ".join(filter(None, counts))
    return f"{skipped} skipped{hint}" if skipped else ""


def _inside(path: Path, recursive: bool) -> tuple[list[Path], list[Path]]:
    """Return the files and folders of a folder without hidden ones. Raises OSError."""
    files, folders = [], []
    for child in sorted(path.iterdir()):
        if not child.name.startswith("."):
            (folders if child.is_dir() else files).append(child)
    for folder in folders if recursive else ():
        if not folder.is_symlink():
            files += _inside(folder, True)[0]
    return files, folders
