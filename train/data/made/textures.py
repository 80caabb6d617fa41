"""Procedural textures: patterns of materials, and printed matter with letter-like marks.

A pattern is a mix ``[SIDE, SIDE]`` in [0, 1] of two colours, and repeats without a seam. Printed
matter is a whole picture ``[h, w, 3]``. Colours are display values in [0, 1].
"""

from __future__ import annotations

import colorsys
import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

SIDE = 128
PRINT = 256
Pattern = Callable[[np.random.Generator], np.ndarray]
_U, _V = np.meshgrid(*[((np.arange(SIDE) + 0.5) / SIDE).astype(np.float32)] * 2)
_LETTERS = "AAABCDEEEEFGHIIJKLMNNOOPQRSSTTUVWXYZ"


# Hues of toys; few things are bright green.
_HUES = (
    *(0.0, 0.0, 0.02, 0.07, 0.12, 0.14, 0.15, 0.25),
    *(0.36, 0.45, 0.55, 0.58, 0.6, 0.62, 0.78, 0.92),
)
# Ranges of hue, saturation and value.
_COLORS = {
    "pastel": ((0.0, 1.0), (0.12, 0.45), (0.75, 0.97)),
    "white": ((0.05, 0.2), (0.0, 0.1), (0.82, 0.98)),
    "wood": ((0.05, 0.11), (0.3, 0.7), (0.3, 0.88)),
    "metal": ((0.5, 0.65), (0.0, 0.08), (0.35, 0.85)),
    "fur": ((0.04, 0.12), (0.0, 0.65), (0.12, 0.95)),
    "earth": ((0.02, 0.2), (0.2, 0.7), (0.2, 0.75)),
    "leather": ((0.02, 0.1), (0.3, 0.8), (0.1, 0.6)),
}


def color(rng: np.random.Generator, kind: str = "any") -> np.ndarray:
    """Draw a colour ``[3]`` of a kind: one of ``_COLORS``, any, toy, dark or wide."""
    if kind == "any":
        kinds = ("toy", "toy", "pastel", "dark", "dark", "white", "white", "earth", "metal", "wide")
        kind = kinds[rng.integers(len(kinds))]
    if kind == "wide":
        return rng.uniform(0.05, 0.95, 3)
    if kind == "toy":
        hue = _HUES[rng.integers(len(_HUES))] + rng.normal(0, 0.015)
        light = rng.uniform(0.45, 0.95) * (0.8 if 0.2 < hue < 0.5 else 1)
        hsv = (hue % 1, rng.uniform(0.55, 0.97), light)
    elif kind == "dark":
        hsv = (rng.random(), rng.uniform(0, 0.5) * (rng.random() < 0.6), rng.uniform(0.05, 0.3))
    else:
        hsv = tuple(rng.uniform(low, high) for low, high in _COLORS[kind])
    return np.array(colorsys.hsv_to_rgb(*map(float, hsv)))


