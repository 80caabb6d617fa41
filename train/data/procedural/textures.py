"""Procedural textures: patterns of materials, and printed matter with letter-like marks.

A pattern is a mix ``[SIDE, SIDE]`` in [0, 1] of two colours, and repeats without a seam. Printed
matter is a whole image ``[PRINT, PRINT, 3]``. Colours are display values in [0, 1].
"""

from __future__ import annotations

import colorsys
import math
from collections.abc import Callable

import numpy as np
from PIL import Image, ImageDraw, ImageFont

SIDE = 128
PRINT = 256
Pattern = Callable[[np.random.Generator], np.ndarray]
_U, _V = np.meshgrid(*[((np.arange(SIDE) + 0.5) / SIDE).astype(np.float32)] * 2)
_LETTERS = "AAABCDEEEEFGHIIJKLMNNOOPQRSSTTUVWXYZ"
# Ranges of hue, saturation and value.
_COLORS = {
    "toy": ((-0.02, 0.16), (0.55, 0.97), (0.45, 0.95)),
    "blue": ((0.45, 0.8), (0.55, 0.97), (0.45, 0.95)),
    "pastel": ((0.0, 1.0), (0.12, 0.45), (0.75, 0.97)),
    "dark": ((0.0, 1.0), (0.0, 0.4), (0.05, 0.3)),
    "white": ((0.05, 0.2), (0.0, 0.1), (0.82, 0.98)),
    "wood": ((0.03, 0.11), (0.3, 0.75), (0.2, 0.85)),
    "metal": ((0.5, 0.65), (0.0, 0.08), (0.35, 0.85)),
    "earth": ((0.02, 0.2), (0.1, 0.7), (0.15, 0.85)),
    "wide": ((0.0, 1.0), (0.0, 0.95), (0.05, 0.95)),
}
COLORS = (*_COLORS,)


def color(rng: np.random.Generator, kind: str = "any") -> np.ndarray:
    """Draw a colour ``[3]`` of a kind: one of ``COLORS``, or any."""
    ranges = _COLORS[COLORS[rng.integers(len(COLORS))] if kind == "any" else kind]
    hue, saturation, value = (float(rng.uniform(low, high)) for low, high in ranges)
    return np.array(colorsys.hsv_to_rgb(hue % 1, saturation, value))


