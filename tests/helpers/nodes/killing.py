"""Repeated kills of one of two training processes, which torchrun restarts."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from helpers.forked import python
from helpers.nodes.processes import environment, free_port

_TIMEOUT = 900.0  # seconds of one run with all its kills
_STEPS_PER_KILL = 8
_WAIT = 0.02  # seconds between two looks


@dataclass(frozen=True)
class Killed:
    """Result of a run with kills.

    Attributes:
        main: number of kills of the writing process.
        resumed: number of resumptions from a checkpoint.
        steps: the last step.
        seconds: total time.
        said: output of the processes.
    """

    main: int
    resumed: int
    steps: int
    seconds: float
    said: str


def steps_for(kills: int) -> int:
    """Steps of a run that is long enough for ``kills`` kills."""
    return _STEPS_PER_KILL * kills + 4


def kill_one_of_two(words: list[str], out: Path, kills: int, rng: random.Random) -> Killed:
    """Train in two processes, each under its own torchrun, as on two machines.

    Args:
        words: options of ``gamba train`` except the run folder, ``--steps`` and those of saving;
            with ``--log-every 1``, which determines the moments.
        out: the run folder; the output of the processes goes into a file beside it.
        kills: number of kills of one of the two.
        rng: generator of the moments and of the choice between the two.

    Raises:
        RuntimeError: the run fails or exceeds its time limit.
    """
    started = time.monotonic()
    own = ["--out", out, "--steps", steps_for(kills), "--save-every", 3]
    reaper = _Reaper(out / "log.jsonl", kills, rng)
    # A kill fails both workers: the other loses its peer.
    said = _nodes([*words, *map(str, own)], out.with_name(f"{out.name}.txt"), 2 * kills, reaper)
    return Killed(
        main=reaper.main,
        resumed=sum(bool(line["resumed_from"]) for line in _lines(reaper.log, "start")),
        steps=_lines(reaper.log, "end")[-1]["step"],
        seconds=round(time.monotonic() - started, 1),
        said=said,
    )


class _Reaper:
    """Kills one of two workers at random moments: while they start, and while they train."""

    def __init__(self, log: Path, kills: int, rng: random.Random) -> None:
        self.log, self.left, self.rng = log, kills, rng
        self.main = 0
        self._gone: set[int] = set()
        self._aim()

    def _aim(self) -> None:
        """Choose the moment: a number of further logged steps, 0 for at once, then some seconds."""
        wanted = self.rng.choice((0, *range(1, _STEPS_PER_KILL)))
        self._steps = len(_lines(self.log, "train")) + wanted
        self._wait = self.rng.uniform(0, 1.5 if wanted == 0 else 0.1)

    def __call__(self, agents: list[subprocess.Popen]) -> None:
        """Kill a worker if the moment has come; ``agents`` are the two torchruns."""
        if not self.left or len(_lines(self.log, "train")) < self._steps:
            return
        workers = [_child(agent.pid) for agent in agents]
        if None in workers or self._gone & {*workers}:  # not started again yet
            return
        time.sleep(self._wait)
        chosen = self.rng.randrange(2)
        number = workers[chosen]
        assert number is not None
        if number != _child(agents[chosen].pid):
            return
        os.kill(number, signal.SIGKILL)
        self._gone |= {*filter(None, workers)}
        self.left -= 1
        self.main += chosen == 0
        self._aim()


def _nodes(
    words: list[str], notes: Path, restarts: int, look: Callable[[list[subprocess.Popen]], None]
) -> str:
    """Run two torchruns with one worker each to their end; return their output."""
    command = [sys.executable, "-m", "torch.distributed.run", "--nnodes", "2"]
    command += ["--nproc-per-node", "1", "--max-restarts", str(restarts), "--rdzv-id", "gamba"]
    command += ["--rdzv-backend", "c10d", "--rdzv-endpoint", f"127.0.0.1:{free_port()}"]
    command += ["--local-addr", "127.0.0.1", "-m", "gamba_warp.train", *words]
    agents: list[subprocess.Popen[Any]] = []
    limit = time.monotonic() + _TIMEOUT
    own = environment(PYTHON_EXEC=python())
    with open(notes, "w+", encoding="utf-8", errors="replace") as file:
        try:
            for _ in range(2):
                agents.append(subprocess.Popen(command, env=own, stdout=file, stderr=file))
                time.sleep(1.0)  # makes the first one the host, with the lower rank
            while any(agent.poll() is None for agent in agents):
                if time.monotonic() > limit:
                    raise RuntimeError(f"no end after {_TIMEOUT:.0f} s: {_tail(notes)}")
                look(agents)
                time.sleep(_WAIT)
        finally:
            for agent in agents:
                _end(agent)
    if codes := [agent.returncode for agent in agents if agent.returncode]:
        raise RuntimeError(f"torchrun ended with code {codes[0]}: {_tail(notes)}")
    return notes.read_text(encoding="utf-8", errors="replace")


def _end(agent: subprocess.Popen) -> None:
    """End a torchrun, and thereby its worker."""
    if agent.poll() is not None:
        return
    worker = _child(agent.pid)
    for number in filter(None, (worker, agent.pid)):
        with suppress(ProcessLookupError):
            os.kill(number, signal.SIGKILL)
    agent.wait()


def _child(parent: int) -> int | None:
    """Process id of the worker of a torchrun; None without one."""
    for entry in os.scandir("/proc"):
        if not entry.name.isdigit():
            continue
        with suppress(OSError, ValueError, IndexError):
            with open(f"/proc/{entry.name}/stat", encoding="utf-8", errors="replace") as file:
                state, above = file.read().rpartition(")")[2].split()[:2]
            if int(above) != parent or state == "Z":
                continue
            with open(f"/proc/{entry.name}/cmdline", encoding="utf-8", errors="replace") as file:
                if "gamba_warp.train" in file.read().split("\0"):
                    return int(entry.name)
    return None


def _lines(log: Path, event: str) -> list[dict]:
    """Complete lines of one kind in a run's log; empty without a log."""
    try:
        text = log.read_text(encoding="utf-8")
    except OSError:
        return []
    whole = [json.loads(line) for line in text.split("\n")[:-1]]
    return [line for line in whole if line["event"] == event]


def _tail(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace")[-2000:]
