"""Report of measurements: Markdown tables, and a chart of run time over error."""

from __future__ import annotations

import html
import math
import textwrap
from collections.abc import Iterator, Sequence
from itertools import groupby

from ..runtime import tables

_HEADER = ("variant", "direction", "dtype", "ms", "20 % to 80 %", "CPU, ms", "first call", "error")
# The tables show these counts under these names; the JSON has all counts.
_WORK = {
    "pairs_box": "pairs of boxes",
    "pairs": "of ellipses",
    "pairs_traversed": "traversed",
    "skipped": "skipped",
    "state_history_bytes": "history",
    "saved_bytes": "saved",
    "samples": "",
    "share of scan": "scan",
    "share of convolution": "convolution",
    "share of rasterizer": "rasterizer",
    "share of products": "products",
}
_UNSTEADY = 1.3  # ratio of the 80 % and 20 % quantiles from which a time is marked
_BUSY = 1.2  # wall time over CPU time from which a machine is busy
_EXPLANATION = (
    "Times are medians in milliseconds, with the 20 % and 80 % quantiles; variants of one table "
    "were timed in turn, so their ratios come from one run. CPU is the time of all threads of the "
    "process. The first call includes compilation or its cache. Before the clock starts every "
    "variant is compared with a float64 oracle; what fails gets no time."
)


def machine_line(document: dict) -> str:
    """Return the machine and the versions in one line."""
    m = document["machine"]
    parts = [m["gpu"], f"CUDA {m['cuda']}"] if m["gpu"] else []
    parts += [f"{m['cpu']} ({m['simd']}, {m['cores']} cores)", f"{m['threads']} threads"]
    parts += [f"torch {m['torch']}, warp {m['warp']}, gamba_warp {m['gamba_warp']}"]
    parts += [f"{name} {version}" for name, version in m.get("peers", {}).items()]
    return " · ".join([*parts, f"Python {m['python']}", m["system"], m["date"]])


def _number(value: float | None) -> str:
    """Return three digits, or a whole number from a thousand on; nothing for None."""
    return "" if value is None else f"{value:.3g}" if value < 1000 else f"{value:,.0f}"


def _work_text(r: dict) -> str:
    def texts() -> Iterator[str]:
        for name, label in _WORK.items():
            value = r["work"].get(name)
            if value is None:
                continue
            if name == "skipped" or name.startswith("share"):
                text = f"{value:.0%}"
            elif name == "samples":
                text = f"{1e3 * value / r['ms_p50']:.3g} samples/s"
            else:
                text = f"{value / 2**20:,.1f} MiB" if name.endswith("_bytes") else f"{value:,}"
            yield f"{label} {text}".strip()

    return ", ".join(texts())


def _row(r: dict) -> list[str]:
    """Return a record's cells: the columns of ``_HEADER``, the comparison with a peer, the work."""
    name = r["variant"] + (" (default)" if r["is_default"] and r["variant"] != "default" else "")
    error = _number(r["rel_rms_error"])
    if r["status"] != "ok":
        reason = textwrap.shorten(r["status"], 90, placeholder=" …")
        return [name, r["direction"], r["dtype"], reason, "", "", "", error, "", ""]
    spread = f"{_number(r['ms_p20'])} to {_number(r['ms_p80'])}"
    spread += " (unsteady)" * (r["ms_p80"] > _UNSTEADY * r["ms_p20"])
    times = [_number(r["ms_p50"]), spread, _number(r["cpu_ms"]), _number(r["jit_ms"])]
    peer = f"{_number(r['peer_ms'] / r['ms_p50'])} ({r['peer']})" if r["peer_ms"] else ""
    return [name, r["direction"], r["dtype"], *times, error or "none", peer, _work_text(r)]


def _table(records: Sequence[dict]) -> str:
    columns = zip((*_HEADER, "peer's time / ours", "work"), *map(_row, records))
    shown = [c for c in columns if c[0] in _HEADER or any(c[1:])]
    header, *rows = zip(*shown)
    return tables.markdown(header, rows)


def busy_line(document: dict) -> str:
    """Return a line if runs on the CPU waited for it; empty if not.

    It has the machine's load, the number of runnable tasks, at both ends.
    """
    timed = [r for r in document["records"] if r["ms_p50"] and r["device"] == "cpu"]
    late = sum(r["ms_p50"] > _BUSY * r["cpu_ms"] for r in timed)
    if late <= len(timed) / 10:
        return ""
    loads = " and ".join(f"{load:.1f}" for load in document["machine"]["load"])
    return (
        f"The machine was busy: {late} of {len(timed)} variants took over {_BUSY:.0%} of their CPU "
        f"time; its load was {loads} at the start and the end."
    )


