"""Killed training resumes to the same bits; other commands never lose older results.

``make endurance`` kills more often, and every command of ``JOBS``; it prints a line for each. A
full disk is simulated by a limit on the size of a file (``RLIMIT_FSIZE``).
"""

import os
import random
import shutil

import numpy as np
import pytest
import torch
from helpers.gaussians import khr_glb, some
from safetensors.torch import save_file

from gamba_warp.files import sha256, sha256_of_all
from gamba_warp.formats.ply import save_ply
from gamba_warp.images import save_image
from gamba_warp.train.checkpoint import damage, list_checkpoints

from .child import gamba
from .folders import age, contents, is_whole, leftovers, lost
from .jobs import JOBS, make_world, training, undisturbed

LONG = "GAMBA_ENDURANCE_KILLS" in os.environ
KILLS = int(os.environ.get("GAMBA_ENDURANCE_KILLS", "2"))  # of each command; more for training
FULL = int(os.environ.get("GAMBA_ENDURANCE_FULL", "2"))  # full disks, of each command
SEED = int(os.environ.get("GAMBA_ENDURANCE_SEED", "0"))
CHOSEN = list(JOBS) if LONG else ["reconstruct"]


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    folder = tmp_path_factory.mktemp("world")
    make_world(folder, CHOSEN)
    yield folder
    shutil.rmtree(folder)


def tell(command, fault, tried, hit, left):
    """Print a line of the results, if nothing was lost."""
    print(f"\n| {command} | {fault} | {tried} | {hit} | 0 | 0 | 0 | {left} | 0 |")


def newest(out):
    """Step of the newest complete checkpoint; -1 without one."""
    steps = [int(p.name.split("_")[1]) for p in list_checkpoints(out) if not damage(p)]
    return max(steps, default=-1)


def trained(out):
    """Digests of the model and of the newest checkpoint's weights."""
    last = list_checkpoints(out)[-1]
    return sha256(out / "model.safetensors"), sha256_of_all(last.glob("*.safetensors"), last)


@pytest.mark.slow
def test_killed_training_goes_on_to_the_same_bits(world, tmp_path):
    kills, steps, rng = (5 * KILLS, 60, random.Random(SEED)) if LONG else (4, 12, random.Random(0))
    quiet = undisturbed(*training(world, tmp_path / "quiet", steps))
    wanted, hit, left, tried, turn = trained(tmp_path / "quiet"), 0, 0, 0, 0
    while tried < kills:
        turn, step, ended = turn + 1, -1, False
        out = tmp_path / f"killed-{turn}"
        while not ended and tried < kills:
            after = rng.uniform(0, 0.7 * quiet.seconds)
            end = gamba(*training(world, out, steps), kill_after=after)
            tried, hit, ended = tried + 1, hit + end.killed, end.code == 0
            assert ended or end.killed, f"it did not go on: {end.said[-2000:]}"
            left += len(leftovers(out)) if out.exists() else 0
            assert newest(out) >= step, f"step {step} is gone"
            step = newest(out)
        if not ended:
            undisturbed(*training(world, out, steps))
        assert trained(out) == wanted and not leftovers(out)
    tell("train", "SIGKILL", tried, hit, left)


@pytest.mark.slow
def test_training_on_a_full_disk_keeps_its_checkpoint(world, tmp_path):
    out, steps, rng, hit, left = tmp_path / "filled", 4, random.Random(SEED), 0, 0
    undisturbed(*training(world, out, steps))
    largest = max(map(len, contents(out).values()))
    for _ in range(FULL):
        before, steps = newest(out), steps + 4
        words = training(world, out, steps)
        end = gamba(*words, file_limit=rng.randrange(largest))
        hit += end.code != 0
        assert end.code == 0 or end.is_one_line, end.said[-2000:]
        assert newest(out) >= before
        left += len(leftovers(out))
        undisturbed(*words)
    assert not leftovers(out)
    tell("train", "full disk", FULL, hit, left)


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["SIGKILL", "full disk"])
@pytest.mark.parametrize("name", CHOSEN)
def test_a_disturbed_command_loses_nothing(world, tmp_path, name, fault):
    """Older results remain or are replaced by complete ones."""
    job, out, rng, hit = JOBS[name], tmp_path / "out", random.Random(f"{SEED} {name} {fault}"), 0
    words = job.words(world, out)
    first = undisturbed(*words)
    if job.undo is not None:  # existing results would be skipped
        job.undo(out)
        first = undisturbed(*words)
    whole = contents(out)
    largest = max(map(len, whole.values()))
    times = KILLS if fault == "SIGKILL" else FULL
    for turn in range(times):
        if job.undo is not None and out.exists():
            job.undo(out)
        before = contents(out)
        changed = [*words, *(job.other.split() if turn % 2 == 0 else ())]
        if fault == "SIGKILL":
            after = rng.uniform(0.02, 1.1) * first.seconds
            end = gamba(*changed, kill_after=after)
            hit += end.killed
        else:
            end = gamba(*changed, file_limit=rng.randrange(1, largest))
            hit += end.code != 0
            assert end.code == 0 or end.is_one_line, end.said[-2000:]
        assert not lost(before, contents(out))
    left = len(leftovers(out)) if out.exists() else 0
    age(out)
    undisturbed(*words)
    assert contents(out).keys() == whole.keys() and not leftovers(out)
    tell(name, fault, times, hit, left)


def test_files_cut_short_are_not_whole(tmp_path):
    save_ply(tmp_path / "a.ply", some(9))
    (tmp_path / "a.glb").write_bytes(khr_glb(some(9)))
    save_file({"a": torch.rand(3), "b": torch.rand(2, 2)}, tmp_path / "a.safetensors")
    save_image(tmp_path / "a.png", np.random.default_rng(0).random((9, 9, 3)))
    (tmp_path / "a.html").write_text("<p></p>\n</html>\n")
    (tmp_path / "a.json").write_text('{"a": 1}\n')
    (tmp_path / "a.csv").write_text("a\n")
    for name, data in contents(tmp_path).items():
        assert is_whole(name, data), name
        assert not is_whole(name, data[:-1]), name
        assert not is_whole(name, b""), name


def test_children_are_killed_and_find_a_full_disk(tmp_path):
    save_ply(tmp_path / "a.ply", some(9))
    words = "stress", "scan", "--minutes", 1, "--device", "cpu", "--out", tmp_path
    end = gamba(*words, kill_after=0.1)
    assert end.killed and end.code == -9 and end.seconds < 30
    words = "view", tmp_path / "a.ply", "--out", tmp_path / "a.html", "--no-open-browser"
    end = gamba(*words, file_limit=5)
    assert end.code == 2 and end.is_one_line and "File too large" in end.said
