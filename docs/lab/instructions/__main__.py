"""``make instructions``: writes docs/lab/benchmarks/static.json and static.md."""

from __future__ import annotations

from pathlib import Path

from gamba_warp.files import write_json, write_text

from .page import markdown
from .report import report

if __name__ == "__main__":
    folder = Path(__file__).resolve().parents[1] / "benchmarks"
    document = report(print)
    write_json(folder / "static.json", document)
    write_text(folder / "static.md", markdown(document))
