"""Manifests: the objects of a dataset, checked once, compared by size and time."""

import json
import os
import pickle
import shutil

import pytest
from helpers import micro
from helpers.refusals import refused

from gamba_warp import cli
from gamba_warp.data import dataset as datasets
from gamba_warp.data.dataset import index_dataset, open_dataset
from gamba_warp.data.manifest import MANIFEST
from gamba_warp.untrusted.names import Within, inside


@pytest.fixture
def data(tmp_path):
    """Three clouds in two folders, of which one lacks an image; with its manifest."""
    root = micro.write_dataset(tmp_path / "set", 4)
    (root / "more").mkdir()
    (root / "cloudb").rename(root / "more" / "cloudb")
    (root / "cloudc" / "003.png").unlink()
    index_dataset(root)
    return root


def test_a_manifest_gives_the_dataset_without_reading_an_object(data, monkeypatch):
    uids = ["clouda", "cloudc", "cloudd", "more/cloudb"]
    fresh = {uid: datasets.content_digest(datasets._read_folder(data, "transforms", uid))
             for uid in uids}  # fmt: skip
    read = []
    monkeypatch.setattr(datasets, "_read_folder", lambda *a: read.append(a))
    found = open_dataset(data)
    assert found.uids == uids and found.layout == "transforms"
    assert found.check() == {"cloudc": f"{data / 'cloudc' / '003.png'}: no such file"}
    for uid in ("clouda", "more/cloudb"):
        assert found.digest(uid) == fresh[uid]
    assert not read
    assert open_dataset(data, "val").uids == ["cloudd"]
    joined = open_dataset(data, "val").joined("x", found)
    assert joined.uids == ["cloudd", *(f"x/{uid}" for uid in uids)]
    assert [*joined.check()] == ["x/cloudc"] and joined.digest("x/clouda") == fresh["clouda"]
    assert not read


def test_views_are_those_of_the_files(data):
    (before, after) = (open_dataset(data).joined("x", open_dataset(data)) for _ in range(2))
    (data / MANIFEST).unlink()
    plain = open_dataset(data)
    for uid in ("clouda", "more/cloudb"):
        want = plain.load(uid)
        for got in (before.load(uid), after.load(f"x/{uid}")):
            assert (got.images == want.images).all()
            assert (got.cameras.viewmats == want.cameras.viewmats).all()
    assert pickle.loads(pickle.dumps(before)).uids == before.uids


CHANGES = {
    "an object": lambda root: shutil.copytree(root / "clouda", root / "more" / "cloude"),
    "a removed object": lambda root: shutil.rmtree(root / "more" / "cloudb"),
    "a folder": lambda root: (root / "new").mkdir(),
    "a camera file": lambda root: os.utime(root / "clouda" / "transforms.json", ns=(1, 1)),
    "its size": lambda root: (root / "clouda" / "transforms.json").open("a").write(" "),
    "an image": lambda root: (root / "clouda" / "001.png").unlink(),
    "a repair": lambda root: shutil.copy(root / "clouda/001.png", root / "cloudc/003.png"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_an_old_manifest_is_refused_and_made_anew(data, change, capsys):
    times = [os.stat(data / uid).st_mtime_ns for uid in ("clouda", "cloudc")]
    CHANGES[change](data)
    if change in ("an image", "a repair"):  # the clock of some systems ticks every 10 ms
        for uid, time in zip(("clouda", "cloudc"), times):
            if os.stat(data / uid).st_mtime_ns == time:
                os.utime(data / uid, ns=(time + 1, time + 1))
    line = refused("older than its dataset, .* has changed", open_dataset, data)
    assert f"gamba data index {data} writes it again" in line
    bad = 0 if change == "a repair" else 2 if change == "an image" else 1
    assert cli.run("data index", [str(data)]) == min(1, bad)
    assert f", {bad} left out, listed in {data / MANIFEST}" in capsys.readouterr().out
    assert len(open_dataset(data).check()) == bad


def test_other_files_change_nothing(data):
    (data / "notes.txt").write_text("x")
    (data / "more" / ".hidden").mkdir()
    assert len(open_dataset(data)) == 4


def changed(value, *path):
    """Return a function that changes the second line of a manifest, its first object."""

    def change(lines):
        entry = place = json.loads(lines[1])
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = value
        return [lines[0], json.dumps(entry).encode() + b"\n", *lines[2:]]

    return change


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda lines: lines[:-1], "cut short at line 5"),
        (lambda lines: [*lines[:-1], lines[-1][:20]], "cut short at line 5"),
        (lambda lines: [*lines, lines[-1]], "has more than 4 objects"),
        (lambda lines: [*lines[:-1], lines[1]], "the object clouda occurs twice"),
        (lambda lines: [lines[0].replace(b'"version":1', b'"version":9')], "manifest of version 1"),
        (lambda lines: [lines[0].replace(b'"transforms"', b'"other"')], "manifest of version 1"),
        (changed("../set/clouda", 0), "line 2: the name .* leaves its folder"),
        (changed(".x/y", 0), "line 2: the name '.x/y' has a part with a leading dot"),
        (changed("/etc", 0), "line 2: the name .* is not relative"),
        (changed("../../etc/passwd", 3, 0, 0), "line 2: the name .* leaves its folder"),
        (changed("no", 1), "line 2: "),
    ],
)
def test_a_damaged_manifest_is_one_line(data, change, words):
    lines = (data / MANIFEST).read_bytes().splitlines(keepends=True)
    (data / MANIFEST).write_bytes(b"".join(change(lines)))
    refused(words, open_dataset, data)


def test_what_has_no_manifest(data, tmp_path):
    refused("is one object", index_dataset, data / "clouda")
    refused("no such folder", index_dataset, tmp_path / "none")
    (tmp_path / "empty").mkdir()
    refused("no objects found", index_dataset, tmp_path / "empty")
    (data / MANIFEST).unlink()
    (data / MANIFEST).mkdir()
    refused("not a plain file", open_dataset, data)


def test_names_within_a_folder_are_those_of_inside(tmp_path):
    folder, outside = tmp_path / "a", tmp_path / "outside"
    (folder / "sub").mkdir(parents=True)
    outside.mkdir()
    for path in (folder / "x.png", folder / "sub" / "y.png", outside / "z.png"):
        path.write_text("")
    (folder / "out.png").symlink_to(outside / "z.png")
    (folder / "in.png").symlink_to(folder / "x.png")
    (folder / "away").symlink_to(outside)
    (folder / "near").symlink_to(folder / "sub")
    within = Within(folder)
    for name in ("x.png", "sub/y.png", "./sub/./y.png", "in.png", "near/y.png", "none.png", "no/x"):
        assert within.path(name, "s") == inside(folder, name, "s")
    for name in ("out.png", "away/z.png", "../outside/z.png", "/etc/passwd", "a\\b", "", 3):
        assert refused("s: ", within.path, name, "s") == refused("s: ", inside, folder, name, "s")
