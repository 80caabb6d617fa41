"""The gallery: pictures that come with the package, two in an installed one, more in a checkout."""

from __future__ import annotations

from pathlib import Path

from ..files import STARTER

FOLDER = STARTER / "icons"


def examples() -> list[tuple[Path, str]]:
    """The pictures, sorted by name, each with what it shows."""
    found = sorted(FOLDER.glob("*.png"))
    return [(path, _title(path.stem)) for path in found]


def _title(name: str) -> str:
    """``scopia-dog-house`` is "dog house": what comes first is who made it."""
    for maker in ("blendswap-cc-0-", "blendswap-cc-by-", "katorlegaz-", "scopia-"):
        name = name.removeprefix(maker)
    return name.rstrip("0123456789").replace("-", " ").replace("_", " ")
