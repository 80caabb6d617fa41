"""Training loop: bit-identical resumption, skipping of non-finite steps, invalid checkpoints."""

import io
import itertools
import json
import math
import os
import re
import shutil
import signal
import sys
import time
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from helpers import micro
from helpers.micro import lines, run
from helpers.model import micro as small
from helpers.refusals import refused
from PIL import Image
from safetensors.torch import load_file
from torch.utils.checkpoint import checkpoint

from gamba_warp import batch
from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.files import sha256
from gamba_warp.model.gamba import Gamba
from gamba_warp.train import loop, step, validation
from gamba_warp.train.batches import choose_views
from gamba_warp.train.checkpoint import list_checkpoints
from gamba_warp.train.objective import losses
from gamba_warp.train.optim import Ema, build_optimizer
from gamba_warp.vision.lpips import LPIPS


def assert_same_files(a, b):
    assert micro.same_weights(a, b) and sha256(a) == sha256(b)


def on_forward(monkeypatch, change):
    """Call ``change(number, result)`` after each forward pass, numbered from 1."""
    real, numbers = step.forward, itertools.count(1)

    def changed(*arguments):
        result = real(*arguments)
        change(next(numbers), result)
        return result

    monkeypatch.setattr(step, "forward", changed)


def spoil(monkeypatch, factor):
    """Multiply the loss of each step by ``factor(number)``."""

    def multiply(number, result):
        result.loss = result.loss * factor(number)

    on_forward(monkeypatch, multiply)


def stop_after(monkeypatch, count):
    """Send SIGTERM to this process in the middle of step ``count``."""
    on_forward(monkeypatch, lambda n, _: n == count and os.kill(os.getpid(), signal.SIGTERM))


class Difference(torch.nn.Module):
    """A stand-in for LPIPS."""

    def forward(self, got, want):
        return (got - want).abs().mean((-3, -2, -1))


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_progress_is_a_bar_on_a_terminal_and_lines_in_a_log(data, tmp_path, monkeypatch):
    def shown(stream, out, **length):
        monkeypatch.setattr(sys, "stderr", stream)
        assert run(data, tmp_path / out, length=length) == 0
        return stream.getvalue()

    assert "2/2" in shown(Terminal(), "steps", steps=2)
    minutes = {"steps": None, "minutes": 0.02}
    bar = shown(Terminal(), "minutes", **minutes)
    assert "of 0.02 min, step=1, loss=" in bar and re.search(r"\b(9\d|100)%\|", bar), bar
    monkeypatch.setattr(batch, "LINE_SECONDS", 3600.0)  # a busy machine may need ten seconds
    assert shown(io.StringIO(), "quick", steps=3) == ""
    monkeypatch.setattr(batch, "LINE_SECONDS", 0.0)
    text = shown(io.StringIO(), "log", steps=3)
    assert "3/3 steps [00:0" in text and "loss=" in text and "psnr=" in text
    assert "\r" not in text and all(text.splitlines())
    assert "of 0.02 min, step=1, loss=" in shown(io.StringIO(), "log of minutes", **minutes)


