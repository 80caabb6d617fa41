"""Names from archives, catalogues and datasets stay inside their folder, or raise."""

import pytest
from helpers.refusals import refused

from gamba_warp.untrusted.names import MAX_NAME, inside, plain_name

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
