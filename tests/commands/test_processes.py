"""Processes of commands: their time, their end, and what they started."""

import os
import signal
import sys
import time
from pathlib import Path

import pytest

from gamba_warp.processes import Child

# Starts a process that would live for a minute, writes its number, and waits.
PARENT = """
import pathlib, subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
place = pathlib.Path(sys.argv[1])
place.with_suffix(".new").write_text(str(child.pid))
place.with_suffix(".new").rename(place)
time.sleep(60)
"""


def ended_with_its_child(path):
    """Runs ``PARENT`` until its child is there; whether that is gone a little later."""

    def look():
        if path.exists():
            raise KeyboardInterrupt  # the time is up at once, and not before

    with pytest.raises(KeyboardInterrupt):
        Child([sys.executable, "-c", PARENT, str(path)]).wait(look)
    stat = Path("/proc") / path.read_text() / "stat"
    for _ in range(30):
        try:
            state = stat.read_text().rsplit(")", 1)[1].split()[0]
        except OSError:
            return True
        if state == "Z":  # ended, and nobody has asked for it
            return True
        time.sleep(0.1)
    os.kill(int(path.read_text()), signal.SIGKILL)
    return False


def test_what_takes_too_long_is_ended_with_what_it_started(tmp_path):
    assert ended_with_its_child(tmp_path / "by group")


def test_a_process_ends_in_its_time_or_by_itself(tmp_path):
    looks = []
    sleeper = Child([sys.executable, "-c", "import time; time.sleep(60)"])
    assert sleeper.wait(lambda: looks.append(1), 0.5) is None and looks
    assert sleeper.poll().code == 128 + signal.SIGKILL
    with open(tmp_path / "said", "wb") as output:
        words = "import os; print('it', os.environ['OWN']); raise SystemExit(3)"
        child = Child([sys.executable, "-c", words], output, {"OWN": "x"})
        end = child.wait(lambda: None)
    assert (end.code, end.stopped) == (3, False) and end.seconds > 0
    assert end.peak_memory is None or end.peak_memory > 1e6
    assert (tmp_path / "said").read_text() == "it x\n"
