"""Runs a command in a child process that may be killed or find a full disk."""

import os
import subprocess
import time
from typing import Any, NamedTuple

from helpers.forked import python

LONGEST = 300.0  # seconds; a command that takes longer hangs
# Loaded once, so that a kill rarely meets an import.
_LOADED = (
    *("timm", "trimesh", "gamba_warp.measure.models", "gamba_warp.pipeline"),
    *("gamba_warp.eval.shapes.pairs", "gamba_warp.eval.views.evaluate"),
    *("gamba_warp.model.predict", "gamba_warp.model.released"),
    *("gamba_warp.train.loop", "gamba_warp.train.data.render"),
)
# Runs ``gamba`` with a limit on the size of its files.
_CODE = """
import resource, runpy, sys
limit = int(sys.argv.pop(1))
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
runpy.run_module("gamba_warp", run_name="__main__", alter_sys=True)
"""


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


def gamba(*words: object, kill_after: float = LONGEST, file_limit: int = -1) -> End:
    """Run ``gamba WORDS`` in a child process.

    Args:
        words: the command and its arguments.
        kill_after: seconds until SIGKILL, also of processes that it has started.
        file_limit: largest size of a file in bytes, or -1.
    """
    command = [python(*_LOADED), "-c", _CODE, str(file_limit), *map(str, words)]
    started, killed = time.monotonic(), False
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    process = subprocess.Popen(command, env=os.environ | {"OMP_NUM_THREADS": "1"}, **pipes)
    try:
        said, _ = process.communicate(timeout=kill_after)
    except subprocess.TimeoutExpired:
        process.kill()
        said, _ = process.communicate()  # until all of them have ended
        killed = True
    return End(process.returncode, said, time.monotonic() - started, killed)
