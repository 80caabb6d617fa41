"""Warp's folder of compiled kernels: it can be written, and what is damaged is built again."""

import os
from pathlib import Path

import pytest
import torch
import warp as wp

from gamba_warp.kernels.runtime import cache, launch


@wp.kernel(module="unique", enable_backward=False)
def _double(values: wp.array(dtype=float)):
    values[wp.tid()] = 2.0 * values[wp.tid()]


def doubled() -> list[float]:
    """Loads the kernel anew and runs it."""
    _double.module.unload()
    values = torch.tensor([1.0, 2.0])
    launch.cuda_launch(_double, 2, [values], device=torch.device("cpu"), block_dim=1)
    return values.tolist()


def files() -> tuple[Path, Path]:
    """The kernel's machine code and its description."""
    folder = Path(wp.config.kernel_cache_dir) / _double.module.get_module_identifier(1)
    return next(folder.glob("*.o")), next(folder.glob("*.meta"))


def flip(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 255]) + data[middle + 1 :]


@pytest.mark.parametrize("which", [0, 1], ids=["code", "description"])
@pytest.mark.parametrize("damage", [flip, lambda data: data[: len(data) // 2], lambda data: b""])
@pytest.mark.parametrize("sealed", [True, False])
def test_a_damaged_kernel_is_named_and_built_again_once(capfd, which, damage, sealed):
    if damage is flip and not sealed:
        pytest.skip("nothing tells one wrong bit where there is no checksum")
    assert doubled() == [2.0, 4.0]
    path = files()[which]
    if not sealed:
        for sums in path.parent.glob("*.sha256"):
            sums.unlink()
    path.write_bytes(damage(path.read_bytes()))
    capfd.readouterr()
    assert doubled() == [2.0, 4.0]
    said = capfd.readouterr().err
    assert said == f"gamba: damaged kernels, built again: {path.parent}\n"
    assert doubled() == [2.0, 4.0] and capfd.readouterr().err == ""
    assert not list(path.parent.parent.glob(".gamba-part-*"))


def test_a_disk_that_fills_up_leaves_no_half_kernel(capfd):
    assert doubled() == [2.0, 4.0]
    code, _ = files()
    assert cache.is_whole(code)
    code.with_name(code.name + ".sha256").unlink()
    code.write_bytes(code.read_bytes()[:-1])
    assert not cache.is_whole(code)
    assert doubled() == [2.0, 4.0]


def test_a_home_that_cannot_be_written_is_replaced_for_now(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(cache.tempfile, "tempdir", str(tmp_path))
    fine = tmp_path / "home" / ".cache"
    assert cache.writable_folder(fine, "kernels") == fine and capsys.readouterr().err == ""
    instead = tmp_path / f"kernels-{os.geteuid()}"
    for wanted, reason in (
        (Path("/proc/none/cache"), "/proc/none/cache"),
        (None, "no home folder"),
    ):
        assert cache.writable_folder(wanted, "kernels") == instead and instead.is_dir()
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and reason in said and str(instead) in said


def test_a_temporary_cache_of_somebody_else_is_not_used(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(cache.tempfile, "tempdir", str(tmp_path))
    theirs = tmp_path / f"kernels-{os.geteuid()}"
    theirs.mkdir()
    theirs.chmod(0o777)
    got = cache.writable_folder(None, "kernels")
    assert got != theirs and got.is_dir() and not got.stat().st_mode & 0o077
    theirs.rmdir()
    theirs.symlink_to(tmp_path)
    assert cache.writable_folder(None, "kernels") not in (theirs, tmp_path)
