"""Readers of what compares methods and models: plans, reports, folders of pictures."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..errors import UserError

_FOLDER = re.compile(r"[a-z0-9][a-z0-9_-]*")


def attempt(read: Callable, *arguments: Any) -> Any:
    """What is read, or the error: one bad file of many is told, and the others are read."""
    try:
        return read(*arguments)
    except UserError as error:
        return error


def plan(path: Path, out: Path) -> Any:
    """The plan of an ablation, and the commands of its rows."""
    from ..ablation import jobs
    from ..ablation.plan import named, read_plan

    found = read_plan(path)
    with named(path):
        budget = jobs.budget_of(found, None, None)
        settings = jobs.Settings(path.parent, out, found.evaluation, budget, None, "cpu")
        jobs.check(found, settings, found.rows)
    return found, [jobs.stages(found, row, 0, settings) for row in found.rows]


def sound_plan(result: Any, path: Path, out: Path) -> str | None:
    """A plan whose folders stay inside the ablation's, and whose words are no other options."""
    found, commands = result
    for row, stages in zip(found.rows, commands):
        if not _FOLDER.fullmatch(row.name):
            return f"the name {row.name[:40]!r} is no folder's"
        for stage in stages:
            if any("\0" in word for word in stage.words):
                return "a word with a NUL, with which no process can be started"
            outs = [i for i, word in enumerate(stage.words) if word.startswith("--out")]
            if len(outs) != 1 or not stage.words[outs[0] + 1].startswith("ROW/"):
                return "a command that writes elsewhere"
    return None


def reports(path: Path, out: Path) -> Any:
    """The table of a report beside itself, as ``gamba compare`` writes it."""
    from gamba_warp.eval.joined import join
    from gamba_warp.eval.joined_page import html_page, markdown_page
    from gamba_warp.eval.methods import read_methods

    methods, notes = read_methods((f"a={path}", f"b={path}"), ())
    joined = join(methods, None, notes)
    json.dumps(joined, allow_nan=False)
    return [markdown_page(joined, True), html_page(joined, True)]


def shown(path: Path, out: Path) -> Any:
    """Pictures that take the place of predictions, of each object of a dataset."""
    from gamba_warp.eval.views.compare import ViewsProtocol, load_truth
    from gamba_warp.eval.views.pictures import PicturePredictions

    from ..data.dataset import open_dataset

    dataset, given = open_dataset(path / "data"), PicturePredictions(path / "seen", 1.5, "cpu")
    protocol = ViewsProtocol("all", 0, None, None, None, None, 1.5)
    truths = [attempt(load_truth, dataset, uid, protocol, "cpu") for uid in dataset.uids]
    good = [truth for truth in truths if not isinstance(truth, UserError)]
    return [attempt(given.pictures, dataset, truth) for truth in good]


def seen(result: Any, path: Path, out: Path) -> str | None:
    """Pictures in place of true views: colours in [0, 1], and alpha of their size or none."""
    rgb, alpha = result.shown.on(), result.shown.alpha
    if not (rgb.isfinite().all() and rgb.min() >= 0 and rgb.max() <= 1):
        return "a colour outside of [0, 1]"
    return "alpha of another size" if alpha is not None and alpha.shape != rgb.shape[:3] else None
