"""Features that macOS lacks, taken away on the machine of the tests, and text encodings."""

import ast
import configparser
import os
import re
import sys
from pathlib import Path

import pytest
import torch
import warp as wp
from helpers.refusals import refused

from gamba_warp.errors import UserError
from gamba_warp.files import only_process, write_json
from gamba_warp.kernels.runtime import launch, memory, system
from gamba_warp.kernels.selective_scan import selective_scan
from gamba_warp.untrusted import children
from gamba_warp.vision.weights import cache_folder, store_weights

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = {
    "gamba_warp": "gamba_warp",
    "kernels": "gamba_warp.kernels",
    "train": "gamba_warp.train",
    "eval": "gamba_warp.eval",
}


def test_json_ends_its_lines_alike_everywhere(tmp_path):
    write_json(tmp_path / "a.json", ["ä"])
    assert (tmp_path / "a.json").read_bytes() == b'[\n  "\\u00e4"\n]\n'


wp.init()  # its libraries are found before ctypes is patched


def test_launches_without_openmp_and_huge_pages(monkeypatch):
    def library(name):
        raise OSError("no such library")

    monkeypatch.setattr(launch.ctypes, "CDLL", library)
    monkeypatch.setattr(memory, "pool", None)
    assert memory.empty((3, 1 << 20), torch.float32).shape == (3, 1 << 20)
    u, delta = torch.randn(1, 7, 35), torch.rand(1, 7, 35)
    A, B = -torch.rand(35, 2), torch.randn(1, 7, 2)
    try:
        before = selective_scan(u, delta, A, B, B)
        launch._find_team()
        assert not launch.has_team()
        assert torch.equal(selective_scan(u, delta, A, B, B), before)
    finally:
        monkeypatch.undo()
        launch._find_team()


def test_limits_of_memory_are_left_out(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setitem(sys.modules, "resource", None)
    children._limit(1 << 20)


def test_cores_without_affinity(monkeypatch):
    assert 1 <= system.cores() <= (os.cpu_count() or 1)
    monkeypatch.delattr(os, "sched_getaffinity")
    assert system.cores() == (os.cpu_count() or 1)


def test_where_weights_are_kept(tmp_path, monkeypatch):
    monkeypatch.delenv("GAMBA_CACHE", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "elsewhere"))
    old = tmp_path / ".cache" / "gamba_warp"
    assert cache_folder() == old
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.delitem(sys.modules, "platformdirs", raising=False)
    old.mkdir(parents=True)
    assert cache_folder() == old  # what was fetched there is found again
    old.rmdir()
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder() == tmp_path / "Library" / "Caches" / "gamba_warp"
    monkeypatch.setenv("GAMBA_CACHE", str(tmp_path / "chosen"))
    assert cache_folder() == tmp_path / "chosen"


def test_without_a_home_weights_need_a_folder(tmp_path, monkeypatch):
    def nowhere():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("GAMBA_CACHE", raising=False)
    monkeypatch.setattr(Path, "home", nowhere)
    refused("no home folder; set GAMBA_CACHE to", cache_folder)
    (tmp_path / "file").touch()
    monkeypatch.setenv("GAMBA_CACHE", str(tmp_path / "file"))
    refused("file: .*; GAMBA_CACHE can name another folder", store_weights)


def test_a_lock_that_is_a_link_is_not_followed(tmp_path):
    (tmp_path / "target").write_bytes(b"precious")
    (tmp_path / ".lock").symlink_to(tmp_path / "target")
    with pytest.raises(UserError, match=".lock is a link"), only_process(tmp_path, "trains"):
        pass
    assert (tmp_path / "target").read_bytes() == b"precious"


def _text_without_encoding(path: Path) -> list[int]:
    """Lines that open text in an encoding that differs between systems."""
    lines = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Call):
            continue
        name = ast.unparse(node.func).rpartition(".")[2]
        given = {keyword.arg for keyword in node.keywords}
        if name in ("run", "Popen") and {"text", "universal_newlines"} & given - {"encoding"}:
            lines += [] if "encoding" in given else [node.lineno]
        method = isinstance(node.func, ast.Attribute)
        if name in ("open", "fdopen") and ast.unparse(node.func) in ("open", "os.fdopen"):
            mode = ast.unparse(node.args[1]) if len(node.args) > 1 else ""
            lines += [] if "b" in mode or {"encoding", None} & given else [node.lineno]
        if method and name in ("read_text", "write_text") and "encoding" not in given:
            lines.append(node.lineno)
    return lines


def test_text_has_an_encoding(tmp_path):
    wrong = 'open("a")\nopen("a", "rb")\np.read_text()\np.write_text(x)\nrun(a, text=True)\n'
    (tmp_path / "a.py").write_text(wrong, encoding="utf-8")
    assert _text_without_encoding(tmp_path / "a.py") == [1, 3, 4, 5]
    files = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")]
    found = {path: _text_without_encoding(path) for path in files}
    assert not {path: lines for path, lines in found.items() if lines}


def test_every_package_is_listed():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    folders = {
        ".".join((package, *path.parent.relative_to(ROOT / folder).parts))
        for folder, package in FOLDERS.items()
        for path in (ROOT / folder).rglob("*.py")
    }
    # The shipped model: files, and no code.
    assert set(config["options"]["packages"].split()) == folders | {"gamba_warp.starter"}


def test_modules_are_not_imported_by_their_folders_names():
    by_folder = re.compile(r"^ *(from|import) (kernels|train|eval)\b", re.M)
    for folder in (*FOLDERS, "tests", "docs"):
        for path in (ROOT / folder).rglob("*.py"):
            assert not by_folder.search(path.read_text(encoding="utf-8")), path
