"""Writes the table of docs/kernels-alone.md from cpu-times.json.

After the measurement, with mambapy installed:

    make study WHAT="times --threads 1 --out out/times"
    cp out/times/bench.json docs/lab/benchmarks/cpu-times.json
    make figures
"""

from __future__ import annotations

from pathlib import Path

from gamba_warp.files import write_text
from gamba_warp.kernels.bench.core.report import machine_line
from gamba_warp.kernels.runtime.tables import markdown
from gamba_warp.measure.suites import read_document

from .parts import with_parts

DOCS = Path(__file__).parents[2]
PAGE, TIMES = DOCS / "kernels-alone.md", DOCS / "lab" / "benchmarks" / "cpu-times.json"
_HEADER = ("tokens", "channels", "dtype", "forward, ms", "error")
_HEADER += ("with gradients, ms", "worst error", "torch loop, ms", "mambapy, ms")


def main() -> None:
    """Update the page."""
    text = PAGE.read_text(encoding="utf-8")
    write_text(PAGE, page_of(text, read_document(TIMES)))


def page_of(text: str, document: dict) -> str:
    """Update the page's table from the results.

    Args:
        text: of the page.
        document: results of the study, from ``read_document``.

    Raises:
        ValueError: the page lacks a mark.
    """
    found = {(r["case"], r["variant"], r["direction"]): r for r in document["records"]}
    rows = []
    for case in dict.fromkeys(r["case"] for r in document["records"]):

        def both(name: str, case: str = case) -> str:
            pair = [found.get((case, name, d)) for d in ("forward", "forward+backward")]
            return " / ".join(_ms(r["ms_p50"]) for r in pair if r and r["ms_p50"])

        for dtype in ("float32", "bfloat16"):
            one, two = (found[case, dtype, d] for d in ("forward", "forward+backward"))
            sizes = [f"{one['parameters'][name]:,}" for name in "LD"]
            others = [both("torch loop"), both("mambapy")]
            cells = [_ms(one["ms_p50"]), f"{one['rel_rms_error']:.1e}"]
            cells += [_ms(two["ms_p50"]), f"{two['rel_rms_error']:.1e}"]
            rows.append([*sizes, dtype, *cells, *(others if dtype == "float32" else [""] * 2)])
    table = "\n\n".join([markdown([*_HEADER], rows), machine_line(document)])
    return with_parts(text, "make figures", {"times": table})


def _ms(value: float) -> str:
    return f"{value:.3g}" if value < 1000 else f"{value:,.0f}"
