"""Flags, axes and warnings for a report of shapes, and its table."""

from __future__ import annotations

from collections import Counter
from typing import Any

from ..averages import LEVEL, mean_of
from ..report import OK, flat, summary_lines
from ..tables import Column, Row, figures, markdown
from .protocol import GeometryProtocol

_SHOWN = {
    "iou": Column("Volume IoU", 4),
    "chamfer": Column("Chamfer", 4),
    "normal_consistency": Column("normal consistency", 4),
}
# Largest fractions of the Chamfer distance after a transform for a warning: of one object's, or of
# the mean over at least MANY.
FAR_BETTER, BETTER, MANY = 0.6, 0.9, 5
AS_IS, MIRRORED = "as it is", "mirrored"  # key of the identity, first word of the mirrors'
# A mirror counts below this fraction of the best rotation's distance: many shapes are symmetric.
_MIRROR = 0.8
_NAMED = 3  # most objects named in a warning


def page(report: dict[str, Any]) -> str:
    """Return the text of ``table.md`` from a report of ``eval-geometry``."""
    thresholds = sorted(report["protocol"]["thresholds"])
    middle = thresholds[len(thresholds) // 2]
    columns = _SHOWN | {f"fscore.{middle:g}": Column(f"F-score at {middle:g}", 4)}
    statistics = {key: flat(report[key], lists=True) for key in ("mean", "interval", "median")}
    shown = {key: {kind: values.get(key) for kind, values in statistics.items()} for key in columns}
    count = str(report["num_ok"])
    means, medians = (
        figures(["", "objects"], columns, [Row([of, count], shown)], of)
        for of in ("mean", "median")
    )
    return (
        f"{markdown([*means, medians[1]])}\n\nOver objects, with {100 * LEVEL:g} % bootstrap "
        "intervals over objects. Lengths: the ground truth's longest side is "
        f"{report['protocol']['unit']:g}. Chamfer: less is better.\n"
    )


def text_of(report: dict[str, Any], protocol: GeometryProtocol) -> str:
    """Return the text that ``gamba eval-geometry`` prints of a report."""
    changes = f", changed: {', '.join(protocol.changes())}" if protocol.changes() else ""
    lines = [f"protocol {protocol.name}{changes}"]
    for key in ("axes", "flags"):
        for side, counts in report[key].items():
            if counts:
                text = ", ".join(f"{count} {word}" for word, count in counts.items())
                lines.append(f"{side + ' ' + key:<24} {text} of {report['num_ok']}")
    if any("unknown" in counts for counts in report["axes"].values()):
        note = "unknown axes: coordinates are used unchanged (--pred-axes, --up)"
        lines.append(f"{'':<24} {note}")
    lines += summary_lines(report)
    return "\n".join(lines) + "\n"


def summaries(objects: list[dict[str, Any]]) -> dict[str, Any]:
    """Summarise the evaluated shapes besides metrics.

    Returns:
        ``flags`` and ``axes``: counts for each side; and ``warnings``: about ground truths that are
        not placed as in the dataset, parts of files that are not read, and rotations that would
        improve the score a lot.
    """
    done = [record for record in objects if record["status"] == OK]
    sides = ("pred", "gt")
    return {
        "flags": {s: dict(Counter(f for r in done for f in r[f"{s}_flags"])) for s in sides},
        "axes": {s: dict(Counter(r[f"{s}_axes"] for r in done)) for s in sides},
        "warnings": [*file_warnings(done), *rotation_warnings(done)],
    }


def file_warnings(done: list[dict[str, Any]]) -> list[str]:
    """Return each warning of the evaluated files, with the number of files."""
    warnings = []
    for key, name in (("gt_warnings", "ground truths"), ("pred_warnings", "predictions")):
        counts = Counter(text for record in done for text in record.get(key, ()))
        warnings += [f"{count} of {len(done)} {name}: {text}" for text, count in counts.items()]
    return warnings


def rotation_warnings(done: list[dict[str, Any]]) -> list[str]:
    """Warn about rotations and mirrors of the predictions' files that improve the score a lot.

    A transform that improves the mean of many objects gives one warning; else each transform that
    improves single objects by ``FAR_BETTER`` gives one.

    Args:
        done: records of the evaluated objects.
    """

    def straight_and_best(turned: dict[str, float]) -> tuple[float, str, float]:
        def judged(name: str) -> float:
            return turned[name] / (_MIRROR if name.startswith(MIRRORED) else 1)

        best = min((name for name in turned if name != AS_IS), key=judged)
        return turned[AS_IS], best, turned[best]

    def ask(name: str) -> str:
        if name.startswith(MIRRORED):
            return "does the file have left-handed axes?"
        return "are the axes right? (--pred-axes, --up, --frame)"

    if len(done) >= MANY:
        straight, turn, value = straight_and_best(mean_of([r["chamfer_turned"] for r in done]))
        if value <= BETTER * straight:
            return [
                f"the mean Chamfer distance of {len(done)} predictions would be {value:.3g} "
                f"in place of {straight:.3g} if all were {turn}; {ask(turn)}"
            ]
    by_turn: dict[str, list[str]] = {}
    for record in done:
        straight, turn, value = straight_and_best(record["chamfer_turned"])
        if value < FAR_BETTER * straight:
            text = f"{record['name']} {value:.3g} in place of {straight:.3g}"
            by_turn.setdefault(turn, []).append(text)
    return [
        f"{len(texts)} of {len(done)} predictions would have a far smaller Chamfer distance {turn} "
        f"({'; '.join(texts[:_NAMED])}{'; ...' if len(texts) > _NAMED else ''}); {ask(turn)}"
        for turn, texts in by_turn.items()
    ]
