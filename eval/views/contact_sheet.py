"""Images of an evaluation: strips per object, and a sheet of best, median and worst."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont, ImageOps
from torch import Tensor

from gamba_warp.files import atomic_path, output_folder
from gamba_warp.image_metrics import METRICS
from gamba_warp.images import save_image, to_uint8

from .compare import GroundTruth, choose_views

TILE = 128  # pixels per side; images are fitted into it
_LABEL, _HEADER, _GAP, _LINE = 200, 22, 4, 16  # pixels
RULE = "by PSNR of the novel views, of the input view where there are no others"


@dataclass
class Row:
    """Row of one object.

    Attributes:
        lines: its label.
        shown: the input image ``[H, W, 3]`` in [0, 1].
        gt: true views ``[k, H, W, 3]`` in [0, 1].
        predicted: the same views as predicted.
    """

    lines: list[str]
    shown: Tensor
    gt: Tensor
    predicted: Tensor


def choose_ranks(count: int, each: int) -> dict[int, str]:
    """Choose ``each`` of the best, median and worst ranks; 0 is the best.

    Returns:
        Labels by rank; an object in two groups is listed once.
    """
    starts = {"best": 0, "median": max(0, (count - each) // 2), "worst": count - each}
    labels: dict[int, str] = {}
    for name, start in starts.items():
        for rank in range(max(0, start), min(start + each, count)):
            labels.setdefault(rank, name)
    return dict(sorted(labels.items()))


def label(record: dict[str, Any], place: str) -> list[str]:
    """Return the lines next to an object's images: its name, rank and metrics."""
    lines = [record["name"], place]
    for kind, values in (("novel", record), ("input", record["input"])):
        known = [
            f"{metric.title} {values[key]:.{metric.digits}f} {metric.unit}".strip()
            for key, metric in METRICS.items()
            if values[key] is not None
        ]
        if known:
            lines += [f"{kind}: {', '.join(known[:2])}", f"    {', '.join(known[2:])}"]
    return lines


def contact_sheet(path: Path, rows: list[Row]) -> None:
    """Write a PNG with a row per object: label | input | true novel views | predicted ones.

    Raises:
        UserError: the file cannot be written.
    """
    most = max(len(row.gt) for row in rows)
    step = TILE + _GAP
    starts = [_LABEL, _LABEL + step + 2 * _GAP, _LABEL + step + 4 * _GAP + most * step]
    sheet = Image.new("RGB", (starts[2] + most * step, _HEADER + len(rows) * step), (255, 255, 255))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default()
    for start, title in zip(
        starts, ("input", "ground truth", "prediction") if most else ("input",)
    ):
        draw.text((start, 4), title, fill=(0, 0, 0), font=font)
    for number, row in enumerate(rows):
        top = _HEADER + number * step
        for k, line in enumerate(row.lines):
            grey = (0, 0, 0) if k == 0 else (80, 80, 80)
            draw.text((6, top + 4 + k * _LINE), line, fill=grey, font=font)
        for start, images in zip(starts, (row.shown[None], row.gt, row.predicted)):
            for k, image in enumerate(images):
                pixels = Image.fromarray(to_uint8(np.asarray(image.cpu())))
                tile = ImageOps.pad(pixels, (TILE, TILE), color=(255, 255, 255))
                edge = (0, 0, TILE - 1, TILE - 1)
                ImageDraw.Draw(tile).rectangle(edge, outline=(225, 225, 225))
                sheet.paste(tile, (start + k * step, top))
    with atomic_path(path) as temporary:
        sheet.save(temporary)


def save_strips(path: Path, rgb: Tensor, gt: GroundTruth, count: int = 4) -> None:
    """Write rows of input, prediction and ground truth: ``count`` views, the input first."""
    rows = choose_views(len(rgb), 0, count)
    strips = [torch.cat([gt.rgb[0], rgb[row], gt.rgb[row]], 1) for row in rows]
    output_folder(path.parent)
    save_image(path, torch.cat(strips, 0).cpu().numpy())
