"""True and predicted views of an object, and the metrics between them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gamba_warp.batch import progress_bar
from gamba_warp.cameras import Cameras
from gamba_warp.conventions import GROUNDS, WHITE, over_another, over_background
from gamba_warp.data.dataset import SPLIT_VERSION, ViewDataset, evenly
from gamba_warp.errors import UserError
from gamba_warp.gaussians import Gaussians
from gamba_warp.image_metrics import MAX_PSNR, SSIM_SIGMA, SSIM_WINDOW, all_figures, measure
from gamba_warp.model.posing import relative_cameras
from gamba_warp.render import render
from gamba_warp.vision.lpips import LPIPS

from ..averages import mean_of

BATCH = 4  # views compared at once; bounds the memory of LPIPS features
NEARLY_EMPTY = 0.01  # fraction of the image; see ViewsProtocol

Values = dict[str, float | None]  # one view's metrics


class Shown(NamedTuple):
    """Images to compare.

    Attributes:
        rgb: ``[V, H, W, 3]`` on white; renderings are not yet clipped to [0, 1].
        alpha: ``[V, H, W]`` in [0, 1]; None if unknown.
    """

    rgb: Tensor
    alpha: Tensor | None

    def on(self, ground: float = WHITE) -> Tensor:
        """Return RGB ``[V, H, W, 3]`` in [0, 1] on a grey value; always on white without alpha."""
        if self.alpha is None or ground == WHITE:
            return self.rgb.clamp(0, 1)
        return over_another(self.rgb, self.alpha[..., None], WHITE, ground).clamp(0, 1)

    def mask(self) -> Tensor | None:
        """Return the mask ``[V, H, W]`` bool; None without alpha."""
        return None if self.alpha is None else self.alpha > 0.5


@dataclass(frozen=True)
class ViewsProtocol:
    """Definition of the numbers of ``eval-views``.

    Attributes:
        split: split of the dataset.
        reference: index of the input view.
        views: number of views of an object, input included, evenly spaced in file order; None: all.
        size: height of the images compared; None: the files' own.
        lpips: the network, or None.
        lpips_reason: why LPIPS is missing, or None.
        distance: of the input camera from the object's centre, object units.
        background: grey value behind both sides.
        grounds: grey values of the other backgrounds, by suffix of their metrics' names. Images
            without alpha are not compared on them.
        region: part of the image covered by the image metrics.
        rendering: clipping and rounding of predicted values.
        max_psnr: dB, of equal images.
        ssim: window and convention.
        mask_iou: definition of a covered pixel.
        averaging: order of the means.
        poses: frame and distance of the cameras.
        split_version: version of the split's rule or file.
        nearly_empty: a view is nearly empty if its mean true alpha is smaller. Such views count in
            all means; the report also has the means without them, because their PSNR is high for
            any prediction.
        mean_error: definition of the PSNR of the mean error.
        evaluation: a named evaluation and its missing objects, or None.
        images: reading and matching of images under test; None: Gaussians are rendered.
        resize_images: images of another size are resized.
        name: of the protocol.
        changed: names of its options that were changed.
    """

    split: str
    reference: int
    views: int | None
    size: int | None
    lpips: str | None
    lpips_reason: str | None
    distance: float
    background: float = WHITE
    grounds: dict[str, float] = field(default_factory=GROUNDS.copy)
    region: str = "full image"
    rendering: str = "clipped to [0, 1], not rounded to 8 bits"
    max_psnr: float = MAX_PSNR
    ssim: str = f"Gaussian {SSIM_WINDOW}x{SSIM_WINDOW}, sigma {SSIM_SIGMA}, no padding, range 1"
    mask_iou: str = "alpha > 0.5 on both sides"
    averaging: str = "views, then objects; input view apart"
    poses: str = "relative to the input view, its distance normalised"
    split_version: int = SPLIT_VERSION
    nearly_empty: float = NEARLY_EMPTY
    mean_error: str = "mean squared error over views, then objects, as PSNR"
    evaluation: dict[str, Any] | None = None
    images: str | None = None
    resize_images: bool = False
    name: str = "default"
    changed: list[str] = field(default_factory=list)


@dataclass
class GroundTruth:
    """True views of one object.

    Attributes:
        uid: the object.
        images: ``[V, H, W, 4]`` straight RGBA in [0, 1]; view 0 is the input.
        cameras: V cameras in the input camera's world.
        views: their V indices in the dataset.
        shown: the images to compare.
        rgb: ``[V, H, W, 3]``, the images on white.
        mask: ``[V, H, W]`` bool.
        coverage: V fractions of the image covered by the object: means of alpha, in [0, 1].
        digest: SHA-256 of the images, 16 digits.
    """

    uid: str
    images: Tensor
    cameras: Cameras
    views: list[int]

    def __post_init__(self) -> None:
        self.shown = shown(self.images)
        self.rgb, self.mask = self.shown.rgb, self.images[..., 3] > 0.5
        self.coverage: list[float] = self.images[..., 3].double().mean((1, 2)).tolist()
        pixels = self.images.cpu().numpy().tobytes()
        self.digest = hashlib.sha256(pixels).hexdigest()[:16]


def shown(images: Tensor) -> Shown:
    """Return straight RGBA ``[V, H, W, 4]`` as images to compare."""
    return Shown(over_background(images, WHITE), images[..., 3])


def choose_views(count: int, reference: int, wanted: int | None) -> list[int]:
    """Choose views: the input, then ``wanted - 1`` others evenly spaced (None: all).

    Raises:
        UserError: view ``reference`` is missing.
    """
    if not 0 <= reference < count:
        raise UserError(f"the input view {reference} is not one of its {count} views")
    others = [view for view in range(count) if view != reference]
    return [reference, *evenly(others, len(others) if wanted is None else wanted - 1)]


def load_gt(dataset: ViewDataset, uid: str, protocol: ViewsProtocol, device: str) -> GroundTruth:
    """Load one object's views, with cameras in the input camera's world.

    Args:
        dataset: of the views.
        uid: the object.
        protocol: with the choice of views, their size and the distance.
        device: torch device of the result.

    Raises:
        UserError: a view is missing, or a file cannot be read.
    """
    views = choose_views(dataset.num_views(uid), protocol.reference, protocol.views)
    loaded = dataset.load(uid, views=views, size=protocol.size)
    cameras = relative_cameras(loaded.cameras, protocol.distance)
    return GroundTruth(uid, loaded.images.to(device), cameras.to(device), views)


def render_views(gaussians: Gaussians, cameras: Cameras) -> Shown:
    """Render on white, once for all backgrounds."""
    with torch.no_grad():
        out = render(gaussians, cameras, background=cameras.viewmats.new_full((3,), WHITE))
    return Shown(out.rgb, out.alpha[..., 0])


def compare(candidates: Mapping[str, Shown], gt: GroundTruth) -> dict[str, list[Values]]:
    """Compute all metrics of each view for each candidate, except LPIPS, which stays None.

    ``mse`` is the mean squared error of the PSNR on white. Masks and metrics on other backgrounds
    are None for a candidate without alpha.
    """
    result: dict[str, list[Values]] = {}
    for name, images in candidates.items():
        alpha, mask = images.alpha, images.mask()
        measured = measure(
            lambda grey, shown=images: (shown.on(grey), gt.shown.on(grey)),
            None if mask is None else (mask, gt.mask),
            [k for k, m in all_figures().items() if alpha is not None or m.ground is None],
        )
        values = dict.fromkeys(all_figures(), [None] * len(images.rgb))
        values |= {key: figures.tolist() for key, figures in measured.items()}
        values["mse"] = (10 ** (-measured["psnr"] / 10)).tolist()
        result[name] = [dict(zip(values, row)) for row in zip(*values.values())]
    return result


@torch.no_grad()
def add_lpips(
    values: dict[str, list[Values]],
    candidates: Mapping[str, Shown],
    gt: GroundTruth,
    lpips: LPIPS,
) -> None:
    """Add LPIPS, on every background, to the result of ``compare``.

    Features take nearly all the time. They are computed once for the ground truth, and once for a
    candidate with the same image (an expanded tensor) in every view. A progress bar appears after
    two seconds.
    """
    about = {"desc": f"LPIPS of {gt.uid}", "unit": "batch", "leave": False, "delay": 2}
    figures = {key: metric for key, metric in all_figures().items() if metric.compare is None}
    starts = range(0, len(gt.rgb), BATCH)
    with progress_bar(total=len(figures) * len(starts), **about) as bar:
        for key, metric in figures.items():
            grey = metric.grey
            known = {n: c for n, c in candidates.items() if c.alpha is not None or grey == WHITE}
            shown = {name: images.on(grey) for name, images in known.items()}
            fixed = {
                n: lpips.features(shown[n][0]) for n, c in known.items() if not c.rgb.stride(0)
            }
            true = gt.shown.on(grey)
            for start in starts:
                part = slice(start, start + BATCH)
                features = lpips.features(true[part])
                for name, rgb in shown.items():
                    candidate = fixed[name] if name in fixed else lpips.features(rgb[part])
                    distances = lpips.distance(candidate, features).tolist()
                    for row, value in zip(values[name][part], distances):
                        row[key] = value
                bar.update()


def summary(views: list[Values], coverage: list[float]) -> dict[str, Any]:
    """Average over the novel views (None without any), with the input view (the first) apart.

    Args:
        views: metrics of each view.
        coverage: of each view, see ``GroundTruth``.

    Returns:
        The metrics, ``input``, and ``without_nearly_empty``: the same without nearly empty views.
    """
    covered = [None if fraction < NEARLY_EMPTY else view for view, fraction in zip(views, coverage)]
    parts = []
    for chosen in (views, covered):
        novel = mean_of([view for view in chosen[1:] if view is not None])
        absent = dict.fromkeys(views[0])
        parts.append({**absent, **novel, "input": chosen[0] or absent})
    return {**parts[0], "without_nearly_empty": parts[1]}