def mixed(mix: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Mix two colours to an image ``[h, w, 3]`` uint8."""
    m = mix[..., None]
    return np.rint(255 * np.clip(first * (1 - m) + second * m, 0, 1)).astype(np.uint8)


def noise(
    rng: np.random.Generator, levels: tuple[int, int] = (2, 6), stretch: int = 1, side: int = SIDE
) -> np.ndarray:
    """Smooth noise ``[side, side]`` from 0 to 1 without a seam.

    Args:
        rng: random generator.
        levels: range of the powers of 2 of its wave numbers, the last excluded.
        stretch: ratio of the horizontal to the vertical wavelength.
        side: pixels.
    """
    total = np.zeros((side, side), np.float32)
    for level in range(*levels):
        coarse = rng.random((2**level, max(1, 2**level // stretch)), dtype=np.float32)
        wrapped = np.pad(coarse, 2, mode="wrap")
        box = (2, 2, wrapped.shape[1] - 2, wrapped.shape[0] - 2)
        finer = Image.fromarray(wrapped).resize((side, side), Image.Resampling.BICUBIC, box)
        total += np.asarray(finer) / np.float32(2 ** (0.8 * level))
    return (total - total.min()) / max(float(np.ptp(total)), 1e-6)


def striped(rng: np.random.Generator) -> np.ndarray:
    """Stripes along one side or across."""
    across = (_U, _V, _U + _V)[rng.integers(3)]
    return ((across * rng.integers(1, 10)) % 1 < rng.uniform(0.15, 0.6)).astype(np.float32)


def checked(rng: np.random.Generator) -> np.ndarray:
    """A chessboard or a tartan."""
    count = int(rng.integers(1, 6))
    if rng.random() < 0.5:
        return (np.floor(2 * count * _U) + np.floor(2 * count * _V)) % 2
    return ((_U * count % 1 < 0.4) * 0.5 + (_V * count % 1 < 0.4) * 0.5).astype(np.float32)


def dotted(rng: np.random.Generator) -> np.ndarray:
    """Dots in rows."""
    count = rng.integers(2, 8)
    x, y = (_U * count) % 1 - 0.5, (_V * count) % 1 - 0.5
    return (x**2 + y**2 < rng.uniform(0.02, 0.16)).astype(np.float32)


def clouded(rng: np.random.Generator) -> np.ndarray:
    """Smooth noise, faint or strong."""
    return rng.uniform(0.1, 1) * noise(rng)


def grained(rng: np.random.Generator) -> np.ndarray:
    """The grain of wood."""
    rings = noise(rng, (1, 4), 4)
    return 0.6 * (0.5 + 0.5 * np.sin(2 * math.pi * (rings * rng.uniform(3, 9)))) + 0.4 * noise(
        rng, (4, 7), 16
    )


def furry(rng: np.random.Generator) -> np.ndarray:
    """Fur: fine strands in tufts."""
    return 0.4 * noise(rng, (2, 5)) + 0.6 * noise(rng, (4, 7), 2).T


def spotted(rng: np.random.Generator) -> np.ndarray:
    """Patches with sharp edges: cows, camouflage, marble."""
    level = int(rng.integers(2, 4))
    steep = rng.uniform(8, 40)
    return np.clip((noise(rng, (level, level + 2)) - rng.uniform(0.4, 0.65)) * steep + 0.5, 0, 1)


def speckled(rng: np.random.Generator) -> np.ndarray:
    """Fine grains: stone, foam, bread, glaze."""
    grains = rng.random((SIDE, SIDE), dtype=np.float32)
    return np.clip(0.35 * noise(rng, (2, 5)) + (grains > rng.uniform(0.7, 0.97)) * 0.7, 0, 1)


PATTERNS: dict[str, Pattern] = {
    f.__name__: f for f in (striped, checked, dotted, clouded, grained, furry, spotted, speckled)
}


def _ink(value: np.ndarray) -> tuple[int, ...]:
    return tuple(int(round(255 * float(v))) for v in np.clip(value, 0, 1))


def _polygon(points: np.ndarray) -> list[tuple[float, ...]]:
    return [tuple(point) for point in (PRINT * points).tolist()]


def _photo(rng: np.random.Generator) -> Image.Image:
    """An image like a photograph: a soft ground, and shaded things before it."""
    pixels = mixed(noise(rng, (1, 5), side=64), color(rng), color(rng))
    part = Image.fromarray(pixels)
    draw = ImageDraw.Draw(part)
    for _ in range(rng.integers(1, 5)):
        r, tall, ink = rng.uniform(5, 22), rng.uniform(0.5, 1.8), color(rng)
        x, y = rng.uniform(6, 58), rng.uniform(19, 58)
        for shade, fraction in ((0.7, 1.0), (1.0, 0.85), (1.25, 0.45)):
            s = r * fraction
            draw.ellipse((x - s, y - s * tall, x + s, y + s * tall), _ink(ink * shade))
    return part


def package(rng: np.random.Generator, ground: np.ndarray, inks: list[np.ndarray]) -> np.ndarray:
    """A printed side of a package, ``[PRINT, PRINT, 3]`` uint8: fields, a photo, logos and text.

    Args:
        rng: random generator.
        ground: colour of the paper.
        inks: two or more colours.
    """
    sheet = Image.new("RGB", (PRINT, PRINT), _ink(ground))
    draw = ImageDraw.Draw(sheet)

    def ink() -> tuple[int, ...]:
        return _ink(inks[rng.integers(len(inks))])

    text = _ink(np.full(3, ground.mean() < 0.5)) if rng.random() < 0.6 else ink()
    if rng.random() < 0.5:  # a field with a curved or slanted edge
        x = np.linspace(0, 1, 24)
        slope, swing, turns = rng.uniform((-0.25, 0, 1), (0.25, 0.15, 7))
        y = rng.uniform(0.2, 0.8) + slope * (x - 0.5) + swing * np.sin(x * turns)
        draw.polygon(_polygon(np.stack([[*x, 1, 0], [*y, 1, 1]], 1)), ink())
    if rng.random() < 0.6:
        side = int(PRINT * rng.uniform(0.35, 0.7))
        x, y = (int(at) for at in rng.integers(0, PRINT - side, 2))
        sheet.paste(_photo(rng).resize((side, side)), (x, y))
    for _ in range(rng.integers(0, 3)):  # logos: discs and stars
        corners = int(rng.integers(3, 13))
        angle = np.arange(2 * corners) * math.pi / corners + rng.uniform(0, 6)
        reach = np.where(np.arange(2 * corners) % 2, rng.uniform(0.4, 1), 1)
        points = np.stack([reach * np.cos(angle), reach * np.sin(angle)], 1)
        draw.polygon(_polygon(rng.uniform(0.06, 0.2) * points + rng.uniform(0.1, 0.9, 2)), ink())
    for _ in range(rng.integers(1, 4)):  # words, some on a band
        top, high = rng.uniform(0.05, 0.7), rng.uniform(0.06, 0.25)
        if rng.random() < 0.3:
            draw.rectangle((0, PRINT * (top - 0.02), PRINT, PRINT * (top + high + 0.02)), ink())
        letters = rng.integers(len(_LETTERS), size=rng.integers(2, 9))
        word = "".join(_LETTERS[i] for i in letters)
        size = min(PRINT * high, 1.4 * PRINT / len(word))
        place = (PRINT / 2, PRINT * (top + high / 2))
        draw.text(place, word, text, ImageFont.load_default(size), anchor="mm")
    for y in range(int(PRINT * 0.82), int(PRINT * rng.uniform(0.82, 0.98)), 8):  # small print
        x, end = 16, PRINT * rng.uniform(0.4, 0.9)
        while x < end:
            long = int(rng.integers(5, 24))
            draw.rectangle((x, y, x + long, y + 3), text)
            x += long + 4
    return np.asarray(sheet)
