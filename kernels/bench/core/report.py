"""Reports of measurements: ratios and Markdown tables."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from ...runtime import tables

_HEADER = ("variant", "direction", "dtype", "ms", "20 % to 80 %", "first call", "error")

# The tables show these counts under these names; the JSON has all counts.
_WORK = {
    "pairs_box": "pairs of boxes",
    "pairs": "of ellipses",
    "pairs_walked": "walked",
    "skipped": "skipped",
    "state_history_bytes": "history",
    "saved_bytes": "saved",
    "peak_bytes": "peak",
    "products": "products",
    "tokens": "tokens",
    "drawn": "Gaussians an object",
    "samples": "",
    "psnr_to_full": "PSNR to the full model's",
    "psnr_to_float32": "PSNR to float32's",
    "gradient_error": "gradient off by",
    "gradient_angle": "its 1 - cosine",
    "flops": "",
    "traffic": "",
}


def identity(record: dict) -> tuple[str, ...]:
    """Returns the values that tell the records of one document apart."""
    names = ("op", "case", "variant", "direction", "dtype", "device")
    return tuple(str(record[name]) for name in names)


def ratios(old: dict, new: dict) -> list[tuple[dict, float, float]]:
    """Pairs the records that both documents have; returns the new one and both medians in ms."""
    before = {identity(r): r["ms_p50"] for r in old["records"]}
    pairs = [(r, before.get(identity(r)), r["ms_p50"]) for r in new["records"]]
    return [(r, a, b) for r, a, b in pairs if a and b]


def ratio_table(old: dict, new: dict) -> str:
    """Returns ``ratios`` as text; a ratio over 1 is slower than before."""
    rows = [
        f"{b / a:8.2f} x  {a:10.4g} -> {b:10.4g} ms  "
        f"{r['op']} · {r['case']} · {r['variant']} · {r['direction']} · {r['dtype']}"
        for r, a, b in sorted(ratios(old, new), key=lambda row: -row[2] / row[1])
    ]
    notes = [
        f"note: {name} was {old['machine'].get(name)}, is {value}"
        for name, value in new["machine"].items()
        if name not in ("date",) and old["machine"].get(name) != value
    ]
    return "\n".join([*notes, *rows]) or "nothing in common"


def machine_line(document: dict) -> str:
    """Returns the machine and the versions in one line."""
    m = document["machine"]
    parts = [m["gpu"], f"CUDA {m['cuda']}"] if m["gpu"] else []
    parts += [f"{m['cpu']} ({m['simd']}, {m['cores']} cores)", f"{m['threads']} threads"]
    parts += [f"torch {m['torch']}, warp {m['warp']}, gamba_warp {m['gamba_warp']}"]
    parts += [f"{name} {version}" for name, version in m.get("peers", {}).items()]
    return " · ".join([*parts, f"Python {m['python']}", m["system"], m["date"]])


def number(value: float | None) -> str:
    """Three digits, or a whole number from a thousand on; nothing for None."""
    return "" if value is None else f"{value:.3g}" if value < 1000 else f"{value:,.0f}"


def _row(r: dict) -> list[str]:
    """Returns a record's cells under ``_HEADER``."""
    name = r["variant"] + (" (default)" if r["is_default"] and r["variant"] != "default" else "")
    if r["status"] != "ok":
        reason = textwrap.shorten(r["status"], 90, placeholder=" …")
        return [name, r["direction"], r["dtype"], reason, "", "", number(r["rel_rms_error"])]
    spread = f"{number(r['ms_p20'])} to {number(r['ms_p80'])}"
    error = number(r["rel_rms_error"]) or "none"
    times = [number(r["ms_p50"]), spread, number(r["jit_ms"])]
    return [name, r["direction"], r["dtype"], *times, error]


