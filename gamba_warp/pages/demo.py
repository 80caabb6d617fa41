"""The page of ``gamba demo``: what its commands wrote, on one page."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

import numpy as np

from ..conventions import WHITE, over_background
from ..data.preprocess import prepare
from ..errors import UserError
from ..formats.ply import load_ply
from ..gaussians import Gaussians
from .card import OF_GROUNDS, OF_PICTURES, about_model, read_card
from .curves import curves_section
from .page import Section, demo_page
from .run_log import read_run_log
from .sheet import tiles
from .turntable import turntable_frames

_BASELINES = {
    "background": "an empty picture",
    "input_copy": "a copy of the input",
    "billboard": "the input as a flat cut-out",
    "retrieval": "the training object most like it",
}
_LIBRARY = re.compile(r"^(blendswap-cc-(0|by)|katorlegaz|reallusion|scopia)-")
_ICON = "Icon: "
_FIRST = 6  # pictures in the first section
_TURN = 24  # views of a turntable
_SHOWN = 5  # of these in the first section


@dataclass(frozen=True)
class DemoResults:
    """Where the commands of a demo left their results.

    Attributes:
        shipped: the model file that the demo came with.
        icons: pictures that were reconstructed.
        results: what ``gamba reconstruct`` made of them; some may be missing.
        views: results of ``gamba eval-views`` of the shipped model.
        shapes: results of ``gamba eval-geometry``; the report may be missing.
        run: run folder of ``gamba train``; it may be missing still.
        views_here: results of ``gamba eval-views`` of that model; they may be missing still.
    """

    shipped: Path
    icons: Path
    results: Path
    views: Path
    shapes: Path
    run: Path
    views_here: Path


def write_demo(path: Path, results: DemoResults, text: str) -> None:
    """Writes the page.

    Args:
        path: the .html file.
        results: what is shown.
        text: a sentence or two for the head of the page.

    Raises:
        UserError: a file cannot be read or written.
    """
    views, here = _report(results.views), _report(results.views_here)
    strips = sorted((results.views / "strips").glob("*.png"))
    icons = _icons(results)
    held_out = [_held_out(strip, results.views, views) for strip in strips]
    sections = [
        _first(icons, held_out),
        *_numbers(views, _report(results.shapes), here, results.shipped),
        Section("The shipped model", table=about_model(results.shipped)),
        *_trained_here(results, strips if here else []),
        *held_out,
        *icons,
    ]
    demo_page(path, sections, text=text)


def _report(folder: Path) -> dict:
    path = folder / "report.json"
    return json.loads(path.read_bytes()) if path.exists() else {}


def _cell(value: float | None) -> str:
    return "absent" if value is None else f"{value:.3f}"


def _first(icons: list[Section], held_out: list[Section]) -> Section:
    """Some of the pictures, each with views from around what the shipped model makes of it."""
    names = {section.title for section in held_out}
    others = [section for section in icons if section.title.removeprefix(_ICON) not in names]
    mixed = [section for pair in zip_longest(held_out, others) for section in pair if section]
    rows = {section.title: _around(section) for section in mixed[:_FIRST]}
    text = (
        "One picture in, the first of each row; one pass of the shipped model on this machine; "
        f"views from all around out, in steps of {360 * (_TURN // _SHOWN) // _TURN} degrees, the "
        "first from the same side. The model was trained on none of these objects."
    )
    return Section("Objects that the model has never seen", text, views=rows)


def _around(section: Section) -> np.ndarray:
    """The input and some frames of the turntable, ``[1 + _SHOWN, S, S, 3]``."""
    assert section.picture is not None and section.turntable is not None
    frames = section.turntable[:: len(section.turntable) // _SHOWN][:_SHOWN] / 255.0
    flat = section.picture
    if flat.shape[-1] == 4:
        flat = over_background(flat, WHITE)
    side = frames.shape[1]
    nearest = (np.arange(side) + 0.5) * len(flat) / side
    index = nearest.astype(int)
    return np.concatenate([flat[index][:, index][None], frames])


def _numbers(views: dict, shapes: dict, here: dict, shipped: Path) -> list[Section]:
    """Metrics of the models beside those of the baselines, on white and on other grounds."""
    models = {"the shipped model": views["mean"]}
    if here:
        models["the model trained here"] = here["mean"]
    others = {_BASELINES.get(name, name): m for name, m in views["baselines"].items()}
    figures = [
        (label, which, mean if which == "new views" else mean["input"])
        for which, candidates in (("new views", models | others), ("input view", models))
        for label, mean in candidates.items()
    ]
    geometry = shapes.get("mean", {})
    keys = ("chamfer", "normal_consistency", "iou")
    found = [f"{key.replace('_', ' ')} {_cell(geometry[key])}" for key in keys if key in geometry]
    text = f"Means over {views['num_ok']} held-out objects; LPIPS is better the lower it is. "
    text += f"Shape, by the shipped model: {', '.join(found)}." if found else "No geometry."
    text += _beside_all(views, shipped)
    haze = "What has white haze around it is right on white, and wrong here."
    sections = []
    for title, said, names in (
        ("Numbers", text, OF_PICTURES),
        ("Numbers on black and on grey", haze, OF_GROUNDS),
    ):
        rows = [[label, which, *(_cell(v.get(k)) for k in names)] for label, which, v in figures]
        sections.append(Section(title, said, header=["", "views", *names.values()], table=rows))
    return sections


def _beside_all(views: dict, shipped: Path) -> str:
    """Why the shipped model scores lower here than over all test objects; "" where it does not."""
    try:
        card = read_card(shipped)
    except UserError:
        card = None
    rows = [row for row in (card.figures if card else ()) if row.views == "novel"]
    known = {row.name: row.psnr.mean for row in rows if row.psnr is not None}
    empty = views["baselines"].get("background", {}).get("psnr", math.inf)
    if views["mean"]["psnr"] >= known.get("model", 0) or empty >= known.get("background", 0):
        return ""
    return (
        f" Over the {rows[0].objects} test objects of the README the shipped model has "
        f"{known['model']:.1f} dB in new views. These few are harder for every method, because "
        "they fill more of their pictures: an empty picture, which is right wherever nothing is, "
        f"has {empty:.1f} dB here and {known['background']:.1f} dB there."
    )


def _trained_here(results: DemoResults, strips: list[Path]) -> list[Section]:
    """The training that the demo ran, and the held-out objects by both models."""
    log = results.run / "log.jsonl"
    if not log.exists():
        return [Section("Trained here", "This part is not done yet.")]
    record = read_run_log(log)
    text = (
        "A model of the preset rays, trained by this demo from random weights on the training "
        f"objects of the starter set, for {record.step:,} steps{_compared(results.shipped)}. Its "
        "curves show that training works, its pictures what more of it is for."
    )
    sections = [curves_section("Trained here", text, record)]
    for strip in strips:
        other = results.views_here / "strips" / strip.name
        if other.exists():
            shipped, here = tiles(strip), tiles(other)
            rows = {"Shipped": shipped[1], "Trained here": here[1], "Truth": shipped[2]}
            sections.append(
                Section(f"{_name(strip.stem)}: shipped, trained here, and true", views=rows)
            )
    return sections[:3]


def _compared(shipped: Path) -> str:
    try:
        card = read_card(shipped)
    except UserError:
        card = None
    return f"; the shipped one took {card.steps:,}" if card else ""


def _held_out(strip: Path, views: Path, report: dict) -> Section:
    """One object with its predicted and its true views, by the shipped model."""
    shown = tiles(strip)
    gaussians = load_ply(views / "gaussians" / f"{strip.stem}.ply").drawn()
    record = next(o for o in report["objects"] if o["name"] == strip.stem)
    return Section(
        _name(strip.stem),
        f"Shipped model. New views: {record['psnr']:.1f} dB; "
        f"input view: {record['input']['psnr']:.1f} dB.",
        picture=shown[0][0],
        gaussians=gaussians,
        turntable=_turntable(gaussians),
        views={"Predicted": shown[1], "Truth": shown[2]},
    )


def _icons(results: DemoResults) -> list[Section]:
    sections = []
    for icon in sorted(results.icons.glob("*.png")):
        ply = results.results / f"{icon.stem}.ply"
        if ply.exists():
            gaussians = load_ply(ply).drawn()
            sections.append(
                Section(
                    f"{_ICON}{_name(icon.stem)}",
                    "Shipped model; a picture by another renderer.",
                    picture=prepare(icon),
                    turntable=_turntable(gaussians),
                    gaussians=gaussians,
                )
            )
    return sections


def _name(stem: str) -> str:
    """The name of an object without that of its library."""
    return _LIBRARY.sub("", stem)


def _turntable(gaussians: Gaussians) -> np.ndarray:
    return turntable_frames(gaussians, size=192, frames=_TURN)
