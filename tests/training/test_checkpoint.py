"""Checkpoints: round trip, atomicity, damage."""

import errno
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from helpers import micro

from gamba_warp.errors import UserError
from gamba_warp.model.checkpoint import load_model
from gamba_warp.model.gamba import Gamba
from gamba_warp.train import checkpoint
from gamba_warp.train.checkpoint import (
    find_checkpoint,
    list_checkpoints,
    load_weights,
    read_state,
    save_checkpoint,
)


@pytest.fixture
def model(tmp_path):
    return Gamba(micro.options(tmp_path, tmp_path).model_config())


def names(run):
    return [path.name for path in list_checkpoints(run)]


def test_round_trip(tmp_path, model):
    state = {"step": 7, "values": [1.5, "text", None], "tensor": torch.arange(3)}
    path = save_checkpoint(tmp_path, 7, {"model": model, "ema": model}, state, keep=2)
    assert path == tmp_path / "checkpoints" / "step_000007"
    got = read_state(path)
    assert got["values"] == state["values"] and torch.equal(got["tensor"], state["tensor"])
    other = Gamba(model.config)
    load_weights(path / "ema.safetensors", other)
    for (name, a), b in zip(model.state_dict().items(), other.state_dict().values()):
        assert torch.equal(a, b), name
    assert load_model(path / "model.safetensors").config == model.config


def test_keeps_the_newest(tmp_path, model):
    for step in (5, 90, 100, 1_000_000):
        save_checkpoint(tmp_path, step, {"model": model}, {}, keep=2)
    assert names(tmp_path) == ["step_000100", "step_1000000"]
    assert sorted(os.listdir(tmp_path / "checkpoints")) == ["step_000100", "step_1000000"]
    assert find_checkpoint(tmp_path, "auto").name == "step_1000000"


def test_same_step_is_replaced(tmp_path, model):
    save_checkpoint(tmp_path, 5, {"model": model}, {"a": 1}, keep=2)
    path = save_checkpoint(tmp_path, 5, {"model": model}, {"a": 2}, keep=2)
    assert read_state(path) == {"a": 2} and names(tmp_path) == ["step_000005"]


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, "No space left on device"), RuntimeError("x")]
)
def test_full_disk_leaves_the_old_one(tmp_path, model, monkeypatch, error):
    save_checkpoint(tmp_path, 1, {"model": model}, {"a": 1}, keep=1)

    def full(*arguments):
        raise error

    monkeypatch.setattr(checkpoint.torch, "save", full)
    with pytest.raises(UserError, match="cannot write .*step_000002"):
        save_checkpoint(tmp_path, 2, {"model": model}, {"a": 2}, keep=1)
    assert names(tmp_path) == ["step_000001"]
    assert read_state(find_checkpoint(tmp_path, "auto")) == {"a": 1}
    assert os.listdir(tmp_path / "checkpoints") == ["step_000001"], "no leftovers"


def test_killed_while_saving_leaves_the_old_one(tmp_path, model):
    """A process is killed between two files of its second checkpoint."""
    script = (
        "import sys, time\n"
        "from helpers import micro\n"
        "from pathlib import Path\n"
        "from gamba_warp.model.checkpoint import Gamba\n"
        "from gamba_warp.train import checkpoint\n"
        "run = Path(sys.argv[1])\n"
        "model = Gamba(micro.options(run, run).model_config())\n"
        "checkpoint.save_checkpoint(run, 1, {'model': model}, {'a': 1}, keep=1)\n"
        "def slow(*arguments):\n"
        "    (run / 'saving').touch()\n"
        "    time.sleep(60)\n"
        "checkpoint.torch.save = slow\n"
        "checkpoint.save_checkpoint(run, 2, {'model': model}, {'a': 2}, keep=1)\n"
    )
    path = os.pathsep.join([str(Path(micro.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path)], env={**os.environ, "PYTHONPATH": path}
    )
    try:
        for _ in range(600):
            if (tmp_path / "saving").exists() or process.poll() is not None:
                break
            time.sleep(0.1)
        assert process.poll() is None and (tmp_path / "saving").exists()
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert names(tmp_path) == ["step_000001"]
    assert len(os.listdir(tmp_path / "checkpoints")) == 2, "the unfinished folder is there"
    assert read_state(find_checkpoint(tmp_path, "auto")) == {"a": 1}
    save_checkpoint(tmp_path, 3, {"model": model}, {"a": 3}, keep=1)
    assert os.listdir(tmp_path / "checkpoints") == ["step_000003"], "and cleared by the next save"


@pytest.mark.parametrize("share", [0.0, 0.3, 0.95])
def test_truncated_files(tmp_path, model, share):
    path = save_checkpoint(tmp_path, 1, {"model": model}, {"t": torch.zeros(5000)}, keep=1)
    for name in ("state.pt", "model.safetensors"):
        whole = (path / name).read_bytes()
        (path / name).write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(UserError, match="state.pt: damaged"):
        read_state(path)
    with pytest.raises(UserError, match="model.safetensors"):
        load_weights(path / "model.safetensors", model)


def test_missing_files(tmp_path, model):
    with pytest.raises(UserError, match="no such file"):
        read_state(tmp_path)
    with pytest.raises(UserError, match="no such file"):
        load_weights(tmp_path / "model.safetensors", model)
    assert find_checkpoint(tmp_path, "auto") is None
    assert find_checkpoint(tmp_path, "never") is None


def test_code_in_a_state_file_is_not_run(tmp_path):
    import pickle

    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "owned"),)

    (tmp_path / "state.pt").write_bytes(pickle.dumps(Evil(), protocol=2))
    with pytest.raises(UserError, match="damaged"):
        read_state(tmp_path)
    torch.save(Evil(), tmp_path / "state.pt")
    with pytest.raises(UserError, match="damaged"):
        read_state(tmp_path)
    assert not (tmp_path / "owned").exists()


def test_other_model_is_named(tmp_path, model):
    from dataclasses import replace

    path = save_checkpoint(tmp_path, 1, {"model": model}, {}, keep=1)
    other = Gamba(replace(model.config, width=24, norm="rms"))
    with pytest.raises(UserError, match="another width, norm"):
        load_weights(path / "model.safetensors", other)
