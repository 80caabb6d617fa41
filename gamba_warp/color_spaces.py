"""Colour spaces of images, and their conversion to sRGB.

A file tells its space by an ICC profile, or by numbers: code points of ITU-T H.273 (PNG's cICP,
HEIC's and AVIF's nclx), PNG's cHRM and gAMA, or the interoperability index of EXIF.
"""

from __future__ import annotations

import functools
import io
import struct
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np
from PIL import Image

from .errors import first_line

Convert = Callable[[Image.Image], Image.Image]
Curve = Callable[[np.ndarray], np.ndarray]

_MAX_PROFILE = 4 << 20  # bytes; a profile for printing takes 3 MB
_META = 1 << 16  # first bytes of an AVIF, which state its colours
# EXIF's entry "InteroperabilityIndex: R03" in both byte orders.
_R03 = (b"\1\0\2\0\4\0\0\0R03\0", b"\0\1\0\2\0\0\0\4R03\0")
_WHITE = 203  # cd/m² of white where transfer functions give light (ITU-R BT.2408)


def to_linear(display: np.ndarray | float) -> np.ndarray:
    """Convert sRGB display values in [0, 1] to linear light (IEC 61966-2-1), float32."""
    x = np.asarray(display, dtype=np.float32)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)


def to_display(linear: np.ndarray) -> np.ndarray:
    """Convert linear light in [0, 1] to sRGB display values, float32."""
    x = np.asarray(linear, dtype=np.float32)
    curve = 1.055 * np.maximum(x, 1e-8) ** (1 / 2.4) - 0.055
    return np.where(x <= 0.0031308, 12.92 * x, curve).astype(np.float32)


def _perceptual_quantizer(x: np.ndarray) -> np.ndarray:
    """Convert values of SMPTE ST 2084 to linear light, of which 1 is white."""
    root = x ** (1 / 78.84375)
    light = np.maximum(root - 0.8359375, 0) / (18.8515625 - 18.6875 * root)
    return light ** (1 / 0.1593017578125) * 10_000 / _WHITE


def _gamma(exponent: float) -> Curve:
    return lambda x: x**exponent


class Space(NamedTuple):
    """An RGB colour space.

    Attributes:
        primaries: CIE x and y of white, red, green and blue.
        curve: from stored values in [0, 1] to linear light, of which 1 is white.
    """

    primaries: tuple[float, ...]
    curve: Curve

    def is_srgb(self) -> bool:
        """Return True for sRGB up to rounding."""
        off = np.abs(np.subtract(self.primaries, SRGB.primaries)).max()
        return self.curve is to_linear and bool(off < 0.01)


def _to_xyz(primaries: tuple[float, ...]) -> np.ndarray:
    """Return ``[3, 3]`` from linear light to CIE XYZ, with a white of Y = 1."""
    x, y = np.reshape(np.asarray(primaries, np.float64), (4, 2)).T
    white, *columns = (np.stack([x, y, 1 - x - y]) / y).T
    matrix = np.stack(columns, 1)
    return matrix * np.linalg.solve(matrix, white)


_D65 = (0.3127, 0.329)
SRGB = Space((*_D65, 0.64, 0.33, 0.3, 0.6, 0.15, 0.06), to_linear)
ADOBE_RGB = Space((*_D65, 0.64, 0.33, 0.21, 0.71, 0.15, 0.06), _gamma(563 / 256))
# By their numbers in H.273; 2 is "unspecified". Televisions' curves are shown as sRGB's.
_PRIMARIES = {
    **dict.fromkeys((1, 2), SRGB.primaries),
    5: (*_D65, 0.64, 0.33, 0.29, 0.6, 0.15, 0.06),
    **dict.fromkeys((6, 7), (*_D65, 0.63, 0.34, 0.31, 0.595, 0.155, 0.07)),
    9: (*_D65, 0.708, 0.292, 0.17, 0.797, 0.131, 0.046),
    11: (0.314, 0.351, 0.68, 0.32, 0.265, 0.69, 0.15, 0.06),
    12: (*_D65, 0.68, 0.32, 0.265, 0.69, 0.15, 0.06),
}
_CURVES: dict[int, Curve] = {
    **dict.fromkeys((1, 2, 6, 13, 14, 15), to_linear),
    **{4: _gamma(2.2), 5: _gamma(2.8), 8: _gamma(1.0), 16: _perceptual_quantizer},
}


def conversion(image: Image.Image, warn: Callable[[str], None]) -> Convert | None:
    """Return the conversion of an image's 8-bit pixels to sRGB; alpha is kept.

    Args:
        image: not decoded yet.
        warn: called with a line if the file's statement cannot be used.

    Returns:
        The conversion; None if none is needed or possible.
    """
    profile, what = image.info.get("icc_profile"), "space"
    try:
        if (points := _code_points(image)) is not None:
            primaries, transfer, full = points
            if primaries not in _PRIMARIES or transfer not in _CURVES or not full:
                narrow = "" if full else ", narrow range"
                raise ValueError(f"primaries {primaries}, transfer {transfer} of H.273{narrow}")
            return _from_space(Space(_PRIMARIES[primaries], _CURVES[transfer]))
        if profile is None:
            return _from_space(_stated_space(image))
        what = "profile"
        if not isinstance(profile, bytes) or not 0 < len(profile) <= _MAX_PROFILE:
            raise ValueError("it is damaged or too large")
        grey = image.mode in ("1", "L", "LA") or image.mode.startswith(("I", "F"))
        mode = "L" if grey else "CMYK" if image.mode == "CMYK" else "RGB"
        return _from_profile(profile, mode)
    except Exception as error:  # invalid numbers, or littleCMS is missing or fails
        warn(f"its colour {what} is not used ({first_line(error)}); colours are taken as sRGB")
        return None


