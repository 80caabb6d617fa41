"""``gamba compare``: reports of several methods in one table.

Slow imports are inside the command, so that ``--help`` is quick.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from gamba_warp.batch import print_json
from gamba_warp.errors import UserError
from gamba_warp.untrusted.ranges import ranged


@ranged
def compare_command(
    reports: tyro.conf.Positional[
        Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=REPORT ...")]
    ],
    *,
    against: str | None = None,
    out: Path | None = None,
    json: bool = False,
) -> int:
    """PSNR, SSIM, LPIPS, Chamfer and Volume IoU of several methods, as the paper's Table 1.

    First evaluate each method by eval-views, eval-geometry or both; give a name twice for both
    reports. Means are over the objects that all methods have. Reports of different protocols, or of
    different true images or shapes, are refused.

    Args:
        reports: NAME=FILE: a report.json, or its folder.
        against: Baseline of the paired differences; by default the first method.
        out: Folder for compare.json and compare.md.
        json: Print compare.json in place of the table.
    """
    if not reports:
        raise UserError("give NAME=REPORT pairs, each a report.json of eval-views or eval-geometry")
    from gamba_warp.files import output_folder, write_json, write_text

    from .compare import join, markdown_page, read_reports
    from .report import json_of

    joined = join(read_reports(reports), against)
    if out is not None:
        folder = output_folder(out)
        write_json(folder / "compare.json", joined)
        write_text(folder / "compare.md", markdown_page(joined))
    if json:
        print_json(json_of(joined))
    else:
        print(markdown_page(joined), end="")
    return 0
