"""``gamba eval-join``: reports of ``--shard i/n`` joined to that of all objects.

Slow imports are inside the command, so that ``--help`` is quick.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro

from gamba_warp.errors import UserError
from gamba_warp.untrusted.ranges import ranged


@ranged
def eval_join_command(
    reports: tyro.conf.Positional[Annotated[tuple[Path, ...], tyro.conf.arg(metavar="REPORT ...")]],
    *,
    out: Path | None = None,
    json: bool = False,
) -> int:
    """Join the reports of eval-views or eval-geometry with --shard i/n to that of all objects.

    Means, intervals, tables and failures are those of the undivided evaluation. Reports of
    different protocols, data, models or versions are refused, and a shard that is missing or given
    twice. Pictures and saved shapes are not joined: they stay in the folders of the shards.

    Args:
        reports: a report.json, or its folder, of each shard.
        out: folder for report.json, objects.csv and table.md (of shapes also table.tex).
        json: print report.json in place of the table.
    """
    if not reports:
        raise UserError("give the report.json of each shard")
    from gamba_warp.files import output_folder, write_text

    from ..report import count_line, json_of, save_report
    from .join import join_reports, unjoined

    joined = join_reports(reports)
    report = joined.report
    if out is not None:
        save_report(report, output_folder(out))
        for name, text in joined.files.items():
            write_text(out / name, text)
    print(json_of(report) if json else joined.text, end="")
    beside = len(report["failures"]) - report["num_failed"]
    beside += sum(len(part.get("failures", ())) for part in report["baselines"].values())
    for item in report["failures"]:
        print(f"failed: {item['name']}: {item['reason']}", file=sys.stderr)
    notes = sys.stderr if json else sys.stdout
    if left := unjoined(reports):
        print(f"not joined, in the folders of the shards: {', '.join(left)}", file=notes)
    print(count_line(report, out, beside), file=notes)
    return 1 if report["failures"] or beside else 0
