"""Made objects on plain backgrounds with their right masks, for the cut-out.

    PYTHONPATH=.:tests python -m helpers.cutouts

prints the tables of docs/reconstruct.md. Objects are drawn, or were rendered once (compositions of
random parts, and mugs: tests/photo/objects); half of them have enclosed background, the others
matter of the background's colour. Further ones are light grey on white, and only their doubts are
counted.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageDraw, ImageFilter

from gamba_warp.images import to_uint8

if TYPE_CHECKING:
    from gamba_warp.photo.plain import Plain

SIZE = 256  # side of a picture, pixels
KEPT = Path(__file__).parents[1] / "photo" / "objects"
_FINE = 3  # drawn pixels per pixel
_RED, _BLUE, _DARK, _WOOD = (178, 34, 40), (38, 84, 160), (42, 44, 50), (150, 98, 52)


@dataclass(frozen=True)
class Case:
    """A picture and its right mask.

    Attributes:
        name: of the object and its background.
        white: parts of the object have the background's colour; else it encloses background.
        shadow: the object casts a soft shadow.
        rgb: ``[S, S, 3]`` float32 in [0, 1].
        alpha: ``[S, S]`` float32 in [0, 1].
    """

    name: str
    white: bool
    shadow: bool
    rgb: np.ndarray
    alpha: np.ndarray


class _Pen:
    """A drawing in colours and coverage, finer than the picture; lengths in [0, 100]."""

    def __init__(self) -> None:
        self.side = SIZE * _FINE
        self.colors = Image.new("RGB", (self.side, self.side))
        self.cover = Image.new("L", (self.side, self.side))
        self.match = Image.new("L", (self.side, self.side))  # of the background's colour

    def __call__(self, shape: str, box: tuple, color: tuple | str, radius: float = 0) -> None:
        """Draw a shape in a colour, "clear" (background), "clipped" or "paper" (its colour)."""
        points = tuple(v * self.side / 100 for v in box)
        clear, white = color == "clear", {"clipped": 255, "paper": 128}.get(str(color), 0)
        more = {"radius": radius * self.side / 100} if shape == "rounded_rectangle" else {}
        for image, fill in (
            (self.colors, color if isinstance(color, tuple) else 0),
            (self.cover, 0 if clear else 255),
            (self.match, white),
        ):
            getattr(ImageDraw.Draw(image), shape)(points, fill=fill, **more)

    def lines(self, left: float, right: float, tops: range, thick: float, color: tuple) -> None:
        """Draw lines of text."""
        for number, top in enumerate(tops):
            end = right - (right - left) * (0.1 + 0.13 * (number * 7 % 4))
            self("rectangle", (left, top, end, top + thick), color)

    def layers(self, paper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return premultiplied colours ``[S, S, 3]`` and alpha for a background's colour."""
        colors, cover, match = (
            np.asarray(x, np.float32) / 255 for x in (self.colors, self.cover, self.match)
        )
        y, x = np.mgrid[: self.side, : self.side] / self.side
        light = 1.03 - 0.16 * np.clip(x + y - 0.4, 0, 1)[..., None]  # from the upper left
        shaded = np.where(match[..., None] > 0.4, np.minimum(paper * light, 1), colors * light)
        shaded = np.where(match[..., None] > 0.9, paper, shaded) * cover[..., None]
        folded = np.dstack([shaded, cover]).reshape(SIZE, _FINE, SIZE, _FINE, 4).mean((1, 3))
        return folded[..., :3], folded[..., 3]


def _headphones(p: _Pen) -> None:
    p("ellipse", (18, 10, 82, 84), _BLUE)
    p("ellipse", (26, 17, 74, 80), "clear")
    for left in (12, 66):
        p("rounded_rectangle", (left, 48, left + 22, 88), _DARK, 8)


def _glasses(p: _Pen) -> None:
    p("rectangle", (40, 44, 60, 48), _DARK)
    for left in (6, 54):
        p("ellipse", (left, 34, left + 40, 66), _DARK)
        p("ellipse", (left + 4, 38, left + 36, 62), "clear")


