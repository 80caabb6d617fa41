"""What tests of the interpreter need: a compiler and NVRTC."""

import pytest

from .machine import Missing


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_call(item):
    outcome = yield
    if outcome.excinfo and isinstance(outcome.excinfo[1], Missing):
        outcome.force_exception(pytest.skip.Exception(str(outcome.excinfo[1])))
