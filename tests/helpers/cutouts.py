"""Made objects on plain backgrounds with their right masks, for the cut-out.

    PYTHONPATH=.:tests python -m helpers.cutouts

prints the tables of docs/reconstruct.md. Objects were drawn once, each for its background, or
rendered (compositions of random parts, and mugs); tests/photo/objects has them. Half of them have
enclosed background, the others matter of the background's colour. Further ones are light grey on
white, and only their doubts are counted.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageFilter

from gamba_warp.images import to_uint8

if TYPE_CHECKING:
    from gamba_warp.photo.plain import Plain

SIZE = 256  # side of an image, pixels
KEPT = Path(__file__).parents[1] / "photo" / "objects"


@dataclass(frozen=True)
class Case:
    """An image and its right mask.

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


def _kept(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return premultiplied colours ``[S, S, 3]`` and alpha of an object."""
    rgba = np.asarray(Image.open(KEPT / f"{name}.webp").convert("RGBA"), np.float32) / 255
    return rgba[..., :3] * rgba[..., 3:], rgba[..., 3]


# Backgrounds: colour, gradient from top to bottom, noise, quality of JPEG (0: none).
_GROUNDS = {
    "white": ((1.0, 1.0, 1.0), 0.0, 0.0, 0),
    "white JPEG": ((1.0, 1.0, 1.0), 0.0, 0.0, 88),
    "ivory": ((0.965, 0.955, 0.93), 0.0, 0.006, 0),
    "grey": ((0.70, 0.70, 0.71), 0.05, 0.005, 92),
    "blue": ((0.62, 0.76, 0.90), 0.03, 0.008, 90),
}


def _case(name: str, white: bool, ground: str, shadow: bool) -> Case:
    color, gradient, noise, quality = _GROUNDS[ground]
    front, alpha = _kept(name)
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


_HOLED = "headphones glasses frame scissors padlock ladder ring basket".split()
_WHITE = "bottle jar monitor telephone letter dice plate cup clock panda".split()
_HOLED += [f"made {seed}" for seed in (0, 25, 68, 73, 97, 134, 161, 185, 207, 223, 233, 249)]
_WHITE += [*(f"white made {seed}" for seed in range(1, 9)), "white mug 0", "white mug 1"]


def cases() -> list[Case]:
    """Make the cases, 20 with enclosed background and 20 with white matter."""
    made, grounds = [], list(_GROUNDS)
    for white, objects in ((False, _HOLED), (True, _WHITE)):
        for number, name in enumerate(objects):
            ground = grounds[(number + number // 5) % len(grounds)]
            made.append(_case(name, white, ground, number % 3 == 1))
    return made


def near_white() -> list[Case]:
    """Make light grey objects on white: parts look like the background or enclose it."""
    kinds = product(range(7), zip((0.88, 0.93), _GROUNDS))
    return [_case(f"mug {seed} of {shade}", True, at, False) for seed, (shade, at) in kinds]


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
