"""Runs a command in a child process that may be killed or find a full disk."""

import multiprocessing
import os
import resource
import runpy
import signal
import sys
import threading
import time
from contextlib import suppress
from typing import NamedTuple

LONGEST = 300.0  # seconds; a command that takes longer hangs
# A server imports these once, computes nothing, and is forked for each command.
_FORKS = multiprocessing.get_context("forkserver")
_FORKS.set_forkserver_preload(
    [
        *("timm", "trimesh", "gamba_warp.measure.models"),
        *("gamba_warp.eval.shapes.pairs", "gamba_warp.eval.views.evaluate"),
        *("gamba_warp.model.predict", "gamba_warp.model.released"),
        *("gamba_warp.pipeline", "gamba_warp.train.loop", "gamba_warp.train.data.render"),
    ]
)


class End(NamedTuple):
    """Result of a child.

    Attributes:
        code: exit code; negative: the signal that ended it.
        said: its text on both outputs.
        seconds: its run time.
        killed: True if it was killed here at the requested moment.
    """

    code: int
    said: str
    seconds: float
    killed: bool

    @property
    def is_one_line(self) -> bool:
        """True if a failure is a message of the command line, without traceback or crash."""
        told = "gamba: " in self.said or "failed: " in self.said
        return self.code in (0, 1, 2) and "Traceback" not in self.said and told


def gamba(*words: object) -> None:
    """Run ``python -m gamba_warp WORDS``."""
    sys.argv = ["gamba", *map(str, words)]
    runpy.run_module("gamba_warp", run_name="__main__", alter_sys=True)


def run_child(function, *arguments, kill_after=None, file_limit=None) -> End:
    """Call a function in a child process.

    Args:
        function: of a module; the exit code is that of its ``sys.exit``, or 1 for an exception.
        arguments: its arguments.
        kill_after: seconds until SIGKILL, or None.
        file_limit: largest size of a file in bytes, or None.
    """
    ours, theirs = _FORKS.Pipe(duplex=False)
    process = _FORKS.Process(target=_become, args=(theirs, file_limit, function, arguments))
    process.start()
    started, parts = time.monotonic(), []
    theirs.close()

    def listen() -> None:
        with suppress(OSError):
            while part := os.read(ours.fileno(), 1 << 16):
                parts.append(part)

    # Not a file: the child's files may not grow.
    listener = threading.Thread(target=listen, daemon=True)
    listener.start()
    process.join(LONGEST if kill_after is None else kill_after)
    killed = process.is_alive()
    process.kill()
    process.join()
    seconds = time.monotonic() - started
    with suppress(ProcessLookupError):  # helpers of the command, such as ffmpeg or workers
        os.killpg(process.pid, signal.SIGKILL)
    listener.join(10)
    ours.close()
    said = b"".join(parts).decode(errors="replace")
    return End(process.exitcode, said, seconds, killed and process.exitcode == -signal.SIGKILL)


def _become(pipe, file_limit, function, arguments) -> None:
    import torch
    from tqdm import tqdm

    os.setsid()
    tqdm.set_lock(threading.RLock())  # its own would outlive a killed child, as a semaphore
    for target, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(pipe.fileno(), target)
        setattr(sys, name, open(target, "w", encoding="utf-8", closefd=False))
    pipe.close()
    torch.set_num_threads(1)
    if file_limit is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (file_limit, file_limit))
    function(*arguments)
