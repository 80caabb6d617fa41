"""Page of ``gamba demo`` with the results of its commands."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from ..conventions import GREY, over_background
from ..errors import UserError
from ..formats.ply import load_ply
from ..photo.cutout import cut_out
from ..trajectories.movies import turntable_frames
from ..untrusted.documents import read_document
from .card import OF_GROUNDS, OF_IMAGES, ModelCard, about_model, read_card
from .page import Section, write_page
from .sheet import tiles

_BASELINES = {
    "background": "an empty image",
    "input_copy": "a copy of the input",
    "billboard": "the input as a flat cut-out",
    "retrieval": "the training object most like it",
}
_LIBRARY = re.compile(r"^(blendswap-cc-(0|by)|katorlegaz|reallusion|scopia)-")
_FIRST = 6  # images in the first section
_TURN = 24  # views of a turntable
_SHOWN = 5  # of these, in the first section


@dataclass(frozen=True)
class DemoResults:
    """Paths of the results of a demo's commands.

    Attributes:
        shipped: the shipped model file.
        icons: images that were reconstructed.
        results: of ``gamba reconstruct``; some may be missing.
        views: results of ``gamba eval-views`` of the shipped model.
        shapes: results of ``gamba eval-geometry``; the report may be missing.
    """

    shipped: Path
    icons: Path
    results: Path
    views: Path
    shapes: Path


def write_demo(path: Path, results: DemoResults, text: str) -> None:
    """Write the page.

    Args:
        path: the .html file.
        results: to show.
        text: a sentence or two for the head of the page.

    Raises:
        UserError: a file cannot be read or written.
    """
    try:
        card = read_card(results.shipped)
    except UserError:
        card = None
    report = read_document(results.views / "report.json", dict[str, Any])
    strips = sorted((results.views / "strips").glob("*.png"))
    held_out = []
    for strip in strips:
        shown = tiles(strip)
        record = next(o for o in report["objects"] if o["name"] == strip.stem)
        caption = (
            f"Shipped model. New views: {record['psnr']:.1f} dB; "
            f"input view: {record['input']['psnr']:.1f} dB."
        )
        section = _turned(_name(strip), caption, results.views / "gaussians" / f"{strip.stem}.ply")
        section.image, section.views = shown[0][0], {"Predicted": shown[1], "Truth": shown[2]}
        held_out.append(section)
    icons, others = [], []
    for icon in sorted(results.icons.glob("*.png")):
        ply = results.results / f"{icon.stem}.ply"
        if ply.exists():
            caption = "Shipped model; an image by another renderer."
            icons.append(_turned(f"Icon: {_name(icon)}", caption, ply))
            icons[-1].image = cut_out(icon).rgba
            if _name(icon) not in map(_name, strips):
                others.append(icons[-1])
    mixed = [section for pair in zip_longest(held_out, others) for section in pair if section]
    first = (
        "Each row has the input image, then views of the result of one pass of the shipped model "
        f"on this machine, in steps of {360 * (_TURN // _SHOWN) // _TURN} degrees from the input "
        "view. The model was trained on none of these objects."
    )
    around = {section.title: _around(section) for section in mixed[:_FIRST]}
    sections = [
        Section("Objects that the model has never seen", first, views=around),
        *_numbers(results, report, card),
        Section("The shipped model", table=about_model(results.shipped)),
        *held_out,
        *icons,
    ]
    write_page(path, "Gamba demo", sections, text)


def _turned(title: str, text: str, ply: Path) -> Section:
    """Return a reconstruction with its turntable."""
    gaussians = load_ply(ply).drawn()
    turn = turntable_frames(gaussians, size=192, frames=_TURN)
    return Section(title, text, gaussians=gaussians, turntable=turn)


def _name(path: Path) -> str:
    """Return the name of an object without its library's."""
    return _LIBRARY.sub("", path.stem)


def _around(section: Section) -> np.ndarray:
    """Return the input and some frames of the turntable, ``[1 + _SHOWN, S, S, 3]``."""
    assert section.image is not None and section.turntable is not None
    frames = section.turntable[:: len(section.turntable) // _SHOWN][:_SHOWN] / 255.0
    flat = section.image
    if flat.shape[-1] == 4:
        flat = over_background(flat, GREY)
    side = frames.shape[1]
    nearest = ((np.arange(side) + 0.5) * len(flat) / side).astype(int)
    return np.concatenate([flat[nearest][:, nearest][None], frames])


def _numbers(results: DemoResults, report: dict[str, Any], card: ModelCard | None) -> list[Section]:
    """Return metrics of models and baselines, on white and on other backgrounds."""
    models = {"the shipped model": report["mean"]}
    others = {_BASELINES.get(name, name): mean for name, mean in report["baselines"].items()}
    figures = [(label, "new views", mean) for label, mean in (models | others).items()]
    figures += [(label, "input view", mean["input"]) for label, mean in models.items()]
    shapes = results.shapes / "report.json"
    geometry = read_document(shapes, dict[str, Any])["mean"] if shapes.exists() else {}
    keys = ("chamfer", "normal_consistency", "iou")
    found = [f"{key.replace('_', ' ')} {_cell(geometry[key])}" for key in keys if key in geometry]
    text = f"Means over {report['num_ok']} held-out objects; LPIPS is better the lower it is. "
    text += f"Shape, by the shipped model: {', '.join(found)}." if found else "No geometry."
    rows = [row for row in (card.figures if card else ()) if row.views == "novel"]
    of, known = "psnr", {}
    for row in rows:
        if figure := getattr(row, of):
            known[row.name] = figure.mean
    empty = report["baselines"].get("background", {}).get("psnr", math.inf)
    if report["mean"]["psnr"] < known.get("model", 0) and empty < known.get("background", 0):
        text += (
            f" Over the {rows[0].objects} test objects of the README the shipped model has "
            f"{known['model']:.1f} dB in new views. These few are harder for every method, because "
            "they fill more of their images: an empty image, which is right wherever nothing "
            f"is, has {empty:.1f} dB here and {known['background']:.1f} dB there."
        )
    floaters = "White floaters are invisible on white, but count here."
    parts = ("Numbers", text, OF_IMAGES), ("Numbers on black and on grey", floaters, OF_GROUNDS)
    sections = []
    for title, caption, names in parts:
        rows = [[label, views, *(_cell(m.get(k)) for k in names)] for label, views, m in figures]
        sections.append(Section(title, caption, header=["", "views", *names.values()], table=rows))
    return sections


def _cell(value: float | None) -> str:
    return "absent" if value is None else f"{value:.3f}"
