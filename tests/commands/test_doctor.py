import importlib.metadata
import re

import pytest
import torch

from gamba_warp import __version__, cli, versions
from gamba_warp.measure import health


def run(capsys, *arguments):
    code = cli.run("doctor", list(arguments))
    return code, capsys.readouterr().out


def test_it_says_what_is_there(capsys):
    code, out = run(capsys)
    assert code == 0
    assert re.search(rf"gamba_warp +{re.escape(__version__)}\n", out)
    for name in ("torch", "warp-lang", "kornia", "pymeshlab"):
        assert re.search(rf"{name} +{re.escape(importlib.metadata.version(name))}\n", out)
    assert re.search(r"open3d(-cpu)? +\d", out) and "not installed" not in out
    assert re.search(r"cpu +\d+ threads", out) and "--warm-up" in out
    if not torch.cuda.is_available():
        assert re.search(r"cuda +none", out)
    for name in ("open3d", "mp4"):
        assert re.search(rf"{name} +yes\n", out)


def test_missing_weights_come_with_a_remedy_and_are_no_fault(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("GAMBA_CACHE", str(tmp_path / "none"))
    monkeypatch.setattr(health, "DEFAULT_CHECKPOINT", tmp_path / "tiny.safetensors")
    code, out = run(capsys)
    assert code == 0
    assert f"{tmp_path}/none (0 MiB)" in out
    assert re.search(r"lpips +no weights here; 'gamba weights lpips' fetches them", out)
    assert re.search(r"reconstruct +no shipped model, .*--checkpoint", out)
    (tmp_path / "tiny.safetensors").touch()
    assert re.search(r"reconstruct +yes\n", run(capsys)[1])


def test_a_library_that_does_not_work_is_a_fault(capsys, monkeypatch):
    def broken():
        raise OSError("libusb-1.0.so.0: cannot open shared object file\nmore")

    monkeypatch.setattr(health, "import_open3d", broken)
    code, out = run(capsys)
    assert code == 1 and re.search(r"open3d +no: libusb-1.0.so.0: cannot open .* file\n", out)


def test_a_missing_package_is_named(capsys, monkeypatch):
    monkeypatch.setattr(versions, "_USED", ("torch", "no-such-package"))
    assert re.search(r"no-such-package +not installed\n", run(capsys)[1])


def test_warming_up_runs_both_kernels(capsys):
    code, out = run(capsys, "--warm-up")
    found = re.search(r"cpu +([\d.]+) s to compile or load, then (\d+) ms", out)
    assert code == 0 and found
    assert float(found[1]) * 1000 + 50 >= float(found[2])  # rounded to 0.1 s


@pytest.mark.gpu
def test_warming_up_on_the_gpu(capsys):
    assert re.search(r"cuda +[\d.]+ s to compile or load", run(capsys, "--warm-up")[1])
