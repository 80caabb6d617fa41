"""``gamba fit``: Gaussians fitted to each object of a dataset, measured on held-out views."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro
from msgspec import Meta

from ..batch import check_not_read, report
from ..conventions import DeviceChoice
from ..devices import pick_device
from ..errors import UserError
from ..files import output_folder
from ..fitting.config import Count, FitConfig, RasterizeMode, Steps
from ..untrusted.ranges import Minutes, Seed, ranged


@ranged
def fit_command(
    folder: tyro.conf.Positional[Path],
    out: Path = Path("out/fit"),
    objects: tuple[str, ...] = (),
    split: Literal["all", "train", "val", "test"] = "all",
    limit: Annotated[int, Meta(ge=1)] | None = None,
    held_out: Annotated[int, Meta(ge=0, le=100_000)] = 6,
    steps: Steps = FitConfig.steps,
    minutes: Minutes | None = None,
    gaussians: Count = FitConfig.gaussians,
    size: Annotated[int, Meta(ge=8, le=4096)] | None = None,
    rasterize_mode: RasterizeMode = "classic",
    seed: Seed = 0,
    device: DeviceChoice = "auto",
) -> int:
    """Fit Gaussians to the posed views of each object, without a model.

    Args:
        folder: One object (transforms.json and RGBA pictures), or a dataset of them.
        out: Folder for report.json, report.md, objects/, gaussians/ and strips/ (truth | fitted).
        objects: Names of the objects to fit; all by default.
        split: Part of the dataset.
        limit: Number of objects to fit, evenly spaced in the order of names.
        held_out: Every so many views one is held out for the metrics; 0 for none.
        steps: Number of Adam steps.
        minutes: Time limit of each object; the learning rates then decay with time.
        gaussians: Number of Gaussians per object.
        size: Height of the pictures; the files' own by default.
        rasterize_mode: Antialiased fits small pictures better, but files do not store the mode, and
            most viewers (and eval-views) are classic.
        seed: Seed of all random numbers.
        device: Device that computes; auto is the GPU if there is one.
    """
    from ..data.dataset import background_note, open_dataset
    from ..fitting.objects import FitJob, choose_objects, fit_objects, object_paths

    if held_out == 1:
        raise UserError("--held-out 1: would leave no view for the fit; 2 or more, or 0 for none")
    chosen = pick_device(device)
    dataset = open_dataset(folder, split)
    if note := background_note(dataset):
        print(f"warning: {folder}: {note}", file=sys.stderr)
    uids = choose_objects(dataset.uids, objects, limit)
    targets = (path for uid in uids for path in object_paths(out, uid).values())
    check_not_read(targets, [folder / uid for uid in uids])
    config = FitConfig(
        gaussians=gaussians,
        steps=steps,
        seconds=None if minutes is None else 60 * minutes,
        rasterize_mode=rasterize_mode,
        seed=seed,
    )
    job = FitJob(dataset, output_folder(out), config, held_out, size, chosen)
    text, failures = fit_objects(job, uids)
    print(text)
    return report(len(uids), "object", failures, out)
