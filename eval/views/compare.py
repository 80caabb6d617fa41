"""True views of an object, predicted views of it, and the metrics between the two."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
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

BATCH = 4  # views compared at once, which bounds the memory of LPIPS features
NEARLY_EMPTY = 0.01  # share of the picture; see ViewsProtocol

Values = dict[str, float | None]  # one view's metrics


class Shown(NamedTuple):
    """Pictures that are compared.

    Attributes:
        rgb: ``[V, H, W, 3]`` on white; what is rendered is not clipped to [0, 1] yet.
        alpha: ``[V, H, W]`` in [0, 1]; None where nothing says what the object covers.
    """

    rgb: Tensor
    alpha: Tensor | None

    def on(self, ground: float = WHITE) -> Tensor:
        """RGB ``[V, H, W, 3]`` in [0, 1] on a grey value; without alpha on white alone."""
        if self.alpha is None or ground == WHITE:
            return self.rgb.clamp(0, 1)
        return over_another(self.rgb, self.alpha[..., None], WHITE, ground).clamp(0, 1)

    def mask(self) -> Tensor | None:
        """``[V, H, W]`` bool."""
        return None if self.alpha is None else self.alpha > 0.5


@dataclass(frozen=True)
class ViewsProtocol:
    """What the numbers of ``eval-views`` mean.

    Attributes:
        split: split of the dataset.
        reference: index of the input view.
        views: number of views of an object, input included, evenly spaced in file order; None: all.
        size: height of the pictures compared; None: the files' own.
        lpips: the network, or None.
        lpips_reason: why there is no LPIPS, or None.
        distance: of the input camera from the object's centre, object units.
        background: grey value that both sides are composited on.
        grounds: grey values of the other backgrounds, by the end of their metrics' names: both
            sides are composited on them by their alpha, which pictures without alpha do not have.
        region: part of the picture that the picture metrics run over.
        rendering: how predicted values are compared.
        max_psnr: dB, given to equal pictures.
        ssim: window and convention.
        mask_iou: when a pixel counts as covered.
        averaging: order of the means.
        poses: frame and distance of the cameras.
        split_version: version of the rule or file that made the split.
        nearly_empty: a view is nearly empty where the mean of its true alpha over the picture is
            smaller. Such views count in all means; the report also has the same means without
            them, because their PSNR is high whatever is predicted.
        mean_error: how the PSNR of the mean error comes about.
        evaluation: of a named evaluation, what it is and which of its objects are missing; or None.
        pictures: how pictures under test are read and matched; None: Gaussians are rendered.
        resize_pictures: whether those of another size are resized.
        name: of the protocol.
        changed: the options of its own that were given others.
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
    pictures: str | None = None
    resize_pictures: bool = False
    name: str = "default"
    changed: list[str] = field(default_factory=list)


