"""Sound pictures and masks, one of each kind that people have."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

Files = dict[str, bytes]

EPS = (
    b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 16 16\n%%EndComments\n"
    b"newpath 4 4 moveto 12 4 lineto 12 12 lineto fill\nshowpage\n%%EOF\n"
)


def rgba(size: int = 24) -> np.ndarray:
    """``[size, size, 4]`` uint8: a coloured disc on a transparent ground."""
    y, x = np.mgrid[:size, :size]
    far = np.hypot(x - size / 2 + 0.5, y - size / 2 + 0.5) * 2.6 / size
    colour = [8 * x % 256, 8 * y % 256, (x + y) * 5 % 256]
    alpha = np.where(far < 1, 255, 0)
    return np.stack([*colour, alpha], -1).astype(np.uint8)


def encoded(picture: Image.Image, form: str, **options) -> bytes:
    """The bytes of a picture in one of PIL's formats."""
    content = io.BytesIO()
    picture.save(content, form, **options)
    return content.getvalue()


def png(size: int = 24) -> bytes:
    """A small RGBA picture as PNG."""
    return encoded(Image.fromarray(rgba(size)), "PNG")


def depth_png(size: int = 8) -> bytes:
    """A small 16-bit grey picture as PNG."""
    steps = (np.arange(size * size).reshape(size, size) * 500).astype(np.uint16)
    return encoded(Image.fromarray(steps), "PNG")


def pictures() -> dict[str, Files]:
    """Single pictures by name of the kind; each has one file."""
    cut, grey = Image.fromarray(rgba()), Image.fromarray(rgba()[..., 0])
    on_white = Image.new("RGBA", cut.size, "white")
    on_white.alpha_composite(cut)
    plain = on_white.convert("RGB")
    wide = (rgba()[..., 0].astype(np.uint16) * 257).astype(np.uint16)
    exif = Image.Exif()
    exif[0x0112] = 6
    made = {
        "png-rgba": ("photo.png", encoded(cut, "PNG")),
        "png-16": ("photo.png", encoded(Image.fromarray(wide), "PNG")),
        "png-palette": ("photo.png", encoded(plain.quantize(16), "PNG", transparency=0)),
        "png-grey": ("photo.png", encoded(grey, "PNG")),
        "png-bit": ("photo.png", encoded(grey.convert("1"), "PNG")),
        "jpeg": ("photo.jpg", encoded(plain, "JPEG", exif=exif)),
        "jpeg-progressive": ("photo.jpg", encoded(plain, "JPEG", progressive=True)),
        "jpeg-cmyk": ("photo.jpg", encoded(plain.convert("CMYK"), "JPEG")),
        "webp": ("photo.webp", encoded(cut, "WEBP", lossless=True)),
        "webp-lossy": ("photo.webp", encoded(cut, "WEBP", quality=70)),
        "gif": ("photo.gif", encoded(plain.quantize(16), "GIF")),
        "tiff": ("photo.tif", encoded(cut, "TIFF")),
        "tiff-deflate": ("photo.tiff", encoded(cut, "TIFF", compression="tiff_deflate")),
        "tiff-float": ("photo.tif", encoded(Image.fromarray(wide / np.float32(65535)), "TIFF")),
        "bmp": ("photo.bmp", encoded(plain, "BMP")),
        "eps-as-png": ("photo.png", EPS),
    }
    return {name: {file: data} for name, (file, data) in made.items()}


def masked_pictures() -> dict[str, Files]:
    """Pictures with ``mask.png`` beside them, by name; and one that needs no mask."""
    cut = rgba()
    plain = Image.fromarray(np.where(cut[..., 3:] > 0, cut[..., :3], 255).astype(np.uint8))
    mask = encoded(Image.fromarray(cut[..., 3]), "PNG")
    busy = Image.fromarray(np.random.default_rng(0).integers(0, 256, (24, 24, 3), np.uint8))
    return {
        "masked": {"photo.png": encoded(busy, "PNG"), "mask.png": mask},
        "masked-jpeg": {"photo.jpg": encoded(busy, "JPEG"), "mask.png": mask},
        "plain-ground": {"photo.png": encoded(plain, "PNG")},
        "cut-out": {"photo.png": png()},
    }
