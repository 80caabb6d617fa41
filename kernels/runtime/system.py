"""Signals and cores of this process."""

from __future__ import annotations

import os
import signal


def end_signals() -> list[signal.Signals]:
    """Signals that ask this process to end: SIGTERM, and SIGHUP unless ignored, as under nohup."""
    ignored = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    return [signal.SIGTERM] if ignored else [signal.SIGTERM, signal.SIGHUP]


def cores() -> int:
    """Number of cores this process may use; on macOS, all of them."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
