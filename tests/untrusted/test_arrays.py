"""Small ``.npy`` files with a false size, type or format."""

import io
import zipfile

import numpy as np
import pytest
from helpers.refusals import refused, refused_at

from gamba_warp.untrusted.arrays import MAX_BYTES, read_array

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
def test_lies_are_one_line(tmp_path, content, reason):
    path = tmp_path / "a.npy"
    path.write_bytes(content)
    refused_at(path, reason, read_array, path, (3, 2))


def test_what_is_no_file(tmp_path):
    for path in (tmp_path, tmp_path / "none.npy", tmp_path / ("n" * 300), tmp_path / "a\0b"):
        refused("cannot be read", read_array, path, (3, 2))
