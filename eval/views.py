"""``gamba eval-views``: predicted views against true ones."""

from __future__ import annotations

import hashlib
import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from torch import Tensor
from tqdm import tqdm

from gamba_warp.cameras import DEFAULT_DISTANCE, Cameras, relative_to_reference
from gamba_warp.dataset import ViewDataset, open_dataset
from gamba_warp.errors import UserError
from gamba_warp.files import output_folder
from gamba_warp.gaussians import Gaussians
from gamba_warp.images import over_background, save_image
from gamba_warp.lpips import FETCH, LPIPS, load_lpips, lpips_available
from gamba_warp.ply import save_ply
from gamba_warp.reconstruct import pick_device

from .metrics import MAX_PSNR, SSIM_SIGMA, SSIM_WINDOW, mask_iou, psnr, ssim
from .predictions import Predictions, open_predictions
from .report import OK, check_finite, failure, mean_of, print_summary, versions, write_report

WHITE = 1.0
BATCH = 4  # views compared at once: bounds the memory of LPIPS features
METRICS = ("psnr", "ssim", "lpips", "mask_iou")


@dataclass(frozen=True)
class ViewsProtocol:
    """What the numbers of ``eval-views`` mean.

    Attributes:
        split: of the dataset.
        reference: index of the input view.
        views: how many views an object, input included, evenly spaced in file order; None: all.
        size: height of the pictures compared; None: the files' own.
        background: grey value both sides are composited on.
        region: over what the picture metrics run.
        rendering: how predicted values are compared.
        max_psnr: dB, given to equal pictures.
        ssim: window and convention.
        lpips: network, or None.
        lpips_reason: why there is no LPIPS, or None.
        mask_iou: when a pixel counts as covered.
        averaging: order of the means.
        poses: frame and distance of the cameras.
        distance: of the input camera from the object's centre, object units.
    """

    split: str
    reference: int
    views: int | None
    size: int | None
    lpips: str | None
    lpips_reason: str | None
    distance: float
    background: float = WHITE
    region: str = "full image"
    rendering: str = "clipped to [0, 1], not rounded to 8 bits"
    max_psnr: float = MAX_PSNR
    ssim: str = f"Gaussian {SSIM_WINDOW}x{SSIM_WINDOW}, sigma {SSIM_SIGMA}, no padding, range 1"
    mask_iou: str = "alpha > 0.5 on both sides"
    averaging: str = "views, then objects; input view apart"
    poses: str = "relative to the input view, its distance normalised"


@dataclass
class Truth:
    """One object's views to compare with.

    Attributes:
        rgb: ``[V, H, W, 3]`` on the background; view 0 is the input.
        mask: ``[V, H, W]`` bool.
        cameras: V cameras in the input camera's world.
        views: their V indices in the dataset.
        digest: SHA-256 of the pictures, 16 digits.
    """

    rgb: Tensor
    mask: Tensor
    cameras: Cameras
    views: list[int]
    digest: str


def choose_views(count: int, reference: int, wanted: int | None) -> list[int]:
    """The input view first, then ``wanted - 1`` others evenly spaced (all of them for None).

    Raises:
        UserError: there is no view ``reference``.
    """
    if not 0 <= reference < count:
        raise UserError(f"no view {reference} for the input among its {count}")
    others = [view for view in range(count) if view != reference]
    if wanted is not None and wanted - 1 < len(others):
        step = len(others) / max(1, wanted - 1)
        others = [others[int(k * step)] for k in range(wanted - 1)]
    return [reference, *others]


def load_truth(dataset: ViewDataset, uid: str, protocol: ViewsProtocol, device: str) -> Truth:
    """Loads one object's views, composites them and moves the cameras. Raises UserError."""
    views = choose_views(dataset.num_views(uid), protocol.reference, protocol.views)
    loaded = dataset.load(uid, views=views, size=protocol.size)
    viewmats, _ = relative_to_reference(
        loaded.cameras.viewmats, loaded.cameras.viewmats[0], protocol.distance
    )
    cameras = Cameras(viewmats, loaded.cameras.Ks, loaded.cameras.width, loaded.cameras.height)
    return Truth(
        rgb=over_background(loaded.images, WHITE).to(device),
        mask=(loaded.images[..., 3] > 0.5).to(device),
        cameras=cameras.to(device),
        views=views,
        digest=hashlib.sha256(loaded.images.numpy().tobytes()).hexdigest()[:16],
    )


