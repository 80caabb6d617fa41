"""Digests of files; atomic writes, and removal of their leftovers."""

import errno
import hashlib
import os
import time
import tracemalloc
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from helpers.disk import full_at
from helpers.refusals import refused
from safetensors.torch import save_file

from gamba_warp.data.dataset import open_dataset
from gamba_warp.errors import UserError
from gamba_warp.eval.shapes.pairs import find_pairs
from gamba_warp.files import (
    PART,
    atomic_folder,
    atomic_path,
    check_sha256,
    output_folder,
    sha256,
    sweep,
    visible,
    write_json,
    write_text,
)
from gamba_warp.formats.read import find_gaussians
from gamba_warp.images import find_images, save_image
from gamba_warp.trajectories.movies import save_turntable


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
    refused("absent: No such file", sha256, tmp_path / "absent")
    refused("not a plain file", sha256, tmp_path)
    (tmp_path / "a").write_bytes(b"a")
    right = sha256(tmp_path / "a")
    check_sha256(tmp_path / "a", right)
    for wrong in (right[:8], right[:-1], "0" * 64):  # part of a digest is none
        words = f"SHA-256 is {right}, expected {wrong}$"
        refused(words, check_sha256, tmp_path / "a", wrong)


def test_leftovers_are_swept_by_age_and_nothing_else_is(tmp_path):
    def put(name: str, days: float) -> str:
        path = tmp_path / name
        path.mkdir()
        (path / "a.ply").touch()
        for part in (path / "a.ply", path):
            os.utime(part, (time.time() - days * 86400,) * 2)
        return name

    put(f"{PART}abcd1234", 1.1)
    young, link = put(f"{PART}abcd1235", 0.9), f"{PART}linklink"
    others = (f"{PART}abcd12345", f"x{PART}abcd1234", ".config.settings", "results")
    kept = {link, *(put(name, 3) for name in others)}
    (tmp_path / link).symlink_to(tmp_path / "results")
    output_folder(tmp_path)
    assert {*os.listdir(tmp_path)} == {*kept, young}
    sweep(tmp_path, age=0)
    assert {*os.listdir(tmp_path)} == kept
    assert os.listdir(tmp_path / "results") == ["a.ply"]


@pytest.mark.parametrize("kind", ["safetensors", "json", "png", "mp4", "gif"])
def test_a_full_disk_is_one_line_and_the_older_file_stays(tmp_path, kind):
    path = tmp_path / f"a.{kind}"
    pixels = np.random.default_rng(0).random((64, 64, 3))
    frames = (pixels[None] * 255).astype(np.uint8).repeat(3, 0)

    def write():
        if kind == "safetensors":
            with atomic_path(path) as temporary:
                save_file({"a": torch.zeros(9000)}, temporary)
        elif kind == "json":
            write_json(path, list(range(9000)))
        elif kind == "png":
            save_image(path, pixels)
        else:
            save_turntable(path, frames)

    path.write_bytes(b"older")
    with full_at(1000):
        refused(f"^cannot write {path}: ", write)
    assert os.listdir(tmp_path) == [path.name] and path.read_bytes() == b"older"
    write()
    assert path.stat().st_size > 1000


