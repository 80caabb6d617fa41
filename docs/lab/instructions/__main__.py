"""``make instructions``: writes static.json, static.md, counts.json and counts.md."""

from __future__ import annotations

import sys
from pathlib import Path

from ptx.machine import Missing

from gamba_warp.files import write_json, write_text

from . import headline, page, report

if __name__ == "__main__":
    folder = Path(__file__).resolve().parents[1] / "benchmarks"
    parts = {"counts": (headline.headline, headline.markdown)}
    parts["static"] = report.report, page.markdown
    for name, (make, markdown) in parts.items():
        try:
            document = make(print)
        except Missing as reason:
            sys.exit(f"nothing can be executed: {reason}")
        write_json(folder / f"{name}.json", document)
        write_text(folder / f"{name}.md", markdown(document))
