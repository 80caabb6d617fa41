"""Hostile zip, tar and ar archives: names, links, false sizes, bombs, damage."""

import bz2
import gzip
import io
import lzma
import random
import stat
import tarfile
import time
import tracemalloc
import zipfile
import zlib

import pytest
from helpers.refusals import refused_at

from gamba_warp.errors import UserError
from gamba_warp.untrusted import archives
from gamba_warp.untrusted.archives import open_tar, open_zip, read_ar


def make_zip(path, members, method=zipfile.ZIP_DEFLATED):
    """Write members, whose names may be ZipInfo objects."""
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in members:
            archive.writestr(name, data)
    return path


def linked(name):
    info = zipfile.ZipInfo(name)
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    return info


def unpack(path, out):
    with open_zip(path) as archive:
        for name in archive.names:
            archive.unpack(name, out)
        return archive.names


def test_a_zip_is_unpacked_inside_its_folder(tmp_path):
    path = make_zip(tmp_path / "a.zip", [("a.txt", "one"), ("b/", ""), ("b/c/d.txt", "two")])
    assert unpack(path, tmp_path / "out") == ["a.txt", "b/c/d.txt"]
    assert (tmp_path / "out/b/c/d.txt").read_text() == "two"
    with open_zip(path) as archive:
        assert archive.read("a.txt", 10) == b"one"
        refused_at(path, "is over", archive.read, "a.txt", 2)
        refused_at(path, "holds no 'x'", archive.read, "x", 2)


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize(
    "members, reason",
    [
        ([("../x", "")], "leaves"),
        ([("a/../../x", "")], "leaves"),
        ([("/x", "")], "relative"),
        ([("C:/x", "")], "relative"),
        ([("a\\..\\x", "")], "relative"),
        ([("a" * 300, "")], "too long"),
        ([("a\nb", "")], "control"),
        ([(linked("a"), "/etc/passwd")], "link"),
        ([("a", "1"), ("a", "2")], "twice"),
        ([("A/x", "1"), ("a/X", "2")], "twice"),
        ([(f"{i}", "") for i in range(6)], "6 members"),
    ],
    ids=range(11),
)
def test_bad_members_are_refused_before_any_is_unpacked(tmp_path, monkeypatch, members, reason):
    monkeypatch.setattr(archives, "MAX_MEMBERS", 5)
    path = make_zip(tmp_path / "a.zip", [("good", "1"), *members][-6:])
    refused_at(path, reason, unpack, path, tmp_path / "out")
    assert [p.name for p in tmp_path.iterdir()] == ["a.zip"]


def test_bombs_and_odd_zips(tmp_path, monkeypatch):
    monkeypatch.setattr(archives, "_SMALL", 1000)
    path = make_zip(tmp_path / "bomb.zip", [("a", b"0" * 1_000_000)])
    refused_at(path, "100 times its size", unpack, path, tmp_path / "out")
    path = make_zip(tmp_path / "b.zip", [("a", b"0" * 99)], zipfile.ZIP_LZMA)
    refused_at(path, "unsupported compression", unpack, path, tmp_path / "out")
    path = make_zip(tmp_path / "c.zip", [("a", b"0" * 99)])
    data = bytearray(path.read_bytes())
    data[data.rindex(b"PK\1\2") + 8] |= 1  # the flag of a password
    path.write_bytes(data)
    refused_at(path, "encrypted", unpack, path, tmp_path / "out")
    monkeypatch.setattr(archives, "_DIRECTORY", 10)
    refused_at(path, "too many members", unpack, path, tmp_path / "out")
    path = make_zip(tmp_path / "d.zip", [("a/b", "1"), ("a", "1")])
    monkeypatch.undo()
    refused_at(path, "", unpack, path, tmp_path / "out")  # a file where a folder is


def test_a_zip_that_lies_about_a_size_fills_no_memory(tmp_path):
    path = make_zip(tmp_path / "a.zip", [("a", b"0" * 50_000_000)])
    data = bytearray(path.read_bytes())
    place = data.rindex(b"PK\1\2") + 24  # size in the table of contents
    data[place : place + 4] = (10).to_bytes(4, "little")
    path.write_bytes(data)
    tracemalloc.start()
    try:
        with open_zip(path) as archive:
            refused_at(path, "CRC", archive.read, "a", 100)
        refused_at(path, "CRC", unpack, path, tmp_path / "out")
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
    finally:
        tracemalloc.stop()


def make_ar(path, members):
    with path.open("wb") as file:
        file.write(b"!<arch>\n")
        for name, data, size in members:
            file.write(f"{name:<16}{0:<12}{0:<6}{0:<6}{'100644':<8}{size:<10}`\n".encode())
            file.write(data + b"\n" * (len(data) % 2))
    return path


def read_data(path):
    out = io.BytesIO()
    return read_ar(path, "data.tar", out), out.getvalue()


