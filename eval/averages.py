"""Means and medians over objects with bootstrap intervals, and paired differences."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

LEVEL = 0.95  # fraction of the resampled means within an interval
RESAMPLES = 10_000
SEED = 0
BOOTSTRAP = {"level": LEVEL, "resamples": RESAMPLES, "seed": SEED, "method": "percentile"}
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


def intervals_of(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Compute percentile bootstrap intervals of the means of ``mean_of``.

    Returns:
        The keys of ``mean_of``, each as from ``bootstrap``.
    """
    return _over_objects(records, lambda values: bootstrap(np.array(values, np.float64), mean))


def bootstrap(values: np.ndarray, statistic: Statistic) -> list[float] | None:
    """Compute the percentile interval of a statistic.

    Each resample draws as many objects as there are, with replacement (Efron 1979); the draws
    depend on the number of objects alone. The interval covers only the choice of objects; with a
    handful of objects it is too narrow.

    Args:
        values: ``[.., n]`` float64, of n objects; all values of an object are drawn together.
        statistic: maps ``[.., draws, n]`` to ``[draws]``.

    Returns:
        ``[low, high]``; None with fewer than 2 objects.
    """
    count = values.shape[-1]
    if count < 2:
        return None
    random = np.random.default_rng(SEED)
    batch = max(1, _BATCH // count)
    with np.errstate(all="ignore"):  # a sum may overflow
        draws = [
            statistic(values[..., random.integers(0, count, (min(batch, RESAMPLES - at), count))])
            for at in range(0, RESAMPLES, batch)
        ]
        ends = np.quantile(np.concatenate(draws), [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return ends.tolist()


def mean(values: np.ndarray) -> np.ndarray:
    """Return the mean of ``[.., n]`` objects, as a statistic of ``bootstrap``."""
    return values.mean(-1)


def median(values: np.ndarray) -> np.ndarray:
    """Return the median of ``[.., n]`` objects, as a statistic of ``bootstrap``."""
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
        "interval": bootstrap(known, mean),
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