@dataclass
class Truth:
    """One object's views to compare with.

    Attributes:
        uid: the object.
        images: ``[V, H, W, 4]`` straight RGBA in [0, 1]; view 0 is the input.
        cameras: V cameras in the input camera's world.
        views: their V indices in the dataset.
        shown: the pictures as they are compared.
        rgb: ``[V, H, W, 3]``, the pictures on white.
        mask: ``[V, H, W]`` bool.
        coverage: V shares of the picture, in [0, 1], that the object covers: means of alpha.
        digest: SHA-256 of the pictures, 16 digits.
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
    """What is compared of straight RGBA ``[V, H, W, 4]``."""
    return Shown(over_background(images, WHITE), images[..., 3])


def choose_views(count: int, reference: int, wanted: int | None) -> list[int]:
    """Chooses views: the input first, then ``wanted - 1`` others evenly spaced (None: all).

    Raises:
        UserError: there is no view ``reference``.
    """
    if not 0 <= reference < count:
        raise UserError(f"no view {reference} for the input among its {count}")
    others = [view for view in range(count) if view != reference]
    return [reference, *evenly(others, len(others) if wanted is None else wanted - 1)]


def load_truth(dataset: ViewDataset, uid: str, protocol: ViewsProtocol, device: str) -> Truth:
    """Loads one object's views, with cameras in the input camera's world.

    Args:
        dataset: where the views come from.
        uid: the object.
        protocol: says which views, their size and the distance.
        device: torch device of the result.

    Raises:
        UserError: there is no such view, or a file cannot be read.
    """
    views = choose_views(dataset.num_views(uid), protocol.reference, protocol.views)
    loaded = dataset.load(uid, views=views, size=protocol.size)
    cameras = relative_cameras(loaded.cameras, protocol.distance)
    return Truth(uid, loaded.images.to(device), cameras.to(device), views)


def render_views(gaussians: Gaussians, cameras: Cameras) -> Shown:
    """Renders on white, once for all backgrounds."""
    with torch.no_grad():
        out = render(gaussians, cameras, background=cameras.viewmats.new_full((3,), WHITE))
    return Shown(out.rgb, out.alpha[..., 0])


def compare(candidates: Mapping[str, Shown], truth: Truth) -> dict[str, list[Values]]:
    """Computes all figures of each view for each candidate; LPIPS is None yet.

    Besides, ``mse``: the mean squared error that the PSNR on white states. Masks and figures on
    other backgrounds go by alpha, and are None where a candidate has none.
    """
    result: dict[str, list[Values]] = {}
    for name, pictures in candidates.items():
        alpha, mask = pictures.alpha, pictures.mask()
        found = measure(
            lambda grey, shown=pictures: (shown.on(grey), truth.shown.on(grey)),
            None if mask is None else (mask, truth.mask),
            [k for k, m in all_figures().items() if alpha is not None or m.ground is None],
        )
        values = dict.fromkeys(all_figures(), [None] * len(pictures.rgb))
        values |= {key: figures.tolist() for key, figures in found.items()}
        values["mse"] = (10 ** (-found["psnr"] / 10)).tolist()
        result[name] = [dict(zip(values, row)) for row in zip(*values.values())]
    return result


@torch.no_grad()
def add_lpips(
    values: dict[str, list[Values]],
    candidates: Mapping[str, Shown],
    truth: Truth,
    lpips: LPIPS,
) -> None:
    """Adds LPIPS, on every background, to what ``compare`` returned.

    Nearly all the time goes into the features. They are computed once for the truth, and once for
    a candidate that shows the same picture (an expanded tensor) in every view. A bar shows how far
    they are, where they take more than two seconds.
    """
    total = lpips_pictures(candidates, truth)
    about = {"desc": f"LPIPS of {truth.uid}", "unit": "picture", "leave": False, "delay": 2}
    with progress_bar(total=total, **about) as bar:
        _add_lpips(values, candidates, truth, lpips, bar.update)


def lpips_pictures(candidates: Mapping[str, Shown], truth: Truth) -> int:
    """The number of pictures whose features ``add_lpips`` computes."""
    count = 0
    for metric in all_figures().values():
        if metric.compare is None:
            known = [c for c in candidates.values() if c.alpha is not None or metric.grey == WHITE]
            count += len(truth.rgb)
            count += sum(len(truth.rgb) if c.rgb.stride(0) else 1 for c in known)
    return count


def _add_lpips(
    values: dict[str, list[Values]],
    candidates: Mapping[str, Shown],
    truth: Truth,
    lpips: LPIPS,
    done: Callable[[int], object],
) -> None:
    """As ``add_lpips``; ``done`` is told the number of pictures after each part."""
    for key, metric in all_figures().items():
        if metric.compare is not None:
            continue
        grey = metric.grey
        known = {n: c for n, c in candidates.items() if c.alpha is not None or grey == WHITE}
        shown = {name: pictures.on(grey) for name, pictures in known.items()}
        fixed = {n: lpips.features(shown[n][0]) for n, c in known.items() if not c.rgb.stride(0)}
        done(len(fixed))
        true = truth.shown.on(grey)
        for start in range(0, len(true), BATCH):
            part = slice(start, start + BATCH)
            features = lpips.features(true[part])
            done(len(true[part]))
            for name, rgb in shown.items():
                found = fixed[name] if name in fixed else lpips.features(rgb[part])
                distances = lpips.distance(found, features).tolist()
                for row, value in zip(values[name][part], distances):
                    row[key] = value
                done(0 if name in fixed else len(distances))


def summary(views: list[Values], coverage: list[float]) -> dict[str, Any]:
    """Means over the novel views (None without any), and the input view (the first) apart.

    Args:
        views: metrics of each view.
        coverage: what the object covers of each, see ``Truth``.

    Returns:
        The metrics, ``input``, and ``without_nearly_empty``: the same without the views that are
        nearly empty.
    """
    seen = [None if share < NEARLY_EMPTY else view for view, share in zip(views, coverage)]
    parts = []
    for chosen in (views, seen):
        novel = mean_of([view for view in chosen[1:] if view is not None])
        absent = dict.fromkeys(views[0])
        parts.append({**absent, **novel, "input": chosen[0] or absent})
    return {**parts[0], "without_nearly_empty": parts[1]}
