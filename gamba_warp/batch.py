"""Processing of many inputs: a failure is recorded, and the rest continues."""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, TypeVar
from unicodedata import normalize

from .errors import UserError, escaped, first_line, one_line
from .files import check_folder_name, identity

if TYPE_CHECKING:
    from tqdm import tqdm

Item = TypeVar("Item")
LINE_SECONDS = 10.0  # between two lines of progress in a log
_LINE = "{desc} {n_fmt}/{total_fmt} {unit}s [{elapsed}<{remaining}, {rate_fmt}{postfix}]"
# Errors that one bad input may raise. Any other is a bug, and stops the program.
EXPECTED = (UserError, ValueError, ArithmeticError, OSError, RuntimeError, MemoryError)


def for_each(
    named: Mapping[str, Item],
    function: Callable[[str, Item], None],
    desc: str,
    unit: str,
    failures: list[tuple[Item, str]] | None = None,
) -> list[tuple[Item, str]]:
    """Call ``function(name, item)`` on each item, with a progress bar.

    Args:
        named: the items by name.
        function: called on each.
        desc: the bar's title.
        unit: the noun for one item.
        failures: list to append to; the caller has it even if the loop is interrupted.

    Returns:
        ``failures`` with the failed items appended, each with a reason of one line.
    """
    failures = [] if failures is None else failures
    with progress_bar(named.items(), desc=desc, unit=unit) as bar:
        STAGES.show = bar.set_postfix_str
        for name, item in bar:
            try:
                function(name, item)
            except EXPECTED as error:
                prefix = f"{escaped(str(item))}: "
                failures.append((item, first_line(error).removeprefix(prefix)))
        STAGES.show = None
    return failures


def progress_bar(
    items: Iterable[Item] | None = None, lines: bool = False, **options: Any
) -> tqdm[Item]:
    """Return a tqdm bar on stderr; nothing is drawn with --quiet, or unless stderr is a terminal.

    A log or a pipe would collect every state of the bar on one long line.

    Args:
        items: wrapped by the bar, or None.
        lines: without a terminal print the state as a line, at most one in ``LINE_SECONDS``.
        options: of tqdm.
    """
    from tqdm import tqdm

    stream = _terminal(options.get("file") or sys.stderr)
    if lines and not (stream.isatty() or STAGES.quiet):
        form = options.get("bar_format", _LINE).replace("|{bar}|", "")
        options |= {"file": _Lines(stream), "disable": False, "bar_format": form}
    else:
        options |= {"file": stream, "disable": True if STAGES.quiet else None}
    bar: Any = tqdm(items, **options)  # without items its type is unknown
    return bar


class _Lines:
    """Text stream that turns the states of a bar into lines, and leaves most of them out."""

    encoding = "utf-8"

    def __init__(self, stream: Any) -> None:
        self._stream, self._last = stream, time.monotonic()

    def write(self, text: str) -> None:
        """Write a state as a line, if the last one was long ago."""
        text, now = text.strip(), time.monotonic()
        if text and now - self._last >= LINE_SECONDS:
            self._last = now
            self._stream.write(f"{text}\n")

    def flush(self) -> None:
        """Flush the stream."""
        self._stream.flush()


def _terminal(stream: Any) -> Any:
    return getattr(stream, "terminal", stream)


def say(line: str, stream: TextIO | None = None) -> None:
    """Print a text as one line, ``escaped``, on stdout or a stream, above the progress bars."""
    from tqdm import tqdm

    with tqdm.external_write_mode(file=_terminal(sys.stderr)):
        print(escaped(line), file=stream or sys.stdout)


def print_json(text: str, stream: TextIO | None = None) -> None:
    """Print the JSON that an option asks for on stdout, or on another stream, even with --quiet."""
    print(text.rstrip("\n"), file=STAGES.stdout or stream or sys.stdout)


def warn(path: Path, lines: Iterable[str]) -> None:
    """Print warnings about a file on stderr, in one line above the bar, if there are any."""
    if text := "; ".join(lines):
        say(one_line(f"warning: {path}: {text}"), sys.stderr)


