"""Objects of a dataset, each fitted on its own and measured on held-out views."""

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
    """What is the same for every object.

    Attributes:
        dataset: source of the views.
        folder: folder of the results.
        config: settings of a fit.
        held_out: one view of so many is held out, the last; 0 for none.
        size: height of the pictures, pixels; None for the files' own.
        device: device that computes.
    """

    dataset: ViewDataset
    folder: Path
    config: FitConfig
    held_out: int
    size: int | None
    device: torch.device


def choose_objects(uids: list[str], names: tuple[str, ...], limit: int | None) -> list[str]:
    """Chooses the named objects, or all; of these ``limit``, evenly spaced.

    Args:
        uids: the objects there are.
        names: those wanted, or none for all.
        limit: at most so many, of index ``⌊k · count / limit⌋``; None for no limit.

    Raises:
        UserError: a name is not among ``uids``.
    """
    unknown = [name for name in names if name not in uids]
    if unknown:
        raise UserError(f"--objects {unknown[0]}: not among the {len(uids)} objects")
    chosen = list(dict.fromkeys(names)) or uids
    return chosen if limit is None else evenly(chosen, limit)


def split_views(count: int, held_out: int) -> tuple[list[int], list[int]]:
    """Splits views in file order: for the fit, and held out from it.

    Args:
        count: number of views.
        held_out: the last of every so many is held out (5, 11, 17, 23 for 6); 0 for none.

    Returns:
        Indices of the views for the fit, and of those held out.
    """
    kept = [v for v in range(count) if held_out and v % held_out == held_out - 1]
    return [v for v in range(count) if v not in kept], kept


def load_views(job: FitJob, uid: str, fitted: list[int]) -> ObjectViews:
    """Loads all views of one object, those for the fit and those held out.

    Raises:
        UserError: a file is bad, or the ``fitted`` views are fewer than two, have no transparent
            pixel or show nothing.
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
    """Fits objects one after the other, and reports on all; one that fails stops no other.

    The report is written also when the loop is interrupted, of what was finished.

    Args:
        job: what is fitted, and how.
        uids: the objects' names.

    Returns:
        The summary as Markdown, and the objects that failed, each with the reason.
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
    """Fits one object and writes its files, with a progress bar.

    Returns:
        Its record, as ``objects/NAME.json`` holds it without the settings.

    Raises:
        UserError: its views cannot be used, or a file cannot be written.
        ValueError: no silhouette meets the unit cube.
        FloatingPointError: the fit diverged.
    """
    fitted, kept = split_views(job.dataset.num_views(uid), job.held_out)
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
        got = over_another(out.rgb, out.alpha, WHITE, grey)[kept].clamp(0, 1)
        found = psnr(got, over_background(images[kept], grey))
        grounds[f"psnr_{ground}_held_out"] = _mean(found.tolist())
    by_view = psnr(rgb, truth).tolist()
    large = min(rgb.shape[1:3]) >= SSIM_WINDOW  # in smaller pictures it is not defined
    similar = ssim(rgb[kept], truth[kept]).tolist() if kept and large else []
    record = {
        "name": uid,
        "views_train": fitted,
        "views_held_out": kept,
        "size": [cameras.width, cameras.height],
        "psnr_train": _mean([by_view[v] for v in fitted]),
        "psnr_held_out": _mean([by_view[v] for v in kept]),
        **grounds,
        "ssim_held_out": _mean(similar),
        "psnr_by_view": by_view,
        "gaussians": result.gaussians.num,
        "relocated": result.relocated,
        "steps": len(result.losses),
        "loss_first": result.losses[0],
        "loss_last": result.losses[-1],
        "seconds": wall,
        "cpu_seconds": cpu,
    }
    _write_object(
        job, record, result.gaussians, cameras, torch.cat([truth, rgb], 2)[kept or fitted]
    )
    return record


def _mean(values: list[float]) -> float | None:
    return sum(values) / len(values) if values else None


def object_paths(folder: Path, uid: str) -> dict[str, Path]:
    """The files of one object in the folder of the results, by the sub-folder that each is in."""
    kinds = {"gaussians": ".ply", "strips": ".png", "objects": ".json"}
    return {kind: folder / kind / f"{uid}{suffix}" for kind, suffix in kinds.items()}


def _write_object(
    job: FitJob,
    record: dict[str, Any],
    gaussians: Gaussians,
    cameras: Cameras,
    rows: Tensor,
) -> None:
    """Writes the ``.ply``, the strip ``[V, H, 2W, 3]`` (at most 4 views) and, last, the record."""
    paths = object_paths(job.folder, record["name"])
    for path in paths.values():
        output_folder(path.parent)
    # eval-views and eval-geometry expect predictions in the input camera's world.
    reference = cameras.viewmats[0]
    _, scale = relative_to_reference(cameras.viewmats[:1], reference)
    moved = gaussians.transformed(reference[:3, :3], reference.new_zeros(3), scale.item())
    how = f"strategy {job.config.strategy}, rasterize_mode {job.config.rasterize_mode}"
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
    """Writes ``report.json`` and ``report.md``; returns the summary as Markdown."""
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
