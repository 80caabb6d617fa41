"""Untrusted JSON, ``.npy`` files and numbers: valid values, or a one-line error."""

import io
import os
import zipfile
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import pytest
from helpers.refusals import refused, refused_at
from msgspec import Meta

from gamba_warp.untrusted.arrays import MAX_BYTES, read_array
from gamba_warp.untrusted.documents import (
    parse_document,
    read_bytes,
    read_document,
    read_lines,
    value_of,
)
from gamba_warp.untrusted.ranges import Seed, check_options, range_error, ranged


@pytest.mark.parametrize(
    "text, reason",
    [
        ("", "not valid JSON"),
        ("{", "not valid JSON"),
        ('{"a": NaN}', "not valid JSON"),
        ('{"a": -Infinity}', "not valid JSON"),
        ('{"a": 1e999}', "out of range"),
        ('{"a": "\ud800"}'.encode("utf-8", "surrogatepass"), "not valid JSON"),
        (b"\xff\xfe{", "not valid JSON"),
        ("[" * 40 + "]" * 40, "nested deeper than 32 levels"),
        ("[" * 10**6, "nested deeper than 32 levels"),
        ('{"a":' * 10**5, "nested deeper than 32 levels"),
        ("[1]", "Expected `object`"),
        ('{"a": "1"}', "Expected `int`"),
        ('{"a": -1}', "Expected `int` >= 0"),
    ],
)
def test_documents_that_are_refused(text, reason):
    assert reason in refused("^some file: ", parse_document, text, dict[str, Seed], "some file")


def test_documents_that_are_read(tmp_path):
    path = tmp_path / "a.json"
    path.write_bytes(b'\xef\xbb\xbf{"a": 5}')
    assert read_document(path, dict[str, Seed]) == {"a": 5}
    path.write_text("[" * 32 + "]" * 32)
    assert read_document(path, Any)


def test_lines_that_are_no_documents_are_passed_over(tmp_path):
    path = tmp_path / "a.jsonl"
    path.write_bytes(b'{"a": 1}\n' + b"[" * 10**5 + b'\n{"a": "b"}\n\xff\n\n{"a": 2}\n{"a": 3')
    assert list(read_lines(path, dict[str, Seed])) == [{"a": 1}, {"a": 2}]
    os.mkfifo(tmp_path / "pipe")
    for name, reason in (("pipe", "not a plain file"), ("none", "no such file")):
        refused(reason, lambda name: list(read_lines(tmp_path / name, Any)), name)


def test_the_value_of_an_option_is_json_or_the_text_itself():
    for text in ("word", "[1", "[" * 10**5, "\ud800", "NaN"):
        assert value_of(text) == text
    assert value_of("[1, 2.5]") == [1, 2.5] and value_of('"1"') == "1" and value_of("true") is True


def test_only_plain_files_of_a_bounded_size_are_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "large").write_bytes(bytes(101))
    assert read_bytes(tmp_path / "large", 101) == bytes(101)
    reasons = {"pipe": "not a plain file", ".": "not a plain file", "none": "No such file"}
    reasons |= {"a\0b": "null", "x" * 5000: "too long", "large": "over"}
    for name, reason in reasons.items():
        refused(reason, read_bytes, tmp_path / name, 100)


@pytest.mark.parametrize(
    "value, limits, words",
    [
        (5, Meta(ge=5, le=5), None),
        (4, Meta(ge=5), "must be at least 5"),
        (0.0, Meta(gt=0, lt=1), "must be above 0 and below 1"),
        (1e4, Meta(gt=0, le=1000), "must be above 0 and at most 1,000"),
        (float("nan"), Meta(ge=0), "must be at least 0"),
        (float("inf"), Meta(ge=0), "must be at least 0"),
        (float("inf"), Meta(), "must be finite"),
        (10**400, Meta(le=10), "must be at most 10"),
    ],
)
def test_ranges(value, limits, words):
    assert range_error(value, limits) == words