def test_what_has_its_name_is_on_the_disk(tmp_path, monkeypatch):
    """A power cut leaves the older file or the complete new one: sync files first, then folders."""
    done, real = [], os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: done.append(os.fstat(handle).st_ino))

    def name(part, path):
        done.append(os.path.basename(path))
        real(part, path)

    monkeypatch.setattr(os, "replace", name)
    monkeypatch.setattr(os, "rename", name)
    path = tmp_path / "a.txt"
    write_text(path, "a")
    assert done == [path.stat().st_ino, "a.txt", tmp_path.stat().st_ino]
    done.clear()
    folder = tmp_path / "b"
    with atomic_folder(folder, replace=True) as temporary:
        (temporary / "deep").mkdir()
        write_text(temporary / "deep" / "c.txt", "c")
        assert done == ["c.txt"]  # all of a folder is synced at once, when it is whole
    parts = {part.stat().st_ino for part in (folder, folder / "deep", folder / "deep" / "c.txt")}
    assert set(done[1:-2]) == parts and done[-2:] == ["b", tmp_path.stat().st_ino]

    monkeypatch.setattr(os, "fsync", Mock(side_effect=OSError(errno.EINVAL, "no sync")))
    write_text(path, "b")  # to a drive that cannot sync
    monkeypatch.setattr(os, "fsync", Mock(side_effect=OSError(errno.EIO, "Input/output error")))
    refused("a.txt: Input/output error", write_text, path, "c")
    assert path.read_text() == "b"


def test_a_folder_that_cannot_be_replaced_is_back(tmp_path, monkeypatch):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "one").touch()
    real = os.rename

    def rename(part, path):
        if os.path.exists(os.path.join(part, "two")):
            raise OSError(errno.EIO, "Input/output error")
        real(part, path)

    monkeypatch.setattr(os, "rename", rename)
    with pytest.raises(UserError, match="cannot write .*a: Input/output error"):
        with atomic_folder(tmp_path / "a", replace=True) as temporary:
            (temporary / "two").touch()
    assert os.listdir(tmp_path) == ["a"] and os.listdir(tmp_path / "a") == ["one"]


def test_a_folder_appears_whole_and_replaces_only_when_told(tmp_path):
    path = tmp_path / "a"
    with pytest.raises(ValueError), atomic_folder(path) as temporary:
        (temporary / "half").touch()
        raise ValueError
    assert os.listdir(tmp_path) == []
    for content in ("one", "two"):
        with atomic_folder(path, replace=True) as temporary:
            (temporary / content).touch()
    assert os.listdir(path) == ["two"]
    with pytest.raises(UserError, match="cannot write"), atomic_folder(path) as temporary:
        (temporary / "three").touch()
    assert os.listdir(path) == ["two"] and os.listdir(tmp_path) == ["a"]


def test_names_that_are_not_utf_8_are_written_with_escapes(tmp_path):
    write_text(tmp_path / "a.md", os.fsdecode(b"caf\xe9"))
    assert (tmp_path / "a.md").read_text() == "caf\\udce9"


def test_what_begins_with_a_dot_is_no_input(tmp_path):
    part = tmp_path / f"{PART}abcd1234"
    part.mkdir()
    for folder in (tmp_path, part):
        for name in ("a.png", "a.ply", ".b.png", ".b.ply"):
            (folder / name).write_bytes(b"x")
    assert find_images([tmp_path])[0] == [tmp_path / "a.png"]
    assert find_gaussians([tmp_path])[0] == [tmp_path / "a.ply"]
    assert list(visible(tmp_path, "*.ply")) == [tmp_path / "a.ply"]
    pairs, failures = find_pairs(tmp_path, tmp_path)
    assert [pair.name for pair in pairs] == ["a"] and not failures
    refused(None, open_dataset, part)


def test_who_reads_the_older_file_reads_it_to_its_end(tmp_path):
    """The name moves to the new file at once; the older one is not overwritten."""
    path = tmp_path / "a.txt"
    path.write_text("old" * 100_000)
    with open(path) as reader:
        assert reader.read(3) == "old"
        with atomic_path(path) as temporary:
            temporary.write_text("new")
        assert reader.read() == "old" * 99_999
    assert path.read_text() == "new"
    (tmp_path / "plain").touch()
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_folder_has_no_files_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("model.glb", "m.webm", "A.PLY", "views.tar.gz", "page.html"):
        refused(f"{name}: looks like a file", output_folder, name)
    assert not list(tmp_path.iterdir())
    (tmp_path / "old.zip").mkdir()
    for name in ("old.zip", "run.v2", "2026.11.27", "out"):
        assert output_folder(name).is_dir()
