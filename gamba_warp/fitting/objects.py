"""Fits each object of a dataset and measures it on held-out views."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..batch import for_each, progress_bar
from ..cameras import Cameras, relative_to_reference
from ..conventions import DEFAULT_DISTANCE, GROUNDS, WHITE, over_another, over_background
from ..data.dataset import ObjectViews, ViewDataset, evenly
from ..errors import UserError
from ..files import output_folder, write_json, write_text
from ..formats.ply import save_ply
from ..gaussians import Gaussians
from ..image_metrics import SSIM_WINDOW, psnr, ssim
from ..images import save_image
from ..kernels.runtime.tables import markdown
from ..render import render
from ..versions import used_versions
from .config import FitConfig
from .optimize import fit

PROTOCOL = {
    "background": WHITE,
    "grounds": GROUNDS,
    "region": "full image",
    "rendering": "clipped to [0, 1], not rounded to 8 bits",
    "averaging": "views, then objects",
    "gaussians": f"in the world of view 0, its camera at distance {DEFAULT_DISTANCE}",
}
_TABLE = (
    ("held-out PSNR [dB]", "psnr_held_out", "{:.2f}"),
    *((f"held-out PSNR on {g} [dB]", f"psnr_{g}_held_out", "{:.2f}") for g in GROUNDS),
    ("held-out SSIM", "ssim_held_out", "{:.4f}"),
    ("train PSNR [dB]", "psnr_train", "{:.2f}"),
    ("seconds", "seconds", "{:.1f}"),
    ("CPU seconds", "cpu_seconds", "{:.1f}"),
    ("Gaussians", "gaussians", "{:.0f}"),
)


@dataclass
class FitJob:
    """Settings common to all objects.

    Attributes:
        dataset: source of the views.
        folder: folder of the results.
        config: options of a fit.
        held_out: the last of every ``held_out`` views is held out; 0 for none.
        size: height of the pictures, pixels; None for the files' own.
        device: device of the fit.
    """

    dataset: ViewDataset
    folder: Path
    config: FitConfig
    held_out: int
    size: int | None
    device: torch.device


def choose_objects(uids: list[str], names: tuple[str, ...], limit: int | None) -> list[str]:
    """Choose the named objects, or all; of these ``limit``, evenly spaced.

    Args:
        uids: all objects.
        names: names to choose; empty for all.
        limit: largest number, of index ``⌊k · count / limit⌋``; None for no limit.

    Raises:
        UserError: a name is not among ``uids``.
    """
    unknown = [name for name in names if name not in uids]
    if unknown:
        raise UserError(f"--objects {unknown[0]}: not among the {len(uids)} objects")
    chosen = list(dict.fromkeys(names)) or uids
    return chosen if limit is None else evenly(chosen, limit)


def split_views(count: int, held_out: int) -> tuple[list[int], list[int]]:
    """Split views in file order: for the fit, and held out from it.

    Args:
        count: number of views.
        held_out: the last of every ``held_out`` views is held out (5, 11, 17, 23 for 6); 0 for
            none.

    Returns:
        Indices of the views for the fit, and of those held out.
    """
    test = [v for v in range(count) if held_out and v % held_out == held_out - 1]
    return [v for v in range(count) if v not in test], test


def load_views(job: FitJob, uid: str, fitted: list[int]) -> ObjectViews:
    """Load all views of one object, those for the fit and those held out.

    Raises:
        UserError: a file is invalid, or the ``fitted`` views are fewer than two, have no
            transparent pixel or are empty.
    """
    if len(fitted) < 2:
        raise UserError(f"{uid}: {len(fitted)} views to fit, at least 2 are needed")
    views = job.dataset.load(uid, size=job.size)
    alphas = views.images[fitted, ..., 3]
    if alphas.min() == 1:
        raise UserError(f"{uid}: its pictures have no transparent pixel; a background is needed")
    if alphas.max() == 0:
        raise UserError(f"{uid}: its pictures are empty")
    return views


def fit_objects(job: FitJob, uids: Sequence[str]) -> tuple[str, list[tuple[str, str]]]:
    """Fit objects one after the other, and report on all; a failure does not stop the others.

    If the loop is interrupted, the report on the finished objects is still written.

    Args:
        job: settings of all fits.
        uids: the objects' names.

    Returns:
        The summary as Markdown, and the failed objects with the reasons.
    """
    records: list[dict[str, Any]] = []
    failures: list[tuple[str, str]] = []

    def one(uid: str, _: str) -> None:
        records.append(fit_object(job, uid))

    try:
        for_each({uid: uid for uid in uids}, one, "fit", "object", failures)
    finally:
        text = _write_report(job, records, failures)
    return text, failures


def fit_object(job: FitJob, uid: str) -> dict[str, Any]:
    """Fit one object and write its files, with a progress bar.

    Returns:
        Its record, the content of ``objects/NAME.json`` without the settings.

    Raises:
        UserError: its views cannot be used, or a file cannot be written.
        ValueError: no silhouette meets the unit cube.
        FloatingPointError: the fit diverged.
    """
    fitted, test = split_views(job.dataset.num_views(uid), job.held_out)
    views = load_views(job, uid, fitted)
    images, cameras = views.images.to(job.device), views.cameras.to(job.device)
    wall, cpu = time.perf_counter(), time.process_time()
    with progress_bar(total=100, desc=uid, unit="%", leave=False) as bar:

        def show(done: float, loss: float) -> None:
            bar.set_postfix(loss=f"{loss:.4f}", refresh=False)
            bar.update(int(100 * done) - bar.n)

        result = fit(images[fitted], cameras[fitted], job.config, show)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    with torch.no_grad():
        white = images.new_full((3,), WHITE)
        mode = job.config.rasterize_mode
        out = render(result.gaussians, cameras, white, rasterize_mode=mode)
    rgb, truth = out.rgb.clamp(0, 1), over_background(images, WHITE)
    grounds = {}
    for ground, grey in GROUNDS.items():
        got = over_another(out.rgb, out.alpha, WHITE, grey)[test].clamp(0, 1)
        found = psnr(got, over_background(images[test], grey))
        grounds[f"psnr_{ground}_held_out"] = _mean(found.tolist())
    by_view = psnr(rgb, truth).tolist()
    large = min(rgb.shape[1:3]) >= SSIM_WINDOW  # undefined for smaller pictures
    similar = ssim(rgb[test], truth[test]).tolist() if test and large else []
    record = {
        "name": uid,
        "views_train": fitted,
        "views_held_out": test,
        "size": [cameras.width, cameras.height],
        "psnr_train": _mean([by_view[v] for v in fitted]),
        "psnr_held_out": _mean([by_view[v] for v in test]),
        **grounds,
        "ssim_held_out": _mean(similar),
        "psnr_by_view": by_view,
        "gaussians": result.gaussians.num,
        "steps": len(result.losses),
        "loss_first": result.losses[0],
        "loss_last": result.losses[-1],
        "seconds": wall,
        "cpu_seconds": cpu,
    }
    _write_object(
        job, record, result.gaussians, cameras, torch.cat([truth, rgb], 2)[test or fitted]
    )
    return record


def _mean(values: list[float]) -> float | None:
    return sum(values) / len(values) if values else None


def object_paths(folder: Path, uid: str) -> dict[str, Path]:
    """Result files of one object, by sub-folder."""
    kinds = {"gaussians": ".ply", "strips": ".png", "objects": ".json"}
    return {kind: folder / kind / f"{uid}{suffix}" for kind, suffix in kinds.items()}


def _write_object(
    job: FitJob,
    record: dict[str, Any],
    gaussians: Gaussians,
    cameras: Cameras,
    rows: Tensor,
) -> None:
    """Write the ``.ply``, the strip ``[V, H, 2W, 3]`` (at most 4 views) and, last, the record."""
    paths = object_paths(job.folder, record["name"])
    for path in paths.values():
        output_folder(path.parent)
    # eval-views and eval-geometry expect predictions in the input camera's world.
    reference = cameras.viewmats[0]
    _, scale = relative_to_reference(cameras.viewmats[:1], reference)
    moved = gaussians.transformed(reference[:3, :3], reference.new_zeros(3), scale.item())
    how = f"rasterize_mode {job.config.rasterize_mode}"
    note = f"fitted to {record['name']} by gamba fit, {how}"
    save_ply(paths["gaussians"], moved, comments=[note])
    save_image(paths["strips"], rows[:4].flatten(0, 1).cpu().numpy())
    write_json(paths["objects"], {**_settings(job), **record})


def _settings(job: FitJob) -> dict[str, Any]:
    return {
        "protocol": {**PROTOCOL, "held_out": job.held_out, "size": job.size},
        "settings": {**asdict(job.config), "device": job.device.type},
        "versions": used_versions(),
    }


def _write_report(
    job: FitJob, records: list[dict[str, Any]], failures: list[tuple[str, str]]
) -> str:
    """Write ``report.json`` and ``report.md``; return the summary as Markdown."""
    summary, rows = {}, []
    for label, key, form in _TABLE:
        values = [record[key] for record in records if record[key] is not None]
        if values:
            summary[key] = {"mean": _mean(values), "min": min(values), "max": max(values)}
            rows.append([label, *map(form.format, summary[key].values())])
    text = markdown(["", "mean", "min", "max"], rows) if rows else "no object was fitted"
    reasons = [{"name": name, "reason": reason} for name, reason in failures]
    report = {**_settings(job), "summary": summary, "objects": records, "failures": reasons}
    write_json(job.folder / "report.json", report)
    shown = [
        [r["name"], *("" if r[key] is None else form.format(r[key]) for _, key, form in _TABLE)]
        for r in records
    ]
    table = markdown(["object", *(label for label, *_ in _TABLE)], shown)
    failed = "".join(f"\nfailed: {name}: {reason}" for name, reason in failures)
    write_text(job.folder / "report.md", f"{text}\n\n{table}\n{failed}".rstrip() + "\n")
    return text