def markdown(document: dict) -> str:
    """Return a page with a table for each case."""
    lines = ["# Benchmarks", "Written by `gamba bench`.", _EXPLANATION, machine_line(document)]
    lines += ["The run was interrupted; these are its measurements."] * document["interrupted"]
    lines += filter(None, [busy_line(document)])
    for (op, case), group in groupby(document["records"], lambda r: (r["op"], r["case"])):
        records = list(group)
        mine = (r["oracle"] for r in records if r["oracle"] and not r["is_peer"])
        against = " / ".join(dict.fromkeys(mine))
        text = records[0]["text"] + f" Error: relative rms to {against}." * bool(against)
        lines += [f"## {op}: {case}", text, _table(records)]
    return "\n\n".join(lines) + "\n"


_WIDTH, _HEIGHT, _MARGIN = 640, 300, 50  # of a panel, pixels


def chart(document: dict) -> str:
    """Return an SVG with a panel of run time over error for each operator and direction.

    Axes are logarithmic, an error of 0 is drawn at the bottom. A ring is a default, a square a
    peer; titles of the marks name case, variant, time and error.
    """
    done = [r for r in document["records"] if r["ms_p50"] and r["rel_rms_error"] is not None]
    panels: dict[tuple[str, str], list[dict]] = {}
    for r in done:
        panels.setdefault((r["op"], r["direction"]), []).append(r)
    body = [
        f'<g transform="translate(0 {i * _HEIGHT})">{_panel(" ".join(name), records)}</g>'
        for i, (name, records) in enumerate(panels.items())
    ]
    size = f'width="{_WIDTH}" height="{max(1, len(panels)) * _HEIGHT}"'
    style = 'font-family="sans-serif" font-size="11" fill="none" stroke="none"'
    return "\n".join(
        [f'<svg xmlns="http://www.w3.org/2000/svg" {size} {style}>', *body, "</svg>\n"]
    )


def _panel(title: str, records: Sequence[dict]) -> str:
    times = [math.log10(r["ms_p50"]) for r in records]
    least = min((r["rel_rms_error"] for r in records if r["rel_rms_error"]), default=1e-8) / 3
    errors = [math.log10(max(r["rel_rms_error"], least)) for r in records]
    left, right = math.floor(min(times)), math.floor(max(times)) + 1
    low, high = math.floor(min(errors)), math.floor(max(errors)) + 1

    def x(value: float) -> float:
        return _MARGIN + (value - left) / (right - left) * (_WIDTH - 2 * _MARGIN)

    def y(value: float) -> float:
        return _HEIGHT - _MARGIN + (low - value) / (high - low) * (_HEIGHT - 2 * _MARGIN)

    def text(at: tuple[float, float], words: str, anchor: str = "middle") -> str:
        place = f'x="{at[0]:.1f}" y="{at[1]:.1f}" text-anchor="{anchor}"'
        return f'<text {place} fill="black">{html.escape(words)}</text>'

    parts = [text((_WIDTH / 2, 20), f"{title}: milliseconds over relative rms error")]
    for power in range(left, right + 1):
        parts.append(f'<path d="M{x(power):.1f} {y(low):.1f}V{y(high):.1f}" stroke="#ddd"/>')
        parts.append(text((x(power), _HEIGHT - _MARGIN + 16), f"{10.0**power:g} ms"))
    for power in range(low, high + 1):
        parts.append(f'<path d="M{x(left):.1f} {y(power):.1f}H{x(right):.1f}" stroke="#ddd"/>')
        parts.append(text((_MARGIN - 6, y(power) + 4), f"1e{power}", "end"))
    for r, time, error in zip(records, times, errors):
        a, b = x(time), y(error)
        mark = f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3.5" fill="teal"'
        if r["is_peer"]:
            mark = f'<path d="M{a - 3:.1f} {b - 3:.1f}h6v6h-6z" fill="orange"'
        elif r["is_default"]:
            mark = f'<circle cx="{a:.1f}" cy="{b:.1f}" r="5" stroke="teal" stroke-width="2"'
        element = "path" if r["is_peer"] else "circle"
        words = f"{r['case']}, {r['variant']}: {r['ms_p50']:.3g} ms, {r['rel_rms_error']:.2g}"
        parts.append(f"{mark}><title>{html.escape(words)}</title></{element}>")
    return "".join(parts)
