"""Configuration of all tests: rewritten asserts in helpers, the marker ``gpu``, a fixed seed."""

import contextlib
import gc
import os
import shutil
import signal
import tempfile
from pathlib import Path

import pytest
import torch

# This must come before the first import of helpers, so that a failing assert in them shows values.
pytest.register_assert_rewrite("helpers")

from helpers.browser import browser, browser_page  # noqa: E402, F401
from ptx.launch import interpreted  # noqa: E402
from ptx.machine import Missing  # noqa: E402

from gamba_warp.devices import use_fastest_products  # noqa: E402

# No test downloads a matting model, or uses one cached by rembg on this machine.
os.environ["GAMBA_OFFLINE"] = "1"
os.environ["U2NET_HOME"] = os.devnull

# Commands set this for their process; so results do not depend on the order of the tests.
use_fastest_products()

# A script that runs pytest in the background makes every process of a test ignore Ctrl-C, too.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Collecting the tests makes millions of objects and no garbage, which is visited again and again.
gc.disable()


def pytest_collection_finish():
    gc.enable()
    gc.freeze()


def pytest_collection_modifyitems(items):
    if torch.cuda.is_available():
        return
    for item in items:
        if "gpu" in item.keywords:
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))


def pytest_unconfigure():
    """Remove NVRTC's precompiled headers, 80 MB, which remain after ``os._exit``."""
    gc.unfreeze()  # nanobind reports what Python does not collect at its end
    for folder in Path(tempfile.gettempdir()).glob(f"__nvrtc_auto_pch_{os.getpid()}_*"):
        shutil.rmtree(folder, ignore_errors=True)


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_call(item):
    """Skip tests that execute PTX (tests/ptx) without a compiler or NVRTC."""
    outcome = yield
    if outcome.excinfo and isinstance(outcome.excinfo[1], Missing):
        outcome.force_exception(pytest.skip.Exception(str(outcome.excinfo[1])))


@pytest.fixture
def from_ptx():
    """Function that makes CPU tensors take the CUDA path from then on, executed from PTX."""
    machines = []
    with contextlib.ExitStack() as stack:
        yield lambda: machines.append(stack.enter_context(interpreted()))
    findings = [line for machine in machines for line in machine.findings]
    assert not findings, "\n".join(findings)


@pytest.fixture
def one_thread():
    """Use one thread, which is faster for images of a few pixels."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def no_nohup():
    """Let SIGHUP end a process, even if the tests themselves run under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)