def work_text(r: dict) -> str:
    """Returns the counts of a record that tables show, under their names there."""
    parts = []
    for name, label in _WORK.items():
        if name not in r["work"]:
            continue
        value = r["work"][name]
        if name == "skipped":
            text = f"{value:.0%}"
        elif name.endswith("_bytes"):
            text = f"{value / 2**20:,.1f} MiB"
        elif name == "flops":
            text = f"{value / 1e9:.3g} GFLOP, {value / r['ms_p50'] / 1e6:.0f} GFLOP/s"
        elif name == "traffic":
            text = f"{value / r['ms_p50'] / 1e6:,.0f} GB/s"
        elif name == "samples":
            text = f"{1e3 * value / r['ms_p50']:.3g} samples/s"
        else:
            text = f"{value:,}"
        parts.append(f"{label} {text}".strip())
    return ", ".join(parts)


def table(records: Sequence[dict]) -> tuple[list[str], list[list[str]]]:
    """Returns header and rows of one case, without the columns that would be empty."""
    compared = [r["peer_ms"] and r["ms_p50"] and r["peer_ms"] / r["ms_p50"] for r in records]
    peers = [f"{number(x)} ({r['peer']})" if x else "" for x, r in zip(compared, records)]
    work = [work_text(r) for r in records]
    header: list[str] = [*_HEADER]
    rows = [_row(r) for r in records]
    for name, cells in (("peer's time / ours", peers), ("work", work)):
        if any(cells):
            header.append(name)
            for row, cell in zip(rows, cells):
                row.append(cell)
    return header, rows


def groups(document: dict) -> dict[str, dict[str, list[dict]]]:
    """Groups the records by op, then by case, in the order of their measuring."""
    found: dict[str, dict[str, list[dict]]] = {}
    for r in document["records"]:
        found.setdefault(r["op"], {}).setdefault(r["case"], []).append(r)
    return found


EXPLANATION = (
    "Times are medians in milliseconds, with the 20 % and 80 % quantiles; variants of one table "
    "were timed in turn, so their ratios come from one run. The first call includes compilation or "
    "its cache. Before the clock starts every variant is compared with a float64 oracle; what "
    "fails gets no time."
)


Table = tuple[Sequence[str], Sequence[Sequence[str]]]  # header and rows
# Text of a study beside the common table, from a document and the records of one of its cases, or
# of the whole document where there are no records: sentences, and tables.
More = Callable[[dict, Sequence[dict]], tuple[list[str], list[Table]]]


class Part(NamedTuple):
    """Part of a report below one heading.

    Attributes:
        title: the heading: a machine, or an operator and a case.
        texts: paragraphs.
        tables: in their order.
        records: of the case; none for a machine.
    """

    title: str
    texts: list[str]
    tables: list[Table]
    records: Sequence[dict] = ()


def nothing_more(document: dict, records: Sequence[dict]) -> tuple[list[str], list[Table]]:
    """Return the text that ``gamba bench`` adds to the table of a case: none."""
    return [], []


def parts(documents: Sequence[dict], more: More = nothing_more) -> Iterator[Part]:
    """Yields for each document its machine, and then its cases."""
    for document in documents:
        texts, tables = more(document, [])
        if document["interrupted"]:
            texts = ["The run was interrupted; these are its measurements.", *texts]
        yield Part(machine_line(document), texts, tables)
        yield from case_parts(document, more)


def case_parts(document: dict, more: More = nothing_more) -> Iterator[Part]:
    """Yields a part for each case of a document, with the oracle of its errors."""
    for op, cases in groups(document).items():
        for case, records in cases.items():
            texts, tables = more(document, records)
            mine = (r["oracle"] for r in records if r["oracle"] and not r["is_peer"])
            against = " / ".join(dict.fromkeys(mine))
            text = records[0]["text"] + f" Error: relative rms to {against}." * bool(against)
            yield Part(f"{op}: {case}", [text, *texts], [table(records), *tables], records)


def markdown(
    documents: Sequence[dict], more: More = nothing_more, by: str = "`gamba bench`, not by hand"
) -> str:
    """Returns a page of all tables; each document is of one machine."""
    lines = ["# Benchmarks", f"Written by {by}.", EXPLANATION]
    for part in parts(documents, more):
        lines += [f"{'###' if part.records else '##'} {part.title}", *part.texts]
        lines += [tables.markdown(*rows) for rows in part.tables]
    return "\n\n".join(lines) + "\n"
