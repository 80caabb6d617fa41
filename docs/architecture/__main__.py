"""``make architecture``: write the table of docs/architecture.md."""

from __future__ import annotations

import sys
from pathlib import Path

from lab.figures.parts import with_parts

from .imports import Import, read_imports
from .packages import PACKAGES, edges, refused

ROOT = Path(__file__).resolve().parents[2]


def table(entries: list[Import]) -> str:
    """Return the table of docs/architecture.md: contents and imports of each package."""
    at_once = edges([entry for entry in entries if not entry.lazy], by_package=True)
    any_time = edges(entries, by_package=True)
    lines = [
        "| package | holds | imports | imports inside functions |",
        "| --- | --- | --- | --- |",
    ]
    for name, package in PACKAGES.items():
        now = at_once.get(name, set())
        cells = (now, any_time.get(name, set()) - now)
        texts = (", ".join(r for r in PACKAGES if r in cell) for cell in cells)
        lines.append(f"| `{name}` | {package.holds} | {' | '.join(texts)} |")
    return "\n".join(lines)


def page(text: str, entries: list[Import]) -> str:
    """Return the page ``text`` with its table rewritten."""
    return with_parts(text, "make architecture", {"packages": table(entries)})


if __name__ == "__main__":
    found = read_imports(ROOT)
    if reasons := [*filter(None, map(refused, found))]:
        sys.exit(
            "\n".join([*reasons, "fix these imports first: see docs/architecture/packages.py"])
        )
    document = ROOT / "docs" / "architecture.md"
    document.write_text(page(document.read_text(), found))
