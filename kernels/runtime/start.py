"""Starts Warp quietly."""

from __future__ import annotations

import os
import sys
import tempfile

import warp as wp

# A missing driver is no fault on a CPU; and setup.cfg allows no Warp that has given up Python 3.10.
_HELD_BACK = ("NVIDIA CUDA driver", "Support for Python 3.10 is deprecated")


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
