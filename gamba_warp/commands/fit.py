"""``gamba fit``: every object of a dataset fitted on its own, and measured on held-out views."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any, Literal

import tyro

from ..data.dataset import open_dataset
from ..devices import pick_device
from ..errors import UserError
from ..files import output_folder
from ..fitting.config import FitConfig, RasterizeMode
from ..fitting.objects import FitJob, choose_objects, fit_object, write_report


def fit_command(
    folder: tyro.conf.Positional[Path],
    out: Path = Path("out/fit"),
    objects: tuple[str, ...] = (),
    split: Literal["all", "train", "val", "test"] = "all",
    limit: int | None = None,
    held_out: int = 6,
    steps: int = FitConfig.steps,
    minutes: float | None = None,
    gaussians: int = FitConfig.gaussians,
    size: int | None = None,
    rasterize_mode: RasterizeMode = "classic",
    seed: int = 0,
    device: Literal["auto", "cpu", "cuda"] = "auto",
) -> int:
    """Fits Gaussians to the posed views of each object, without any model.

    Args:
        folder: One object (transforms.json and RGBA pictures), or a dataset of them.
        out: Folder for report.json, report.md, objects/, gaussians/ and strips/ (truth | fitted).
        objects: Only these, by name.
        split: Of the dataset.
        limit: So many objects only, evenly spaced in the order of names.
        held_out: Every so many-th view is kept from the fit and measured; 0 for none.
        steps: Of Adam.
        minutes: For each object at most; the learning rates then fall with the time.
        gaussians: In each object.
        size: Height of the pictures; the files' own by default.
        rasterize_mode: Antialiased fits small pictures better, but files do not hold the mode, and
            most viewers (and eval-views) are classic.
        seed: Of everything random.
        device: Where to compute.
    """
    _check(limit, held_out, steps, minutes, gaussians, size, seed)
    where = pick_device(device)
    dataset = open_dataset(folder, split)
    uids = choose_objects(dataset.uids, objects, limit)
    seconds = None if minutes is None else 60 * minutes
    config = FitConfig(
        gaussians=gaussians,
        steps=steps,
        seconds=seconds,
        rasterize_mode=rasterize_mode,
        seed=seed,
    )
    job = FitJob(dataset, output_folder(out), config, held_out, size, where)
    records: list[dict[str, Any]] = []
    failures: list[dict[str, str]] = []
    try:
        for number, uid in enumerate(uids, 1):
            try:
                records.append(fit_object(job, uid, f"{number}/{len(uids)} {uid}"))
            except (UserError, ValueError, ArithmeticError, RuntimeError, MemoryError) as error:
                lines = str(error).splitlines() or [type(error).__name__]
                failures.append({"name": uid, "reason": lines[0].removeprefix(f"{uid}: ")})
    finally:  # also when interrupted: what is finished counts
        text = write_report(job, records, failures)
    print(text)
    for item in failures:
        print(f"gamba: failed: {item['name']}: {item['reason']}", file=sys.stderr)
    print(f"{len(uids)} objects, {len(failures)} failures, results in {out}")
    return 1 if failures else 0


def _check(limit, held_out, steps, minutes, gaussians, size, seed) -> None:
    """Raises UserError for the first option that is out of its range."""
    least = {"limit": 1, "steps": 1, "gaussians": 2, "size": 8, "seed": 0, "held-out": 0}
    values = {
        "limit": limit,
        "steps": steps,
        "gaussians": gaussians,
        "size": size,
        "seed": seed,
        "held-out": held_out,
    }
    for name, value in values.items():
        if value is not None and value < least[name]:
            raise UserError(f"--{name} {value}: must be at least {least[name]}")
    if held_out == 1:
        raise UserError("--held-out 1: would leave no view for the fit; 2 or more, or 0 for none")
    if minutes is not None and not (math.isfinite(minutes) and minutes > 0):
        raise UserError(f"--minutes {minutes}: must be above 0")