def test_options_and_arguments_are_checked_by_their_declarations():
    @dataclass
    class Options:
        warm_up: Annotated[int, Meta(ge=1)] | None = None
        fractions: tuple[Annotated[float, Meta(ge=0, le=1)], ...] = ()
        flag: bool = True
        free: float = 0.0

    called = []

    @ranged
    def command(options: Options, /, seed: Seed = 0, *, rest: str = "") -> int:
        called.append(seed)
        return seed

    globals()["Options"] = Options  # the declarations are looked up by name
    check_options(Options(warm_up=None, fractions=(0, 1), free=float("nan")))
    assert command(Options(), 7) == 7 and called == [7]
    for options, seed, words in (
        (Options(warm_up=0), 0, "--warm-up 0: must be at least 1"),
        (Options(fractions=(0.5, 2)), 0, "--fractions 2: must be at least 0 and at most 1"),
        (Options(), -1, "--seed -1: must be at least 0 and at most 4,294,967,295"),
        (Options(), 10**10**4, "--seed huge: must be"),
    ):
        assert refused(None, command, options, seed).startswith(words) and called == [7]


WANTED = np.arange(6.0).reshape(3, 2) + 0.5


def header(text):
    text = text.encode("latin-1")
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


def stored(array, **options):
    file = io.BytesIO()
    np.save(file, array, **options)
    return file.getvalue()


def a_zip():
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("arr_0.npy", stored(WANTED))
    return file.getvalue()


@pytest.mark.parametrize("dtype", ["<f8", ">f8", "<f4", ">f4", "<f2", "<i4", ">i8", "u1"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_every_kind_of_number_is_read(tmp_path, dtype, order):
    path = tmp_path / "a.npy"
    path.write_bytes(stored(np.array(WANTED, dtype=dtype, order=order)))
    got = read_array(path, (3, 2))
    assert got.dtype == np.float64
    np.testing.assert_array_equal(got, WANTED.astype(dtype))


@pytest.mark.parametrize(
    "content, reason",
    [
        (b"", "header"),
        (b"nonsense", "header"),
        (stored(WANTED)[:90], "header"),
        (stored(WANTED)[:-1], "47 bytes"),
        (stored(WANTED) + b"1", "49 bytes"),
        (stored(WANTED.T), "its header states 2x3"),
        (stored(np.float64(1)), "a single number"),
        (stored(np.array([["a"] * 2] * 3)), "not numbers"),
        (stored(WANTED > 0), "not numbers"),
        (stored(WANTED.astype(object), allow_pickle=True), "not numbers"),
        (stored(WANTED.astype(complex)), "not numbers"),
        (stored(np.where(WANTED > 2, np.nan, WANTED)), "finite"),
        (stored(np.where(WANTED > 2, np.inf, WANTED)), "finite"),
        (a_zip(), "header"),
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': (100000000000,)}\n"), "states"),
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': (3, -2)}\n"), "states"),
        (header("{'descr': '(9,9)<f8', 'fortran_order': False, 'shape': (3, 2)}\n"), "not numbers"),
        (header("{'descr': '<f8', 'shape': (3, 2)}\n"), "header"),
        (header("(" * 5000), "header"),
        (header("__import__('os').system('true')"), "header"),
        (b"\x93NUMPY\x09\x00" + stored(WANTED)[8:], "header"),
        (b"x" * (MAX_BYTES + 1), "1 MB"),
    ],
    ids=range(22),
)
def test_an_invalid_array_is_one_line(tmp_path, content, reason):
    path = tmp_path / "a.npy"
    path.write_bytes(content)
    refused_at(path, reason, read_array, path, (3, 2))


def test_an_unreadable_path_is_one_line(tmp_path):
    for path in (tmp_path, tmp_path / "none.npy", tmp_path / ("n" * 300), tmp_path / "a\0b"):
        refused("cannot be read", read_array, path, (3, 2))
