"""Starts Warp quietly."""

from __future__ import annotations

import os
import sys
import tempfile

import warp as wp


def start_without_gpu() -> None:
    """Starts Warp and holds back its note on a missing CUDA driver, which is no fault on a CPU."""
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
    sys.stderr.write("".join(line for line in lines if "NVIDIA CUDA driver" not in line))
