"""Several processes train like one: the same sums, averaged logs, the same end."""

import json

import pytest
import torch
from helpers import micro, on_threads
from helpers.micro import lines, run, same_weights
from helpers.nodes.processes import train_all, words
from helpers.refusals import refused
from safetensors.torch import load_file

from gamba_warp.train.checkpoint import list_checkpoints

pytestmark = pytest.mark.slow  # a process takes seconds to import torch

STEPS = 4
VIEWS = {"background": "random", "views_per_object": None, "flip": 0.5, "color_jitter": 0.5}
OPTIONS = ["--steps", STEPS, "--background", "random", "--flip", 0.5, "--color-jitter", 0.5]
OPTIONS += ["--save-every", 1]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return micro.write_dataset(tmp_path_factory.mktemp("data") / "clouds", 6)


@pytest.fixture(scope="module")
def runs(data, tmp_path_factory):
    """Runs of 1 x 4 objects, 2 x 2 in turn, and 2 x 2 in two processes."""
    folder = tmp_path_factory.mktemp("runs")
    alone = {"length": {"steps": STEPS}, "run": {"save_every": 1, "threads": 1}}
    with on_threads(1):  # as in the processes, since threads split sums
        assert run(data, folder / "whole", views={**VIEWS, "batch_size": 4}, **alone) == 0
        halves = {**VIEWS, "batch_size": 2, "accumulate": 2}
        assert run(data, folder / "halves", views=halves, **alone) == 0
    ends = train_all([words(data, folder / name, *OPTIONS) for name in ("two", "not-there")])
    assert [end.returncode for end in ends] == [0, 0], ends
    assert not (folder / "not-there").exists()  # only the first process writes
    assert ends[1].stdout == ""
    # Warp itself reports in every process that no driver was found.
    assert all(line.startswith("Warp CUDA warning") for line in ends[1].stderr.splitlines())
    return folder


def weights(run, step, kind="model"):
    return run / "checkpoints" / f"step_{step:06d}" / f"{kind}.safetensors"


def test_two_processes_have_the_bits_of_two_halves_in_turn(runs):
    """Halving a sum is exact, and the sum of two numbers has no order."""
    for kind in ("model", "ema"):
        for step in range(1, STEPS + 1):
            files = [weights(runs / name, step, kind) for name in ("halves", "two")]
            assert same_weights(*files), (step, kind)
    alone, both = (lines(runs / name, "train") for name in ("halves", "two"))
    for a, b in zip(alone, both, strict=True):
        assert b["loss"] == pytest.approx(a["loss"], rel=1e-5)  # of the log's six digits
        assert b["grad_norm"] == a["grad_norm"]


def test_two_processes_with_half_the_batch_are_one_to_rounding(runs):
    alone, both = (lines(runs / name, "train") for name in ("whole", "two"))
    for a, b in zip(alone, both, strict=True):  # of all objects, not of the first process's
        for name in ("loss", "loss_rgb", "loss_mask", "psnr", "spread", "mean_alpha", "grad_norm"):
            assert b[name] == pytest.approx(a[name], rel=1e-5), name  # of the log's six digits
    for step in range(1, STEPS + 1):
        one, two = (load_file(weights(runs / name, step)) for name in ("whole", "two"))
        for name, value in one.items():
            # Sums of gradients in another order differ by 1e-7 of their largest parts. Adam divides
            # each by its own size: an entry a thousandth of those moves by 1e-3 * 1e-4 a step more
            # or less. Found: 1.2e-7 after four steps, in which weights moved by up to 3e-3.
            torch.testing.assert_close(two[name], value, atol=1e-6, rtol=0, msg=name)


def test_two_processes_become_one_and_one_becomes_two(data, runs, tmp_path):
    """The number of objects a step stays: the batches do, and by halves in turn the bits too."""
    halves = {**VIEWS, "batch_size": 2, "accumulate": 2}
    options = {"length": {"steps": STEPS}, "views": halves}
    step = "checkpoints/step_000002"
    with on_threads(1):
        resumed = {"resume": str(runs / "two" / step), "threads": 1}
        assert run(data, tmp_path / "one", run=resumed, **options) == 0
    resume = ["--resume", runs / "halves" / step]
    two = [words(data, tmp_path / name, *OPTIONS, *resume) for name in ("two", "not-there")]
    assert [end.returncode for end in train_all(two)] == [0, 0]
    for name in ("one", "two"):
        assert same_weights(weights(tmp_path / name, STEPS), weights(runs / "halves", STEPS)), name
    options["views"] = {**VIEWS, "batch_size": 2}
    said = r"objects a step \(4 there, 2 here: --batch-size 4 keeps it\)"
    refused(said, run, data, tmp_path / "other", run=resumed, **options)


def test_the_run_is_one_of_all_processes(runs):
    (start,) = lines(runs / "two", "start")
    assert json.loads((runs / "two" / "config.json").read_text()) == start["config"]
    assert [p.name for p in list_checkpoints(runs / "two")][-1] == f"step_{STEPS:06d}"