def _frame(p: _Pen) -> None:
    p("rectangle", (16, 12, 84, 88), _WOOD)
    p("rectangle", (25, 21, 75, 79), "clear")


def _scissors(p: _Pen) -> None:
    p("polygon", (30, 6, 36, 6, 62, 66, 52, 66), (120, 126, 134))
    p("polygon", (70, 6, 64, 6, 38, 66, 48, 66), (120, 126, 134))
    for left in (22, 52):
        p("ellipse", (left, 60, left + 26, 92), _RED)
        p("ellipse", (left + 6, 66, left + 20, 86), "clear")


def _padlock(p: _Pen) -> None:
    p("rounded_rectangle", (30, 8, 70, 70), (130, 134, 140), 20)
    p("rounded_rectangle", (40, 18, 60, 70), "clear", 10)
    p("rounded_rectangle", (20, 44, 80, 92), (196, 150, 46), 5)


def _ladder(p: _Pen) -> None:
    p("polygon", (36, 4, 64, 4, 84, 96, 16, 96), _WOOD)
    for top in range(10, 90, 16):
        left, lower = (41 - (y - 4) * 20 / 92 for y in (top, top + 11))
        p("polygon", (left, top, 100 - left, top, 100 - lower, top + 11, lower, top + 11), "clear")


def _ring(p: _Pen) -> None:
    p("ellipse", (8, 26, 92, 78), (220, 120, 150))
    p("ellipse", (30, 40, 70, 62), "clear")


def _basket(p: _Pen) -> None:
    p("polygon", (10, 34, 90, 34, 80, 92, 20, 92), _DARK)
    for row in range(5):
        for column in range(6):
            left, top = 22 + 9.6 * column, 40 + 10 * row
            p("rectangle", (left, top, left + 7, top + 7.4), "clear")


def _bottle(p: _Pen) -> None:
    p("rounded_rectangle", (42, 4, 58, 30), _DARK, 2)
    p("rounded_rectangle", (32, 24, 68, 96), (40, 96, 58), 8)
    p("rectangle", (32, 46, 68, 78), "paper")
    p("rectangle", (32.2, 46, 32.9, 78), (40, 96, 58))
    p("rectangle", (67.1, 46, 67.8, 78), (40, 96, 58))
    p.lines(37, 63, range(52, 74, 7), 2.4, _DARK)


def _jar(p: _Pen) -> None:  # a label without text, overexposed
    p("rounded_rectangle", (24, 14, 76, 92), _RED, 10)
    p("rounded_rectangle", (34, 40, 66, 70), "clipped", 3)


def _monitor(p: _Pen) -> None:
    p("rounded_rectangle", (8, 14, 92, 74), _DARK, 3)
    p("rectangle", (12, 18, 88, 68), "clipped")
    p.lines(18, 82, range(24, 60, 9), 3, _BLUE)
    p("rectangle", (44, 74, 56, 86), _DARK)
    p("rectangle", (30, 84, 70, 90), _DARK)


def _telephone(p: _Pen) -> None:
    p("rounded_rectangle", (30, 6, 70, 94), _DARK, 6)
    p("rectangle", (33, 14, 67, 84), "paper")


def _letter(p: _Pen) -> None:
    p("rectangle", (20, 10, 80, 90), (70, 70, 72))
    p("rectangle", (20.8, 10.8, 79.2, 89.2), "paper")
    p.lines(28, 74, range(20, 84, 8), 2, _DARK)


def _dice(p: _Pen) -> None:
    p("rounded_rectangle", (16, 16, 84, 84), (96, 96, 100), 10)
    p("rounded_rectangle", (17.2, 17.2, 82.8, 82.8), "paper", 9)
    for x, y in ((33, 33), (67, 33), (50, 50), (33, 67), (67, 67)):
        p("ellipse", (x - 6, y - 6, x + 6, y + 6), _DARK)


