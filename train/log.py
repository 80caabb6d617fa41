"""Log of a run: one JSON object per line, TensorBoard, and sample images."""

from __future__ import annotations

import errno
import io
import json
import math
import os
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from gamba_warp.batch import progress_bar
from gamba_warp.batch import say as above_bars
from gamba_warp.errors import UserError
from gamba_warp.files import reason_of
from gamba_warp.images import save_image, to_uint8


class RunLog:
    """Append to ``RUN/log.jsonl``; every line has ``event``, ``step`` and ``time`` (Unix, s).

    Errors of the log never stop a run: each writer's first error is reported, then it is dropped.
    """

    def __init__(self, run: Path) -> None:
        """Open the log in the run folder, and TensorBoard's files if it is installed.

        Raises:
            UserError: the file cannot be written.
        """
        self._said: set[str] = set()
        self._failed: set[str] = set()  # uids of objects
        self._board: Any = None  # a ``SummaryWriter``
        try:
            # Unbuffered, so that a failed write is known at once and leaves nothing pending.
            self._file = open(run / "log.jsonl", "a+b", buffering=0)
            size = self._file.seek(0, os.SEEK_END)  # 0 for a device, whose reading would never end
            self._file.seek(0)
            self._truncate(self._file.read(size).rfind(b"\n") + 1)
        except OSError as error:
            raise UserError(f"cannot write {run / 'log.jsonl'}: {error.strerror}") from error
        with self._guarded("tensorboard"), suppress(ImportError):
            from torch.utils.tensorboard import SummaryWriter

            self._board = SummaryWriter(str(run / "tensorboard"))

    @contextmanager
    def _guarded(self, name: str) -> Iterator[None]:
        """Report the first error of each writer in one line, and continue."""
        try:
            yield
        except Exception as error:  # TensorBoard's thread may raise anything
            if name not in self._said:
                self._said.add(name)
                say(f"gamba train: {name} cannot be written, the run continues: {reason_of(error)}")
            if name == "tensorboard":
                self._board = None

    def _truncate(self, size: int) -> None:
        """Remove a partial line left by a full disk or a kill."""
        if os.fstat(self._file.fileno()).st_size > size:
            os.ftruncate(self._file.fileno(), size)

    def write(self, event: str, step: int, **values: object) -> None:
        """Write a line; non-finite numbers become null.

        The events are start, train, seen, val, best, warning and end.
        """
        line = {"event": event, "step": step, "time": round(time.time(), 3), **_to_json(values)}
        data = (json.dumps(line) + "\n").encode()
        with self._guarded("log.jsonl"):
            size = os.fstat(self._file.fileno()).st_size
            try:
                if self._file.write(data) != len(data):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            except OSError:
                self._truncate(size)
                raise
        if self._board is not None:
            with self._guarded("tensorboard"):
                for name, value in values.items():
                    if isinstance(value, (int, float)) and not isinstance(value, bool):
                        self._board.add_scalar(f"{event}/{name}", value, step)

    def warn(self, step: int, message: str) -> None:
        """Print one line above the progress bar and log it."""
        say(f"gamba train: {message}")
        self.write("warning", step, message=message)

    def warn_of_objects(self, step: int, failures: Mapping[str, str]) -> None:
        """Warn of each object that could not be read, by uid, once."""
        for uid in [uid for uid in failures if uid not in self._failed]:
            self._failed.add(uid)
            self.warn(step, f"{uid} is skipped: {failures[uid]}")

    def sample(self, step: int, path: Path, rows: list[Tensor]) -> None:
        """Write sample images, see ``strip_of``, also to TensorBoard; warn if that fails."""
        strip = strip_of(rows)
        try:
            save_image(path, strip)
        except UserError as error:
            self.warn(step, str(error))
        if self._board is not None:
            with self._guarded("tensorboard"):
                self._board.add_image("val/images", to_uint8(strip), step, dataformats="HWC")

    def close(self) -> None:
        """Close the files."""
        self._file.close()
        if self._board is not None:
            with self._guarded("tensorboard"):
                self._board.close()


class NoLog(RunLog):
    """Log of a process that is not the main one: nothing is written or printed."""

    def __init__(self) -> None:
        self._failed = set()

    def write(self, event: str, step: int, **values: object) -> None:
        """Write nothing."""

    def warn(self, step: int, message: str) -> None:
        """Print nothing."""


def say(text: str, file: TextIO | None = None) -> None:
    """Print a line above the progress bar, ignoring output errors.

    A closed terminal (SIGHUP) and a full disk under the standard output raise OSError.
    """
    with suppress(OSError):
        above_bars(text, file)
        (file or sys.stdout).flush()


class SafeStream:
    """Text stream for a progress bar that ignores write errors."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)

    def write(self, text: str) -> None:
        """Write, ignoring errors."""
        with suppress(OSError):
            self._stream.write(text)

    def flush(self) -> None:
        """Flush, ignoring errors."""
        with suppress(OSError):
            self._stream.flush()


def _to_json(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    if isinstance(value, dict):
        return {name: _to_json(inner) for name, inner in value.items()}
    return value


def strip_of(rows: list[Tensor]) -> np.ndarray:
    """Join images to one: each of ``rows`` is ``[V, H, W, 3]`` in [0, 1], left to right."""
    strips = [torch.cat(list(row), dim=1) for row in rows]
    width = max(strip.shape[1] for strip in strips)
    padded = [torch.nn.functional.pad(s, (0, 0, 0, width - s.shape[1]), value=1.0) for s in strips]
    return torch.cat(padded).cpu().numpy()


def run_bar(total: int | None, minutes: float | None, step: int, spent: float, main: bool) -> tqdm:
    """Progress bar of a run: of its minutes if they are limited, else of its steps.

    Without a terminal it prints lines, see ``progress_bar``.

    Args:
        total: steps of the run, or None if only minutes limit it.
        minutes: its time limit, or None.
        step: steps done.
        spent: minutes spent.
        main: True if this process draws the bar.
    """
    file = SafeStream(sys.stderr if main else io.StringIO())
    if minutes is None:
        return progress_bar(total=total, initial=step, unit="step", file=file, lines=main)
    form = "{percentage:3.0f}%|{bar}| {n:.1f} of {total:g} min{postfix}"
    about = {"total": minutes, "initial": min(minutes, spent), "bar_format": form}
    return progress_bar(**about, file=file, lines=main)
