"""A run of ``gamba stress files``: its cases, its counts, and the files that it leaves."""

from __future__ import annotations

import itertools
import math
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from ..batch import progress_bar
from ..errors import UserError
from ..files import atomic_path, write_json
from ..kernels.runtime.system import cores
from ..versions import __version__, installed
from .case import FORMAT, Case, read_case, stored_case
from .mutations.draw import draw_case
from .pool import Pool
from .readers import READERS
from .seeds.pictures import Files
from .shrink import shrink, signature
from .verdict import BAD, GOOD, OUTCOMES, Verdict

_SHRUNK = 8  # kinds of failures of a run that are made small
_WRITTEN = 5  # cases of one kind of failure that are written


def versions() -> dict[str, str]:
    """Versions by name of what decides an outcome."""
    names = ("numpy", "torch", "pillow", "trimesh", "open3d-cpu", "pymeshlab", "safetensors")
    return {"gamba_warp": __version__} | installed(*names)


class Cases:
    """Draws hostile cases; the same seed gives the same cases in the same order.

    Attributes:
        sound: the sound files by reader and name.

    Args:
        seed: of all chance.
        names: of the readers; all if empty.
    """

    def __init__(self, seed: int, names: Sequence[str] = ()) -> None:
        self.seed = seed
        chosen = [READERS[name] for name in names or READERS]
        self.sound: dict[tuple[str, str], Files] = {}
        made: dict = {}
        for reader in chosen:
            if reader.seeds not in made:
                made[reader.seeds] = reader.seeds()
            for name, files in made[reader.seeds].items():
                self.sound[reader.name, name] = files
        turns = [reader.name for reader in chosen for _ in range(reader.share)]
        Random(0).shuffle(turns)
        self._turns, self._seeds = turns, {name: self._names(name) for name in set(turns)}
        self._others = [data for files in self.sound.values() for data in files.values()]

    def _names(self, reader: str) -> list[str]:
        return [name for other, name in self.sound if other == reader]

    def main(self, reader: str, seed: str) -> str:
        """The name that a reader is pointed at, of sound files."""
        return "" if READERS[reader].whole else next(iter(self.sound[reader, seed]))

    def draw(self) -> Iterator[Case]:
        """Draws cases endlessly."""
        for index in itertools.count():
            reader = self._turns[index % len(self._turns)]
            rng = Random(f"{self.seed} {reader} {index}")
            seed = rng.choice(self._seeds[reader])
            files = self.sound[reader, seed]
            yield draw_case(reader, seed, self.main(reader, seed), files, self._others, rng)


@dataclass
class Row:
    """What the cases of one reader came to.

    Attributes:
        reader: its name.
        counts: number of cases by outcome.
        seconds: time that reading took.
        slowest: the longest time of a case.
        peak: the largest memory of a case, bytes.
        printed: number of cases in which a library wrote to the terminal.
    """

    reader: str
    counts: Counter[str] = field(default_factory=Counter)
    seconds: float = 0.0
    slowest: float = 0.0
    peak: int = 0
    printed: int = 0

    def add(self, verdict: Verdict) -> None:
        """Counts one case."""
        self.counts[verdict.outcome] += 1
        self.seconds += verdict.seconds
        self.slowest = max(self.slowest, verdict.seconds)
        self.peak = max(self.peak, verdict.peak)
        self.printed += verdict.printed

    @property
    def cases(self) -> int:
        """The number of cases."""
        return self.counts.total()

    def record(self) -> dict:
        """The row as JSON values."""
        counts = {name: self.counts[name] for name in OUTCOMES}
        return {
            "reader": self.reader,
            "cases": self.cases,
            **counts,
            "seconds": round(self.seconds, 3),
            "slowest": round(self.slowest, 3),
            "peak_mb": self.peak >> 20,
            "printed": self.printed,
        }


