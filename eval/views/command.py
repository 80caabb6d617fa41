"""``gamba eval-views``: predicted views against true ones.

``--help`` answers at once, so what is slow to import is imported by the command itself.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import tyro

from gamba_warp.errors import UserError
from gamba_warp.untrusted.ranges import ranged

from .options import ViewsOptions


@ranged
def eval_views_command(
    options: Annotated[ViewsOptions, tyro.conf.arg(name="")],
    json: bool = False,
    csv: bool = False,
) -> int:
    """PSNR, SSIM, LPIPS and mask IoU of predicted views; the input view and novel views apart.

    Args:
        options: what to evaluate, and how.
        json: Print the report, as report.json holds it, in place of the table.
        csv: Print the objects, as objects.csv holds them, in place of the table.
    """
    options.check()
    if json and csv:
        raise UserError("--json and --csv: give one of them")
    from .evaluate import evaluate_views

    report = evaluate_views(options)
    _print_report(report, options.out, json=json, csv=csv)
    if report["interrupted"]:
        print("gamba: interrupted; the report has what was evaluated before", file=sys.stderr)
        return 130
    return 1 if report["failures"] else 0


def _print_report(report: dict[str, Any], out: Path | None, *, json: bool, csv: bool) -> None:
    """Prints the table, or JSON or CSV alone; what is missing goes to the error output."""
    from ..report import count_line, csv_of, json_of
    from .table import page

    text = json_of(report) if json else csv_of(report) if csv else page(report)
    print(text, end="")
    for name, reason in report["left_out_baselines"].items():
        print(f"left out: {name}: {reason}", file=sys.stderr)
    for item in report["failures"]:
        print(f"failed: {item['name']}: {item['reason']}", file=sys.stderr)
    print(count_line(report, out), file=sys.stderr if json or csv else sys.stdout)
