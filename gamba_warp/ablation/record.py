"""What of a row is done: ``state.json`` while it runs, ``row.json`` when it has ended."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from ..errors import UserError
from ..files import remove_folder, write_json
from ..untrusted.documents import read_document
from .jobs import Stage, difference, digest

VERSION = 1
_MAX = 1 << 20  # bytes of a record; ours have a few kB
_Words = dict[str, list[str]]


class Ended(msgspec.Struct):
    """A command that has ended well.

    Attributes:
        seconds: that it took, of all its parts where it was stopped on the way.
        peak_memory: most bytes of memory that its process held, or None.
        threads: that it had.
        jobs: rows that ran at once.
        note: what went wrong beside, in one line.
    """

    seconds: float = 0.0
    peak_memory: int | None = None
    threads: int = 1
    jobs: int = 1
    note: str = ""


class Record(msgspec.Struct):
    """What is known of a row with one seed.

    Attributes:
        row: its name.
        seed: its seed.
        commands: words by the command's name, ``ROW`` in place of the row's folder.
        digest: the hash of the commands.
        status: "begun", "ok" or "failed".
        reason: why it failed, in one line.
        ended: what has ended well, by the command's name.
        parts: of the commands that have not.
        gamba_warp: version of the package.
    """

    row: str
    seed: int
    commands: _Words
    digest: str
    version: Annotated[int, Meta(ge=VERSION, le=VERSION)] = VERSION
    status: Literal["begun", "ok", "failed"] = "begun"
    reason: str = ""
    ended: dict[str, Ended] = {}
    parts: dict[str, Ended] = {}
    gamba_warp: str = ""


def row_folder(out: Path, row: str, seed: int) -> Path:
    """The folder of a row with one seed."""
    return out / "rows" / row / f"seed-{seed}"


def new_record(row: str, seed: int, stages: list[Stage]) -> Record:
    """The record of a row that has not begun."""
    from ..versions import __version__

    commands = {stage.name: list(stage.words) for stage in stages}
    return Record(row, seed, commands, digest(commands), gamba_warp=__version__)


def read_record(folder: Path) -> Record | None:
    """The record of a row's folder; None where there is none.

    Raises:
        UserError: it is damaged.
    """
    for name in ("row.json", "state.json"):
        if (folder / name).exists():
            return read_document(folder / name, Record, _MAX)
    return None


def write_record(folder: Path, record: Record) -> None:
    """Writes the record, atomically: ``row.json`` where the row has ended, else ``state.json``."""
    ended = record.status != "begun"
    write_json(folder / ("row.json" if ended else "state.json"), msgspec.to_builtins(record))
    if ended:
        (folder / "state.json").unlink(missing_ok=True)
    else:
        (folder / "row.json").unlink(missing_ok=True)


def add_part(old: Ended | None, new: Ended) -> Ended:
    """A command's parts together: a run that was stopped and went on is one run."""
    if old is None:
        return new
    memory = [m for m in (old.peak_memory, new.peak_memory) if m is not None]
    return Ended(
        old.seconds + new.seconds, max(memory, default=None), new.threads, new.jobs, new.note
    )


def changed(record: Record, wanted: Record) -> str | None:
    """What of the commands is another one now; None where they are the same."""
    if record.digest == wanted.digest:
        return None
    return difference(record.commands, wanted.commands) or "its commands"


def begin_anew(folder: Path, record: Record, wanted: Record) -> Record:
    """Removes what commands made that are others now, and what came after them.

    Args:
        folder: of the row.
        record: what is there.
        wanted: what there shall be.

    Returns:
        The record to go on with: of the commands that are the same, what they made stays.

    Raises:
        UserError: something cannot be removed.
    """
    kept = {}
    for name, words in wanted.commands.items():
        if record.commands.get(name) != words or name not in record.ended:
            break
        kept[name] = record.ended[name]
    gone = [name for name in record.commands if name not in kept]
    try:
        for name in gone:
            for path in sorted(folder.glob("chosen-*")) if name == "shapes" else []:
                shutil.rmtree(path)
            made = folder / _FOLDERS[name]
            if made.is_dir():
                remove_folder(made)
    except OSError as error:
        raise UserError(f"cannot remove {folder}: {error.strerror}") from error
    wanted.ended = kept
    return wanted


_FOLDERS = {"train": "run", "views": "views", "shapes": "shapes", "fit": "fit"}
