"""Fuzzing of every reader with hypothesis, and tests of the detection of failures.

``make hostile MINUTES=30 SEED=2`` runs longer. A failing case, after shrinking, is written to
``out/hostile/``; as a file in ``corpus/`` it is run by every ``make test``.
"""

import functools
import os
import tempfile
import time
from collections import Counter
from pathlib import Path

import hypothesis
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from msgspec.structs import replace

from gamba_warp.errors import MOST_LETTERS, UserError, one_line
from gamba_warp.untrusted.children import end_idle

from .case import Entry, read_case, valid_case, write_case
from .child import BAD, GOOD, run_case
from .drawing import cases
from .readers import READERS, REFUSED

ROOT = Path(__file__).resolve().parents[2]
CORPUS = sorted((Path(__file__).parent / "corpus").glob("*.json"))
SEED = int(os.environ.get("GAMBA_HOSTILE_SEED", "1"))
MINUTES = float(os.environ.get("GAMBA_HOSTILE_MINUTES", "0"))  # for all readers
EXAMPLES = 10  # cases of a reader per fraction, without a given time
FRACTIONS = sum(reader.fraction for reader in READERS.values())
TRIED = [name for name, reader in READERS.items() if reader.fraction]
WANTED = {
    **dict.fromkeys(("raises", "exits"), "exception"),
    **dict.fromkeys(("opens", "starts", "writes"), "outside"),
    **{"lines": "line", "memory": "memory", "dies": "death", "wrong": "unsound"},
}


@pytest.fixture(scope="module")
def base():
    """A folder for child processes, in memory to spare the disk."""
    memory = Path("/dev/shm")
    end_idle()
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        yield Path(folder)
        end_idle()


@functools.cache
def valid_cases(reader):
    """A case of each of a reader's valid files."""
    made = READERS[reader].seeds().items()
    mains = ("" if READERS[reader].whole else next(iter(files)) for _, files in made)
    return [valid_case(reader, seed, main, files) for (seed, files), main in zip(made, mains)]


@functools.cache
def failure(signature):
    """An exception type for each kind of failure, so that hypothesis shrinks each separately."""
    return type("Failure", (AssertionError,), {"__doc__": signature})


def fuzz(reader, base, seed, examples, out, counts):
    """Draw cases of a reader; write the smallest failing one to a folder, and raise it."""

    @hypothesis.seed(seed)
    @settings(
        max_examples=examples,
        phases=(Phase.generate, Phase.shrink),
        database=None,
        deadline=None,
        report_multiple_bugs=False,
        suppress_health_check=list(HealthCheck),
    )
    @given(cases(valid_cases(reader)))
    def holds(case):
        verdict = run_case(case, base)
        counts[verdict.outcome] += 1
        if verdict.bad:
            path = out / f"{reader}.json"
            write_case(case, path, *verdict)
            done = "; ".join(case.mutations)
            text = f"{reader}, {case.seed} ({done}): {verdict.outcome}, {verdict.text}; {path}"
            raise failure(verdict.signature())(text)

    holds()


@pytest.mark.parametrize("reader", TRIED)
def test_hostile_files(reader, base):
    """Every case gives a valid result, or an error with one line that names the file."""
    fraction, counts, start = READERS[reader].fraction, Counter(), time.monotonic()
    # A rejected seed would test nothing after the first check.
    told = {case.seed: run_case(case, base) for case in valid_cases(reader)}
    for seed, verdict in told.items():
        wanted = "refused" if (reader, seed) in REFUSED else "sound"
        assert verdict.outcome == wanted, f"{reader}, {seed}: {verdict}"
    out, end = ROOT / "out" / "hostile", start + 60 * MINUTES * fraction / FRACTIONS
    turn = 0
    while turn == 0 or time.monotonic() < end:
        examples = 100 if MINUTES else EXAMPLES * fraction
        fuzz(reader, base, f"{SEED} {reader} {turn}", examples, out, counts)
        turn += 1
    cases_a_second = counts.total() / (time.monotonic() - start)
    bad = sum(counts[name] for name in BAD)
    figures = [counts.total(), counts["sound"], counts["refused"], bad, round(cases_a_second)]
    print(f"\n| {reader} | {' | '.join(map(str, figures))} |")
    assert counts.total() >= 10


def faulty_case(what):
    return valid_case("faulty", "text", "a.txt", {"a.txt": what.encode(), "b.txt": b"unused"})


def test_each_fault_is_seen(base):
    got = {name: run_case(faulty_case(name), base).outcome for name in WANTED}
    assert got == WANTED
    assert run_case(faulty_case("nothing"), base).outcome == "sound"


def test_a_hang_is_seen(base):
    run_case(faulty_case("nothing"), base)
    assert run_case(faulty_case("hangs"), base, seconds=0.5).outcome == "hang"


def test_a_failure_is_found_and_made_small(base, tmp_path):
    """The reader fails if the third byte is not ASCII."""
    with pytest.raises(AssertionError, match="exception, KeyError at"):
        fuzz("faulty", base, 0, 400, tmp_path, Counter())
    small = read_case(tmp_path / "faulty.json")
    assert len(small.mutations) <= 2
    assert len(small.files["a.txt"].data) <= len("valid text")


@pytest.mark.parametrize("kind", ["pipe", "folder", "link", "missing"])
def test_what_is_no_file_is_refused(base, kind):
    """In place of each file of every reader: a pipe and /dev/zero never end."""
    told = {}
    for reader in TRIED:
        case = valid_cases(reader)[0]
        for name in list(case.files)[:3]:
            changed = {name: Entry(b"/dev/zero", kind)} if kind != "missing" else {}
            files = {other: entry for other, entry in case.files.items() if other != name}
            verdict = run_case(replace(case, files=files | changed), base)
            if verdict.bad:
                told[reader, name] = verdict
    assert not told


@pytest.mark.parametrize("path", CORPUS, ids=lambda path: path.stem)
def test_what_was_found_once_stays_mended(base, path):
    """``corpus/`` holds cases that once failed; each is judged again."""
    verdict = run_case(read_case(path), base)
    assert verdict.outcome in GOOD, verdict


@pytest.mark.parametrize("text", ["a\nb", "a\x1b[31mb", "\ud800", "x" * 10**6, "\r\n", "a\u2028b"])
def test_an_error_is_one_line(text):
    line = str(UserError(f"file.png: {text} end"))
    assert line.startswith("file.png: ") and line.endswith("end")
    assert line.isprintable()
    assert len(line) <= MOST_LETTERS


def test_an_error_keeps_what_is_valid():
    assert one_line("café.png: ungültig") == "café.png: ungültig"
