"""Many inputs, one after the other: one that fails is noted, and the rest go on."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from .errors import UserError

if TYPE_CHECKING:
    pass


def for_each(
    named: dict[str, Path], function: Callable[[str, Path], None], desc: str, unit: str
) -> list[tuple[Path, str]]:
    """Calls ``function(name, path)`` on each, with a progress bar.

    Returns:
        Those that failed, each with a reason of one line.
    """
    failures = []
    for name, path in tqdm(named.items(), desc=desc, unit=unit, disable=None):
        try:
            function(name, path)
        except (UserError, ValueError, OSError, RuntimeError, MemoryError) as error:
            lines = str(error).splitlines() or [type(error).__name__]
            failures.append((path, lines[0].removeprefix(f"{path}: ")))
    return failures


def report(count: int, unit: str, failures: list[tuple[Path, str]], out: Path) -> int:
    """Says what failed, and where the results are; returns the exit code, 1 after a failure."""
    for path, reason in failures:
        print(f"gamba: failed: {path}: {reason}", file=sys.stderr)
    print(f"{count} {unit}s, {len(failures)} failures, results in {out}")
    return 1 if failures else 0


def unique_names(paths: Sequence[Path]) -> dict[str, Path]:
    """A distinct output name for each path: its stem, with a number where stems meet."""
    names: dict[str, Path] = {}
    for path in paths:
        name, number = path.stem, 1
        while name in names:
            number += 1
            name = f"{path.stem}-{number}"
        names[name] = path
    return names
