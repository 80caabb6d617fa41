"""Loop over many inputs: recorded failures, fatal errors, and the names of outputs."""

from pathlib import Path

import pytest
from helpers.refusals import refused

from gamba_warp.batch import check_not_read, for_each, plan_outputs
from gamba_warp.errors import UserError

FAILURES = {
    "user": UserError("user: bad\nmore"),  # such an error makes itself one line
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
        *[("user", "bad\\nmore"), ("value", "wrong"), ("diverged", "not finite"), ("disk", "full")],
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


def planned(inputs, suffixes, folder, reads=()):
    """The plan, checked: no two inputs share an output, on any file system."""
    names = plan_outputs(inputs, suffixes, folder, reads)
    outputs = [(name + suffix).casefold() for name in names for suffix in suffixes]
    assert len(set(outputs)) == len(outputs) and list(names.values()) == list(inputs)
    return list(names)


def test_no_two_inputs_share_an_output(tmp_path, capsys):
    def plan(files, *suffixes):
        return planned([tmp_path / name for name in files], suffixes, tmp_path / "out")

    assert plan(["a.png", "a-mesh.png"], ".ply", "-mesh.glb") == ["a", "a-mesh"]
    assert plan(["a.png", "a-mesh.png"], ".glb", "-mesh.glb") == ["a", "a-mesh-2"]
    assert plan(["a-mesh.png", "a.png"], ".glb", "-mesh.glb") == ["a-mesh", "a-2"]
    capsys.readouterr()
    assert plan(["a.png", "A.jpg", "x/a.png"], ".ply") == ["a", "A-2", "a-3"]
    assert capsys.readouterr().out == (
        f"{tmp_path / 'A.jpg'}: its results are named A-2\n"
        f"{tmp_path / 'x' / 'a.png'}: its results are named a-3\n"
    )
    assert plan(["a.png", "a.jpg", "x/a.png", "a-2.png"]) == ["a", "a-2", "a-3", "a-2-2"]
    assert plan(["\u00e9.png", "e\u0301.png"], ".ply") == ["\u00e9", "e\u0301-2"]


def test_a_name_does_not_say_that_a_file_is_compressed():
    names = ["a.compressed.ply", "b.Compressed.PLY", "c.compressed.png", ".compressed.ply", "a.spz"]
    found = planned([Path(name) for name in names], [".ply"], Path("out"))
    assert found == ["a", "b", "c.compressed", ".compressed", "a-2"]


def test_what_is_read_is_never_an_output(tmp_path):
    photo, mask, out = tmp_path / "photo.gif", tmp_path / "photo.html", tmp_path / "out"
    photo.touch(), mask.touch(), out.mkdir()
    said = "photo.gif: would be overwritten by an output"
    refused(said, plan_outputs, [photo], [".ply", ".gif"], tmp_path)
    (out / "photo.ply").hardlink_to(mask)
    for suffix, folder in ((".html", tmp_path), (".ply", out)):
        said = "photo.html: would be overwritten"
        refused(said, plan_outputs, [photo], [suffix], folder, [None, mask])
    assert planned([photo], [".gif"], out) == ["photo"]
    (out / "photo.gif").touch()  # of an earlier run
    assert planned([photo], [".gif"], out, [tmp_path / "none"]) == ["photo"]


def test_a_file_in_a_folder_that_is_read_is_never_an_output(tmp_path):
    (tmp_path / "data" / "chair").mkdir(parents=True)
    image = tmp_path / "data" / "chair" / "a.png"
    check_not_read([image], [tmp_path / "data" / "chair"])
    image.touch()
    refused("a.png: would be overwritten", check_not_read, [image], [tmp_path / "data" / "chair"])
    check_not_read([image], [tmp_path / "data" / "table", tmp_path / "none"])
