"""Hostile names, and zip archives: links, false sizes, bombs, damage."""

import stat
import tracemalloc
import zipfile

import pytest
from helpers.refusals import refused, refused_at

from gamba_warp.untrusted import archives
from gamba_warp.untrusted.archives import open_zip
from gamba_warp.untrusted.names import MAX_NAME, inside, plain_name


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


BAD = [
    *("", " ", ".", "..", "../x", "a/../b", "a/..", "/x", "//x"),
    *("C:/x", "C:x", "\\\\host\\x", "a\\b"),
    *("a\0b", "a\nb", "a\x7f", "a\u2028b", "\ud800", "a" * (MAX_NAME + 1), "a/" * 600),
    *(None, 3, ["a"], {"a": 1}, True),
]


@pytest.mark.parametrize("name", BAD, ids=ascii)
def test_bad_names_are_one_line(tmp_path, name):
    for function in (lambda: inside(tmp_path, name, "x.json"), lambda: plain_name(name, "x.json")):
        assert len(refused(r"^x\.json: ", function)) < 200


def test_good_names(tmp_path):
    good = "a.png", "./a.png", "images/a.png", "Café chair", "a..b", "-", "~", "a" * MAX_NAME
    for name in good:
        assert inside(tmp_path, name, "x") == tmp_path / name
    assert plain_name("chair-1.obj", "x") == "chair-1.obj"
    for name in ("a/b", "./a", "a/", ".hidden"):
        refused(None, plain_name, name, "x")


def test_links_may_not_leave_the_folder(tmp_path):
    folder = tmp_path / "data"
    (folder / "images").mkdir(parents=True)
    (tmp_path / "secret.png").touch()
    (folder / "out").symlink_to(tmp_path)
    (folder / "in").symlink_to(folder / "images")
    (folder / "round").symlink_to(folder / "round")
    for name in ("out/secret.png", "out/none.png", "out"):
        refused("leaves", inside, folder, name, "x")
    assert inside(folder, "in/a.png", "x") == folder / "in" / "a.png"
    inside(folder, "round/a.png", "x")  # opening it fails with an error
    (tmp_path / "link").symlink_to(folder)
    assert inside(tmp_path / "link", "images/a.png", "x")  # the folder itself may be one
