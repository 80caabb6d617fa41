"""Functions that Linux, macOS and Windows do not all have, with substitutes."""

from __future__ import annotations

import os
import signal


def is_own(found: os.stat_result) -> bool:
    """True if a file belongs to this user; always on Windows, whose users have no numbers.

    Args:
        found: what ``os.stat`` says of the file.
    """
    return not hasattr(os, "geteuid") or os.geteuid() == found.st_uid


def end_signals() -> list[signal.Signals]:
    """Signals that ask this process to end: SIGTERM, and SIGHUP where it exists.

    A SIGHUP that is ignored, as below nohup, is left out: it is to stay so.
    """
    found = [signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        found.append(signal.SIGHUP)
    return found


def cores() -> int:
    """Number of cores this process may use; all of them where the system does not say."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
