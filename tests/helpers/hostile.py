"""A reader that does what the file says, so that the fuzzer has something to find."""

import os
import signal
import time
from pathlib import Path

import numpy as np

from gamba_warp.errors import UserError
from gamba_warp.hostile.readers import READERS, Reader


def faulty(path: Path, out: Path):
    """A reader that does what the file says."""
    what = path.read_text()
    if what == "raises":
        raise KeyError("no such key")
    if what == "lines":
        raise UserError("something is wrong")
    if what == "tells":
        raise ValueError(f"{path} and {out} are wrong")
    if what == "opens":
        (out / ".." / ".." / "canary" / "kept.txt").read_text()
    if what == "starts":
        os.system("true")
    if what == "writes":
        (out.parent.parent / "new.txt").write_text("x")
    if what == "memory":
        np.ones(1 << 30)
    if what == "dies":
        os.kill(os.getpid(), signal.SIGSEGV)
    if what == "hangs":
        time.sleep(100)
    if what == "exits":
        raise SystemExit
    return what


def wrong(result, path, out):
    """What is unsound in ``faulty``'s result."""
    return "it says so" if result == "wrong" else None


def add_faulty():
    """Adds the reader, in a child process of the fuzzer."""
    READERS["faulty"] = Reader("faulty", faulty, wrong, dict)
