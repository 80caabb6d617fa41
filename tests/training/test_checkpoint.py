"""Checkpoints: round trip, atomicity, damage."""

import copy
import errno
import math
import os
import pickle
import zipfile
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from helpers import micro
from helpers.children import ran
from helpers.forked import python
from helpers.nodes.processes import environment
from helpers.refusals import refused

from gamba_warp.model.checkpoint import load_model
from gamba_warp.model.gamba import Gamba
from gamba_warp.train import checkpoint
from gamba_warp.train.checkpoint import (
    check_state,
    find_checkpoint,
    list_checkpoints,
    load_weights,
    read_state,
    save_checkpoint,
)
from gamba_warp.train.optim import build_optimizer, checked_moments


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
    assert names(tmp_path) == sorted(os.listdir(tmp_path / "checkpoints"))
    assert names(tmp_path) == ["step_000100", "step_1000000"]
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
    monkeypatch.setattr(checkpoint.torch, "save", Mock(side_effect=error))
    said = "cannot write .*step_000002"
    refused(said, save_checkpoint, tmp_path, 2, {"model": model}, {"a": 2}, keep=1)
    assert names(tmp_path) == ["step_000001"]
    assert read_state(find_checkpoint(tmp_path, "auto")) == {"a": 1}
    assert os.listdir(tmp_path / "checkpoints") == ["step_000001"], "no leftovers"


def test_killed_while_saving_leaves_the_old_one(tmp_path, model):
    """A process is killed between two files of its second checkpoint."""
    script = (
        "import os, sys\n"
        "from helpers import micro\n"
        "from pathlib import Path\n"
        "from gamba_warp import Gamba\n"
        "from gamba_warp.train import checkpoint\n"
        "run = Path(sys.argv[1])\n"
        "model = Gamba(micro.options(run, run).model_config())\n"
        "checkpoint.save_checkpoint(run, 1, {'model': model}, {'a': 1}, keep=1)\n"
        "checkpoint.torch.save = lambda *_: os.kill(os.getpid(), 9)\n"
        "checkpoint.save_checkpoint(run, 2, {'model': model}, {'a': 2}, keep=1)\n"
    )
    assert ran(python(), "-c", script, tmp_path, env=environment()).returncode == -9
    assert names(tmp_path) == ["step_000001"]
    assert len(os.listdir(tmp_path / "checkpoints")) == 2, "the unfinished folder is there"
    assert read_state(find_checkpoint(tmp_path, "auto")) == {"a": 1}
    save_checkpoint(tmp_path, 3, {"model": model}, {"a": 3}, keep=1)
    assert os.listdir(tmp_path / "checkpoints") == ["step_000003"], "and cleared by the next save"


@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.95])
def test_truncated_files(tmp_path, model, fraction):
    path = save_checkpoint(tmp_path, 1, {"model": model}, {"t": torch.zeros(5000)}, keep=1)
    for name in ("state.pt", "model.safetensors"):
        whole = (path / name).read_bytes()
        (path / name).write_bytes(whole[: int(fraction * len(whole))])
    refused("state.pt: damaged", read_state, path)
    refused("model.safetensors", load_weights, path / "model.safetensors", model)


def test_missing_files(tmp_path, model):
    refused("no such file", read_state, tmp_path)
    refused("no such file", load_weights, tmp_path / "model.safetensors", model)
    assert find_checkpoint(tmp_path, "auto") is None
    assert find_checkpoint(tmp_path, "never") is None


def test_code_in_a_state_file_is_not_run(tmp_path):
    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "owned"),)

    (tmp_path / "state.pt").write_bytes(pickle.dumps(Evil(), protocol=2))
    refused("damaged", read_state, tmp_path)
    torch.save(Evil(), tmp_path / "state.pt")
    refused("damaged", read_state, tmp_path)
    assert not (tmp_path / "owned").exists()


def test_other_model_is_named(tmp_path, model):
    path = save_checkpoint(tmp_path, 1, {"model": model}, {}, keep=1)
    other = Gamba(replace(model.config, width=24, norm="rms"))
    refused("a different width, norm", load_weights, path / "model.safetensors", other)


@pytest.fixture
def two(tmp_path, model):
    """Two checkpoints, steps 1 and 2."""
    return [save_checkpoint(tmp_path, n, {"model": model}, {"a": n}, keep=3) for n in (1, 2)]


def flip(path, fraction):
    """Change one bit of a file."""
    data = bytearray(path.read_bytes())
    data[int(fraction * (len(data) - 1))] ^= 4
    path.write_bytes(data)


@pytest.mark.parametrize("name", ["model.safetensors", "state.pt", "checksums.json"])
@pytest.mark.parametrize("fraction", [0.0, 0.5, 0.97, 1.0])
def test_a_flipped_bit_is_found_and_the_older_checkpoint_taken(tmp_path, two, name, fraction):
    flip(two[1] / name, fraction)
    said = []
    assert find_checkpoint(tmp_path, "auto", said.append) == two[0]
    assert len(said) == 1 and "step_000002" in said[0] and f"resuming from {two[0]}" in said[0]
    words = f"step_000002/.*; --resume {two[0]} is intact"
    refused(words, find_checkpoint, tmp_path, str(two[1]))
    flip(two[0] / "model.safetensors", 0.6)
    refused("no checkpoint of this run is intact", find_checkpoint, tmp_path, "auto")


