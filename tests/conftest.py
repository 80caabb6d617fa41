"""What holds for all tests: rewritten asserts in helpers, the marker ``gpu``, a fixed seed."""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import torch

# This must come before the first import of helpers, so that a failing assert in them shows values.
pytest.register_assert_rewrite("helpers")

from helpers.browser import browser, browser_page  # noqa: E402, F401

# No test fetches a matting model, or uses one that rembg keeps on this machine.
os.environ["GAMBA_OFFLINE"] = "1"
os.environ["U2NET_HOME"] = os.devnull

# A script that runs us in the background has us ignore Ctrl-C, and so every process of a test too.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Minutes of the run; GAMBA_STRESS_MINUTES asks for a longer one.
MINUTES = float(os.environ.get("GAMBA_STRESS_MINUTES", "2"))


class Fuzz:
    """A process that starts at once, with one child, and gives way to the tests."""

    def __init__(self) -> None:
        self.out = Path(tempfile.mkdtemp(prefix="gamba-fuzz-"))
        options = ["--seed", "1", "--minutes", str(MINUTES), "--threads", "1"]
        command = [sys.executable, "-m", "gamba_warp", "stress", "files", *options]
        with open(self.out / "log.txt", "w") as log:
            self._process = subprocess.Popen(
                [*command, "--shrink-seconds", "5", "--out", str(self.out)],
                stdout=log,
                stderr=subprocess.STDOUT,
                preexec_fn=lambda: os.nice(10),
            )

    def wait(self) -> int:
        """Waits for the end; returns the exit code."""
        return self._process.wait(timeout=60 * MINUTES + 300)

    def end(self) -> None:
        """Ends the process, if it still runs, and removes its files."""
        self._process.terminate()
        self._process.wait()
        shutil.rmtree(self.out, ignore_errors=True)


FUZZ: pytest.StashKey[Fuzz] = pytest.StashKey()


def pytest_collection_modifyitems(items):
    if torch.cuda.is_available():
        return
    for item in items:
        if "gpu" in item.keywords:
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))


def pytest_collection_finish(session):
    """Starts the fuzzer if its test is to run: most tests leave a core to it."""
    wanted = any(item.name == "test_hostile_files" for item in session.items)
    if wanted and not session.config.option.collectonly:
        session.config.stash[FUZZ] = Fuzz()


def pytest_unconfigure(config):
    if FUZZ in config.stash:
        config.stash[FUZZ].end()


@pytest.fixture
def fuzz(request):
    """The run of ``gamba stress files`` that goes on beside the other tests."""
    return request.config.stash[FUZZ]


@pytest.fixture
def one_thread():
    """Pictures of a few pixels take longer on several threads than on one."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def no_nohup():
    """SIGHUP ends a process, as it does not where the tests themselves run below nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)
