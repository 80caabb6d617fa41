"""A command in a forked child, which may be killed, or find a full disk."""

from __future__ import annotations

import os
import select
import signal
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

_LONGEST = 300.0  # seconds; a command that takes longer hangs


@dataclass(frozen=True)
class End:
    """How a child ended.

    Attributes:
        code: exit code; negative: the signal that ended it.
        said: what it wrote to both outputs.
        seconds: how long it ran.
        killed: whether it was killed from here, at the moment that was asked for.
    """

    code: int
    said: str
    seconds: float
    killed: bool

    @property
    def is_one_line(self) -> bool:
        """Whether a failure is told as the command line tells it: no traceback, no native death."""
        told = "gamba: " in self.said or "failed: " in self.said
        return self.code in (0, 1, 2) and "Traceback" not in self.said and told


def run_child(
    function: Callable[[], int | None],
    kill_after: float | None = None,
    file_limit: int | None = None,
) -> End:
    """Runs a function in a fork of this process, which has done the imports already.

    This process must not have computed with torch: its threads would be missing in the child.

    Args:
        function: returns the exit code.
        kill_after: seconds until SIGKILL, or None.
        file_limit: no file may grow beyond so many bytes, or None.
    """
    reader, writer = os.pipe()
    number = _fork()
    started = time.monotonic()
    if number == 0:
        os.close(reader)
        _become(function, writer, file_limit)
    os.close(writer)
    os.set_blocking(reader, False)
    parts: list[bytes] = []
    killed, ended = False, 0
    limit = started + (_LONGEST if kill_after is None else kill_after)
    while not ended:
        # A helper of the command may hold the pipe open, so its end does not tell the command's.
        left = limit - time.monotonic()
        select.select([reader], [], [], min(0.02, max(0.0, left)))
        parts += _read(reader)
        if left <= 0 and not killed:
            os.kill(number, signal.SIGKILL)
            killed = True
        ended, status = os.waitpid(number, 0 if killed else os.WNOHANG)
    seconds = time.monotonic() - started
    parts += _read(reader)
    try:  # helpers of the command, such as ffmpeg or workers
        os.killpg(number, signal.SIGKILL)
    except ProcessLookupError:
        pass
    os.close(reader)
    code = os.waitstatus_to_exitcode(status)
    return End(code, b"".join(parts).decode(errors="replace"), seconds, killed and code == -9)


def _fork() -> int:
    """``os.fork``, tried again for a while where the machine has no free process."""
    for _ in range(100):
        try:
            return os.fork()
        except BlockingIOError:
            time.sleep(0.1)
    return os.fork()


def _read(pipe: int) -> list[bytes]:
    """What is in a pipe now."""
    parts = []
    with suppress(BlockingIOError):
        while part := os.read(pipe, 1 << 16):
            parts.append(part)
    return parts


def _become(function: Callable[[], int | None], output: int, file_limit: int | None) -> None:
    """Runs the function as a process of its own would; never returns."""
    import resource  # Linux alone: the command refuses elsewhere

    import torch

    code = 70
    try:
        os.setsid()
        for target in (1, 2):
            os.dup2(output, target)
        for name, number in (("stdout", 1), ("stderr", 2)):
            setattr(
                sys,
                name,
                open(number, "w", encoding="utf-8", errors="backslashreplace", closefd=False),
            )
        torch.set_num_threads(1)
        if file_limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_limit, file_limit))
        code = function() or 0
    except SystemExit as stopped:
        code = stopped.code if isinstance(stopped.code, int) else 1
    except BaseException:
        traceback.print_exc()
        code = 70
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
