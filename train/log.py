"""The run's log: one JSON object per line, TensorBoard if it is installed, and sample pictures."""

from __future__ import annotations

import json
import math
import time
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from gamba_warp.errors import UserError
from gamba_warp.images import save_image


class RunLog:
    """Appends to ``RUN/log.jsonl``; every line has ``event``, ``step`` and ``time`` (Unix, s)."""

    def __init__(self, run: Path, tensorboard: bool) -> None:
        """Opens the log in the run folder.

        Raises:
            UserError: the file cannot be written.
        """
        try:
            self._file = open(run / "log.jsonl", "a", encoding="utf-8")
        except OSError as error:
            raise UserError(f"cannot write {run / 'log.jsonl'}: {error.strerror}") from error
        self._board = _summary_writer(run / "tensorboard") if tensorboard else None

    def write(self, event: str, step: int, **values: object) -> None:
        """Writes a line; numbers that are not finite become null."""
        line = {"event": event, "step": step, "time": round(time.time(), 3)}
        line |= {name: _plain(value) for name, value in values.items()}
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()
        if self._board is not None:
            for name, value in values.items():
                if isinstance(value, (int, float)) and not isinstance(value, bool):
                    self._board.add_scalar(f"{event}/{name}", value, step)

    def warn(self, step: int, message: str) -> None:
        """Prints one line above the progress bar and logs it."""
        tqdm.write(f"gamba train: {message}")
        self.write("warning", step, message=message)

    def close(self) -> None:
        """Closes the files."""
        self._file.close()
        if self._board is not None:
            self._board.close()


def _plain(value: object) -> object:
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    if isinstance(value, dict):
        return {name: _plain(inner) for name, inner in value.items()}
    return value


def _summary_writer(folder: Path):
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder))


def save_strip(path: Path, rows: list[Tensor]) -> None:
    """Writes pictures as one PNG: each of ``rows`` is ``[V, H, W, 3]`` in [0, 1], left to right."""
    strips = [torch.cat(list(row), dim=1) for row in rows]
    width = max(strip.shape[1] for strip in strips)
    padded = [torch.nn.functional.pad(s, (0, 0, 0, width - s.shape[1]), value=1.0) for s in strips]
    save_image(path, torch.cat(padded).cpu().numpy())
