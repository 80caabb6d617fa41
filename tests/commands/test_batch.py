"""One loop over many inputs: what is noted, what stops it, and what is said at the end."""

from pathlib import Path

import pytest

from gamba_warp.batch import for_each, report
from gamba_warp.errors import UserError

FAILURES = {
    "user": UserError("user: bad\nmore"),
    "value": ValueError("wrong"),
    "diverged": FloatingPointError("not finite"),
    "disk": OSError("full"),
    "cuda": RuntimeError("out of memory"),
    "memory": MemoryError(),
}


def test_failures_are_noted_in_one_line_and_the_rest_go_on():
    done = []

    def function(name: str, item: str) -> None:
        if name in FAILURES:
            raise FAILURES[name]
        done.append((name, item))

    names = ["first", *FAILURES, "last"]
    before = [("early", "no such file")]
    failures = for_each({name: name for name in names}, function, "test", "item", before)
    assert done == [("first", "first"), ("last", "last")]
    assert failures is before and failures == [
        ("early", "no such file"),
        *[("user", "bad"), ("value", "wrong"), ("diverged", "not finite"), ("disk", "full")],
        *[("cuda", "out of memory"), ("memory", "MemoryError")],
    ]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), AttributeError("a defect")])
def test_defects_and_ctrl_c_stop_it_but_keep_what_was_noted(error):
    def function(name: str, item: int) -> None:
        raise {"a": ValueError("wrong"), "b": error}[name]

    failures: list[tuple[int, str]] = []
    with pytest.raises(type(error)):
        for_each({"a": 1, "b": 2, "c": 3}, function, "test", "item", failures)
    assert failures == [(1, "wrong")]


def test_the_report_names_failures_and_gives_the_exit_code(capsys):
    assert report(2, "file", [], Path("out")) == 0
    assert capsys.readouterr() == ("2 files, 0 failures, results in out\n", "")
    assert report(2, "file", [(Path("a.ply"), "empty")], Path("out")) == 1
    said = capsys.readouterr()
    assert said.err == "gamba: failed: a.ply: empty\n" and "1 failures" in said.out
