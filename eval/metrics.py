"""Metrics as pure functions: of pictures (torch), of surfaces and of volumes (numpy)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

MAX_PSNR = 100.0  # of equal pictures, whose PSNR has no bound
SSIM_WINDOW = 11
SSIM_SIGMA = 1.5  # fixed in kornia


def psnr(a: Tensor, b: Tensor) -> Tensor:
    """Peak signal-to-noise ratio over the whole picture, in dB, at most ``MAX_PSNR``.

    Args:
        a: ``[.., H, W, C]`` in [0, 1].
        b: the same shape.

    Returns:
        ``[..]`` float64.
    """
    _same_shape(a, b)
    error = (a.double() - b.double()).square().mean((-3, -2, -1))
    return -10 * torch.log10(error.clamp(min=10 ** (-MAX_PSNR / 10)))


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Structural similarity (Wang et al. 2004), mean over channels and whole windows.

    Gaussian window 11x11, sigma 1.5, range 1, no padding; equals scikit-image's with
    ``gaussian_weights=True, use_sample_covariance=False``.

    Args:
        a: ``[.., H, W, C]`` in [0, 1], H and W at least 11.
        b: the same shape.

    Returns:
        ``[..]`` float64, 1 for equal pictures.
    """
    from kornia.metrics import ssim as ssim_map

    _same_shape(a, b)
    if min(a.shape[-3:-1]) < SSIM_WINDOW:
        raise ValueError(f"pictures of {a.shape[-2]}x{a.shape[-3]}; SSIM needs 11x11 or more")
    # float64: the variances are differences of near-equal numbers in flat regions
    x, y = (v.double().reshape(-1, *v.shape[-3:]).permute(0, 3, 1, 2) for v in (a, b))
    values = ssim_map(x, y, SSIM_WINDOW, max_val=1.0, eps=0.0, padding="valid")
    return values.mean((1, 2, 3)).reshape(a.shape[:-3])


def mask_iou(a: Tensor, b: Tensor) -> Tensor:
    """Intersection over union of two masks.

    Args:
        a: ``[.., H, W]`` bool.
        b: the same shape.

    Returns:
        ``[..]`` float64; 1 where both are empty.
    """
    _same_shape(a, b)
    both, either = ((a & b).sum((-2, -1)), (a | b).sum((-2, -1)))
    return torch.where(either > 0, both.double() / either.clamp(min=1), 1.0)


def _same_shape(a: Tensor, b: Tensor) -> None:
    if a.shape != b.shape:
        raise ValueError(f"shapes differ: {tuple(a.shape)} and {tuple(b.shape)}")


@dataclass
class Points:
    """Points on a surface.

    Attributes:
        positions: ``[N, 3]`` float.
        normals: ``[N, 3]`` unit length, either sign; or None.
    """

    positions: np.ndarray
    normals: np.ndarray | None = None


def nearest(queries: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest of ``points [M, 3]`` to each of ``queries [N, 3]``.

    Returns:
        Distances ``[N]`` float32 and indices ``[N]``.
    """
    from gamba_warp.open3d import import_open3d

    o3d = import_open3d()
    search = o3d.core.nns.NearestNeighborSearch(np.ascontiguousarray(points, np.float32))
    search.knn_index()
    indices, squared = search.knn_search(np.ascontiguousarray(queries, np.float32), 1)
    return np.sqrt(squared.numpy()[:, 0]), indices.numpy()[:, 0]


def surface_metrics(
    predicted: Points, truth: Points, thresholds: Sequence[float] = (0.01, 0.02, 0.05)
) -> dict:
    """How far two surfaces are apart, by points on them.

    Args:
        predicted: at least one point.
        truth: at least one point, same unit.
        thresholds: for the F-score, same unit.

    Returns:
        ``accuracy`` (mean distance from predicted to true points), ``completeness`` (from true to
        predicted), ``chamfer`` (mean of the two, distances not squared), ``chamfer_squared`` (mean
        of the two mean squared distances), ``fscore`` ``{str(threshold): 0..1}`` (harmonic mean of
        precision and recall), ``hausdorff`` (the largest distance of either way) and
        ``normal_consistency`` (mean absolute cosine of nearest points' normals, both ways,
        averaged; None without normals).
    """
    there, there_at = nearest(predicted.positions, truth.positions)
    back, back_at = nearest(truth.positions, predicted.positions)
    fscore = {}
    for threshold in thresholds:
        precision, recall = np.mean(there <= threshold), np.mean(back <= threshold)
        total = precision + recall
        fscore[f"{threshold:g}"] = float(2 * precision * recall / total) if total else 0.0
    consistency = None
    if predicted.normals is not None and truth.normals is not None:
        one = np.abs((predicted.normals * truth.normals[there_at]).sum(1)).mean()
        two = np.abs((truth.normals * predicted.normals[back_at]).sum(1)).mean()
        consistency = float(one + two) / 2
    there, back = there.astype(np.float64), back.astype(np.float64)
    return {
        "chamfer": float(there.mean() + back.mean()) / 2,
        "chamfer_squared": float((there**2).mean() + (back**2).mean()) / 2,
        "accuracy": float(there.mean()),
        "completeness": float(back.mean()),
        "hausdorff": float(max(there.max(), back.max())),
        "fscore": fscore,
        "normal_consistency": consistency,
    }


def volume_iou(a: np.ndarray, b: np.ndarray) -> float | None:
    """Intersection over union of two occupancies (bool, same shape); None where both are empty."""
    either = np.count_nonzero(a | b)
    return float(np.count_nonzero(a & b) / either) if either else None
