"""Many inputs, one after the other: one that fails is noted, and the rest go on."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from .errors import UserError

Item = TypeVar("Item")
# What one bad input may raise: everything else is a defect of the program, and stops it.
_EXPECTED = (UserError, ValueError, ArithmeticError, OSError, RuntimeError, MemoryError)


def for_each(
    named: Mapping[str, Item],
    function: Callable[[str, Item], None],
    desc: str,
    unit: str,
    failures: list[tuple[Item, str]] | None = None,
) -> list[tuple[Item, str]]:
    """Calls ``function(name, item)`` on each, with a progress bar.

    Args:
        named: the items by name.
        function: what to do with each.
        desc: the bar's title.
        unit: what one item is called.
        failures: list to add to; who gives it has it also when the loop is interrupted.

    Returns:
        The items that failed, each with a reason of one line, after what was in ``failures``.
    """
    from tqdm import tqdm

    failures = [] if failures is None else failures
    for name, item in tqdm(named.items(), desc=desc, unit=unit, disable=None):
        try:
            function(name, item)
        except _EXPECTED as error:
            lines = str(error).splitlines() or [type(error).__name__]
            failures.append((item, lines[0].removeprefix(f"{item}: ")))
    return failures


def report(count: int, unit: str, failures: Sequence[tuple[object, str]], out: Path) -> int:
    """Says what failed, and where the results are.

    Args:
        count: of the inputs.
        unit: what one input is called.
        failures: as ``for_each`` returns them.
        out: folder of the results.

    Returns:
        The exit code, 1 after a failure.
    """
    for item, reason in failures:
        print(f"gamba: failed: {item}: {reason}", file=sys.stderr)
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
