"""Many inputs, one after the other: one that fails is noted, and the rest go on."""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from unicodedata import normalize

from .errors import UserError, first_line, one_line

if TYPE_CHECKING:
    from tqdm import tqdm

Item = TypeVar("Item")
# What one bad input may raise: everything else is a defect of the program, and stops it.
EXPECTED = (UserError, ValueError, ArithmeticError, OSError, RuntimeError, MemoryError)


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
    failures = [] if failures is None else failures
    with progress_bar(named.items(), desc=desc, unit=unit) as bar:
        STAGES.show = bar.set_postfix_str
        for name, item in bar:
            try:
                function(name, item)
            except EXPECTED as error:
                failures.append((item, first_line(error).removeprefix(f"{item}: ")))
        STAGES.show = None
    return failures


def progress_bar(items: Iterable[Item] | None = None, **options: Any) -> tqdm[Item]:
    """A bar of tqdm's on stderr, with its options; nothing is drawn where that is no terminal.

    A log or a pipe would keep every state of the bar, one behind the other on one line.
    """
    from tqdm import tqdm

    bar: Any = tqdm(items, disable=None, **options)  # without items nothing says of what it is
    return bar


def say(line: str) -> None:
    """Prints a line about an item on stdout, above the progress bar of ``for_each``."""
    from tqdm import tqdm

    tqdm.write(one_line(line))


def warn(path: Path, lines: Iterable[str]) -> None:
    """Prints in one line on stderr, above the bar, what of a file is not used; nothing of none."""
    from tqdm import tqdm

    if text := "; ".join(lines):
        tqdm.write(one_line(f"warning: {path}: {text}"), file=sys.stderr)


class Stages:
    """What a command is doing: shown behind the bar of ``for_each``, and timed.

    Attributes:
        show: shows a name; None where there is no bar.
        seconds: of each stage, over all items: by the clock, and of the processor.
    """

    def __init__(self) -> None:
        self.show: Callable[[str], object] | None = None
        self.seconds: dict[str, list[float]] = {}
        self._name, self._since = "start", (None, 0.0)

    def begin(self, name: str) -> None:
        """Ends the stage before, and begins one; the same name may come again for each item."""
        now = time.perf_counter(), time.process_time()
        then = self._since[0] or now[0]  # what was before the first stage has no clock
        spent = self.seconds.setdefault(self._name, [0.0, 0.0])
        spent[0] += now[0] - then
        spent[1] += now[1] - self._since[1]
        self._name, self._since = name, now
        if self.show is not None and name:
            self.show(name)

    def table(self) -> str:
        """Ends the last stage; one line a stage, with the seconds."""
        self.begin("")
        rows = {name: spent for name, spent in self.seconds.items() if name}
        rows["all"] = [sum(spent[i] for spent in rows.values()) for i in (0, 1)]
        lines = [f"{name:<16} {wall:8.2f} {work:8.2f}" for name, (wall, work) in rows.items()]
        start, (_, work) = next(iter(rows.items()))
        lines[0] = f"{start:<16} {'':8} {work:8.2f}"  # no clock ran before the program
        return "\n".join([f"{'stage':<16} {'clock s':>8} {'CPU s':>8}", *lines])


STAGES = Stages()


def counted(count: int, unit: str) -> str:
    """A number of things: ``1 picture``, ``2 pictures``."""
    return f"{count:,} {unit}" + ("" if count == 1 else "s")


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
    print(f"{counted(count, unit)}, {counted(len(failures), 'failure')}, results in {out}")
    return 1 if failures else 0


def plan_outputs(
    inputs: Sequence[Path],
    suffixes: Sequence[str],
    folder: Path = Path("."),
    reads: Iterable[Path | None] = (),
    own: Sequence[str] = (),
) -> dict[str, Path]:
    """A name for each input: its stem, with a number where two inputs would share an output.

    ``.compressed.ply`` is one suffix: the other formats are not compressed in its way. Whose name
    has a number is said.

    Two names that differ in capitals only are one name to many file systems, and so they are here.

    Args:
        inputs: files that are read.
        suffixes: what follows the name in each output, such as ``-mesh.glb``.
        folder: of the outputs; it need not be there yet.
        reads: other files, and folders, that the command reads; None is passed over.
        own: names of files in the folder that the command writes of no one input.

    Returns:
        The inputs by name, in their order. The outputs are ``folder / (name + suffix)``.

    Raises:
        UserError: an output would overwrite something that is read.
    """
    names: dict[str, Path] = {}
    taken = {name.casefold() for name in own}
    renamed: list[str] = []

    def outputs_of(name: str) -> set[str]:
        return {normalize("NFC", name + suffix).casefold() for suffix in (*suffixes, "")}

    for path in inputs:
        stem = Path(re.sub(r"(?i)(?<=.)\.compressed(?=\.ply$)", "", path.name)).stem
        name, number = stem, 1
        while outputs_of(name) & taken:
            number += 1
            name = f"{stem}-{number}"
        renamed += [f"{path}: its results are named {name}"] * (number > 1)
        taken |= outputs_of(name)
        names[name] = path
    made = [name + suffix for name in names for suffix in suffixes]
    targets = (folder / name for name in (*made, *own))
    check_not_read(targets, [*inputs, *reads])
    for line in renamed:
        say(line)
    return names


def check_not_read(targets: Iterable[Path], reads: Iterable[Path | None]) -> None:
    """Refuses outputs that would replace what the command reads.

    Args:
        targets: files that the command is to write; those that are not there yet are fine.
        reads: files that it reads, and folders, of which every file may be read.

    Raises:
        UserError: a target is one of the files, also by a link or by other capitals, or a file in
            one of the folders.
    """
    files: dict[tuple[int, int], Path] = {}
    folders: dict[tuple[int, int], Path] = {}
    for path in reads:
        if path is not None and (found := _identity(path)) is not None:
            (folders if path.is_dir() else files)[found] = path
    for target in targets:
        there = _identity(target)
        if there is None:
            continue
        source = files.get(there)
        if source is None and folders:
            above = (_identity(parent) for parent in Path(os.path.realpath(target)).parents)
            source = next((target for found in above if found in folders), None)
        if source is not None:
            raise UserError(f"{source}: would be overwritten by an output; give another --out")


def _identity(path: Path) -> tuple[int, int] | None:
    """What tells a file from every other, links followed; None where there is none."""
    try:
        found = os.stat(path)
    except (OSError, ValueError):
        return None
    return found.st_dev, found.st_ino
