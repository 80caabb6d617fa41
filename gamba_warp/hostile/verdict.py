"""How a case ended, and what of that is bad."""

from __future__ import annotations

from dataclasses import dataclass

GOOD = {
    "sound": "read, and what was read is sound",
    "refused": "refused with one line that names the file",
}
BAD = {
    "exception": "an exception that is no UserError: the user would see a traceback",
    "line": "refused, but with several lines, an over-long one, or one that names no file",
    "unsound": "accepted, but not finite, out of range, or not what the file holds",
    "outside": "something outside the case's folder was opened, changed or started",
    "memory": "over 2 GB were taken or asked for",
    "hang": "no end within the time limit",
    "death": "the process died",
}
OUTCOMES = (*GOOD, *BAD)


@dataclass(frozen=True)
class Verdict:
    """How a case ended.

    Attributes:
        outcome: one of ``OUTCOMES``.
        text: a line about it.
        seconds: time that reading took.
        peak: memory that reading took at most, bytes.
        printed: whether a library wrote to the terminal meanwhile.
    """

    outcome: str
    text: str = ""
    seconds: float = 0.0
    peak: int = 0
    printed: bool = False

    @property
    def bad(self) -> bool:
        """Whether the case failed."""
        return self.outcome in BAD
