"""Features of some systems: the package works without them, or raises an error of one line.

Nothing here runs on macOS or Windows: what these lack is taken away on the machine of the tests.
"""

import ast
import fcntl
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import warp as wp
from architecture.imports import modules
from helpers.refusals import refused

import gamba_warp.measure.stress_run  # noqa: F401 (loaded before a test takes something away)
from gamba_warp.errors import UserError
from gamba_warp.files import PART, STARTER, atomic_folder, only_process, sweep, write_json
from gamba_warp.kernels.bench.core.measure import peak_bytes
from gamba_warp.kernels.runtime import launch, memory, system
from gamba_warp.kernels.selective_scan import selective_scan
from gamba_warp.processes import stop_requests
from gamba_warp.untrusted import children
from gamba_warp.untrusted.names import inside, parts_of
from gamba_warp.vision.weights import cache_folder, store_weights

ROOT = Path(__file__).resolve().parents[2]
MODULES = ("resource", "fcntl", "pwd", "grp", "termios", "pty")
NAMES = (
    *("geteuid", "getuid", "fork", "forkpty", "killpg", "getpgid", "setsid", "mkfifo", "nice"),
    *("sched_getaffinity", "register_at_fork", "O_DIRECTORY", "O_NOFOLLOW", "WNOHANG"),
)
SIGNALS = ("SIGHUP", "SIGKILL", "SIGXFSZ", "SIGALRM", "SIGUSR1")
# Loads the libraries, whose wheels for other systems are others; then takes away what Windows has
# not, loads all of ours, and reconstructs a picture.
BARE = f"""
import importlib, os, signal, sys
import filelock, msgspec, numpy, PIL.Image, safetensors.torch, torch, tqdm, trimesh, tyro, warp
import gradio, torch.nn.parallel, torch.utils.tensorboard
for name in {MODULES}:
    sys.modules[name] = None
for place, names in ((os, {NAMES}), (signal, {SIGNALS})):
    for name in names:
        if hasattr(place, name):
            delattr(place, name)
ours, *arguments = sys.argv[1:]
for name in ours.split():
    importlib.import_module(name)
from gamba_warp.cli import main
main(arguments)
"""


@pytest.mark.slow
def test_all_modules_load_and_a_picture_is_reconstructed_on_a_bare_system(tmp_path):
    names = [name for name in modules(ROOT) if not name.endswith("__main__")]
    assert len(names) > 200 and "gamba_warp.untrusted.children" in names
    picture = next(iter(sorted((STARTER / "icons").glob("*.png"))))
    command = ("reconstruct", picture, "--size", 16, "--frames", 2, "--out", tmp_path / "out")
    done = subprocess.run(
        [sys.executable, "-c", BARE, " ".join(names), *map(str, command)],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / f"{picture.stem}.html").exists()


@pytest.fixture
def no_users(monkeypatch):
    for name in ("geteuid", "getuid"):
        monkeypatch.delattr(os, name)
    monkeypatch.setenv("USERNAME", "somebody")  # as Windows sets it; torch asks for it


