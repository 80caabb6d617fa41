"""``make architecture``: writes docs/architecture.svg and the table of docs/architecture.md."""

from __future__ import annotations

import sys
from pathlib import Path

from lab.figures.parts import with_parts

from .imports import Import, read_imports
from .picture import arrows, draw
from .rooms import ROOMS, edges, refused

ROOT = Path(__file__).resolve().parents[2]


def picture(entries: list[Import]) -> str:
    """The text of docs/architecture.svg."""
    at_once = edges([entry for entry in entries if not entry.lazy], by_room=True)
    return draw(arrows(at_once, edges(entries, by_room=True)))


def table(entries: list[Import]) -> str:
    """The table of docs/architecture.md: each room, what it holds, what it imports today."""
    at_once = edges([entry for entry in entries if not entry.lazy], by_room=True)
    any_time = edges(entries, by_room=True)
    lines = [
        "| room | holds | imports | only when a function needs it |",
        "| --- | --- | --- | --- |",
    ]
    for name, room in ROOMS.items():
        now = at_once.get(name, set())
        cells = (now, any_time.get(name, set()) - now)
        texts = (", ".join(r for r in ROOMS if r in cell) for cell in cells)
        lines.append(f"| `{name}` | {room.holds} | {' | '.join(texts)} |")
    return "\n".join(lines)


def page(text: str, entries: list[Import]) -> str:
    """The page with its table made anew; ``text`` is the page as it stands."""
    return with_parts(text, "make architecture", {"rooms": table(entries)})


if __name__ == "__main__":
    found = read_imports(ROOT)
    if reasons := [*filter(None, map(refused, found))]:
        sys.exit("\n".join([*reasons, "mend these imports first: see docs/architecture/rooms.py"]))
    (ROOT / "docs" / "architecture.svg").write_text(picture(found))
    document = ROOT / "docs" / "architecture.md"
    document.write_text(page(document.read_text(), found))