class Stages:
    """Stages of a command, timed and shown next to the bar of ``for_each``.

    Attributes:
        quiet: no bar is drawn.
        verbose: details are printed.
        stdout: the standard output while ``sys.stdout`` drops all text, else None.
        show: shows a name; None without a bar.
        seconds: wall-clock and CPU seconds of each stage, over all items.
    """

    def __init__(self) -> None:
        self.quiet = self.verbose = False
        self.stdout: TextIO | None = None
        self.show: Callable[[str], object] | None = None
        self.seconds: dict[str, list[float]] = {}
        self._name, self._since = "start", (None, 0.0)

    def begin(self, name: str) -> None:
        """End the current stage and begin another; a name may recur for each item."""
        now = time.perf_counter(), time.process_time()
        then = self._since[0] or now[0]  # before the first stage no clock runs
        spent = self.seconds.setdefault(self._name, [0.0, 0.0])
        spent[0] += now[0] - then
        spent[1] += now[1] - self._since[1]
        self._name, self._since = name, now
        if self.show is not None and name:
            self.show(name)

    def table(self) -> str:
        """End the last stage and return one line per stage, with its seconds."""
        self.begin("")
        rows = {name: spent for name, spent in self.seconds.items() if name}
        rows["all"] = [sum(spent[i] for spent in rows.values()) for i in (0, 1)]
        lines = [f"{name:<16} {wall:8.2f} {work:8.2f}" for name, (wall, work) in rows.items()]
        start, (_, work) = next(iter(rows.items()))
        lines[0] = f"{start:<16} {'':8} {work:8.2f}"  # wall-clock time of the start is unknown
        return "\n".join([f"{'stage':<16} {'clock s':>8} {'CPU s':>8}", *lines])


STAGES = Stages()


def counted(count: int, unit: str) -> str:
    """Format a count: ``1 image``, ``2 images``."""
    return f"{count:,} {unit}" + ("" if count == 1 else "s")


def plan_outputs(
    inputs: Sequence[Path],
    suffixes: Sequence[str],
    folder: Path = Path("."),
    reads: Iterable[Path | None] = (),
    own: Sequence[str] = (),
) -> dict[str, Path]:
    """Name each input by its stem, with a number where two inputs would share an output.

    ``.compressed.ply`` counts as one suffix. Numbered names are printed. Names that differ only in
    case count as equal, as on many file systems.

    Args:
        inputs: files that are read.
        suffixes: of the outputs, appended to the name, such as ``-mesh.glb``.
        folder: of the outputs; it need not exist yet.
        reads: other files and folders that the command reads; None is skipped.
        own: names of files that the command writes into the folder for no single input.

    Returns:
        The inputs by name, in their order. The outputs are ``folder / (name + suffix)``.

    Raises:
        UserError: an output would overwrite an input.
    """
    check_folder_name(folder)
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
    outputs = [name + suffix for name in names for suffix in suffixes]
    targets = (folder / name for name in (*outputs, *own))
    check_not_read(targets, [*inputs, *reads])
    for line in renamed:
        say(line)
    return names


def check_not_read(targets: Iterable[Path], reads: Iterable[Path | None]) -> None:
    """Refuse outputs that would replace an input of the command.

    Args:
        targets: files that the command will write; they need not exist yet.
        reads: files that it reads, and folders, in which it may read any file.

    Raises:
        UserError: a target is one of the files, perhaps by a link or in other case, or lies in one
            of the folders.
    """
    files: dict[tuple[int, int], Path] = {}
    folders: dict[tuple[int, int], Path] = {}
    for path in reads:
        if path is not None and (node := identity(path)) is not None:
            (folders if path.is_dir() else files)[node] = path
    for target in targets:
        there = identity(target)
        if there is None:
            continue
        source = files.get(there)
        if source is None and folders:
            above = (identity(parent) for parent in Path(os.path.realpath(target)).parents)
            source = next((target for node in above if node in folders), None)
        if source is not None:
            raise UserError(f"{source}: would be overwritten by an output; give another --out")