def _plate(p: _Pen) -> None:
    p("ellipse", (6, 20, 94, 84), _BLUE)
    p("ellipse", (12, 24, 88, 78), "paper")
    p("ellipse", (24, 33, 76, 70), (208, 212, 216))
    p("ellipse", (25, 33.6, 75, 69.4), "paper")


def _cup(p: _Pen) -> None:  # white in a dark outline, with a real hole in its handle
    p("ellipse", (58, 34, 92, 74), _DARK)
    p("ellipse", (59.4, 35.4, 90.6, 72.6), "paper")
    p("ellipse", (66, 42, 84, 66), _DARK)
    p("ellipse", (67.4, 43.4, 82.6, 64.6), "clear")
    p("rounded_rectangle", (14, 22, 72, 86), _DARK, 8)
    p("rounded_rectangle", (15.4, 23.4, 70.6, 84.6), "paper", 7)
    p("ellipse", (32, 44, 54, 66), _RED)


def _clock(p: _Pen) -> None:
    p("ellipse", (12, 12, 88, 88), _WOOD)
    p("ellipse", (18, 18, 82, 82), "clipped")
    for x, y in ((50, 24), (74, 50), (50, 76), (26, 50)):
        p("ellipse", (x - 2, y - 2, x + 2, y + 2), _DARK)
    p("polygon", (48.5, 52, 48.5, 30, 51.5, 30, 51.5, 52), _DARK)
    p("polygon", (50, 48.5, 66, 56, 65, 59, 48, 51.5), _DARK)


def _panda(p: _Pen) -> None:
    p("ellipse", (14, 16, 86, 90), _DARK)
    p("ellipse", (24, 40, 76, 84), "paper")
    for left in (30, 56):
        p("ellipse", (left, 24, left + 14, 38), "clipped")
        p("ellipse", (left + 4, 28, left + 10, 34), _DARK)


