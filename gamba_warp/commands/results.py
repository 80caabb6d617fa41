"""Results of a command over many inputs: printed as text or JSON, or one file on stdout."""

from __future__ import annotations

import functools
import inspect
import json
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, redirect_stdout
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..batch import STAGES, counted, print_json, say
from ..errors import UserError

STREAM = Path("-")  # as --out: the standard output


@dataclass
class Results:
    """Results of a command.

    Attributes:
        unit: the noun for one input.
        count: number of inputs.
        out: folder or file of the results.
        failures: as ``for_each`` returns them.
        figures: of each other input, with its ``input`` and ``name``.
    """

    unit: str
    count: int
    out: Path
    failures: list[tuple[Path, str]]
    figures: list[dict[str, Any]] = field(default_factory=list)

    def text(self) -> str:
        """Return a line with counts and the folder."""
        # An input that is a folder holds none of the counted ones.
        lost = sum(not item.is_dir() for item, _ in self.failures)
        where = f", results in {self.out}" if lost < self.count and self.out != STREAM else ""
        failures = counted(len(self.failures), "failure")
        return f"{counted(self.count, self.unit)}, {failures}{where}"

    def json(self) -> str:
        """Return the same as a JSON object."""
        failures = [{"input": str(item), "reason": reason} for item, reason in self.failures]
        values = {"out": str(self.out), "results": self.figures, "failures": failures}
        return json.dumps(values, indent=2)


def reported(command: Callable[..., Results]) -> Callable[..., int]:
    """Decorate a command to print its results, and return the exit code: 1 if an input failed.

    The command has either an option ``out``, or ``files`` of ``FileOptions``. With ``--out -`` it
    gets a temporary folder, without page and turntable, whose one file goes to stdout. With that or
    ``--json`` all text goes to stderr.
    """

    @functools.wraps(command)
    def run(*args: Any, **options: Any) -> int:
        bound = inspect.signature(command).bind(*args, **options)
        bound.apply_defaults()
        values, files = bound.arguments, bound.arguments.get("files")
        piped = (files.out if files else values["out"]) == STREAM
        inputs = next(iter(values.values()))
        several = isinstance(inputs, tuple) and (len(inputs) > 1 or any(x.is_dir() for x in inputs))
        if piped and several:
            raise UserError("--out - writes one file; give one input, and no folder")
        as_json = files is not None and files.json
        if piped and as_json:
            raise UserError("--out - writes a file to the standard output; --json cannot, too")
        stdout = sys.stdout
        aside = (piped or as_json) and not STAGES.quiet
        with redirect_stdout(sys.stderr) if aside else nullcontext():
            with _one_file() if piped else nullcontext() as folder:
                if folder and files:
                    values["files"] = replace(files, out=folder, page=False, turntable="none")
                elif folder:
                    values["out"] = folder / f"stdout.{values['kind'] or 'gif'}"
                results = command(*bound.args, **bound.kwargs)
            results.out = STREAM if piped else results.out
            for item, reason in results.failures:
                say(f"gamba: failed: {item}: {reason}", sys.stderr)
            if as_json:
                print_json(results.json(), stdout)
            else:
                say(results.text())
        return 1 if results.failures else 0

    return run


@contextmanager
def _one_file() -> Iterator[Path]:
    """Yield an empty folder; write the one file that is then in it to stdout.

    Raises:
        UserError: there are several files, or stdout is a terminal.
    """
    stdout = sys.__stdout__
    if stdout is None or stdout.isatty():
        raise UserError("--out -: the standard output is a terminal; redirect it to a file")
    with tempfile.TemporaryDirectory(prefix="gamba-") as folder:
        yield Path(folder)
        files = sorted(Path(folder).iterdir())
        if len(files) > 1:
            names = ", ".join(path.name for path in files[:4])
            raise UserError(f"--out - writes one file, but {len(files)} were made: {names}")
        for path in files:
            with open(path, "rb") as file:
                shutil.copyfileobj(file, stdout.buffer)
            stdout.flush()
