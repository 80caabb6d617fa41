"""Number of Gaussians needed for a share of the quality, from rows of different numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

SHARES = (0.87, 0.95)
DEFINITION = (
    "Quality is the gain in PSNR over an empty picture, as a share of the gain of the row with the "
    "most Gaussians. Between two rows it is taken to be linear in the logarithm of N, the number "
    "of Gaussians; what is needed for a share is the smallest N that reaches it."
)


def needed(numbers: Sequence[int], quality: Sequence[float], share: float) -> float | None:
    """Return the smallest number that reaches a share of the quality.

    Args:
        numbers: N of each row, rising.
        quality: of each row.
        share: of the quality.

    Returns:
        The interpolated number; the first row's if that reaches the share (an upper bound); None if
        no row does.
    """
    for k, value in enumerate(quality):
        if value >= share:
            if k == 0:
                return float(numbers[0])
            part = (share - quality[k - 1]) / (value - quality[k - 1])
            low, high = math.log(numbers[k - 1]), math.log(numbers[k])
            return math.exp(low + part * (high - low))
    return None


def qualities(values: np.ndarray) -> np.ndarray | None:
    """Compute the quality of each row from PSNR.

    Args:
        values: ``[rows + 1, ..]`` dB: of the empty picture, then of each row, that with the most
            Gaussians last.

    Returns:
        ``[rows, ..]``; NaN where the last row gains nothing. None without rows.
    """
    if len(values) < 2:
        return None
    gains = values[1:] - values[:1]
    with np.errstate(all="ignore"):
        return np.where(gains[-1] > 0, gains / gains[-1], np.nan)


def series_of(
    numbers: Sequence[int],
    rows: Sequence[Mapping[str, float]],
    empty: Mapping[str, float],
    shares: Sequence[float] = SHARES,
) -> dict[str, Any] | None:
    """Summarise a series of rows.

    Args:
        numbers: N of each row, rising.
        rows: PSNR by object of each row, dB, means over views and seeds.
        empty: PSNR of an empty picture by object, dB, over the same views.
        shares: of the quality.

    Returns:
        None with fewer than two rows, or without a common object. Else ``objects`` (their number),
        ``empty`` (mean PSNR), ``psnr`` and ``quality`` of each number; ``needed``, by share in
        percent, ``{number, at_most, interval}`` of the means over objects (bootstrap interval over
        objects); ``reached``, by share, the fraction of objects whose quality reaches it at each
        number; ``no_gain``: number of objects without gain at the most Gaussians, which
        ``reached`` leaves out.
    """
    from gamba_warp.eval.averages import bootstrap

    names = sorted(set(empty).intersection(*rows)) if rows else []
    if len(rows) < 2 or not names:
        return None
    table = np.array([[part[name] for name in names] for part in (empty, *rows)])
    means = table.mean(1)
    quality = qualities(means)
    assert quality is not None
    known = bool(np.isfinite(quality).all())
    per_object = qualities(table)
    assert per_object is not None
    gaining = np.isfinite(per_object).all(0)
    found: dict[str, Any] = {
        "numbers": list(numbers),
        "objects": len(names),
        "empty": float(means[0]),
        "psnr": [float(value) for value in means[1:]],
        "quality": [float(value) for value in quality] if known else None,
        "no_gain": int((~gaining).sum()),
        "needed": {},
        "reached": {},
    }
    for share in shares:
        key = f"{100 * share:g}"
        number = needed(numbers, list(quality), share) if known else None

        def statistic(drawn: np.ndarray, share: float = share) -> np.ndarray:
            parts = qualities(drawn.mean(-1))
            assert parts is not None
            each = (needed(numbers, column, share) for column in parts.T.tolist())
            return np.array([math.nan if value is None else value for value in each])

        ends = bootstrap(table, statistic, resamples=2000) if number is not None else None
        found["needed"][key] = {
            "number": number,
            "at_most": bool(known and quality[0] >= share),
            "interval": ends if ends and all(map(math.isfinite, ends)) else None,
        }
        enough = [needed(numbers, column, share) for column in per_object[:, gaining].T.tolist()]
        found["reached"][key] = [
            sum(value is not None and value <= n * (1 + 1e-9) for value in enough) / len(enough)
            if enough
            else None
            for n in numbers
        ]
    return found
