"""Makes a failing case small: fewer files that differ from the sound ones, then fewer bytes."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Mapping

from .case import Case, Entry
from .verdict import Verdict

Run = Callable[[Case], Verdict]


def signature(case: Case, verdict: Verdict) -> str:
    """What makes two failures the same: reader, outcome, and its text without numbers and names."""
    text = verdict.text.split(": ")[0] if verdict.outcome == "exception" else verdict.text
    plain = re.sub(r"['\"/].*?(['\"]|$)|\d+", "#", text)[:60]
    return f"{case.reader}, {verdict.outcome}: {plain}"


def shrink(
    case: Case, verdict: Verdict, sound: Mapping[str, bytes], run: Run, seconds: float
) -> tuple[Case, Verdict]:
    """Looks greedily, for at most ``seconds``, for a smaller case that fails in the same way.

    Args:
        case: fails.
        verdict: how.
        sound: the sound files that it was made of.
        run: runs a case.
        seconds: time limit.

    Returns:
        The smallest case found, and how it fails.
    """
    wanted, end = signature(case, verdict), time.monotonic() + seconds

    def tried(candidates: Iterator[Case]) -> bool:
        """Takes the first candidate that fails in the same way."""
        nonlocal case, verdict
        for candidate in candidates:
            if time.monotonic() >= end:
                return False
            found = run(candidate)
            if found.bad and signature(candidate, found) == wanted:
                case, verdict = candidate, found
                return True
        return False

    while tried(_fewer(case, sound)):
        pass
    for name in list(case.files):
        parts = 2
        while parts <= 256 and time.monotonic() < end:
            parts = parts if tried(_shorter(case, name, sound.get(name), parts)) else 2 * parts
    return case, verdict


def _fewer(case: Case, sound: Mapping[str, bytes]) -> Iterator[Case]:
    """Cases without a file, or with one that is sound again."""
    for name, entry in case.files.items():
        if len(case.files) > 1 and name != case.main:
            files = {other: item for other, item in case.files.items() if other != name}
            yield Case(case.reader, case.seed, case.main, files, case.mutations)
        whole = Entry(data=sound[name]) if name in sound else None
        if whole is not None and whole != entry:
            yield _with(case, name, whole)


def _shorter(case: Case, name: str, whole: bytes | None, parts: int) -> Iterator[Case]:
    """Cases in which a part of a file is gone, or is as in the sound file."""
    entry = case.files[name]
    if entry.kind != "file" or entry.data == whole or not entry.data:
        return
    data, length = entry.data, max(1, len(entry.data) // parts)
    for at in range(0, len(data), length):
        yield _with(case, name, Entry(data=data[:at] + data[at + length :]))
        if whole is not None and len(whole) == len(data):
            mended = data[:at] + whole[at : at + length] + data[at + length :]
            if mended != data:
                yield _with(case, name, Entry(data=mended))


def _with(case: Case, name: str, entry: Entry) -> Case:
    return Case(case.reader, case.seed, case.main, {**case.files, name: entry}, case.mutations)
