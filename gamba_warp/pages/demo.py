"""The page of ``gamba demo``: what its commands wrote, on one page."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ..formats.ply import load_ply
from ..gaussians import Gaussians
from ..images import load_rgba
from .page import Section, demo_page
from .turntable import turntable_frames

_METRICS = {"psnr": "PSNR [dB]", "ssim": "SSIM", "lpips": "LPIPS", "mask_iou": "Mask IoU"}


def write_demo(
    path: Path, run: Path, views: Path, shapes: Path, icons: Path, results: Path, text: str
) -> None:
    """Writes the page.

    Args:
        path: the .html file.
        run: run folder of ``gamba train``.
        views: results of ``gamba eval-views``.
        shapes: results of ``gamba eval-geometry``; the report may be missing.
        icons: pictures that were reconstructed.
        results: results of ``gamba reconstruct`` on them; some may be missing.
        text: a sentence or two for the head of the page.

    Raises:
        UserError: a file cannot be read or written.
    """
    report = _report(views)
    sections = [
        _numbers(report, _report(shapes)),
        _training(run),
        *(_held_out(strip, views, report) for strip in sorted((views / "strips").glob("*.png"))),
        *_icons(icons, results),
    ]
    demo_page(path, sections, text=text)


def _report(folder: Path) -> dict:
    path = folder / "report.json"
    return json.loads(path.read_text()) if path.exists() else {}


def _cell(value: float | None) -> str:
    return "absent" if value is None else f"{value:.3f}"


def _numbers(views: dict, shapes: dict) -> Section:
    """Metrics of the model beside those of the baselines, from two reports."""
    candidates = {"this model": views["mean"], **views["baselines"]}
    rows = [
        [label, name, *(_cell(values.get(key)) for key in _METRICS)]
        for label, values in candidates.items()
        for name, values in (("novel", values), ("input", values["input"]))
    ]
    geometry = shapes.get("mean", {})
    keys = ("chamfer", "normal_consistency", "iou")
    found = [f"{key.replace('_', ' ')} {_cell(geometry[key])}" for key in keys if key in geometry]
    text = f"Held-out objects: {views['num_ok']}. "
    text += f"Geometry of this model: {', '.join(found)}." if found else "No geometry."
    return Section("Numbers", text, header=["", "views", *_METRICS.values()], table=rows)


def _training(run: Path) -> Section:
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    curves = {
        "training": [(e["step"], e["loss"]) for e in lines if e["event"] == "train" and e["loss"]],
        "held out": [(e["step"], e["loss"]) for e in lines if e["event"] == "val" and e["loss"]],
    }
    steps = max((e["step"] for e in lines), default=0)
    return Section("Training", f"{steps} steps.", curves=curves, curves_label="loss")


def _held_out(strip: Path, views: Path, report: dict) -> Section:
    """One object; each row of its strip is input | prediction | truth of a view."""
    rgb = load_rgba(strip)[..., :3]
    side = rgb.shape[1] // 3
    tiles = rgb.reshape(-1, side, 3, side, 3).transpose(2, 0, 1, 3, 4)
    gaussians = load_ply(views / "gaussians" / f"{strip.stem}.ply")
    record = next(o for o in report["objects"] if o["name"] == strip.stem)
    return Section(
        strip.stem,
        f"Novel views: {record['psnr']:.1f} dB; input view: {record['input']['psnr']:.1f} dB.",
        picture=tiles[0][0],
        gaussians=gaussians,
        turntable=_turntable(gaussians),
        views={"Predicted": tiles[1], "Truth": tiles[2]},
    )


def _icons(icons: Path, results: Path) -> list[Section]:
    sections = []
    for icon in sorted(icons.glob("*.png")):
        ply = results / f"{icon.stem}.ply"
        if ply.exists():
            gaussians = load_ply(ply)
            sections.append(
                Section(
                    f"Icon: {icon.stem}",
                    picture=load_rgba(icon),
                    turntable=_turntable(gaussians),
                    gaussians=gaussians,
                )
            )
    return sections


def _turntable(gaussians: Gaussians) -> np.ndarray:
    return turntable_frames(gaussians, size=192, frames=24)
