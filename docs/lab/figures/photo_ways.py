"""Cuts the object out of ordinary photographs with each method, and shows the results.

The pictures are samples of other packages, read from the installed packages (or from a folder of
unpacked archives); none of them is stored here:

    python docs/lab/figures/photo_ways.py --model isnet.onnx --folder unpacked --out ways.png

prints the table of docs/photo.md, without the visual judgements, and writes a sheet: a row a
picture; the picture, and the results of plain background, matting network and GrabCut.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from gamba_warp.data.preprocess import shrink
from gamba_warp.images import load_rgba, save_image
from gamba_warp.kernels.runtime.tables import markdown
from gamba_warp.photo.cutout import fault_of
from gamba_warp.photo.grabcut import grabcut
from gamba_warp.photo.matte import Matte
from gamba_warp.photo.plain import plain_matte

# Package (by its import name, or a folder), and the picture in it.
PICTURES = (
    ("skimage/data", "astronaut.png"),
    ("skimage/data", "camera.png"),
    ("skimage/data", "chelsea.png"),
    ("skimage/data", "coffee.png"),
    ("skimage/data", "motorcycle_left.png"),
    ("skimage/data", "rocket.jpg"),
    ("sklearn/datasets/images", "china.jpg"),
    ("sklearn/datasets/images", "flower.jpg"),
    ("matplotlib/mpl-data/sample_data", "grace_hopper.jpg"),
    ("gradio/media_assets/images", "cheetah.jpg"),
    ("gradio/media_assets/images", "cheetah1.jpg"),
    ("gradio/media_assets/images", "lion.jpg"),
    ("gradio/media_assets/images", "tower.jpg"),
    ("ultralytics/assets", "bus.jpg"),
    ("opencv/samples/data", "aloeL.jpg"),
    ("opencv/samples/data", "apple.jpg"),
    ("opencv/samples/data", "baboon.jpg"),
    ("opencv/samples/data", "butterfly.jpg"),
    ("opencv/samples/data", "messi5.jpg"),
    ("opencv/samples/data", "squirrel_cls.jpg"),
)
_CELL = 192  # side of a picture on the sheet, pixels


def find(folder: Path | None) -> Iterator[tuple[str, Path | None]]:
    """Yield each picture's name, and its file or None.

    Args:
        folder: folder with unpacked archives of packages that are not installed.
    """
    for package, name in PICTURES:
        root, _, inner = package.partition("/")
        spec = find_spec(root)
        places = [folder / package / name] if folder is not None else []
        if spec is not None and spec.origin is not None:
            places.append(Path(spec.origin).parent / inner / name)
        yield f"{root}: {name}", next((place for place in places if place.is_file()), None)


def plain(rgb: np.ndarray) -> np.ndarray | None:
    """Alpha after removal of a plain background, or None without one."""
    found = plain_matte(rgb)
    return None if found is None else found.rgba[..., 3]


def cell(picture: np.ndarray) -> np.ndarray:
    """The picture on a square of the sheet."""
    small = shrink(np.dstack([picture, np.ones(picture.shape[:2], np.float32)]), _CELL)
    out = np.ones((_CELL, _CELL, 3), np.float32)
    out[: small.shape[0], : small.shape[1]] = small[..., :3]
    return out


def compare(model: Path, folder: Path | None, out: Path) -> list[list[str]]:
    """Try every method on every available picture, and write the sheet.

    Returns:
        A row for each picture: its name, and for each method the object's share of the picture, or
        the reason of the failure, with the seconds.
    """
    ways: list[Callable[[np.ndarray], np.ndarray | None]] = [plain, Matte(model), grabcut]
    rows, sheet = [], []
    for name, path in find(folder):
        if path is None:
            rows.append([name, "not here", "", ""])
            continue
        rgb = shrink(load_rgba(path), 1024)[..., :3]
        row, cells = [name], [cell(rgb)]
        for way in ways:
            begun = time.perf_counter()
            alpha = way(rgb)
            seconds = time.perf_counter() - begun
            fault = "not plain" if alpha is None else fault_of(alpha)
            alpha = np.zeros(rgb.shape[:2], np.float32) if alpha is None or fault else alpha
            row.append(f"{fault or f'{(alpha > 0.5).mean():.0%}'}, {seconds:.1f} s")
            magenta = np.array([1, 0, 1], np.float32)
            cells.append(cell(rgb * alpha[..., None] + magenta * (1 - alpha[..., None])))
        rows.append(row)
        sheet.append(np.hstack(cells))
    if sheet:
        half = (len(sheet) + 1) // 2
        blank = [np.ones_like(sheet[0])] * (2 * half - len(sheet))
        columns = np.vstack(sheet[:half]), np.vstack(sheet[half:] + blank)
        save_image(out, np.hstack(columns))
    return rows


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Each way on ordinary photographs.")
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--out", type=Path, default=Path("ways.png"))
    given = parser.parse_args()
    rows = compare(given.model, given.folder, given.out)
    print(markdown(["picture", "plain", "matting model", "GrabCut"], rows))


if __name__ == "__main__":
    main()
