"""For pytest, ``-p ptx.plugin``: tests take the CUDA path, their launches executed from PTX.

``GAMBA_PTX_SEED`` draws the order; ``GAMBA_PTX_APPROXIMATE`` is as ``Interpreter.approximate``.
"""

import os

import pytest

from .launch import interpreted

_OPTIONS = {
    name: int(os.environ.get(f"GAMBA_PTX_{name.upper()}", "0")) for name in ("seed", "approximate")
}
_seen = {"launches": 0, "instructions of warps": 0, "tests": 0}


@pytest.fixture(autouse=True)
def _from_ptx():
    with interpreted(**_OPTIONS) as machine:
        yield
    _seen["launches"] += len(machine.trace)
    _seen["instructions of warps"] += machine.steps
    _seen["tests"] += bool(machine.trace)
    assert not machine.findings, "\n".join(machine.findings)


def pytest_terminal_summary(terminalreporter):
    terminalreporter.write_line(f"from PTX: {_seen}")
