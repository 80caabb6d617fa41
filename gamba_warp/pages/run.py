"""Page of a training run, ``RUN/index.html``: curves, pictures, data and options."""

from __future__ import annotations

import contextlib
import json
import re
from pathlib import Path

import msgspec

from ..errors import UserError
from ..image_metrics import METRICS
from ..images import load_rgba
from .card import OF_PICTURES
from .curves import curves_section
from .page import Section, demo_page
from .run_log import RunRecord, read_run_log

PAGE = "index.html"
_WARNINGS = 20  # the last ones are on the page


class _Length(msgspec.Struct, frozen=True):
    steps: int | None = None


class _Config(msgspec.Struct, frozen=True):
    data: str | None = None
    preset: str | None = None
    length: _Length = _Length()


class _Start(msgspec.Struct):
    """Fields used of the log's first line; ignored as a whole if a type is wrong."""

    objects: int | None = None
    held_out: int | None = None
    split_version: int | None = None
    parameters: int | None = None
    steps: int | None = None
    device: str | None = None
    command: str = ""
    config: _Config = _Config()


def write_run_page(run: Path, path: Path | None = None) -> Path:
    """Write a run's page from its log and its last sample pictures.

    Args:
        run: the run folder.
        path: the file; by default ``RUN/index.html``.

    Returns:
        The file.

    Raises:
        UserError: the log cannot be read, or the page cannot be written.
    """
    path = path or run / PAGE
    record, start = read_run_log(run / "log.jsonl"), _Start()
    with contextlib.suppress(msgspec.ValidationError):
        start = msgspec.convert(record.start, _Start)
    steps = start.steps or start.config.length.steps
    total = f" of {steps:,}" if steps else ""
    code = record.end.get("code")
    state = "finished" if record.end else "in training, or cut off"
    if type(code) is int and code > 128:
        state = "stopped; the same command resumes from here"
    hours = f"{record.minutes / 60:.1f} hours"
    spent = hours if record.minutes >= 90 else f"{record.minutes:.1f} minutes"
    sections = [
        Section("Run", table=_facts(record, start)),
        curves_section("Curves", _about_curves(record, start), record),
        *_validation(record),
        *_samples(run),
    ]
    if record.warnings:
        shown = record.warnings[-_WARNINGS:]
        text = "" if len(shown) == len(record.warnings) else f"The last {len(shown)}."
        rows = [[f"step {step:,}", message[:500]] for step, message in shown]
        sections.append(Section("Warnings", text, table=rows))
    if options := record.start.get("config"):
        details = {"All options": json.dumps(options, indent=2)[:30_000]}
        sections.append(Section("Command", code=start.command[:10_000], details=details))
    name = "/".join(run.resolve().parts[-2:])  # many run folders are called run
    text = f"Step {record.step:,}{total}, {spent} of training: {state}."
    demo_page(path, sections, title=f"Training of {name}", text=text)
    return path


def _facts(record: RunRecord, start: _Start) -> list[tuple[str, str]]:
    """Return data, model, device and speed."""
    rows = {
        "Data": start.config.data,
        "Objects": start.objects,
        "Held-out objects": start.held_out,
        "Version of the split": start.split_version,
        "Preset": start.config.preset,
        "Parameters": start.parameters,
        "Device": start.device,
    }
    if record.minutes and record.step:
        rows["Seconds a step"] = f"{60 * record.minutes / record.step:.3g}"
    views = record.series.get("train.views_per_second")
    if views and views.values:
        last = list(views.values)[-50:]
        rows["Views a second, lately"] = f"{sum(last) / len(last):.3g}"
    rows["Warnings"] = len(record.warnings)
    texts = ((name, f"{v:,}" if isinstance(v, int) else v) for name, v in rows.items())
    return [(name, text[:300]) for name, text in texts if text is not None]


def _about_curves(record: RunRecord, start: _Start) -> str:
    text = "Point at a chart for its values."
    if start.held_out is not None:
        text = f"Held out: {start.held_out} objects that are not trained on. {text}"
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
    """Return the last validation as a table."""
    rows = []
    for event, of in (("val", ""), *((f"val/{name}", f", {name}") for name in record.validated)):
        for view, name in (("input", "input view"), ("novel", "novel views")):
            found = [record.series.get(f"{event}.{measure}_{view}") for measure in OF_PICTURES]
            if any(found):
                figures = (f"{s.values[-1]:.4g}" if s else "absent" for s in found)
                rows.append([f"{name}{of}", *figures])
    if not rows:
        return []
    step = max(s.steps[-1] for n, s in record.series.items() if n.startswith("val"))
    text = f"Means over the held-out objects at step {step:,.0f}."
    for name, metric in METRICS.items():
        best = record.series.get(f"best.{name}")
        if best and best.steps:
            where = " over the datasets" if record.validated else ""
            unit = f" {metric.unit}" if metric.unit else ""
            text += (
                f" The best validation, by the mean {metric.title} of novel views{where}, is that "
                f"of step {best.steps[-1]:,.0f} ({best.values[-1]:.4g}{unit}): best.safetensors."
            )
    return [Section("Last validation", text, header=["", *OF_PICTURES.values()], table=rows)]


def _samples(run: Path) -> list[Section]:
    """Return the newest sample pictures of the training."""
    found = ((re.fullmatch(r"step_(\d{1,15})\.png", p.name), p) for p in run.glob("samples/step_*"))
    step, path = max(((int(match[1]), path) for match, path in found if match), default=(0, None))
    with contextlib.suppress(UserError):
        if path is not None:
            text = (
                f"Held-out objects at step {step:,}: in each pair of rows the true views are above "
                "and the predicted ones below; the first column is the input view."
            )
            return [Section("Pictures", text, strip=load_rgba(path)[..., :3])]
    return []
