"""Writes the tables and pictures of docs/lab/growth.md from docs/lab/benchmarks/cpu-growth.json.

After ``make study WHAT=growth`` in one run or in parts:

    make study WHAT="--render out/a/bench.json out/b/bench.json --out out/growth.json"
    cp out/growth.json docs/lab/benchmarks/cpu-growth.json
    make figures
"""

from __future__ import annotations

from pathlib import Path

import torch
from lab.studies import growth, growth_errors
from lab.studies.draw import growth_picture
from lab.studies.slopes import ERRORS, growth_lines, growth_table

from gamba_warp.files import write_text
from gamba_warp.kernels.bench.core.report import groups, machine_line
from gamba_warp.kernels.runtime.tables import markdown
from gamba_warp.measure.suites import make_settings, read_document

from .parts import with_parts

LAB = Path(__file__).parents[1]
PAGE = LAB / "growth.md"
RESULTS = LAB / "benchmarks" / "cpu-growth.json"
PICTURES = {
    "costs": LAB.parent / "pictures" / "growth.svg",
    "errors": LAB.parent / "pictures" / "errors.svg",
}


def main() -> None:
    """Write the page and both pictures again."""
    document = read_document(RESULTS)
    write_text(PAGE, page_of(PAGE.read_text(encoding="utf-8"), document))
    for name, path in PICTURES.items():
        picture = growth_picture([split(document)[name]])
        if picture:
            write_text(path, picture)
        else:
            path.unlink(missing_ok=True)


def split(document: dict) -> dict[str, dict]:
    """Split the document into records of growing costs and of growing errors."""
    found: dict[str, list[dict]] = {"costs": [], "errors": []}
    for record in document["records"]:
        found["errors" if record["axis"] == ERRORS else "costs"].append(record)
    return {name: document | {"records": records} for name, records in found.items()}


def page_of(text: str, document: dict) -> str:
    """Update the parts of the page between its marks from the results.

    Args:
        text: of the page.
        document: result of ``read_document``.

    Raises:
        ValueError: the page lacks a mark.
    """
    parts = split(document)
    costs, errors = (_picture(name, parts) for name in PICTURES)
    written = {
        "machine": "\n\n".join([machine_line(document), *_missing(document)]),
        "costs": costs + _costs(parts["costs"]),
        "errors": errors + _errors(parts["errors"]),
    }
    return with_parts(text, "make figures", written)


def _missing(document: dict) -> list[str]:
    """Sentence on the cases missing in the results, if any."""
    settings = make_settings(torch.device("cpu"), False, False, False, 1)
    known = [(c.op, c.name) for c in (*growth.cases(settings), *growth_errors.cases(settings))]
    measured = {(r["op"], r["case"]) for r in document["records"]}
    lacking = [
        f"{op.removeprefix('growth-')} {name}" for op, name in known if (op, name) not in measured
    ]
    return [f"Not in these results yet: {'; '.join(lacking)}."] if lacking else []


def _picture(name: str, parts: dict[str, dict]) -> str:
    """Link to a picture, unless it is empty."""
    drawn = growth_picture([parts[name]])
    return f"![Growth of {name}](../pictures/{PICTURES[name].name})\n\n" if drawn else ""


def _costs(document: dict) -> str:
    """Figures that grow faster than their work, then one table of all slopes."""
    said, rows, header = [], [], []
    for op, cases in groups(document).items():
        name = op.removeprefix("growth-")
        for case, records in cases.items():
            faster = [line for line in growth_lines(records) if "grows faster" in line]
            said += [f"- {name}, {line}" for line in faster if not line.startswith("Nothing")]
            header, cells = growth_table(records) or ([], [])
            rows += [[f"{name}, {case}", *row] for row in cells]
    if not rows:
        return "Not measured yet."
    said = said or ["- Nothing grows faster than its work."]
    return "\n".join([*said, "", markdown(["case", *header], rows)])


def _errors(document: dict) -> str:
    """A table for every kind of inputs."""
    blocks = []
    for cases in groups(document).values():
        for case, records in cases.items():
            header, rows = growth_table(records) or ([], [])
            blocks.append(f"**{case}**\n\n{markdown(header, rows)}")
    return "\n\n".join(blocks) or "Not measured yet."
