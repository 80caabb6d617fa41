"""One table of several methods over the objects that all of them have, as the paper's Table 1."""

from __future__ import annotations

from typing import Any

import numpy as np

from gamba_warp.conventions import ON_GROUNDS
from gamba_warp.errors import UserError
from gamba_warp.versions import __version__

from .averages import LEVEL, RESAMPLES, summary_of
from .methods import SHAPES, VIEWS, Method, having

FORMAT = "gamba_warp.compare.1"
# Metrics by kind of report; the names are those of the records.
METRICS = {
    VIEWS: ("psnr", "ssim", "lpips", "mask_iou", *ON_GROUNDS),
    SHAPES: ("chamfer", "iou"),
}


def join(methods: list[Method], against: str | None, notes: list[str]) -> dict[str, Any]:
    """Makes the table of methods.

    A metric is averaged over the objects for which every method that has this metric at all has a
    value, so that no method is spared the objects that it failed at without the others being spared
    them too.

    Args:
        methods: as ``read_methods`` returns them.
        against: the method that the others are compared with, object by object; the first one if
            None.
        notes: remarks for the readers.

    Returns:
        ``format, version, against, bootstrap, notes``; ``common``: the names of the objects by
        metric; ``rows``: for each method ``name``, ``seconds`` with where they come from, and by
        metric ``{mean, interval, median, median_interval}``, None where it has no such metric;
        ``differences``: likewise, each method minus ``against``; ``missing``: by kind of report and
        method, the reasons by object; ``reports``: the files and their protocols.

    Raises:
        UserError: there is no such method, or no object is common to all.
    """
    names = [method.name for method in methods]
    base = names[0] if against is None else against
    if base not in names:
        raise UserError(f"--against {base}: the methods are {', '.join(names)}")
    values = _values(methods)
    common = {metric: _common(found) for metric, found in values.items()}
    for kind in METRICS:
        _check_common(having(methods, kind), common, kind)
    rows, differences = [], []
    for method in methods:
        kept = {
            metric: [found[method.name][uid] for uid in common[metric]]
            for metric, found in values.items()
            if method.name in found
        }
        table = {m: summary_of(kept[m]) if kept.get(m) else None for m in values}
        views = method.reports.get(VIEWS)
        uids = [uid for uid in common["psnr"] if views and uid in views.records]
        rows.append({"name": method.name, **_seconds(method, uids), **table})
        if method.name != base:
            gains = {m: _gains(found, method.name, base, common[m]) for m, found in values.items()}
            gained = {m: summary_of(gain) if gain else None for m, gain in gains.items()}
            differences.append({"name": f"{method.name} - {base}", **gained})
    return {
        "format": FORMAT,
        "version": __version__,
        "against": base,
        "bootstrap": {"level": LEVEL, "resamples": RESAMPLES, "seed": 0, "method": "percentile"},
        "notes": notes,
        "common": common,
        "rows": rows,
        "differences": differences,
        "missing": {kind: _missing(methods, kind) for kind in METRICS},
        "reports": {
            method.name: {
                kind: {"file": report.path.name, "protocol": report.protocol}
                for kind, report in method.reports.items()
            }
            for method in methods
        },
    }


def _values(methods: list[Method]) -> dict[str, dict[str, dict[str, float]]]:
    """Values by metric, method and object; methods without any value of a metric are left out."""
    result: dict[str, dict[str, dict[str, float]]] = {}
    for kind, metrics in METRICS.items():
        for metric in metrics:
            found = {
                name: {
                    uid: getattr(record, metric)
                    for uid, record in report.records.items()
                    if getattr(record, metric) is not None
                }
                for name, report in having(methods, kind).items()
            }
            result[metric] = {name: by_uid for name, by_uid in found.items() if by_uid}
    return result


def _common(found: dict[str, dict[str, float]]) -> list[str]:
    return sorted(set.intersection(*map(set, found.values()))) if found else []


def _check_common(reports: dict[str, Any], common: dict[str, list[str]], kind: str) -> None:
    empty = not all(report.records for report in reports.values())
    if reports and (empty or not common[METRICS[kind][0]]):
        counts = ", ".join(f"{name} {len(r.records)}" for name, r in reports.items())
        fewest = min(reports.values(), key=lambda report: len(report.records))
        raise UserError(
            f"{fewest.path}: no object was evaluated for all methods by {kind}: {counts}"
        )


def _gains(
    found: dict[str, dict[str, float]], name: str, base: str, uids: list[str]
) -> list[float]:
    if name not in found or base not in found:
        return []
    return [found[name][uid] - found[base][uid] for uid in uids]


def _seconds(method: Method, uids: list[str]) -> dict[str, Any]:
    """The time of one object, and where it comes from."""
    if method.seconds is not None:
        return {"seconds": method.seconds, "seconds_from": "stated"}
    report = method.reports.get(VIEWS)
    source = report.protocol.get("source") if report else None
    if report and isinstance(source, dict) and source.get("kind") == "checkpoint":
        times = [report.records[uid].seconds.get("predict") for uid in uids]
        known = [time for time in times if time is not None]
        if known:  # the median: the first object's time holds the compilation of the kernels
            return {"seconds": float(np.median(known)), "seconds_from": "measured"}
    return {"seconds": None, "seconds_from": None}


def _missing(methods: list[Method], kind: str) -> dict[str, dict[str, str]]:
    """By method, why it lacks objects that another one has or tried."""
    reports = having(methods, kind)
    known = {uid for report in reports.values() for uid in (*report.records, *report.failed)}
    return {
        name: {
            uid: report.failed.get(uid, "not in its report")
            for uid in sorted(known - report.records.keys())
        }
        for name, report in reports.items()
    }