def render_views(gaussians: Gaussians, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """RGB ``[V, H, W, 3]`` on white, clipped to [0, 1], and mask ``[V, H, W]`` bool."""
    from gamba_warp.render import render

    with torch.no_grad():
        out = render(gaussians, cameras, background=cameras.viewmats.new_full((3,), WHITE))
    return out.rgb.clamp(0, 1), out.alpha[..., 0] > 0.5


@torch.no_grad()
def compare(
    candidates: dict[str, tuple[Tensor, Tensor]], truth: Truth, lpips: LPIPS | None
) -> dict[str, list[dict[str, float | None]]]:
    """Metrics of each view for each candidate ``(rgb, mask)``, as ``Truth`` holds them.

    LPIPS features, which take nearly all the time, are computed once for the truth, and once for a
    candidate that shows every view the same picture (an expanded tensor).
    """
    fixed = {
        name: lpips.features(rgb[0])
        for name, (rgb, _) in candidates.items()
        if lpips and rgb.stride(0) == 0
    }
    result: dict[str, list[dict[str, float | None]]] = {name: [] for name in candidates}
    for start in range(0, len(truth.rgb), BATCH):
        part = slice(start, start + BATCH)
        true_rgb, true_mask = truth.rgb[part], truth.mask[part]
        features = lpips.features(true_rgb) if lpips else None
        for name, (rgb, mask) in candidates.items():
            values = {
                "psnr": psnr(rgb[part], true_rgb).tolist(),
                "ssim": ssim(rgb[part], true_rgb).tolist(),
                "lpips": [None] * len(true_rgb),
                "mask_iou": mask_iou(mask[part], true_mask).tolist(),
            }
            if lpips:
                shown = fixed[name] if name in fixed else lpips.features(rgb[part])
                values["lpips"] = lpips.distance(shown, features).tolist()
            result[name] += [dict(zip(values, row)) for row in zip(*values.values())]
    return result


def summary(views: list[dict[str, float | None]]) -> dict[str, Any]:
    """Means over the novel views, and the input view (the first) apart."""
    novel = mean_of(views[1:]) if len(views) > 1 else dict.fromkeys(METRICS)
    return {**novel, "input": views[0]}


def baselines_of(truth: Truth) -> dict[str, tuple[Tensor, Tensor]]:
    """Predictions that need no model: an empty picture, and the input shown for every view."""
    return {
        "white": (
            torch.full_like(truth.rgb[:1], WHITE).expand_as(truth.rgb),
            torch.zeros_like(truth.mask),
        ),
        "input_copy": (
            truth.rgb[:1].expand_as(truth.rgb),
            truth.mask[:1].expand_as(truth.mask),
        ),
    }


def save_strips(path: Path, rgb: Tensor, truth: Truth, count: int = 4) -> None:
    """Rows of input | prediction | truth, ``count`` views evenly spaced, the input first."""
    rows = choose_views(len(rgb), 0, count)
    strips = [torch.cat([truth.rgb[0], rgb[row], truth.rgb[row]], 1) for row in rows]
    path.parent.mkdir(parents=True, exist_ok=True)
    save_image(path, torch.cat(strips, 0).cpu().numpy())


def evaluate_object(
    predictions: Predictions,
    dataset: ViewDataset,
    uid: str,
    protocol: ViewsProtocol,
    lpips: LPIPS | None,
    device: str,
    baselines: bool,
    strips: Path | None,
    save: Path | None = None,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """One object's record, and its baselines' records by name. Raises UserError, ValueError."""
    truth = load_truth(dataset, uid, protocol, device)
    start = time.perf_counter()
    gaussians = predictions.gaussians(dataset, uid, protocol.reference)
    predicted = time.perf_counter()
    rgb, mask = render_views(gaussians, truth.cameras)
    rendered = time.perf_counter()
    candidates = {"": (rgb, mask)} | (baselines_of(truth) if baselines else {})
    by_view = compare(candidates, truth, lpips)
    if strips is not None:
        save_strips(strips / f"{uid}.png", rgb, truth)
    if save is not None:
        path = save / f"{uid}.ply"
        path.parent.mkdir(parents=True, exist_ok=True)
        save_ply(path, gaussians)
    record = {
        "name": uid,
        "status": OK,
        **check_finite(summary(by_view.pop(""))),
        "views": truth.views,
        "gaussians": gaussians.num,
        "truth_sha256": truth.digest,
        "seconds": {
            "predict": round(predicted - start, 4),
            "render": round(rendered - predicted, 4),
            "compare": round(time.perf_counter() - rendered, 4),
        },
    }
    return record, {name: summary(views) for name, views in by_view.items()}


def _lpips_or_reason(device: str) -> tuple[LPIPS | None, str | None]:
    if lpips_available():
        return load_lpips().to(device), None
    reason = f"no weights; fetch them with: {FETCH}"
    print(f"LPIPS left out: {reason}")
    return None, reason


def eval_views_command(
    checkpoint: tyro.conf.Positional[Path],
    data: tyro.conf.Positional[Path],
    out: Path,
    split: Literal["all", "train", "val", "test"] = "test",
    reference: int = 0,
    views: int | None = None,
    size: int | None = None,
    limit: int | None = None,
    strips: int = 8,
    baselines: bool = True,
    lpips: bool = True,
    save_gaussians: bool = False,
    distance: float = DEFAULT_DISTANCE,
    encoder_weights: Path | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
) -> int:
    """PSNR, SSIM, LPIPS and mask IoU of predicted views; the input view and novel views apart.

    Args:
        checkpoint: a model, or a folder of .ply files named by object.
        data: dataset of posed views.
        out: folder for report.json, objects.csv and strips/ (input | prediction | truth).
        split: of the dataset.
        reference: index of the input view.
        views: views an object, input included, evenly spaced; all by default.
        size: height of the pictures compared; the files' own by default.
        limit: first so many objects only.
        strips: comparison pictures for the first so many objects.
        baselines: also score an empty picture and a copy of the input.
        lpips: LPIPS where its weights are there (gamba weights lpips).
        save_gaussians: also write OUT/gaussians/NAME.ply, in the input camera's world
            (eval-geometry --frame reference reads them).
        distance: of the input camera, for .ply files; a checkpoint states its own.
        encoder_weights: the image encoder's file, for a checkpoint that does not hold it.
        device: where to run.
    """
    for name, value, least in (("views", views, 1), ("size", size, 16), ("limit", limit, 1)):
        if value is not None and value < least:
            raise UserError(f"--{name} {value}: must be at least {least}")
    if not (math.isfinite(distance) and distance > 0):
        raise UserError(f"--distance {distance}: must be above 0")
    place = str(pick_device(device))
    dataset = open_dataset(data, split)
    predictions = open_predictions(checkpoint, distance, place, encoder_weights)
    folder = output_folder(out)
    save = output_folder(folder / "gaussians") if save_gaussians else None
    network, reason = _lpips_or_reason(place) if lpips else (None, "not asked for")
    protocol = ViewsProtocol(
        split=split,
        reference=reference,
        views=views,
        size=size,
        lpips="VGG16, version 0.1" if network else None,
        lpips_reason=reason,
        distance=predictions.distance,
    )
    objects, scores = [], []
    for number, uid in enumerate(tqdm(dataset.uids[:limit], unit="object")):
        where = folder / "strips" if number < strips else None
        try:
            record, others = evaluate_object(
                predictions, dataset, uid, protocol, network, place, baselines, where, save
            )
        except (UserError, ValueError, RuntimeError) as error:
            objects.append(failure(uid, error))
            continue
        objects.append(record)
        scores.append(others)
    report = write_report(
        folder,
        {**asdict(protocol), "source": predictions.source, "data": data.name},
        objects,
        versions("torch", "kornia"),
        baselines=mean_of(scores),
    )
    return print_summary(report, folder)