@pytest.fixture
def windows(monkeypatch, no_users):
    """No handles of folders, no rename onto anything, what is only read has nothing to sync."""
    real_open, real_sync, real_rename = os.open, os.fsync, Path.rename

    def open_file(path, *args, **options):
        if "dir_fd" not in options and Path(path).is_dir():  # with it, shutil.rmtree's own
            raise PermissionError(13, "Permission denied", str(path))
        return real_open(path, *args, **options)

    def sync(handle):
        if fcntl.fcntl(handle, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(9, "Bad file descriptor")
        real_sync(handle)

    def rename(self, target):
        if Path(target).exists():
            raise FileExistsError(17, "File exists", str(target))
        return real_rename(self, target)

    def library(name):
        raise TypeError("LoadLibrary() argument 1 must be str, not None")

    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(shutil, "_use_fd_functions", False)  # rmtree opens no folders there
    monkeypatch.setattr(os, "open", open_file)
    monkeypatch.setattr(os, "fsync", sync)
    monkeypatch.setattr(Path, "rename", rename)
    monkeypatch.setattr(launch.ctypes, "CDLL", library)


def test_folders_are_written_on_windows(windows, tmp_path):
    (tmp_path / "empty").mkdir()
    for name in ("new", "empty"):
        with atomic_folder(tmp_path / name) as folder:
            (folder / "a.txt").write_text("a", encoding="utf-8")
        assert (tmp_path / name / "a.txt").read_text(encoding="utf-8") == "a"
    with pytest.raises(UserError, match="cannot write"), atomic_folder(tmp_path / "new"):
        pass
    with atomic_folder(tmp_path / "new", replace=True) as folder:
        (folder / "b.txt").touch()
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["b.txt"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "new"]


def test_json_ends_its_lines_alike_everywhere(tmp_path):
    write_json(tmp_path / "a.json", ["ä"])
    assert (tmp_path / "a.json").read_bytes() == b'[\n  "\\u00e4"\n]\n'


def test_what_killed_commands_left_is_swept_without_users(no_users, tmp_path):
    part = tmp_path / f"{PART}abcd1234"
    part.mkdir()
    sweep(tmp_path, age=0)
    assert not part.exists()


wp.init()  # its libraries are found before ctypes is patched


def test_launches_without_openmp_and_huge_pages(windows, monkeypatch):
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


def test_memory_is_not_measured_where_it_cannot_be(windows):
    assert peak_bytes(lambda: torch.ones(3), torch.device("cpu")) is None


def test_limits_of_memory_are_left_out(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setitem(sys.modules, "resource", None)
    children._limit(1 << 20)


def test_training_stops_without_sighup(no_nohup, monkeypatch):
    assert system.end_signals() == [signal.SIGTERM, signal.SIGHUP]
    monkeypatch.delattr(signal, "SIGHUP")
    with stop_requests(insist=True) as received:
        signal.raise_signal(signal.SIGTERM)
    assert received == [signal.SIGTERM]


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
    refused("no home folder; let GAMBA_CACHE name one", cache_folder)
    (tmp_path / "file").touch()
    monkeypatch.setenv("GAMBA_CACHE", str(tmp_path / "file"))
    refused("file: .*; GAMBA_CACHE names another folder", store_weights)


@pytest.mark.parametrize("name", ["ab:c.obj", "Con", "nul.png", "a/lpt1.t", "a?", "b.", "b ", "<"])
def test_names_that_windows_takes_for_something_else(name, monkeypatch, tmp_path):
    assert parts_of(name, "file")
    monkeypatch.setattr(sys, "platform", "win32")
    refused("^file: Windows has no files of the name", inside, tmp_path, name, "file")
    for fine in ("console.obj", "a.b/c d.png", "com.txt", "äö/nulls"):
        assert inside(tmp_path, fine, "file") == tmp_path / fine
    refused("leaves its folder", inside, tmp_path, "../a", "file")


def test_a_link_to_another_drive_leaves_the_folder(monkeypatch, tmp_path):
    def other_drives(paths):
        raise ValueError("Paths don't have the same drive")

    monkeypatch.setattr(os.path, "commonpath", other_drives)
    refused("cannot be followed", inside, tmp_path, "a", "file")


def test_a_lock_that_nobody_else_may_read(monkeypatch, tmp_path):
    """Windows refuses to read and write what another process has locked."""

    def locked(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "read_text", locked)
    monkeypatch.setattr(Path, "write_text", locked)
    with only_process(tmp_path, "trains"):
        with pytest.raises(UserError, match="pid unknown"), only_process(tmp_path, "trains"):
            pass


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
    found = {path: _text_without_encoding(path) for path in modules(ROOT).values()}
    assert not {path: lines for path, lines in found.items() if lines}
