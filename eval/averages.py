"""Means and medians over objects with bootstrap intervals, and paired differences."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

LEVEL = 0.95  # fraction of the resampled means within an interval
RESAMPLES = 10_000
BOOTSTRAP = {"level": LEVEL, "resamples": RESAMPLES, "seed": 0, "method": "percentile"}
_BATCH = 1_000_000  # numbers drawn at once; bounds the memory

Statistic = Callable[[np.ndarray], np.ndarray]  # ``[.., n]`` objects to ``[..]``


def mean_of(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Average the numbers of records with the same keys, nested ones too.

    None values are skipped; the mean is None if all values are. Texts, lists and booleans are left
    out.
    """
    return _over_objects(records, lambda values: sum(values) / len(values))


def median_of(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the medians of the numbers that ``mean_of`` averages, with the same keys."""
    return _over_objects(records, lambda values: float(np.median(values)))


def intervals_of(
    records: list[dict[str, Any]],
    level: float = LEVEL,
    resamples: int = RESAMPLES,
    seed: int = 0,
    statistic: Statistic = lambda values: values.mean(-1),
) -> dict[str, Any]:
    """Compute percentile bootstrap intervals of the means of ``mean_of``.

    Each resample draws as many objects as there are, with replacement (Efron 1979). The interval
    covers only the choice of objects; with a handful of objects it is too narrow.

    Args:
        records: records with the same keys, one for each object.
        level: fraction of the resampled means within the interval.
        resamples: number of draws.
        seed: of the draws, which are the same for every number.
        statistic: of the objects drawn; by default the mean.

    Returns:
        The keys of ``mean_of``, each ``[low, high]``; None with fewer than 2 objects.
    """

    def interval(values: list[float]) -> list[float] | None:
        return bootstrap(np.asarray(values, np.float64), statistic, level, resamples, seed)

    return _over_objects(records, interval)


def bootstrap(
    values: np.ndarray,
    statistic: Statistic,
    level: float = LEVEL,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> list[float] | None:
    """Compute the percentile interval of one statistic; see ``intervals_of``.

    Args:
        values: ``[.., n]`` float64, of n objects; all values of an object are drawn together.
        statistic: maps ``[.., draws, n]`` to ``[draws]``.
        level: fraction of the resampled statistics within the interval.
        resamples: number of draws.
        seed: of the draws.

    Returns:
        ``[low, high]``; None with fewer than 2 objects.
    """
    count = values.shape[-1]
    if count < 2:
        return None
    random = np.random.default_rng(seed)
    batch = max(1, _BATCH // count)
    ends = [(1 - level) / 2, (1 + level) / 2]
    with np.errstate(all="ignore"):  # a sum may overflow
        found = [
            statistic(values[..., random.integers(0, count, (min(batch, resamples - at), count))])
            for at in range(0, resamples, batch)
        ]
        return [float(value) for value in np.quantile(np.concatenate(found), ends)]


def median(values: np.ndarray) -> np.ndarray:
    """Return the median of ``[.., n]`` objects, as a statistic of ``intervals_of``."""
    return np.median(values, -1)


def summary_of(values: Sequence[float | None]) -> dict[str, Any]:
    """Return mean and median of one number over objects, with bootstrap intervals.

    Args:
        values: one for each object; None is skipped.

    Returns:
        ``mean, interval, median, median_interval``; None without values, the intervals also with a
        single value.
    """
    known = np.array([value for value in values if value is not None], np.float64)
    return {
        "mean": float(known.mean()) if len(known) else None,
        "interval": bootstrap(known, lambda drawn: drawn.mean(-1)),
        "median": float(median(known)) if len(known) else None,
        "median_interval": bootstrap(known, median),
    }


def minus(a: dict[str, Any], b: dict[str, Any]) -> dict[str, Any]:
    """Subtract the numbers of ``b`` from the ones of ``a``, nested ones too.

    Only keys with numbers in both are kept; the difference is None if one of the two is None.
    """
    result: dict[str, Any] = {}
    for key in (key for key in a if key in b):
        x, y = a[key], b[key]
        if isinstance(x, dict) and isinstance(y, dict):
            result[key] = minus(x, y)
        elif (x is None or _is_number(x)) and (y is None or _is_number(y)):
            result[key] = None if x is None or y is None else x - y
    return result


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _over_objects(records: list[dict[str, Any]], summary: Callable) -> dict[str, Any]:
    """Apply ``summary`` to the values of each number over the records; None without values."""
    result: dict[str, Any] = {}
    for key in dict.fromkeys(key for record in records for key in record):
        values = [record.get(key) for record in records]
        some = [v for v in values if v is not None]
        if some and all(isinstance(v, dict) for v in some):
            result[key] = _over_objects(some, summary)
        elif all(_is_number(v) for v in some):
            result[key] = summary(some) if some else None
    return result
