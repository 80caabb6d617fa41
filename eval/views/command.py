"""``gamba eval-views``: predicted views against true ones.

Slow imports are inside the command, so that ``--help`` is quick.
"""

from __future__ import annotations

import sys
from typing import Annotated

import tyro

from gamba_warp.batch import print_json, say
from gamba_warp.untrusted.ranges import ranged

from .options import ViewsOptions


@ranged
def eval_views_command(
    options: Annotated[ViewsOptions, tyro.conf.arg(name="")],
    json: bool = False,
) -> int:
    """PSNR, SSIM, LPIPS and mask IoU of predicted views; the input view and novel views apart.

    Args:
        options: of the evaluation.
        json: Print report.json in place of the table.
    """
    filled = options.filled()
    from ..report import count_line, json_of
    from .evaluate import evaluate_views
    from .table import page

    report = evaluate_views(filled)
    if json:
        print_json(json_of(report))
    else:
        print(page(report), end="")
    for name, reason in report["left_out_baselines"].items():
        say(f"left out: {name}: {reason}", sys.stderr)
    for item in report["failures"]:
        say(f"failed: {item['name']}: {item['reason']}", sys.stderr)
    beside = len(report["failures"]) - report["num_failed"]
    print(count_line(report, options.out, beside), file=sys.stderr if json else sys.stdout)
    if report["interrupted"]:
        print("gamba: interrupted; the report covers what was evaluated before", file=sys.stderr)
        return 130
    return 1 if report["failures"] else 0
