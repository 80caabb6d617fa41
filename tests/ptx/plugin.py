"""For pytest, ``-p ptx.plugin``: tests take the CUDA path, their launches executed from PTX.

``GAMBA_PTX_SEED`` draws the order; ``GAMBA_PTX_APPROXIMATE`` and ``GAMBA_PTX_CONTRACT`` are as
``Interpreter`` takes them.
"""

import os

import pytest

from .launch import interpreted

_OPTIONS = {x: int(os.environ.get(f"GAMBA_PTX_{x.upper()}", "0")) for x in ("seed", "approximate")}
_OPTIONS["contract"] = os.environ.get("GAMBA_PTX_CONTRACT", "")
# These ask for what only the CPU's kernels have, as their order of lists.
_OF_THE_CPU = ("test_many.py", "[cpu", "_cuda.py", "test_counts_tell")
_seen = {"tests": 0, "launches": 0, "instructions of warps": 0}


def pytest_collection_modifyitems(items):
    from helpers.scan import EX2, approximate  # after conftest.py, which has its asserts rewritten

    approximate["decay"] = EX2 if _OPTIONS["approximate"] else 0.0
    for item in items:
        if any(part in item.nodeid for part in _OF_THE_CPU):
            item.add_marker(pytest.mark.skip(reason="of the CPU's kernels"))


@pytest.fixture(autouse=True)
def _from_ptx():
    with interpreted(**_OPTIONS) as machine:
        yield
    _seen["tests"] += bool(machine.trace)
    _seen["launches"] += len(machine.trace)
    _seen["instructions of warps"] += machine.steps
    assert not machine.findings, "\n".join(machine.findings)


def pytest_terminal_summary(terminalreporter):
    terminalreporter.write_line(f"from PTX: {_seen}")