def test_ar_sizes(tmp_path):
    path = tmp_path / "a.deb"
    make_ar(path, [("debian-binary", b"2.0", 3), ("data.tar.xz", b"12345", 5)])
    assert read_data(path) == ("data.tar.xz", b"12345")
    for size in ("-60", "-1", "1e3", "", "0x10", "9999999999"):
        make_ar(path, [("data.tar.xz", b"12345", size)])
        refused_at(path, "invalid size", read_data, path)
        make_ar(path, [("first", b"2.0", size), ("data.tar.xz", b"12345", 5)])
        started = time.monotonic()
        refused_at(path, "", read_data, path)
        assert time.monotonic() - started < 1  # -60 looped forever
    whole = make_ar(path, [("data.tar.xz", b"12345" * 9, 45)]).read_bytes()
    for length in (0, 7, 8, 30, 67, 68, 90):
        path.write_bytes(whole[:length])
        refused_at(path, "", read_data, path)
    refused_at(tmp_path, "no such file", read_data, tmp_path)


def make_tar(members, form=tarfile.PAX_FORMAT):
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w", format=form) as tar:
        for name, data, kind in members:
            info = tarfile.TarInfo(name)
            info.type, info.size = kind, len(data)
            info.linkname = "/etc/passwd" if kind in (tarfile.SYMTYPE, tarfile.LNKTYPE) else ""
            tar.addfile(info, io.BytesIO(data))
    return file.getvalue()


def read_tar(data, folder):
    with open_tar(io.BytesIO(data), "a.tar", folder) as members:
        return {member.name: member.file.read() for member in members}


PLAIN = [("./a", b"one", tarfile.REGTYPE), ("b/c", b"two", tarfile.REGTYPE)]


def test_tars_packed_in_any_way(tmp_path):
    odd = [("l", b"", tarfile.SYMTYPE), ("h", b"", tarfile.LNKTYPE), ("d", b"", tarfile.CHRTYPE)]
    plain = make_tar([("./", b"", tarfile.DIRTYPE), *odd, *PLAIN])
    for pack in (bytes, gzip.compress, bz2.compress, lzma.compress):
        assert read_tar(pack(plain), tmp_path) == {"./a": b"one", "b/c": b"two"}
    refused_at("a.tar", "zstd", read_tar, b"\x28\xb5\x2f\xfd" + plain, tmp_path)
    assert not list(tmp_path.iterdir())


def test_bad_tars(tmp_path, monkeypatch):
    for name in ("../x", "/x", "a/../../x"):
        data = make_tar([(name, b"", tarfile.REGTYPE)])
        refused_at("a.tar", "", read_tar, data, tmp_path)
    negative = bytearray(make_tar(PLAIN, tarfile.GNU_FORMAT))
    negative[124:136] = b"\xff" * 10 + b"\xfc\x00"  # the size as a number of 12 bytes: -1024
    negative[148:156] = b" " * 8
    negative[148:156] = b"%06o\0 " % sum(negative[:512])
    refused_at("a.tar", "size", read_tar, bytes(negative), tmp_path)
    long_name = bytearray(make_tar([("a" * 150, b"", tarfile.REGTYPE)], tarfile.GNU_FORMAT))
    long_name[124:136] = b"77777777777\0"
    long_name[148:156] = b" " * 8
    long_name[148:156] = b"%06o\0 " % sum(long_name[:512])
    refused_at("a.tar", "a header of", read_tar, bytes(long_name), tmp_path)
    whole = make_tar([("a", b"0" * 3_000, tarfile.REGTYPE)])
    for length in range(512, 512 + 3_000, 300):  # the end is missing when the member is read
        refused_at("a.tar", "", read_tar, whole[:length], tmp_path)
    bomb = make_tar([("a", b"0" * 3_000_000, tarfile.REGTYPE)])
    monkeypatch.setattr(archives, "_SMALL", 1000)
    for pack in (gzip.compress, bz2.compress, lzma.compress):
        refused_at("a.tar", "100 times its size", read_tar, pack(bomb), tmp_path)
    monkeypatch.setattr(archives, "MAX_MEMBERS", 1)
    refused_at("a.tar", "over 1 members", read_tar, make_tar(PLAIN), tmp_path)
    monkeypatch.setattr(archives, "_MEMORY", 1000)
    refused_at("a.tar", "Memory", read_tar, lzma.compress(make_tar(PLAIN)), tmp_path)
    assert not list(tmp_path.iterdir())


def test_damaged_tars_are_one_line(tmp_path):
    rng, plain = random.Random(1), make_tar(PLAIN * 3)
    for pack in (bytes, zlib.compress, gzip.compress, bz2.compress, lzma.compress):
        for _ in range(60):
            content = bytearray(pack(plain))
            for _ in range(rng.randint(1, 4)):
                content[rng.randrange(min(len(content), 600))] = rng.randrange(256)
            content = content[: rng.choice([len(content), rng.randrange(len(content))])]
            try:
                read_tar(bytes(content), tmp_path)
            except UserError as error:
                assert len(str(error).splitlines()) == 1