def _kept(name: str) -> Callable:
    """Return the layers of a rendered object, a composition of random parts or a mug."""

    def layers(paper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rgba = np.asarray(Image.open(KEPT / f"{name}.webp").convert("RGBA"), np.float32) / 255
        return rgba[..., :3] * rgba[..., 3:], rgba[..., 3]

    return layers


def _drawn(draw: Callable[[_Pen], None]) -> Callable:
    def layers(paper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pen = _Pen()
        draw(pen)
        return pen.layers(paper)

    return layers


# Backgrounds: colour, gradient from top to bottom, noise, quality of JPEG (0: none).
_GROUNDS = {
    "white": ((1.0, 1.0, 1.0), 0.0, 0.0, 0),
    "white JPEG": ((1.0, 1.0, 1.0), 0.0, 0.0, 88),
    "ivory": ((0.965, 0.955, 0.93), 0.0, 0.006, 0),
    "grey": ((0.70, 0.70, 0.71), 0.05, 0.005, 92),
    "blue": ((0.62, 0.76, 0.90), 0.03, 0.008, 90),
}


def _case(name: str, white: bool, layers: Callable, ground: str, shadow: bool) -> Case:
    color, gradient, noise, quality = _GROUNDS[ground]
    front, alpha = layers(np.array(color))
    rows = np.linspace(0.5, -0.5, SIZE)[:, None, None]
    back = np.broadcast_to(np.array(color) + gradient * rows, (SIZE, SIZE, 3)).copy()
    if shadow:  # on the floor: the lowest fifth of the object, flattened and blurred
        inside = np.flatnonzero((alpha > 0.5).any(1))
        low, high = inside[-1], max(1, (inside[-1] - inside[0]) // 5)
        cast = np.zeros((SIZE, SIZE), np.float32)
        foot = (alpha[low - high : low] > 0.5).any(0)
        cast[max(0, low - 4) : low + 5, :] = foot
        flat = Image.fromarray(to_uint8(0.55 * cast)).filter(ImageFilter.GaussianBlur(7))
        back *= 1 - np.asarray(flat, np.float32)[..., None] / 255
    rgb = front + (1 - alpha[..., None]) * back
    rgb += np.random.default_rng(len(name)).normal(0, 1, rgb.shape) * noise
    pixels = Image.fromarray(to_uint8(rgb))
    if quality:
        file = io.BytesIO()
        pixels.save(file, "JPEG", quality=quality)
        pixels = Image.open(file)
    rgb = np.asarray(pixels.convert("RGB"), np.float32) / 255
    return Case(f"{name}, {ground}", white, shadow, rgb, alpha.astype(np.float32))


_HOLED = {
    draw.__name__[1:]: _drawn(draw)
    for draw in (_headphones, _glasses, _frame, _scissors, _padlock, _ladder, _ring, _basket)
}
_WHITE = {
    draw.__name__[1:]: _drawn(draw)
    for draw in (_bottle, _jar, _monitor, _telephone, _letter, _dice, _plate, _cup, _clock, _panda)
}
for _seed in (0, 25, 68, 73, 97, 134, 161, 185, 207, 223, 233, 249):  # with enclosed background
    _HOLED[f"made {_seed}"] = _kept(f"made {_seed}")
for _seed in range(1, 9):
    _WHITE[f"white made {_seed}"] = _kept(f"white made {_seed}")
for _seed in range(2):
    _WHITE[f"white mug {_seed}"] = _kept(f"white mug {_seed}")


def cases() -> list[Case]:
    """Make the cases, 20 with enclosed background and 20 with white matter."""
    made, grounds = [], list(_GROUNDS)
    for white, objects in ((False, _HOLED), (True, _WHITE)):
        for number, (name, layers) in enumerate(objects.items()):
            ground = grounds[(number + number // 5) % len(grounds)]
            made.append(_case(name, white, layers, ground, number % 3 == 1))
    return made


def near_white() -> list[Case]:
    """Make light grey objects on white: parts look like the background or enclose it."""
    grounds = list(_GROUNDS)[:2]
    return [
        _case(f"mug {seed} of {shade}", True, _kept(f"mug {seed} of {shade}"), ground, False)
        for seed in range(7)
        for shade, ground in zip((0.88, 0.93), grounds)
    ]


def iou(found: np.ndarray | None, right: np.ndarray) -> float:
    """Return the IoU of two masks in [0, 1]; 0 without one."""
    if found is None:
        return 0.0
    return float(np.minimum(found, right).sum() / np.maximum(found, right).sum())


def doubted(case: Case, found: Plain) -> bool:
    """Return True if the command would doubt a cut-out by its plain background."""
    from gamba_warp.photo.cutout import doubts_of

    return found.alike or bool(doubts_of(case.rgb, found.rgba[..., 3]))


def main() -> None:
    """Print IoU with the right masks, with and without the removal of holes, and the doubts."""
    from gamba_warp.photo.plain import plain_matte

    groups: dict[str, list[tuple[float, float]]] = {}
    doubts: dict[str, list[bool]] = {}
    for case in (*cases(), *near_white()):
        near = " of " in case.name
        kept, removed = (plain_matte(case.rgb, keep_holes=keep) for keep in (True, False))
        assert kept is not None and removed is not None
        scores = iou(kept.rgba[..., 3], case.alpha), iou(removed.rgba[..., 3], case.alpha)
        doubt = doubted(case, removed)
        shown = " | ".join(f"{score:.3f}" for score in scores)
        print(f"| {case.name}{', shadow' * case.shadow} | {shown} | {'doubted' * doubt} |")
        group = "light grey" if near else "white matter" if case.white else "holes"
        for name in (group, *["shadow"] * case.shadow):
            groups.setdefault(name, []).append(scores)
        right = "right" if scores[1] >= 0.9 else "wrong"
        doubts.setdefault(f"{right}, {'light grey' if near else 'the others'}", []).append(doubt)
    for group, pairs in groups.items():
        kept, removed = np.mean(pairs, axis=0)
        print(f"| {group}, mean of {len(pairs)} | {kept:.3f} | {removed:.3f} | |")
    for group, found in doubts.items():
        print(f"| {group} | | | {sum(found)} of {len(found)} doubted |")


if __name__ == "__main__":
    main()
