"""Quick and quiet starts: of Warp, and of the first call of an operator."""

from __future__ import annotations

import os
import sys
import tempfile
from typing import Any, TypeVar

import warp as wp

# A missing driver is no fault on a CPU; and setup.cfg allows no Warp that has given up Python 3.10.
_HELD_BACK = ("NVIDIA CUDA driver", "Support for Python 3.10 is deprecated")
_DISABLED = "__dynamo_disable"  # where torch keeps a function that its compiler passes over
Operator = TypeVar("Operator")


def start_without_gpu() -> None:
    """Starts Warp and holds back its notes on a missing CUDA driver and on Python 3.10."""
    try:
        saved = os.dup(2)
    except OSError:  # stderr is closed, so nobody would see the note
        return wp.init()
    with tempfile.TemporaryFile() as held:
        os.dup2(held.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(saved, 2)
            os.close(saved)
        held.seek(0)
        lines = held.read().decode(errors="replace").splitlines(keepends=True)
    told = (line for line in lines if not any(note in line for note in _HELD_BACK))
    sys.stderr.write("".join(told))


def without_compiler(operator: Operator) -> Operator:
    """Lets an operator run without torch's compiler while nobody has loaded that.

    The body of a ``torch.library.custom_op`` is hidden from ``torch._dynamo``, and for that the
    first call imports it: 1.5 s of a command that compiles nothing. Until something else imports
    it, the body is called as it is; from then on everything is as torch made it. Where a release
    of torch keeps these things elsewhere, nothing changes.

    Args:
        operator: what ``torch.library.custom_op`` returns.

    Returns:
        The same operator.
    """
    for hidden in getattr(operator, "_backend_fns", {}).values():
        body = getattr(hidden, "__wrapped__", None)
        if body is not None and not hasattr(body, _DISABLED):
            setattr(body, _DISABLED, _plain_call(body, hidden))
    return operator


def _plain_call(body: Any, hidden: Any) -> Any:
    def call(*args: Any, **kwargs: Any) -> Any:
        if "torch._dynamo" not in sys.modules:
            return body(*args, **kwargs)
        vars(body).pop(_DISABLED, None)  # torch puts its own there, once
        return hidden(*args, **kwargs)

    return call
