"""Features that macOS lacks, taken away on the machine of the tests; set-up, versions and CI."""

import os
import re
import sys
from pathlib import Path

import pytest
import torch
import warp as wp
from helpers.children import ran
from helpers.refusals import refused

from gamba_warp import devices
from gamba_warp.errors import UserError
from gamba_warp.files import only_process
from gamba_warp.kernels.runtime import launch, memory, system
from gamba_warp.kernels.selective_scan import selective_scan
from gamba_warp.untrusted import children
from gamba_warp.vision.weights import cache_folder, store_weights

ROOT = Path(__file__).resolve().parents[2]


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


def test_modules_are_not_imported_by_their_folders_names():
    by_folder = re.compile(r"^ *(from|import) (kernels|train|eval)\b", re.M)
    for folder in ("gamba_warp", "kernels", "train", "eval", "tests", "docs"):
        for path in (ROOT / folder).rglob("*.py"):
            assert not by_folder.search(path.read_text(encoding="utf-8")), path


def test_the_continuous_integration_trusts_no_tag_and_may_only_read():
    for path in sorted((ROOT / ".github" / "workflows").glob("*.yml")):
        text = path.read_text()
        actions = re.findall(r"uses: *(.*)", text)
        assert actions and "\npermissions:\n  contents: read\n" in text, path
        assert text.count("permissions:") == 1 and "persist-credentials: false" in text, path
        for action in actions:
            assert re.fullmatch(r"\S+@[0-9a-f]{40} # v\d+\.\d+\.\d+", action), action


@pytest.mark.parametrize(
    ("load", "chosen", "want"),
    [
        (1.5, {}, "1000"),
        (0.2, {}, None),
        (1.5, {"GOMP_SPINCOUNT": "77"}, "77"),
        (1.5, {"OMP_WAIT_POLICY": "active"}, None),
    ],
)
def test_threads_sleep_where_the_cores_are_busy(monkeypatch, load, chosen, want):
    for name in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY"):
        monkeypatch.setenv(name, "x")  # so that it is as before in the end, whatever is set
        monkeypatch.delenv(name)
    for name, value in chosen.items():
        monkeypatch.setenv(name, value)
    monkeypatch.delitem(sys.modules, "torch")
    monkeypatch.setattr(os, "getloadavg", lambda: (load, 0.0, 0.0), raising=False)
    monkeypatch.setattr(devices, "cores", lambda: 2)
    devices.share_cores()
    assert os.environ.get("GOMP_SPINCOUNT") == want


def test_what_torch_has_read_already_is_not_changed(monkeypatch):
    monkeypatch.delenv("GOMP_SPINCOUNT", raising=False)
    monkeypatch.setattr(os, "getloadavg", lambda: (99.0, 0.0, 0.0), raising=False)
    assert "torch" in sys.modules or __import__("torch")
    devices.share_cores()
    assert "GOMP_SPINCOUNT" not in os.environ


def commands(folder: Path, *words: str) -> str:
    """Everything that ``make WORDS`` would run where nothing is installed yet."""
    command = ["make", "--dry-run", f"VENV={folder / 'none'}", *words]
    done = ran(*command, cwd=ROOT, env={**os.environ, "MAKEFLAGS": ""})
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("target", ["setup", "demo"])
def test_a_user_installs_no_tools_of_developers(target, tmp_path):
    said = commands(tmp_path, target)
    assert "--editable '.[all]'" in said and "[test]" not in said
    assert "--quiet" not in said, "each step has its line, and downloads pip's bars"
    assert "pip fetches" in said


def test_a_locked_set_up_has_the_versions_of_constraints(tmp_path):
    assert "--constraint" not in commands(tmp_path, "test")
    locked = commands(tmp_path, "test", "LOCKED=1")
    assert locked.count("--constraint constraints.txt --editable") == 2
