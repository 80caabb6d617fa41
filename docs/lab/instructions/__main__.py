"""``PYTHONPATH=docs:tests python -m lab.instructions``: writes the files of docs/lab/benchmarks.

They are counts.json, counts.md, static.json and static.md. With ``--peers`` others' kernels are
counted again, else their counts are kept.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from ptx.machine import Missing

from gamba_warp.files import write_json, write_text

from . import headline, page, peers, report

if __name__ == "__main__":
    docs = Path(__file__).resolve().parents[2]
    folder = docs / "lab" / "benchmarks"
    beside = json.loads((folder / "counts.json").read_text()).get("peers")
    try:
        if "--peers" in sys.argv:
            try:
                beside = peers.compare(docs.parent / "out" / "peers", print)
            except Missing as reason:
                print(f"others' kernels are not counted again: {reason}")
        counts = headline.headline(print) | ({"peers": beside} if beside else {})
        static = report.report(print)
    except Missing as reason:
        sys.exit(f"nothing can be executed: {reason}")
    for name, document, text in (
        ("counts", counts, headline.markdown(counts)),
        ("static", static, page.markdown(static)),
    ):
        write_json(folder / f"{name}.json", document)
        write_text(folder / f"{name}.md", text)
