"""Commands in child processes: their output and end, and a request to stop."""

import os
import signal
import sys
import threading
import time

import pytest

from gamba_warp import processes

SCRIPT = """
import os, signal, sys, time
print(*sys.argv[1:], flush=True)
if sys.argv[1] == "wait":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(5))
    print("ready", flush=True)
    time.sleep(60)
sys.exit(3)
"""


@pytest.fixture(autouse=True)
def script(monkeypatch):
    monkeypatch.setattr(processes, "GAMBA", (sys.executable, "-c", SCRIPT))


def test_a_command_ends_with_its_code_and_output(tmp_path):
    with open(tmp_path / "said", "wb") as output:
        assert processes.run_gamba(["a", "b c"], output, ()) == 3
    assert (tmp_path / "said").read_text() == "a b c\n"


def test_a_request_to_stop_is_passed_on(tmp_path):
    received = []
    said = tmp_path / "said"

    def ask():
        while "ready" not in said.read_text():
            time.sleep(0.02)
        received.append(signal.SIGTERM)

    said.touch()
    thread = threading.Thread(target=ask)
    thread.start()
    with open(said, "wb") as output:
        assert processes.run_gamba(["wait"], output, received) == 5
    thread.join()


def test_a_child_ends_when_the_caller_is_interrupted(tmp_path, monkeypatch):
    started = []

    def interrupted(seconds):
        raise KeyboardInterrupt

    popen = processes.subprocess.Popen
    monkeypatch.setattr(processes.time, "sleep", interrupted)
    monkeypatch.setattr(
        processes.subprocess, "Popen", lambda *a, **k: started.append(popen(*a, **k)) or started[0]
    )
    with pytest.raises(KeyboardInterrupt), open(os.devnull, "wb") as output:
        processes.run_gamba(["wait"], output, ())
    assert started[0].returncode == -signal.SIGKILL
