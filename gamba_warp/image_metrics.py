"""Image metrics, and the registry of those that are reported.

``gamba eval-views``, validation during training and ablations compute every metric in ``METRICS``
and show it in reports, tables and pages. Importing this module loads no torch.
"""

from __future__ import annotations

from collections.abc import Callable, Container
from typing import TYPE_CHECKING, NamedTuple

from .conventions import GROUNDS, WHITE

if TYPE_CHECKING:
    from torch import Tensor

MAX_PSNR = 100.0  # dB; of equal images, whose PSNR is infinite
SSIM_WINDOW = 11  # pixels
SSIM_SIGMA = 1.5  # pixels; kornia has it fixed


def psnr(a: Tensor, b: Tensor) -> Tensor:
    """Compute the peak signal-to-noise ratio of the whole image, in dB, at most ``MAX_PSNR``.

    Args:
        a: ``[.., H, W, C]`` in [0, 1].
        b: the same shape.

    Returns:
        ``[..]`` float64.
    """
    _same_shape(a, b)
    error = (a.double() - b.double()).square().mean((-3, -2, -1))
    return -10 * error.clamp(min=10 ** (-MAX_PSNR / 10)).log10()


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Compute the structural similarity (Wang et al. 2004), mean over channels and whole windows.

    The window is Gaussian, 11x11, with sigma 1.5; the range is 1 and nothing is padded. The result
    equals scikit-image's with ``gaussian_weights=True, use_sample_covariance=False``.

    Args:
        a: ``[.., H, W, C]`` in [0, 1], H and W at least 11.
        b: the same shape.

    Returns:
        ``[..]`` float64, 1 for equal images.

    Raises:
        ValueError: the shapes differ, or the images are smaller than the window.
    """
    from kornia.metrics import ssim as ssim_map

    _same_shape(a, b)
    if min(a.shape[-3:-1]) < SSIM_WINDOW:
        raise ValueError(f"images of {a.shape[-2]}x{a.shape[-3]}; SSIM needs 11x11 or more")
    # float64, because in flat regions variances are differences of nearly equal numbers.
    x, y = (v.double().reshape(-1, *v.shape[-3:]).permute(0, 3, 1, 2) for v in (a, b))
    values = ssim_map(x, y, SSIM_WINDOW, max_val=1.0, eps=0.0, padding="valid")
    return values.mean((1, 2, 3)).reshape(a.shape[:-3])


def mask_iou(a: Tensor, b: Tensor) -> Tensor:
    """Compute the intersection over union of two masks.

    Args:
        a: ``[.., H, W]`` bool.
        b: the same shape.

    Returns:
        ``[..]`` float64; 1 where both are empty.
    """
    _same_shape(a, b)
    both, either = (a & b).sum((-2, -1)), (a | b).sum((-2, -1))
    return (both.double() / either.clamp(min=1)).where(either > 0, 1.0)


def _same_shape(a: Tensor, b: Tensor) -> None:
    if a.shape != b.shape:
        raise ValueError(f"shapes differ: {tuple(a.shape)} and {tuple(b.shape)}")


class Metric(NamedTuple):
    """An image metric, as records, tables and pages show it.

    Attributes:
        title: heading of its column.
        compare: function of images ``[V, H, W, 3]`` in [0, 1] or masks ``[V, H, W]`` bool, and
            the true ones; returns ``[V]``. None: LPIPS, whose network may be missing.
        unit: or "".
        digits: decimals shown.
        more_is_better: False if less is.
        of_masks: compares masks (alpha) instead of colours.
        on_grounds: depends on the background, so it is also computed on each of ``GROUNDS``.
        ground: the key of ``GROUNDS`` that it is computed on; None: white.
        least_side: it is undefined for images with a shorter side.
        in_compare: shown in the table of ``gamba compare``; its JSON has all metrics.
    """

    title: str
    compare: Callable[[Tensor, Tensor], Tensor] | None
    unit: str = ""
    digits: int = 3
    more_is_better: bool = True
    of_masks: bool = False
    on_grounds: bool = False
    ground: str | None = None
    least_side: int = 1
    in_compare: bool = True

    @property
    def head(self) -> str:
        """Title with the unit."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    @property
    def grey(self) -> float:
        """Grey value of its background."""
        return WHITE if self.ground is None else GROUNDS[self.ground]


# By key in records. A script may add to it (docs/train-your-own.md).
METRICS: dict[str, Metric] = {
    "psnr": Metric("PSNR", psnr, "dB", digits=2, on_grounds=True),
    "ssim": Metric("SSIM", ssim, least_side=SSIM_WINDOW),
    "lpips": Metric("LPIPS", None, more_is_better=False, on_grounds=True),
    "mask_iou": Metric("mask IoU", mask_iou, of_masks=True, in_compare=False),
}


def on_grounds() -> dict[str, Metric]:
    """Return the background-dependent ``METRICS`` on each of ``GROUNDS``, by key."""
    return {
        f"{name}_{key}": metric._replace(title=f"{metric.title} on {key}", unit="", ground=key)
        for key in GROUNDS
        for name, metric in METRICS.items()
        if metric.on_grounds
    }


def all_figures() -> dict[str, Metric]:
    """Return every metric by its key in records: on white, then on the other backgrounds."""
    return METRICS | on_grounds()


def measure(
    images: Callable[[float], tuple[Tensor, Tensor]],
    masks: tuple[Tensor, Tensor] | None,
    keys: Container[str] | None = None,
) -> dict[str, Tensor]:
    """Compute every metric that needs no network.

    Args:
        images: returns the images to judge and the true ones on a grey value.
        masks: of the same views, see ``Metric.compare``; None without masks.
        keys: of the metrics, or None for all.

    Returns:
        Values ``[V]`` float64 by key, in the order of ``all_figures``.

    Raises:
        ValueError: as the metrics do.
    """
    found = {}
    for key, metric in all_figures().items():
        if metric.compare is None or (keys is not None and key not in keys):
            continue
        pair = masks if metric.of_masks else images(metric.grey)
        if pair is not None:
            found[key] = metric.compare(*pair)
    return found