def _code_points(image: Image.Image) -> tuple[int, int, bool] | None:
    """Return primaries and transfer function by number, and whether the range is full."""
    file, code_points = cast(Any, image).fp, None
    if image.format == "PNG":
        start = file.tell()
        file.seek(8)
        while len(head := file.read(8)) == 8 and head[4:] not in (b"IDAT", b"IEND"):
            length = struct.unpack(">I", head[:4])[0]
            if head[4:] == b"cICP" and length == 4:
                primaries, transfer, _, full = file.read(4)
                code_points = primaries, transfer, bool(full)
                break
            file.seek(length + 4, io.SEEK_CUR)
        file.seek(start)
    elif image.format == "AVIF" and "icc_profile" not in image.info:
        start = file.tell()
        file.seek(0)
        _, box, nclx = file.read(_META).partition(b"colrnclx")
        file.seek(start)
        if box and len(nclx) >= 4:
            primaries, transfer = struct.unpack(">2H", nclx[:4])
            code_points = primaries, transfer, True  # the decoder widens the range
    elif nclx := image.info.get("nclx_profile"):
        code_points = int(nclx["color_primaries"]), int(nclx["transfer_characteristics"]), True
    return code_points


def _stated_space(image: Image.Image) -> Space:
    """Return the space of PNG's cHRM and gAMA or of EXIF; sRGB without any."""
    if "srgb" in image.info:
        return SRGB
    primaries, gamma = (image.info.get(name) for name in ("chromaticity", "gamma"))
    if primaries is None and gamma is None:
        exif = image.info.get("exif", b"")
        return ADOBE_RGB if any(entry in exif for entry in _R03) else SRGB
    space = SRGB if primaries is None else SRGB._replace(primaries=tuple(np.ravel(primaries)))
    if gamma is None or (space.is_srgb() and abs(gamma - 1 / 2.2) < 0.01):
        return space
    return space._replace(curve=_gamma(1 / gamma))


def _from_space(space: Space) -> Convert | None:
    """Return the conversion of RGB or grey pixels; None for sRGB up to rounding."""
    if space.is_srgb():
        return None
    # From its linear light to that of sRGB; white stays white.
    matrix = np.linalg.inv(_to_xyz(SRGB.primaries)) @ _to_xyz(space.primaries)
    matrix /= matrix.sum(1, keepdims=True)
    table = space.curve(np.arange(256) / 255.0)
    if not (np.isfinite(matrix).all() and np.isfinite(table).all()):
        raise ValueError("invalid numbers")

    def colours(band: Image.Image) -> Image.Image:
        linear = table[np.asarray(band.convert("RGB"))] @ matrix.T
        return Image.fromarray((to_display(np.clip(linear, 0, 1)) * 255 + 0.5).astype(np.uint8))

    return _keeping_alpha(colours)


@functools.lru_cache(8)
def _from_profile(profile: bytes, mode: str) -> Convert | None:
    """Return the conversion of L, RGB or CMYK pixels from a profile to sRGB; alpha is kept.

    None if no value changes by more than 1: then the profile is sRGB up to rounding.
    """
    from PIL import ImageCms

    source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
    space = cast(Any, source.profile).xcolor_space.strip()  # missing in Pillow's stub
    if space not in {"L": ("GRAY", "RGB"), "RGB": ("RGB",), "CMYK": ("CMYK",)}[mode]:
        raise ValueError(f"it is for {space}, but the image is {mode}")
    source_mode = "L" if space == "GRAY" else space
    # For speed littleCMS interpolates grey between a few steps; the table below has all 256.
    flags = ImageCms.Flags.NOOPTIMIZE if mode == "L" else ImageCms.Flags.NONE
    srgb = ImageCms.createProfile("sRGB")
    transform = ImageCms.buildTransform(source, srgb, source_mode, "RGB", flags=flags)

    def colours(band: Image.Image) -> Image.Image:
        converted = ImageCms.applyTransform(band.convert(source_mode), transform)
        assert converted is not None  # because it is not in place
        return converted

    levels = np.arange(256, dtype=np.uint8)
    if mode == "L":  # grey stays grey, as masks must
        table = np.asarray(colours(Image.fromarray(levels[None])))[0, :, 1]
        if np.abs(table.astype(int) - levels).max() <= 1:
            return None
        return _keeping_alpha(lambda band: band.convert("L").point(table.tolist()))
    if mode == "RGB":
        grid = np.stack(np.meshgrid(*3 * [levels[::15]]), -1).reshape(18, -1, 3)
        if np.abs(np.asarray(colours(Image.fromarray(grid))).astype(int) - grid).max() <= 1:
            return None
    return _keeping_alpha(colours)


def _keeping_alpha(colours: Convert) -> Convert:
    """Extend a conversion to images with alpha, which is copied."""

    def convert(band: Image.Image) -> Image.Image:
        converted = colours(band)
        if "A" in band.mode:
            converted.putalpha(band.getchannel("A"))
        return converted

    return convert
