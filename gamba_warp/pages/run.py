"""The page of a training run, ``RUN/index.html``: curves, pictures, what was trained and how."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from ..errors import UserError
from ..images import load_rgba
from .card import OF_PICTURES
from .curves import curves_section
from .page import Section, demo_page
from .run_log import RunRecord, read_run_log

PAGE = "index.html"
_WARNINGS = 20  # the last ones, on the page


def write_run_page(run: Path, path: Path | None = None) -> Path:
    """Writes a run's page, from its log and its last sample pictures.

    Args:
        run: the run folder.
        path: the file; ``RUN/index.html`` if not given.

    Returns:
        The file.

    Raises:
        UserError: the log cannot be read, or the page cannot be written.
    """
    path = path or run / PAGE
    record = read_run_log(run / "log.jsonl")
    sections = [
        Section("Run", table=_facts(record)),
        curves_section("Curves", _about_curves(record), record),
        *_validation(record),
        *_samples(run),
        *_warnings(record),
        *_configuration(record),
    ]
    name = "/".join(run.resolve().parts[-2:])  # many a run lies in a folder that is called run
    demo_page(path, sections, title=f"Training of {name}", text=_state(record))
    return path


def _state(record: RunRecord) -> str:
    length = record.start.get("config", {})
    length = length.get("length", {}) if isinstance(length, dict) else {}
    steps = record.start.get("steps") or (length.get("steps") if isinstance(length, dict) else None)
    total = f" of {steps:,}" if type(steps) is int else ""
    if record.end:
        code = record.end.get("code")
        stopped = type(code) is int and code > 128
        state = "stopped; the same command goes on from here" if stopped else "finished"
    else:
        state = "in training, or cut off"
    return f"Step {record.step:,}{total}, {_time(record.minutes)} of training: {state}."


def _time(minutes: float) -> str:
    return f"{minutes / 60:.1f} hours" if minutes >= 90 else f"{minutes:.1f} minutes"


def _facts(record: RunRecord) -> list[tuple[str, str | int | float]]:
    """What is trained on what, and how fast."""
    start, config = record.start, record.start.get("config")
    config = config if isinstance(config, dict) else {}
    rows: list[tuple[str, Any]] = [
        ("Data", config.get("data")),
        ("Objects", start.get("objects")),
        ("Held-out objects", start.get("held_out")),
        ("Version of the split", start.get("split_version")),
        ("Preset", config.get("preset")),
        ("Parameters", start.get("parameters")),
        ("Device", start.get("device")),
    ]
    if record.minutes and record.step:
        rows.append(("Seconds a step", f"{60 * record.minutes / record.step:.3g}"))
    views = record.series.get("train.views_per_second")
    if views and views.values:
        last = list(views.values)[-50:]
        rows.append(("Views a second, lately", f"{sum(last) / len(last):.3g}"))
    rows.append(("Warnings", len(record.warnings)))
    return [(name, _cell(value)) for name, value in rows if value is not None]


def _cell(value: object) -> str:
    return f"{value:,}" if type(value) is int else str(value)[:300]


def _about_curves(record: RunRecord) -> str:
    held = record.start.get("held_out")
    text = "Point at a chart for its values."
    if type(held) is int:
        text = f"Held out: {held} objects that are not trained on. {text}"
    loss = record.series.get("train.loss")
    if loss and len(loss.steps) > 60:
        text += (
            " Curves of the training are means of many steps; the band holds four of five steps."
        )
    terms = record.series.get("train.loss_lpips")
    if loss and terms and loss.steps and terms.steps and terms.steps[0] > loss.steps[0]:
        text += f" From about step {terms.steps[0]:,.0f} on LPIPS counts in the loss."
    return text


def _validation(record: RunRecord) -> list[Section]:
    """The last validation as a table."""
    rows = []
    for view in ("input", "novel"):
        found = [record.series.get(f"val.{measure}_{view}") for measure in OF_PICTURES]
        if any(found):
            cells = [f"{series.values[-1]:.4g}" if series else "absent" for series in found]
            rows.append([f"{view} view" + ("s" if view == "novel" else ""), *cells])
    if not rows:
        return []
    step = int(max(s.steps[-1] for n, s in record.series.items() if n.startswith("val.")))
    text = f"Means over the held-out objects at step {step:,}."
    return [Section("Last validation", text, header=["", *OF_PICTURES.values()], table=rows)]


def _samples(run: Path) -> list[Section]:
    """The newest sample pictures, which the training wrote."""
    found = [(re.fullmatch(r"step_(\d{1,15})\.png", p.name), p) for p in run.glob("samples/step_*")]
    numbered = sorted((int(match[1]), path) for match, path in found if match)
    if not numbered:
        return []
    step, path = numbered[-1]
    try:
        picture = load_rgba(path)[..., :3]
    except UserError:
        return []
    text = (
        f"Held-out objects at step {step:,}: in each pair of rows the true views are above and "
        "the predicted ones below; the first column is the input view."
    )
    return [Section("Pictures", text, strip=picture)]


def _warnings(record: RunRecord) -> list[Section]:
    if not record.warnings:
        return []
    shown = record.warnings[-_WARNINGS:]
    text = "" if len(shown) == len(record.warnings) else f"The last {len(shown)}."
    rows = [[f"step {step:,}", message[:500]] for step, message in shown]
    return [Section("Warnings", text, table=rows)]


def _configuration(record: RunRecord) -> list[Section]:
    config, command = record.start.get("config"), record.start.get("command")
    section = Section("Command", code=command[:10_000] if isinstance(command, str) else "")
    if isinstance(config, dict):
        section.details = {"All options": json.dumps(config, indent=2)[:30_000]}
    return [section] if section.code or section.details else []
