"""Stages of ``gamba demo``: commands in child processes, each executed once."""

from __future__ import annotations

import shutil
import signal
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec

from ..errors import UserError
from ..files import sha256, write_json
from ..kernels.runtime.system import end_signals
from ..processes import GAMBA, Child, stop_requests
from ..untrusted.documents import read_document

_MADE = ("run", "icons", "views", "truth", "geometry", "views-here")  # folders of a demo


class Stopped(Exception):
    """A signal ended a command; ``code`` is 128 + its number."""

    def __init__(self, code: int) -> None:
        super().__init__(f"stopped with code {code}")
        self.code = code


class _Record(msgspec.Struct):
    begun: dict[str, list[str]] = {}
    ended: list[str] = []
    seconds: float = 0.0


class Stages:
    """State of a demo, stored in ``OUT/stages.json``."""

    def __init__(self, out: Path) -> None:
        """Read the state of a folder.

        Raises:
            UserError: the record is damaged.
        """
        self._path, self._record = out / "stages.json", _Record()
        if self._path.exists():
            self._record = read_document(self._path, _Record)
        self.seconds = self._record.seconds  # run time of earlier processes
        self._rerun = False  # True once a stage has run: those after it run too

    def forget(self) -> None:
        """Remove the results of an earlier demo; other files stay.

        Raises:
            UserError: something cannot be removed.
        """
        if self._path.exists():
            try:
                for folder in map(self._path.with_name, _MADE):
                    if folder.is_dir() and not folder.is_symlink():
                        shutil.rmtree(folder)
                self._path.unlink()
            except OSError as error:
                raise UserError(f"cannot remove {error.filename}: {error.strerror}") from error
            self._record, self.seconds = _Record(), 0.0

    def gamba(
        self,
        *arguments: object,
        makes: Sequence[Path] = (),
        reads: Sequence[Path] = (),
        may_fail: bool = False,
        name: str | None = None,
    ) -> None:
        """Run one command in a child process, with its output passed through, unless it is done.

        It is done if it succeeded before with the same arguments, all its results exist, and no
        stage before it has run again.

        Args:
            arguments: of the command.
            makes: files and folders that the command creates.
            reads: input files from outside the demo; their content is part of the options.
            may_fail: continue the demo after a failure.
            name: of the stage; by default the command's.

        Raises:
            UserError: it failed, or an earlier demo in the folder had other options or files.
            Stopped: a signal ended it.
        """
        words = [str(argument) for argument in arguments]
        stage = name or words[0]
        kept = [word.encode(errors="replace").decode() for word in words]
        kept += [f"{path.name} {sha256(path)[:16]}" for path in reads]
        if self._record.begun.get(stage, kept) != kept:
            where = self._path.parent
            raise UserError(
                f"{where}: holds a demo of other options or of another model; "
                "give --fresh or another --out"
            )
        print(f"\n$ gamba {' '.join(words)}", flush=True)
        done = stage in self._record.ended and all(path.exists() for path in makes)
        if done and not self._rerun:
            print("done before", flush=True)
            return
        self._record.begun[stage] = kept  # partial results belong to these options
        self._record.ended = [name for name in self._record.ended if name != stage]
        write_json(self._path, msgspec.to_builtins(self._record))
        started = time.perf_counter()
        code = _call(words)
        self._record.seconds += time.perf_counter() - started
        self._rerun = self._rerun or bool(makes)
        self._record.ended += [stage] if makes and code == 0 else []
        write_json(self._path, msgspec.to_builtins(self._record))
        if code - 128 in (signal.SIGINT, *end_signals()):
            raise Stopped(code)
        if code and not may_fail:
            raise UserError(f"the command above ended with exit code {code}")


def _call(words: list[str]) -> int:
    """Run a command and wait for it; forward signals that ask this process to stop."""
    with stop_requests() as received:
        child = Child([*GAMBA, *words])

        def forward_signals() -> None:
            while received:
                child.ask(received.pop(0))

        end = child.wait(forward_signals)
    assert end is not None, "there is no time limit"
    return end.code
