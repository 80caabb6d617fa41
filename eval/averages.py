"""Means and medians over objects, with bootstrap intervals, and differences object by object."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

LEVEL = 0.95  # share of the resampled means within an interval
RESAMPLES = 10_000
BOOTSTRAP = {"level": LEVEL, "resamples": RESAMPLES, "seed": 0, "method": "percentile"}
_AT_ONCE = 1_000_000  # numbers drawn at once, which bounds the memory

Statistic = Callable[[np.ndarray], np.ndarray]  # of ``[.., n]`` objects, ``[..]``


def mean_of(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Averages the numbers of records with the same keys, nested ones too.

    A number that is None in some records is averaged over the others; the mean is None where no
    record has the number. Texts, lists and booleans are left out.
    """
    return _over_objects(records, lambda values: sum(values) / len(values))


def median_of(records: list[dict[str, Any]]) -> dict[str, Any]:
    """The medians of the numbers that ``mean_of`` averages, with the same keys."""
    return _over_objects(records, lambda values: float(np.median(values)))


def intervals_of(
    records: list[dict[str, Any]],
    level: float = LEVEL,
    resamples: int = RESAMPLES,
    seed: int = 0,
    statistic: Statistic = lambda values: values.mean(-1),
) -> dict[str, Any]:
    """Computes bootstrap intervals of the means of ``mean_of``: percentiles over resamples.

    Objects are drawn with repetition, as many as there are, and averaged (Efron 1979). The interval
    tells how far the mean depends on the choice of objects and nothing else; with a handful of
    objects it is too narrow.

    Args:
        records: records with the same keys, one for each object.
        level: share of the resampled means within the interval.
        resamples: number of draws.
        seed: of the draws; every number has the same draws.
        statistic: what is computed of the objects drawn; the mean unless told.

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
    """Computes the percentile interval of one statistic; see ``intervals_of``.

    Args:
        values: ``[.., n]`` float64, of n objects; what belongs to one object is drawn together.
        statistic: of ``[.., draws, n]``, ``[draws]``.
        level: share of the resampled statistics within the interval.
        resamples: number of draws.
        seed: of the draws.

    Returns:
        ``[low, high]``; None with fewer than 2 objects.
    """
    count = values.shape[-1]
    if count < 2:
        return None
    random = np.random.default_rng(seed)
    batch = max(1, _AT_ONCE // count)
    ends = [(1 - level) / 2, (1 + level) / 2]
    with np.errstate(all="ignore"):  # a sum may be too large for a number
        found = [
            statistic(values[..., random.integers(0, count, (min(batch, resamples - at), count))])
            for at in range(0, resamples, batch)
        ]
        return [float(value) for value in np.quantile(np.concatenate(found), ends)]


def median(values: np.ndarray) -> np.ndarray:
    """The median of ``[.., n]`` objects, as a statistic of ``intervals_of``."""
    return np.median(values, -1)


def summary_of(values: Sequence[float | None]) -> dict[str, Any]:
    """Mean and median of one number over objects, each with its bootstrap interval.

    Args:
        values: one for each object; those that are None are passed over.

    Returns:
        ``mean, interval, median, median_interval``; None where there is no value, and the intervals
        also where there is one only.
    """
    known = np.array([value for value in values if value is not None], np.float64)
    return {
        "mean": float(known.mean()) if len(known) else None,
        "interval": bootstrap(known, lambda drawn: drawn.mean(-1)),
        "median": float(median(known)) if len(known) else None,
        "median_interval": bootstrap(known, median),
    }


def minus(a: dict[str, Any], b: dict[str, Any]) -> dict[str, Any]:
    """Subtracts the numbers of ``b`` from those of ``a``, nested ones too.

    A key whose values are not numbers in both, or that is not in both, is left out; None where one
    of them is None.
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
    """Applies ``summary`` to the values that each number has in the records; None without any."""
    result: dict[str, Any] = {}
    for key in dict.fromkeys(key for record in records for key in record):
        values = [record.get(key) for record in records]
        some = [v for v in values if v is not None]
        if some and all(isinstance(v, dict) for v in some):
            result[key] = _over_objects(some, summary)
        elif all(_is_number(v) for v in some):
            result[key] = summary(some) if some else None
    return result
