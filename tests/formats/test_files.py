"""Digests of files."""

import hashlib
import tracemalloc

import pytest

from gamba_warp.errors import UserError
from gamba_warp.files import check_sha256, sha256


def test_sha256_of_a_large_file_takes_little_memory(tmp_path):
    path = tmp_path / "large"
    with open(path, "wb") as file:
        file.write(b"begin")
        file.truncate(64 << 20)  # the rest is a hole, which reads as zeros
    tracemalloc.start()
    got = sha256(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert got == hashlib.sha256(b"begin" + bytes((64 << 20) - 5)).hexdigest()
    assert peak < 8 << 20, "bytes"


def test_sha256_names_the_file_that_cannot_be_read(tmp_path):
    with pytest.raises(UserError, match="absent: No such file"):
        sha256(tmp_path / "absent")
    with pytest.raises(UserError, match="Is a directory"):
        sha256(tmp_path)
    (tmp_path / "a").write_bytes(b"a")
    check_sha256(tmp_path / "a", "ca978112")
    with pytest.raises(UserError, match="SHA-256 is ca978112, expected ca978113"):
        check_sha256(tmp_path / "a", "ca978113")