def test_lines_of_progress_are_seconds_apart(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(batch.time, "monotonic", lambda: now[0])
    stream = io.StringIO()
    with batch.progress_bar(total=100, lines=True, file=stream, unit="step", mininterval=0) as bar:
        for _ in range(100):
            now[0] += 1.0
            bar.update(1)
    counts = [int(line.split("/")[0]) for line in stream.getvalue().splitlines()]
    assert counts == list(range(10, 101, 10))


def test_recomputation_changes_no_bit(data, tmp_path, monkeypatch):
    assert run(data, tmp_path / "plain") == 0
    counting = Mock(wraps=checkpoint)
    monkeypatch.setattr("gamba_warp.model.parts.block.checkpoint", counting)
    assert run(data, tmp_path / "lean", run={"activation_checkpointing": True}) == 0
    assert counting.call_count == 6  # one block, six steps; none in validation
    assert_same_files(tmp_path / "plain/model.safetensors", tmp_path / "lean/model.safetensors")


@pytest.mark.parametrize("accumulate", [1, 2])
def test_resume_is_bit_identical(data, tmp_path, monkeypatch, accumulate):
    monkeypatch.setattr(losses, "load_lpips", Difference)
    # The number of views changes at almost every step, so that one prepared too early would show.
    views = {"accumulate": accumulate, "background": "random", "views_per_object": None, "size": 20}
    # The positions of the crops come from torch's random numbers.
    views = {"views": views, "loss": {"lpips": "on", "lpips_crop": 16}}
    assert run(data, tmp_path / "whole", **views) == 0
    with monkeypatch.context() as patch:
        stop_after(patch, 3 * accumulate)
        assert run(data, tmp_path / "parts", **views) == 128 + signal.SIGTERM
    assert [p.name for p in list_checkpoints(tmp_path / "parts")] == ["step_000003"]
    assert not (tmp_path / "parts" / "model.safetensors").exists()
    assert run(data, tmp_path / "parts", **views) == 0
    for name in ("model", "ema"):
        file = f"checkpoints/step_000006/{name}.safetensors"
        assert_same_files(tmp_path / "whole" / file, tmp_path / "parts" / file)
    assert_same_files(*(tmp_path / part / "model.safetensors" for part in ("whole", "parts")))
    whole, parts = (lines(tmp_path / part, "train") for part in ("whole", "parts"))
    assert [r["loss"] for r in whole] == [r["loss"] for r in parts] and len(whole) == 6
    first, last = (f"checkpoints/step_00000{n}/model.safetensors" for n in (3, 6))
    assert not micro.same_weights(tmp_path / "parts" / first, tmp_path / "parts" / last)


def test_a_damaged_newest_checkpoint_is_passed_over_and_named(data, tmp_path, capsys):
    short = {"length": {"steps": 4}, "run": {"save_every": 2}}
    assert run(data, tmp_path, **short) == 0
    state = tmp_path / "checkpoints" / "step_000004" / "state.pt"
    content = bytearray(state.read_bytes())
    content[len(content) // 2] ^= 1
    state.write_bytes(content)
    capsys.readouterr()
    assert run(data, tmp_path, **short) == 0
    out = capsys.readouterr().out
    assert "step_000004/state.pt: damaged" in out and "resumed" in out and "at step 2" in out
    assert any("resuming from" in line["message"] for line in lines(tmp_path, "warning"))
    assert run(data, tmp_path, **short) == 0  # the fourth step has been written again
    assert "resuming from" not in capsys.readouterr().out


def test_nothing_is_loaded_where_a_part_is_damaged(data, tmp_path, monkeypatch):
    assert run(data, tmp_path, length={"steps": 2}) == 0
    folder = list_checkpoints(tmp_path)[-1]
    sums = json.loads((folder / "checksums.json").read_text())
    del sums["ema.safetensors"]
    (folder / "checksums.json").write_text(json.dumps(sums))
    (folder / "ema.safetensors").unlink()
    loaded = []
    monkeypatch.setattr(Gamba, "load_stored_state", lambda *arguments: loaded.append(1))
    refused("ema.safetensors: no such file", run, data, tmp_path, length={"steps": 4})
    assert not loaded


def test_a_run_learns_and_writes_everything(tmp_path):
    """One object for training and validation: better by far than at the start."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    data = micro.write_dataset(tmp_path / "clouds", 1)
    shutil.copytree(data / "clouda", data / "cloudb")
    micro.write_split(data, train=["clouda"], val=["cloudb"])
    options = {"views": {"batch_size": 4, "views_per_object": 3}, "run": {"val_every": 60}}
    options |= {"length": {"steps": 120}, "optim": {"lr": 5e-3, "ema": 0.9}}
    assert run(data, tmp_path, **options) == 0
    records = lines(tmp_path, "val")
    assert [record["step"] for record in records] == [60, 120]
    assert records[-1]["psnr_novel"] > 20 and records[-1]["psnr_input"] > 20
    seen = lines(tmp_path, "seen")[-1]  # the same object
    assert seen == records[-1] | {key: seen[key] for key in ("event", "time", "minutes")}
    assert records[-1]["psnr_grey_novel"] > 15 < records[-1]["psnr_black_input"]
    train_records = lines(tmp_path, "train")
    wanted = "loss loss_rgb loss_mask loss_rdist lr grad_norm views_per_second mean_alpha "
    wanted += "visible_share spread psnr epoch skipped"
    assert {*wanted.split()} <= {*train_records[0]}
    assert train_records[0]["loss"] > 2 * train_records[-1]["loss"]
    strip = np.asarray(Image.open(tmp_path / "samples" / "step_000120.png"))
    assert strip.shape == (2 * micro.SIZE, 5 * micro.SIZE, 3)
    assert lines(tmp_path, "start")[0]["config"]["model"]["width"] == 16
    assert json.loads((tmp_path / "latest.json").read_text())["step"] == 120
    board = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert board.Images("val/images")[-1].height == 2 * micro.SIZE


def test_validation_is_on_training_and_held_out_objects(data, tmp_path, monkeypatch):
    trained, validated = Mock(wraps=step.forward), Mock(wraps=step.forward)
    monkeypatch.setattr(step, "forward", trained)
    monkeypatch.setattr(validation, "forward", validated)
    assert run(data, tmp_path, length={"steps": 2}, run={"val_every": 1}) == 0
    uids = [[call.args[1].uids for call in each.call_args_list] for each in (trained, validated)]
    assert {uid for batch in uids[0] for uid in batch} <= {"clouda", "cloudb"}
    assert uids[1] == 2 * [["clouda"], ["cloudb"], ["cloudc"]]


def test_a_validation_is_of_images_in_range(monkeypatch):
    target = torch.ones(1, 2, 4, 4, 3)
    shown = {"rgb": target + 5, "alpha": target[..., :1]}
    front = Cameras(orbit(torch.zeros(2)), intrinsics(4, 4).expand(2, 3, 3), 4, 4)[None]
    targets = torch.ones(1, 2, 4, 4, 4)
    batch = SimpleNamespace(targets=targets, cameras=front, to=lambda device: batch)
    result = SimpleNamespace(loss=torch.zeros(()), **shown, target=target, terms={})
    monkeypatch.setattr(validation, "forward", lambda *_: result)
    given = torch.nn.Identity(), [batch], step.Objective({}), torch.device("cpu")
    figures, _ = validation.validate(*given)
    assert figures["psnr_input"] == figures["psnr_novel"] == 100


def test_non_finite_step_is_skipped_and_counted(data, tmp_path, monkeypatch, capsys):
    spoil(monkeypatch, lambda number: math.nan if number == 3 else 1)
    assert run(data, tmp_path, run={"save_every": 1}) == 0
    saved = [path / "model.safetensors" for path in list_checkpoints(tmp_path)]
    assert len(saved) == 6
    same = [micro.same_weights(a, b) for a, b in itertools.pairwise(saved)]
    assert same == [False, True, False, False, False]
    assert lines(tmp_path, "train")[-1]["skipped"] == 1
    assert "step 3" in lines(tmp_path, "warning")[0]["message"]
    assert lines(tmp_path, "train")[2]["loss"] is None
    assert "1 of 6 steps were skipped" in capsys.readouterr().out


def test_gives_up_after_many_non_finite_steps(data, tmp_path, monkeypatch):
    spoil(monkeypatch, lambda number: math.inf)
    monkeypatch.setattr(loop, "MAX_SKIPPED", 3)
    refused("3 steps in a row were not finite", run, data, tmp_path)


def test_collapse_is_reported():
    healthy = {"target_alpha": 0.3, "mean_alpha": 0.3, "visible_share": 0.5, "spread": 0.2}
    assert step.collapse_reason(healthy) is None
    assert "empty" in step.collapse_reason({**healthy, "mean_alpha": 0.01})
    assert "visible" in step.collapse_reason({**healthy, "visible_share": 0.0})
    assert "one point" in step.collapse_reason({**healthy, "spread": 0.001})


def test_collapse_warns_once(data, tmp_path):
    model = (*micro.MODEL, "opacity_init=0.0001")
    assert run(data, tmp_path, model, optim={"lr": 1e-9}) == 0
    assert ["collapse" in w["message"] for w in lines(tmp_path, "warning")] == [True]


def test_a_run_is_resumed_only_as_asked(data, tmp_path):
    assert run(data, tmp_path / "a", length={"steps": 2}) == 0
    refused("already holds a run", run, data, tmp_path / "a", run={"resume": "never"})
    elsewhere = {"resume": str(tmp_path / "nothing")}
    refused("no checkpoint found", run, data, tmp_path / "b", run=elsewhere)
    refused("optim.lr", run, data, tmp_path / "a", optim={"lr": 2e-3})
    refused("loss.radial_mask", run, data, tmp_path / "a", loss={"radial_mask": False})
    refused("run.seed", run, data, tmp_path / "a", run={"seed": 7})
    deeper = (*micro.MODEL[:3], "depth=2")
    refused(r"model\.depth \(1 there, 2 here\)", run, data, tmp_path / "a", deeper)
    assert run(data, tmp_path / "c", run={"resume": str(tmp_path / "a")}) == 0
    assert [record["step"] for record in lines(tmp_path / "c", "train")] == [3, 4, 5, 6]


def test_bad_data_and_bad_options(data, tmp_path):
    (tmp_path / "file").write_text("")
    refused("file", run, data, tmp_path / "file" / "run")
    refused("no such folder", run, tmp_path / "missing", tmp_path / "run")
    refused("nofield", micro.options, data, tmp_path / "run", ("nofield=3",))
    assert not (tmp_path / "run").exists(), "bad input leaves nothing behind"


def test_minutes_alone_limit_the_run(data, tmp_path, monkeypatch):
    """With a clock that advances one second per reading, two minutes are about 120 readings."""
    ticks = itertools.count()
    clock = SimpleNamespace(monotonic=lambda: float(next(ticks)), perf_counter=time.perf_counter)
    monkeypatch.setattr(loop, "time", clock)
    options = {"length": {"steps": None, "minutes": 0.5}, "run": {"save_every": 99}}
    with monkeypatch.context() as patch:
        stop_after(patch, 10)
        assert run(data, tmp_path, **options) == 128 + signal.SIGTERM
    assert run(data, tmp_path, **options) == 0  # the time before counts
    records = lines(tmp_path, "train")
    assert 25 <= len(records) <= 30
    rates = [record["lr"] for record in records]
    # One step in 29 is left at the end of the cosine: 0.5 (1 + cos(28/29 π)) = 0.003.
    assert rates[-1] < 0.02 * max(rates) and max(rates) > 0.9e-3
    saving = {"run": {"save_every": 99, "save_minutes": 0.1}}  # six readings
    assert run(data, tmp_path / "saving", length={"steps": 20}, **saving) == 0
    steps = [int(path.name[5:]) for path in list_checkpoints(tmp_path / "saving")]
    assert len(steps) == 4 and steps[-1] == 20 and steps[1] - steps[0] == 6
    options = {"length": {"steps": 99, "minutes": 0.1}}
    assert run(data, tmp_path / "both", **options) == 0
    (warning,) = (record["message"] for record in lines(tmp_path / "both", "warning"))
    assert "ends the run at step" in warning and "of 99, before the learning rate" in warning


def test_views_are_distinct_while_they_last():
    rng = np.random.default_rng(0)
    for _ in range(20):
        views = choose_views(6, 5, None, rng)
        assert sorted(views) == list(range(6))
    assert choose_views(6, 3, 0, rng)[0] == 0
    assert len(choose_views(2, 4, None, rng)) == 5
    assert choose_views(1, 2, None, rng) == [0, 0, 0]


def test_lpips_is_real_or_absent(data, tmp_path, monkeypatch):
    monkeypatch.setattr(losses, "lpips_available", lambda: False)
    short = {"length": {"steps": 3}}
    assert run(data, tmp_path / "auto", loss={"lpips": "auto"}, **short) == 0
    warnings = [record["message"] for record in lines(tmp_path / "auto", "warning")]
    assert len(warnings) == 1 and "no LPIPS weights" in warnings[0]
    assert "loss_lpips" not in lines(tmp_path / "auto", "train")[0]

    config = micro.options(data, tmp_path, loss={"lpips": "auto"})
    monkeypatch.setattr(losses, "lpips_available", lambda: True)
    monkeypatch.setattr(losses, "load_lpips", lambda: "real")
    assert losses.open_lpips(config, "cuda") == ("real", None)
    assert losses.open_lpips(config, "cpu") == ("real", losses.COST)
    crop = replace(config, loss=replace(config.loss, lpips_crop=16))
    chosen = replace(config, loss=replace(config.loss, lpips="on"))
    assert losses.open_lpips(crop, "cpu") == losses.open_lpips(chosen, "cpu") == ("real", None)

    class Half(Difference):
        def forward(self, got, want):
            return super().forward(got, want) * 0 + 0.5

    monkeypatch.setattr(losses, "load_lpips", Half)
    loss = {"lpips": "on", "lpips_weight": 3.0, "lpips_after": 2, "radial_mask": False}
    assert run(data, tmp_path / "on", loss=loss, **short) == 0
    records = lines(tmp_path / "on", "train")
    assert ["loss_lpips" in record for record in records] == [False, False, True]
    third = records[2]
    assert third["loss"] == pytest.approx(third["loss_rgb"] + third["loss_mask"] + 1.5, abs=1e-4)
    # A validation's loss has LPIPS from the start; otherwise it would jump when training adds it.
    late = {"loss": loss | {"lpips_after": 9}, "run": {"val_every": 1}}
    assert run(data, tmp_path / "late", **late, **short) == 0
    assert all(record["loss"] > 1.5 for record in lines(tmp_path / "late", "val"))


def test_bfloat16_keeps_float32_weights(data, tmp_path, monkeypatch):
    """bfloat16 is used by the network and LPIPS in a step; a validation uses float32."""
    network, lpips, real = set(), set(), Gamba.forward

    def spy(model, *arguments):
        lower = torch.is_autocast_enabled("cpu") and torch.get_autocast_dtype("cpu")
        network.add((model.training, lower or torch.float32))
        return real(model, *arguments)

    class Square(LPIPS):
        def __init__(self):
            torch.nn.Module.__init__(self)

        def forward(self, got, want, precision=torch.float32):
            lpips.add((torch.is_grad_enabled(), precision))
            return (got - want).square().mean((-3, -2, -1))

    monkeypatch.setattr(Gamba, "forward", spy)
    monkeypatch.setattr(losses, "load_lpips", Square)
    groups = {"optim": {"precision": "bfloat16"}, "loss": {"lpips": "on"}, "run": {"val_every": 3}}
    assert run(data, tmp_path, length={"steps": 3}, **groups) == 0
    assert network == lpips == {(True, torch.bfloat16), (False, torch.float32)}
    weights = load_file(tmp_path / "model.safetensors")
    assert all(value.dtype == torch.float32 for value in weights.values())
    assert all(record["loss"] is not None for record in lines(tmp_path, "train"))


@pytest.mark.parametrize(("gain", "chosen"), [(2.0, "bfloat16"), (1.0, "float32")])
def test_auto_is_the_precision_that_the_trial_finds(data, tmp_path, monkeypatch, gain, chosen):
    monkeypatch.setattr("gamba_warp.devices._bfloat16_speedup", lambda *_: gain)
    for name in ("auto", chosen):
        options = {"optim": {"precision": name}, "length": {"steps": 2}}
        assert run(data, tmp_path / name, **options) == 0
        assert lines(tmp_path / name, "start")[0]["precision"] == chosen
    assert_same_files(*(tmp_path / name / "model.safetensors" for name in ("auto", chosen)))


def test_slow_bfloat16_is_said(data, tmp_path, monkeypatch, capsys):
    for gain, name, said in ((0.25, "bfloat16", 1), (1.5, "bfloat16", 0), (0.25, "float32", 0)):
        monkeypatch.setattr("gamba_warp.devices._bfloat16_speedup", lambda *_, gain=gain: gain)
        out = tmp_path / f"{name} {gain}"
        assert run(data, out, optim={"precision": name}, length={"steps": 1}) == 0
        words = "bfloat16 takes 4.0 times as long as float32"
        assert (words in capsys.readouterr().out) == bool(said)


def test_decay_is_on_matrices_that_are_not_flagged(data):
    model = Gamba(micro.options(data, data).model_config())
    decayed, plain = build_optimizer(model).param_groups
    assert decayed["weight_decay"] == 0.05 and plain["weight_decay"] == 0
    names = {id(p): name for name, p in model.named_parameters()}
    without = {names[id(p)] for p in plain["params"]}
    assert "blocks.0.mamba.in_proj.weight" not in without
    for name in ("A_log", "D", "in_proj.bias", "conv_bias", "norm.weight", "tokens.embedding"):
        matching = [full for full in names.values() if full.endswith(name)]
        assert set(matching) <= without, name
    assert len(decayed["params"]) + len(plain["params"]) == len(names)


@pytest.mark.parametrize("frozen", [True, False])
def test_the_average_is_in_eval_mode_and_shares_a_frozen_encoder(frozen):
    model = Gamba(small(encoder_frozen=frozen), "random").train()
    average = Ema(model, 0.5).model
    assert model.training and not any(part.training for part in average.modules())
    assert (average.encoder is model.encoder) == frozen
    trained = {id(p) for p in model.parameters() if p.requires_grad}
    assert trained.isdisjoint(map(id, average.parameters()))
    assert not any(p.requires_grad for p in average.parameters())