def mixed(mix: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Mix two colours to a picture ``[h, w, 3]`` uint8."""
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


def plain(rng: np.random.Generator) -> np.ndarray:
    """One colour, slightly soiled."""
    return rng.uniform(0, 0.25) * noise(rng, (1, 4))


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
    """Smooth noise."""
    return noise(rng)


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


def woven(rng: np.random.Generator) -> np.ndarray:
    """Cloth with its threads."""
    count = int(rng.integers(12, 32))
    x, y = _U * count, _V * count
    over = (np.floor(x) + np.floor(y)) % 2
    thread = np.where(over > 0, np.sin(math.pi * (x % 1)), np.sin(math.pi * (y % 1)))
    return 0.6 * (1 - thread) + 0.4 * noise(rng, (1, 4)) * 0.5


def knitted(rng: np.random.Generator) -> np.ndarray:
    """Knitting: columns of V's, sometimes with a motif of another colour."""
    count = int(rng.integers(8, 20))
    x, y = (_U * count) % 1, _V * count
    slant = (y + np.abs(x - 0.5)) % 1
    stitch = 0.35 * np.abs(np.sin(math.pi * slant)) + 0.25 * (np.abs(x - 0.5) < 0.08)
    if rng.random() < 0.5:
        rows = rng.random((count, count)) < 0.35
        rows[rng.random(count) < 0.4] = False
        rows = rows | rows[:, ::-1]
        stitch = np.maximum(stitch, 0.95 * rows[(_V * count).astype(int), (_U * count).astype(int)])
    return stitch.astype(np.float32)


def bricked(rng: np.random.Generator) -> np.ndarray:
    """A wall, or tiles."""
    rows = 2 * rng.integers(1, 5)
    shifted = _U * rows / 2 + 0.5 * (np.floor(_V * rows) % 2)
    return np.maximum((_V * rows) % 1 < 0.12, shifted % 1 < 0.06).astype(np.float32)


def shaded(rng: np.random.Generator) -> np.ndarray:
    """From one colour to the other and back, upwards."""
    return (0.5 - 0.5 * np.cos(2 * math.pi * _V)).astype(np.float32)


def brushed(rng: np.random.Generator) -> np.ndarray:
    """Metal that was brushed in one direction."""
    return 0.5 * noise(rng, (3, 7), 32)


def speckled(rng: np.random.Generator) -> np.ndarray:
    """Fine grains: stone, foam, bread, glaze."""
    grains = rng.random((SIDE, SIDE), dtype=np.float32)
    return np.clip(0.35 * noise(rng, (2, 5)) + (grains > rng.uniform(0.7, 0.97)) * 0.7, 0, 1)


def flowered(rng: np.random.Generator) -> np.ndarray:
    """Flowers or leaves strewn about."""
    out = np.zeros_like(_U)
    for _ in range(rng.integers(3, 9)):
        x = (_U - rng.random() + 0.5) % 1 - 0.5
        y = (_V - rng.random() + 0.5) % 1 - 0.5
        r, a = np.hypot(x, y), np.arctan2(y, x) + rng.uniform(0, 6)
        size = rng.uniform(0.05, 0.16)
        petals = size * (0.65 + 0.35 * np.cos(rng.integers(3, 7) * a))
        out = np.where(r < petals, rng.uniform(0.6, 1), out)
        out = np.where(r < 0.25 * size, 0.2, out)
    return out.astype(np.float32)


def paneled(rng: np.random.Generator) -> np.ndarray:
    """Thin lines between panels, with rivets."""
    out = np.zeros_like(_U)
    for axis in (_U, _V):
        for place in rng.random(rng.integers(1, 4)):
            out = np.maximum(out, np.abs(axis - place) < 0.008)
    return 0.8 * out.astype(np.float32)


PATTERNS: dict[str, Pattern] = {
    f.__name__: f
    for f in (
        *(plain, striped, checked, dotted, clouded, grained, furry, spotted, woven, knitted),
        *(bricked, shaded, brushed, speckled, flowered, paneled),
    )
}


@lru_cache(maxsize=16)
def _font(size: int) -> ImageFont.ImageFont | ImageFont.FreeTypeFont:
    return ImageFont.load_default(size)


def _ink(value: np.ndarray) -> tuple[int, ...]:
    return tuple(int(round(255 * float(v))) for v in np.clip(value, 0, 1))


def _word(rng: np.random.Generator, low: int = 2, high: int = 9) -> str:
    letters = "".join(
        _LETTERS[i] for i in rng.integers(len(_LETTERS), size=rng.integers(low, high))
    )
    return letters if rng.random() < 0.6 else letters.capitalize()


class Print:
    """A printed sheet.

    Args:
        rng: random generator.
        ground: its colour.
        height: pixels; ``PRINT`` wide.
    """

    def __init__(self, rng: np.random.Generator, ground: np.ndarray, height: int) -> None:
        self.rng, self.width, self.height = rng, PRINT, height
        self.image = Image.new("RGB", (PRINT, height), _ink(ground))
        self.draw = ImageDraw.Draw(self.image)

    def pixels(self) -> np.ndarray:
        """The picture ``[height, width, 3]`` uint8."""
        return np.asarray(self.image)

    def _place(self, box: tuple[float, float, float, float]) -> tuple[int, int, int, int]:
        w, h = self.width, self.height
        left, top, right, bottom = box
        return (
            int(left * w),
            int(top * h),
            max(int(right * w), int(left * w) + 1),
            max(int(bottom * h), int(top * h) + 1),
        )

    def word(self, box: tuple[float, float, float, float], ink: np.ndarray) -> None:
        """A word that fills a box of shares (left, top, right, bottom) of the sheet."""
        x0, y0, x1, y1 = self._place(box)
        text = _word(self.rng)
        size = max(6, min(int(0.95 * (y1 - y0)), int(1.6 * (x1 - x0) / len(text))))
        bold = size // 18 if self.rng.random() < 0.5 else 0
        self.draw.text(
            ((x0 + x1) / 2, (y0 + y1) / 2),
            text,
            _ink(ink),
            _font(size),
            anchor="mm",
            stroke_width=bold,
        )

    def lines(
        self, box: tuple[float, float, float, float], ink: np.ndarray, height: float = 0.03
    ) -> None:
        """Lines of marks as small print has them."""
        x0, y0, x1, y1 = self._place(box)
        step = max(3, int(height * self.height))
        for y in range(y0, y1 - step // 2, step):
            x = x0
            end = x1 - int(self.rng.uniform(0, 0.35) * (x1 - x0))
            while x < end:
                long = int(self.rng.integers(2, 9)) * step // 3 + 1
                self.draw.rectangle((x, y, min(x + long, end), y + step // 2 - 1), _ink(ink))
                x += long + step // 3 + 1

    def mark(
        self, center: tuple[float, float], radius: float, ink: np.ndarray, second: np.ndarray
    ) -> None:
        """A logo: a disc, a star, a badge or a flower."""
        rng = self.rng
        x, y = center[0] * self.width, center[1] * self.height
        r = radius * min(self.width, self.height)
        kind = rng.integers(5)
        if kind == 0:
            self.draw.ellipse((x - r, y - r, x + r, y + r), _ink(ink))
            self.draw.ellipse((x - r / 2, y - r / 2, x + r / 2, y + r / 2), _ink(second))
        elif kind == 1:
            self.draw.rounded_rectangle(
                (x - r, y - 0.6 * r, x + r, y + 0.6 * r),
                0.3 * r,
                _ink(ink),
                _ink(second),
                max(1, int(r / 8)),
            )
        else:
            corners = int(rng.integers(3, 13))
            angle = np.arange(2 * corners) * math.pi / corners + rng.uniform(0, 6)
            reach = r * np.where(np.arange(2 * corners) % 2, rng.uniform(0.4, 0.95), 1)
            points = np.stack([x + reach * np.cos(angle), y + reach * np.sin(angle)], 1)
            self.draw.polygon([tuple(p) for p in points.tolist()], _ink(ink))
            if kind == 2:
                self.draw.ellipse((x - r / 3, y - r / 3, x + r / 3, y + r / 3), _ink(second))

    def photo(self, box: tuple[float, float, float, float]) -> None:
        """A picture like a photograph: soft ground, shaded things before it."""
        x0, y0, x1, y1 = self._place(box)
        rng = self.rng
        w, h = x1 - x0, y1 - y0
        a, b, c = (color(rng) for _ in range(3))
        m = noise(rng, (1, 5), side=64)
        n = noise(rng, (0, 3), side=64)[..., None]
        ground = mixed(m, a, b) * (1 - 0.5 * n) + 255 * 0.5 * n * c
        part = Image.fromarray(ground.astype(np.uint8)).resize((w, h))
        draw = ImageDraw.Draw(part)
        for _ in range(rng.integers(1, 5)):
            r = rng.uniform(0.08, 0.35) * min(w, h)
            x, y = rng.uniform(0.1, 0.9) * w, rng.uniform(0.3, 0.9) * h
            ink, tall = color(rng), rng.uniform(0.5, 1.8)
            for shade, share in ((0.7, 1.0), (1.0, 0.85), (1.25, 0.45)):
                s = r * share
                draw.ellipse((x - s, y - s * tall, x + s, y + s * tall), _ink(ink * shade))
        self.image.paste(part, (x0, y0))

    def band(self, box: tuple[float, float, float, float], ink: np.ndarray) -> None:
        """A filled rectangle."""
        self.draw.rectangle(self._place(box), _ink(ink))

    def wave(self, ink: np.ndarray) -> None:
        """A field with a curved or slanted edge, over part of the sheet."""
        rng = self.rng
        x = np.linspace(0, 1, 24)
        y = (
            rng.uniform(0.2, 0.8)
            + rng.uniform(-0.25, 0.25) * (x - 0.5)
            + rng.uniform(0, 0.15) * np.sin(x * rng.uniform(1, 7) + rng.uniform(0, 6))
        )
        edge = list(zip((x * self.width).tolist(), (y * self.height).tolist()))
        side = self.height if rng.random() < 0.6 else 0
        self.draw.polygon([*edge, (self.width, side), (0, side)], _ink(ink))


def package(
    rng: np.random.Generator,
    ground: np.ndarray,
    inks: list[np.ndarray],
    kind: str,
    height: int,
) -> np.ndarray:
    """A printed side of a package.

    Args:
        rng: random generator.
        ground: colour of the paper.
        inks: two or more colours.
        kind: front or label.
        height: pixels; ``PRINT`` wide.
    """
    sheet = Print(rng, ground, height)
    ink = lambda: inks[rng.integers(len(inks))]  # noqa: E731
    light = 0.0 if ground.mean() > 0.5 else 1.0
    text = np.full(3, light) if rng.random() < 0.6 else ink()
    if rng.random() < 0.5:
        sheet.wave(ink())
    if kind == "front":
        if rng.random() < 0.7:
            left, top = rng.uniform(0, 0.4), rng.uniform(0.2, 0.5)
            sheet.photo((left, top, rng.uniform(left + 0.35, 1), rng.uniform(top + 0.3, 1)))
        for _ in range(rng.integers(0, 3)):
            sheet.mark(
                (rng.uniform(0.1, 0.9), rng.uniform(0.1, 0.9)), rng.uniform(0.06, 0.2), ink(), ink()
            )
        top = rng.choice([0.04, 0.08, 0.3, 0.62])
        if rng.random() < 0.4:
            sheet.band((0, top - 0.02, 1, top + 0.24), ink())
        sheet.word((0.06, top, 0.94, top + rng.uniform(0.12, 0.25)), text)
        for _ in range(rng.integers(0, 3)):
            y = rng.uniform(0.3, 0.88)
            sheet.word((0.1, y, rng.uniform(0.45, 0.9), y + rng.uniform(0.05, 0.1)), text)
        if rng.random() < 0.5:
            sheet.lines((0.08, 0.86, 0.6, 0.96), text, 0.035)
    else:
        sheet.band((0, 0, 1, rng.uniform(0.05, 0.2)), ink())
        if rng.random() < 0.6:
            sheet.band((0, rng.uniform(0.75, 0.92), 1, 1), ink())
        at = rng.uniform(0.25, 0.5)
        for x in (0.25, 0.75) if rng.random() < 0.5 else (0.5,):
            sheet.word((x - 0.22, at, x + 0.22, at + rng.uniform(0.1, 0.25)), text)
            sheet.mark((x, rng.uniform(0.2, 0.75)), rng.uniform(0.05, 0.15), ink(), ink())
        if rng.random() < 0.4:
            sheet.photo((rng.uniform(0.3, 0.4), 0.4, rng.uniform(0.55, 0.7), 0.9))
        sheet.lines((0.02, 0.3, 0.2, 0.75), text, 0.03)
        sheet.lines((0.8, 0.3, 0.98, 0.75), text, 0.03)
    return sheet.pixels()