class FilesRun:
    """One run: its counts, its failures, and the files that it leaves.

    Attributes:
        about: what is written of the run itself.
        rows: counts by reader.
        failures: the file (empty where no more are written) and a line of each failing case.

    Args:
        readers: names of the readers; all if empty.
        folder: for the summary and the failing cases.
        seed: the same seed gives the same cases in the same order.
        shrink_seconds: time for making one failing case small.
        children: number of child processes; one per core if None.
    """

    def __init__(
        self,
        readers: Sequence[str],
        folder: Path,
        seed: int,
        shrink_seconds: float,
        children: int | None = None,
    ) -> None:
        self._cases, self._folder, self._shrink_seconds = (
            Cases(seed, readers),
            folder,
            shrink_seconds,
        )
        self._children = children or cores()
        self.about: dict = {"seed": seed, **versions()}
        self.rows: dict[str, Row] = {}
        self.failures: list[dict[str, str]] = []
        self._kinds: Counter[str] = Counter()

    def run(self, count: int | None, seconds: float) -> None:
        """Runs cases until there are ``count``, the time is up or Ctrl-C, with a progress bar.

        Args:
            count: of the cases; None for no limit.
            seconds: may be infinite.
        """
        began, interrupted = time.monotonic(), False
        drawn = itertools.islice(self._cases.draw(), count)
        small: list[tuple[Case, Verdict, str]] = []
        total = count if seconds == math.inf else None
        bar = progress_bar(total=total, unit="case", desc="stress files")
        with Pool(self._children) as pool, bar:
            try:
                for case, verdict in pool.run(drawn, seconds):
                    self.rows.setdefault(case.reader, Row(case.reader)).add(verdict)
                    if verdict.bad:
                        self._keep(case, verdict, small)
                    bar.set_postfix_str(f"{len(self.failures)} failures")
                    bar.update()
                for case, verdict, name in small:
                    bar.set_postfix_str(f"{name} is made small")
                    self._shrink(pool, case, verdict, name)
            except KeyboardInterrupt:
                interrupted = True
        minutes = round((time.monotonic() - began) / 60, 2)
        self.about |= {"minutes": minutes, "interrupted": interrupted}

    def _keep(self, case: Case, verdict: Verdict, small: list) -> None:
        kind = signature(case, verdict)
        self._kinds[kind] += 1
        name = f"failure-{case.reader}-{len(self.failures) + 1}.json"
        if self._kinds[kind] > _WRITTEN:
            name = ""
        else:
            self._write_case(name, case, verdict)
        self.failures.append({"file": name, "text": failure_text(case, verdict)})
        if self._kinds[kind] == 1 and len(small) < _SHRUNK:
            small.append((case, verdict, name))

    def _shrink(self, pool: Pool, case: Case, verdict: Verdict, name: str) -> None:
        sound = self._cases.sound[case.reader, case.seed]
        seconds = self._shrink_seconds
        case, verdict = shrink(case, verdict, sound, pool.run_one, seconds)
        self._write_case(name, case, verdict)

    def _write_case(self, name: str, case: Case, verdict: Verdict) -> None:
        content = stored_case(case, verdict.outcome, verdict.text, versions())
        write_json(self._folder / name, content)

    def write(self) -> None:
        """Writes stress.json and stress.md."""
        rows = [row.record() for row in self._sorted()]
        totals = {key: sum(row[key] for row in rows) for key in ("cases", *OUTCOMES, "printed")}
        content = {"format": FORMAT, **self.about, "totals": totals, "rows": rows}
        write_json(self._folder / "stress.json", content | {"failures": self.failures})
        run = ", ".join(f"{name} {value}" for name, value in self.about.items())
        parts = ["# Hostile files", run, self.table(), "\n".join(_meanings())]
        if self.failures:
            parts += ["## Failures", "\n".join(self._failure_lines("- "))]
        with atomic_path(self._folder / "stress.md") as temporary:
            temporary.write_text("\n\n".join(parts) + "\n", encoding="utf-8")

    def _sorted(self) -> list[Row]:
        return [self.rows[name] for name in READERS if name in self.rows]

    def table(self) -> str:
        """The counts by reader as a Markdown table, aligned for a terminal."""
        head = ["reader", "cases", *OUTCOMES, "cases/s", "slowest", "MB", "printed"]
        rows, total = self._sorted(), Row("all")
        for row in rows:
            total.counts.update(row.counts)
            total.seconds += row.seconds
            total.slowest, total.peak = (
                max(total.slowest, row.slowest),
                max(total.peak, row.peak),
            )
            total.printed += row.printed
        cells = [head, *(_cells(row) for row in [*rows, total])]
        widths = [max(len(line[i]) for line in cells) for i in range(len(head))]
        lines = [f"| {' | '.join(c.ljust(w) for c, w in zip(line, widths))} |" for line in cells]
        return "\n".join([lines[0], f"|{'|'.join('-' * (w + 2) for w in widths)}|", *lines[1:]])

    def _failure_lines(self, mark: str = "") -> list[str]:
        found = [f"{mark}{row['file']}: {row['text']}" for row in self.failures if row["file"]]
        more = len(self.failures) - len(found)
        return found + ([f"{mark}and {more} more of the same kinds"] if more else [])

    def summary(self) -> str:
        """The table, and a line for each failure."""
        cases = sum(row.cases for row in self.rows.values())
        text = f"{cases} cases, {len(self.failures)} failed"
        return "\n".join([self.table(), *self._failure_lines(), text])


def _cells(row: Row) -> list[str]:
    speed = f"{row.cases / row.seconds:.0f}" if row.seconds else ""
    counts = [str(row.counts[name]) for name in OUTCOMES]
    last = [speed, f"{row.slowest:.2f} s", str(row.peak >> 20), str(row.printed)]
    return [row.reader, str(row.cases), *counts, *last]


def _meanings() -> list[str]:
    return [f"- {name}: {text}" for name, text in (GOOD | BAD).items()]


def failure_text(case: Case, verdict: Verdict) -> str:
    """Describes a failure in one line."""
    done = "; ".join(case.mutations)[:120]
    text = " ".join(verdict.text.split()).encode("utf-8", "replace").decode()
    return f"{case.reader}, {case.seed} ({done}): {verdict.outcome}, {text}"


def choose_readers(what: Sequence[str]) -> list[str]:
    """The readers that are named beside "files"; none means all.

    Raises:
        UserError: a name is not known.
    """
    names = [name for name in what if name != "files"]
    unknown = [name for name in names if name not in READERS]
    if unknown:
        raise UserError(f"unknown reader '{unknown[0]}'; there are {', '.join(READERS)}")
    return names


def is_hostile_case(path: Path) -> bool:
    """Whether a file seems to be a case of this command, and not a numeric one."""
    try:
        if not path.is_file():
            return False
        with open(path, "rb") as file:
            return FORMAT.encode() in file.read(4096)
    except (OSError, ValueError):
        return False


def replay(paths: Sequence[Path]) -> Iterator[tuple[bool, str]]:
    """Runs the cases in files; all files are read before the first case is run.

    Yields:
        Whether a case passes, and a line about it.

    Raises:
        UserError: a file cannot be read, or is from another version.
    """
    cases = [(path, read_case(path, READERS)) for path in paths]
    with Pool(1) as pool:
        for path, case in cases:
            verdict = pool.run_one(case)
            word = "fails" if verdict.bad else "passes"
            yield not verdict.bad, f"{path}: {word}; {failure_text(case, verdict)}"
