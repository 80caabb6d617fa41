"""``gamba eval-geometry``: predicted shapes against true ones.

``--help`` answers at once, so what is slow to import is imported by the command itself.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from gamba_warp.errors import UserError
from gamba_warp.untrusted.ranges import ranged

from .options import ShapesOptions

if TYPE_CHECKING:
    from .protocol import GeometryProtocol


@ranged
def eval_geometry_command(
    options: Annotated[ShapesOptions, tyro.conf.arg(name="")],
    json: bool = False,
    csv: bool = False,
) -> int:
    """Chamfer distance, F-score, normal consistency and Volume IoU of shapes.

    Prints the means with 95 % intervals over objects. Options that are not given are those of the
    protocol. Exit code 1 where an object failed (each is listed), 2 where nothing could start.

    Args:
        options: what to evaluate, and how.
        json: Print the report, as report.json holds it, in place of the summary.
        csv: Print the objects, as objects.csv holds them, in place of the summary.
    """
    if json and csv:
        raise UserError("--json and --csv: give one of them")
    from ..report import csv_of, json_of
    from .pairs import evaluate_shapes
    from .protocol import chosen_protocol

    protocol = chosen_protocol(options)
    report = evaluate_shapes(options, protocol)
    parts = [report, *report["baselines"].values()]
    for name, part in zip(("", *report["baselines"]), parts):
        for text in part["warnings"]:
            print(f"warning: {name}{': ' if name else ''}{text}", file=sys.stderr)
    if json or csv:
        print(json_of(report) if json else csv_of(report), end="")
        return 1 if any(part["failures"] for part in parts) else 0
    return _print_summary(report, protocol, options.out)


def _print_summary(report: dict[str, Any], protocol: GeometryProtocol, out: Path | None) -> int:
    """Prints the protocol, the flags, the means and the failures; returns the exit code."""
    from ..paired import page
    from ..report import print_summary

    changes = f", changed: {', '.join(protocol.changes())}" if protocol.changes() else ""
    print(f"protocol {protocol.name}{changes}")
    for key in ("axes", "flags"):
        for side, counts in report[key].items():
            if counts:
                text = ", ".join(f"{count} {word}" for word, count in counts.items())
                print(f"{side + ' ' + key:<24} {text} of {report['num_ok']}")
    if any("unknown" in counts for counts in report["axes"].values()):
        print(f"{'':<24} unknown axes: coordinates are used as they are (--pred-axes, --up)")
    code = print_summary(report, out)
    if report["baselines"]:
        print("\n" + page(report), end="")
        for name, part in report["baselines"].items():
            for item in part["failures"]:
                print(f"failed: {item['name']} ({name}): {item['reason']}")
                code = 1
    return code
