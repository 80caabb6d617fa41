"""Starts Warp quietly."""

from __future__ import annotations

import os
import sys
import tempfile

import warp as wp


def start_without_gpu() -> None:
    """Starts Warp, holding back its native note on a missing CUDA driver: a CPU is no fault."""
    try:
        saved = os.dup(2)
    except OSError:  # stderr is closed: nobody to spare
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
