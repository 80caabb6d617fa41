"""Report of measurements: Markdown tables, and charts of run time over error."""

from __future__ import annotations

import html
import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby

from ..runtime import tables

_HEADER = ("variant", "direction", "dtype", "ms", "20 % to 80 %", "CPU, ms", "first call", "error")
# The tables show these counts under these names; the JSON has all counts.
_WORK = {
    "pairs_box": "pairs of boxes",
    "pairs": "of ellipses",
    "pairs_traversed": "traversed",
    "blocks_traversed": "blocks",
    "skipped": "skipped",
    "state_history_bytes": "history",
    "saved_bytes": "saved",
    "samples": "",
    "fraction of scan": "scan",
    "fraction of convolution": "convolution",
    "fraction of rasterizer": "rasterizer",
    "fraction of products": "products",
    "fraction of images' convolutions": "images' convolutions",
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
            if name == "skipped" or name.startswith("fraction"):
                text = f"{value:.0%}"
            elif name == "samples":
                on_cpu = r["device"] == "cpu"
                rate = 1e3 * value / r["cpu_ms" if on_cpu else "ms_p50"]
                text = f"{rate:.3g} samples per {'CPU second' if on_cpu else 'second'}"
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


def _sizes(r: dict) -> str:
    return ", ".join(f"{name} {value}" for name, value in r["parameters"].items())


def _table(records: Sequence[dict]) -> str:
    columns = [*zip((*_HEADER, "peer's time / ours", "work"), *map(_row, records))]
    columns.insert(1, ("sizes", *map(_sizes, records)))
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


def failures(document: dict) -> list[str]:
    """Return a line for each wrong result, and for each that could not be computed."""
    return [
        f"{r['op']}: {r['case']}: {r['variant']}, {r['direction']}: {r['status']}"
        for r in document["records"]
        if r["status"].startswith(("failed", "check"))
    ]


def markdown(document: dict) -> str:
    """Return a page with a table for each case."""
    level = document["settings"]["level"]
    title = "# Benchmarks" + ("" if level == "normal" else f", {level} sizes")
    lines = [title, "Written by `gamba bench`.", _EXPLANATION, machine_line(document)]
    lines += ["The run was interrupted; these are its measurements."] * document["interrupted"]
    lines += filter(None, [busy_line(document)])
    for (op, case), group in groupby(document["records"], lambda r: (r["op"], r["case"])):
        records = list(group)
        mine = (r["oracle"] for r in records if r["oracle"] and not r["is_peer"])
        against = " / ".join(dict.fromkeys(mine))
        text = records[0]["text"] + f" Error: relative rms to {against}." * bool(against)
        lines += [f"## {op}: {case}", text, _table(records)]
    return "\n\n".join(lines) + "\n"


# A panel, its margin, and a line of the legend, pixels.
_WIDTH, _HEIGHT, _MARGIN, _LINE = 440, 280, 46, 15


def charts(document: dict) -> dict[str, str]:
    """Return an SVG of run time over error for each operator, a panel a direction.

    They have all variants of the sizes of its case "knobs", by the numbers of a legend; axes are
    logarithmic. A ring is a default, a square a peer. What has no error, or has the same bits as
    another variant, is left out.
    """
    svgs = {}
    for op, group in groupby(document["records"], lambda r: r["op"]):
        records = [r for r in group if r["ms_p50"] and r["rel_rms_error"]]
        sizes = next((r["parameters"] for r in records if r["case"] == "knobs"), None)
        if sizes is not None:
            same = [r for r in records if sizes.items() <= r["parameters"].items()]
            svgs[op] = _chart(f"{op}: {_sizes(same[0])}", same)
    return svgs


def _chart(title: str, records: Sequence[dict]) -> str:
    names = [*dict.fromkeys(_label(r) for r in records)]
    numbers = {name: i + 1 for i, name in enumerate(names)}
    panels: dict[str, list[dict]] = {}
    for r in records:
        panels.setdefault(r["direction"], []).append(r)
    body = [
        f'<g transform="translate({_WIDTH * i} 24)">{_panel(name, group, numbers)}</g>'
        for i, (name, group) in enumerate(panels.items())
    ]
    width, rows = _WIDTH * len(panels), -(-len(names) // 3)
    for i, name in enumerate(names):
        at = _MARGIN + i // rows * (width - _MARGIN) / 3, _HEIGHT + 40 + i % rows * _LINE
        body.append(_text(at, f"{i + 1}  {name}", "start"))
    height = _HEIGHT + 40 + rows * _LINE
    size = f'width="{width}" height="{height}" viewBox="0 0 {width} {height}"'
    style = 'font-family="sans-serif" font-size="11" fill="none" stroke="none"'
    ground = f'<rect width="{width}" height="{height}" fill="white"/>'
    head = _text((width / 2, 16), f"{title}; relative rms error over milliseconds")
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" {size} {style}>',
            ground,
            head,
            *body,
            "</svg>\n",
        ]
    )


def _label(r: dict) -> str:
    return f"{r['variant']}, {r['dtype']}" if r["dtype"] not in r["variant"] else r["variant"]


def _text(at: tuple[float, float], words: str, anchor: str = "middle") -> str:
    place = f'x="{at[0]:.1f}" y="{at[1]:.1f}" text-anchor="{anchor}"'
    return f'<text {place} fill="black">{html.escape(words)}</text>'


def _panel(title: str, records: Sequence[dict], numbers: Mapping[str, int]) -> str:
    points = [(math.log10(r["ms_p50"]), math.log10(r["rel_rms_error"])) for r in records]
    times, errors = zip(*points)  # whole powers of ten up, half ones across
    left, right = math.floor(2 * min(times)) / 2, math.floor(2 * max(times) + 1) / 2
    low, high = math.floor(min(errors)), math.floor(max(errors)) + 1

    def place(point: tuple[float, float]) -> tuple[float, float]:
        x, y = ((v - a) / (b - a) for v, a, b in zip(point, (left, low), (right, high)))
        across, up = _WIDTH - 2 * _MARGIN, _HEIGHT - 2 * _MARGIN
        return _MARGIN + x * across, _HEIGHT - _MARGIN - y * up

    (x0, y0), (x1, y1) = place((left, low)), place((right, high))
    parts = [_text(((x0 + x1) / 2, y1 - 8), title)]
    for step in range(round(2 * (right - left)) + 1):
        x, _ = place((left + step / 2, low))
        parts.append(f'<path d="M{x:.1f} {y0:.1f}V{y1:.1f}" stroke="#ddd"/>')
        parts.append(_text((x, y0 + 16), f"{10 ** (left + step / 2):.3g} ms"))
    for power in range(low, high + 1):
        _, y = place((left, power))
        parts.append(f'<path d="M{x0:.1f} {y:.1f}H{x1:.1f}" stroke="#ddd"/>')
        parts.append(_text((x0 - 6, y + 4), f"1e{power}", "end"))
    for r, point in zip(records, points):
        x, y = place(point)
        mark = f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="teal"/>'
        if r["is_peer"]:
            mark = f'<path d="M{x - 3:.1f} {y - 3:.1f}h6v6h-6z" fill="orange"/>'
        elif r["is_default"]:
            mark = f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" stroke="teal" stroke-width="2"/>'
        parts += [mark, _text((x + 8, y - 3), str(numbers[_label(r)]), "start")]
    return "".join(parts)