@pytest.mark.parametrize("kind", ["pipe", "link", "folder"])
def test_what_is_no_plain_file_is_damage(tmp_path, two, kind):
    path = two[1] / "model.safetensors"
    path.unlink()
    {"pipe": os.mkfifo, "folder": os.mkdir}.get(kind, lambda p: p.symlink_to("/dev/zero"))(path)
    said = []
    assert find_checkpoint(tmp_path, "auto", said.append) == two[0]
    assert "not a plain file" in said[0]


def test_a_file_that_is_gone_is_damage(tmp_path, two):
    for name in ("model.safetensors", "state.pt", "checksums.json"):
        (two[1] / name).unlink()
        assert find_checkpoint(tmp_path, "auto", [].append) == two[0], name
    save_checkpoint(tmp_path, 2, {}, {"a": 2}, keep=3)  # its checksums do not include the model
    assert find_checkpoint(tmp_path, "auto", [].append) == two[0]


def test_a_damaged_later_checkpoint_pushes_out_no_whole_one(tmp_path, model):
    for step in (1, 2, 9):
        save_checkpoint(tmp_path, step, {"model": model}, {}, keep=3)
    flip(tmp_path / "checkpoints" / "step_000009" / "state.pt", 0.5)
    save_checkpoint(tmp_path, 3, {"model": model}, {}, keep=1)
    assert names(tmp_path) == ["step_000003", "step_000009"]
    assert find_checkpoint(tmp_path, "auto", [].append).name == "step_000003"


STATE = {
    "version": 2, "config": {"seed": 0}, "objects": "abc", "step": 3, "skipped": 0,
    "skipped_in_row": 0, "elapsed": 1.5, "world_size": 1, "ema_updates": 3, "optimizer": {},
    "rng": torch.Generator().get_state(), "rng_cuda": [], "new_length": {}, "scores": {},
}  # fmt: skip


@pytest.mark.parametrize(
    "field, value",
    [
        ("step", -1), ("step", 2.5), ("step", True), ("step", None), ("step", 10**15),
        ("skipped", "0"), ("elapsed", math.nan), ("elapsed", math.inf), ("elapsed", -1.0),
        ("world_size", 0), ("config", []), ("optimizer", None), ("rng_cuda", None),
        ("rng_cuda", [3]), ("rng", torch.zeros(3)), ("rng", torch.zeros(3, dtype=torch.uint8)),
        ("rng", torch.full_like(STATE["rng"], 255)), ("surprise", 1), (None, "step"),
    ],
)  # fmt: skip
def test_fields_of_a_state_are_checked(field, value):
    check_state(STATE, "x")
    state = dict(STATE)
    if field is None:
        del state[value]
    else:
        state[field] = value
    refused("^run/state.pt: damaged, ", check_state, state, "run/state.pt")


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda s: s.pop("state"), "no state"),
        (lambda s: s["state"].update({99: {}}), "parameter '99'"),
        (lambda s: s["state"][0].pop("step"), "parameter 0 has other fields"),
        (lambda s: s["state"].update({0: 5}), "parameter 0 has other fields"),
        (lambda s: s["state"][0].update(exp_avg=torch.ones(3)), "parameter 0 has shape"),
        (lambda s: s["state"][0].update(exp_avg=1.0), "exp_avg of parameter 0 is not a float32"),
        (lambda s: s["state"][0].update(step=torch.ones((), dtype=torch.int64)), "not a float32"),
        (lambda s: s["state"][0]["exp_avg"].fill_(math.nan), "exp_avg .* not finite"),
        (lambda s: s["state"][0]["exp_avg_sq"].fill_(-1.0), "exp_avg_sq .* negative"),
        (lambda s: s["state"][0]["step"].fill_(math.inf), "step .* not finite"),
    ],
)
def test_moments_of_a_state_are_checked(model, change, words):
    optimizer = build_optimizer(model)
    for parameter in model.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    stored = copy.deepcopy(optimizer.state_dict())
    stored["param_groups"][0]["betas"] = (5.0, -1.0)  # settings are not taken from a file
    optimizer.load_state_dict(checked_moments(optimizer, stored, Path("run/state.pt")))
    assert optimizer.param_groups[0]["betas"] == (0.9, 0.95)
    change(stored)
    line = f"^run/state.pt: damaged, .*{words}"
    refused(line, checked_moments, optimizer, stored, Path("run/state.pt"))


def repacked(path, change, packing=zipfile.ZIP_STORED):
    """Rewrite a torch file with a changed pickle, or with compressed members."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", packing) as archive:
        for name, data in members.items():
            archive.writestr(name, change(data) if name.endswith("data.pkl") else data)


def test_a_state_that_claims_more_than_it_holds(tmp_path):
    path = tmp_path / "state.pt"
    torch.save({"a": torch.arange(10.0)}, path)
    repacked(path, lambda data: data.replace(b"K\x0a", b"J\x40\x42\x0f\x00"))  # 10 to 1,000,000
    refused("state.pt: damaged.*", read_state, tmp_path)
    torch.save({"a": torch.arange(10.0)}, path)
    repacked(path, lambda data: data, zipfile.ZIP_DEFLATED)
    refused("state.pt: damaged.*compressed", read_state, tmp_path)
    endless, wide = [], [0]
    endless.append(endless)
    for _ in range(12):
        wide = [wide] * 10
    for value, words in (
        ({"a": torch.ones(1).expand(10**6, 10**6)}, "larger than the file"),  # 4 TB after a copy
        ({"a": endless}, "nested deeper"),
        ({"a": wide}, "over 1,000,000 values"),
        ([1], "not contain the state"),
        ({"a": torch.ones(3).to_sparse()}, "not dense"),
    ):
        torch.save(value, path)
        refused(f"state.pt: damaged.*{words}", read_state, tmp_path)
