"""State of a row with one seed, stored in its ``row.json``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from ..errors import UserError
from ..files import remove_folder, write_json
from ..untrusted.documents import read_document
from ..versions import __version__
from .jobs import FOLDERS, Settings, Stage, difference, stages
from .plan import Row

RECORD = "row.json"
_MAX = 1 << 20  # bytes of a record, which usually has a few kB


class Ended(msgspec.Struct):
    """Costs of a finished command.

    Attributes:
        seconds: its time, summed over stops and resumes.
        peak_memory: peak memory of its process in bytes, or None.
        threads: its number of threads.
        jobs: rows that ran at once.
        note: partial failures, in one line.
    """

    seconds: float = 0.0
    peak_memory: int | None = None
    threads: int = 1
    jobs: int = 1
    note: str = ""


class Record(msgspec.Struct):
    """Record of a row with one seed.

    Attributes:
        row: its name.
        seed: its seed.
        commands: words by the command's name, with ``ROW`` for the row's folder.
        status: "begun", "ok" or "failed".
        reason: of a failure, in one line.
        ended: costs of the finished commands, by name.
        parts: costs so far of the unfinished commands.
        gamba_warp: version of the package.
    """

    row: str
    seed: int
    commands: dict[str, list[str]]
    version: Annotated[int, Meta(ge=1, le=1)] = 1
    status: Literal["begun", "ok", "failed"] = "begun"
    reason: str = ""
    ended: dict[str, Ended] = {}
    parts: dict[str, Ended] = {}
    gamba_warp: str = __version__


@dataclass
class Task:
    """A row with one seed.

    Attributes:
        row: of the plan.
        folder: its folder.
        stages: its commands.
        record: its state.
        changed: the first option of its commands that changed since it ran, or None.
        geometry: number of objects whose shapes are evaluated, or None for all.
    """

    row: Row
    folder: Path
    stages: list[Stage]
    record: Record
    changed: str | None
    geometry: int | None

    @property
    def name(self) -> str:
        """Name in messages."""
        return f"{self.row.name}, seed {self.record.seed}"

    def next_stage(self) -> Stage | None:
        """Return the next command; None if all have succeeded."""
        for stage in self.stages:
            if stage.name not in self.record.ended or not (self.folder / stage.makes).exists():
                return stage
        return None

    def restart(self) -> None:
        """Remove the results of changed commands, and of those after them.

        Raises:
            UserError: something cannot be removed.
        """
        old, self.changed = self.record, None
        self.record = Record(old.row, old.seed, {s.name: s.words for s in self.stages})
        for name, words in self.record.commands.items():
            if old.commands.get(name) != words or name not in old.ended:
                break
            self.record.ended[name] = old.ended[name]
        try:
            for name in (name for name in old.commands if name not in self.record.ended):
                chosen = self.folder.glob("chosen-*") if name == "shapes" else ()
                for path in (*chosen, self.folder / FOLDERS[name]):
                    if path.is_dir():
                        remove_folder(path)
        except OSError as error:
            raise UserError(f"cannot remove {self.folder}: {error.strerror}") from error

    def write(self, status: Literal["begun", "ok", "failed"] | None = None, why: str = "") -> None:
        """Write the record atomically, with a new status if given."""
        if status is not None:
            self.record.status, self.record.reason = status, why
        write_json(self.folder / RECORD, msgspec.to_builtins(self.record))


def task_of(settings: Settings, row: Row, seed: int) -> Task:
    """Return a row with one seed, and its state.

    Raises:
        UserError: an option of the row is invalid, or its record is damaged.
    """
    made = stages(settings, row, seed)
    folder = settings.out / "rows" / row.name / f"seed-{seed}"
    record = wanted = Record(row.name, seed, {stage.name: stage.words for stage in made})
    if (folder / RECORD).exists():
        record = read_document(folder / RECORD, Record, _MAX)
    other = difference(record.commands, wanted.commands)
    return Task(row, folder, made, record, other, settings.evaluation.geometry_objects)
