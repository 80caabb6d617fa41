"""Training in several processes like those of torchrun, each with its own options."""

import os
import signal
import socket
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

from helpers import micro
from helpers.forked import python

ROOT = Path(micro.__file__).resolve().parents[2]
LONGEST = 300  # seconds until processes that wait for one another are killed


def free_port() -> int:
    """Find an unused TCP port."""
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        return held.getsockname()[1]


def environment(**more: object) -> dict[str, str]:
    """The environment of a child: this checkout, one thread, and ``more``."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")])
    known = {"PYTHONPATH": path, "OMP_NUM_THREADS": 1, **more}
    return os.environ | {name: str(value) for name, value in known.items()}


def words(data: Path, out: Path, *more: object) -> list[str]:
    """Arguments of ``gamba train`` for a quick run of a narrow network; ``more`` replaces them."""
    quick = {"--preset": "tiny", "--lpips": "off", "--device": "cpu", "--size": micro.SIZE}
    quick |= {"--batch-size": 2, "--warmup-steps": 1}
    quick |= {"--val-every": 0, "--log-every": 1, "--threads": 1, "--out": out}
    kept = [word for pair in quick.items() if pair[0] not in more for word in pair]
    return [*map(str, [data, "--set", *micro.MODEL, *kept, *more])]


def train_all(
    arguments: list[list[str]], patch: dict[int, str] | None = None
) -> list[CompletedProcess]:
    """Run ``gamba train`` in processes of one group.

    Args:
        arguments: of each process, by its rank.
        patch: by rank, Python that runs before the training.

    Returns:
        As for ``run_all``.
    """
    commands = []
    for rank, own in enumerate(arguments):
        script = f"{(patch or {}).get(rank, '')}\nimport sys\nfrom gamba_warp import cli\n"
        script += "from gamba_warp.train import checkpoint\ncheckpoint.KEPT = 9\n"
        script += "cli.main(['train', *sys.argv[1:]])\n"
        commands.append([python(), "-c", script, *own])
    return run_all(commands)


def run_all(commands: list[list[str]], **more: object) -> list[CompletedProcess]:
    """Run commands as one group, like torchrun's workers, with a time limit.

    Args:
        commands: of each process, by its rank.
        more: variables of their environment.

    Returns:
        The results by rank; processes killed after ``LONGEST`` have the code -9.
    """
    known = {"WORLD_SIZE": len(commands), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": free_port()}

    def run(rank: int) -> CompletedProcess:
        place = environment(RANK=rank, LOCAL_RANK=rank, **known, **more)
        pipes: dict[str, Any] = {"capture_output": True, "text": True, "timeout": LONGEST}
        try:
            return subprocess.run(commands[rank], env=place, **pipes)
        except subprocess.TimeoutExpired as late:  # its outputs are bytes, or None
            out, err = (bytes(x or b"").decode() for x in (late.stdout, late.stderr))
            return CompletedProcess(commands[rank], -signal.SIGKILL, out, err)

    with ThreadPoolExecutor(len(commands)) as threads:
        return [*threads.map(run, range(len(commands)))]
