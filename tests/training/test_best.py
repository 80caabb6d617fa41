"""Validation figures, from the start on, and the best checkpoint by them."""

import pytest
import torch
from helpers import micro
from helpers.views import eval_views

from gamba_warp.train import validation
from gamba_warp.train.checkpoint import list_checkpoints


def test_figures_of_a_validation_are_those_of_eval_views(data, tmp_path):
    out = tmp_path / "run"
    assert micro.run(data, out, run={"val_every": 3}) == 0
    assert [line["step"] for line in micro.lines(out, "val")] == [3, 6]
    assert micro.lines(out, "start")[0]["held_out"] == 1
    options = "--split", "val", "--no-baselines", "--strips", 0, "--sheet", 0, "--views", 5
    _, report = eval_views(out / "model.safetensors", data, tmp_path / "report", *options)
    means = {"novel": report["mean"], "input": report["mean"]["input"]}
    last = micro.lines(out, "val")[-1]
    for view in ("input", "novel"):
        for metric in ("psnr", "ssim", "mask_iou"):
            # The log has six digits; batches and threads change sums of float32 in the last.
            want = pytest.approx(means[view][metric], rel=1e-4, abs=1e-5)
            assert last[f"{metric}_{view}"] == want, (view, metric)


def scripted(monkeypatch, figures):
    """Replace the novel PSNR of validations by given values; 0: no object can be read.

    Before each validation, training objects have better ones, which must not matter.
    """
    rows = [torch.zeros(1, 4, 4, 3)]
    told = iter(
        ({"loss": 1.0, "psnr_input": 50.0, "psnr_novel": psnr + more}, rows if psnr else [])
        for psnr in figures
        for more in (90 - 2 * psnr, 0)
    )
    monkeypatch.setattr(validation, "validate", lambda *_: next(told))


def test_the_best_is_by_novel_views(data, tmp_path, monkeypatch):
    scripted(monkeypatch, [15, 15.5, 15, float("nan"), 0, 14])
    changes = {"val_every": 1, "save_every": 1}
    assert micro.run(data, tmp_path, run=changes) == 0
    best = [(line["step"], line["psnr"]) for line in micro.lines(tmp_path, "best")]
    assert best == [(1, 15.0), (2, 15.5)]
    averages = [path / "ema.safetensors" for path in list_checkpoints(tmp_path)]
    same = [micro.same_weights(each, tmp_path / "best.safetensors") for each in averages]
    assert same == [False, True, False, False, False, False]


def test_a_run_that_goes_on_knows_its_best(data, tmp_path, monkeypatch):
    scripted(monkeypatch, [20, 19])
    assert micro.run(data, tmp_path, run={"val_every": 1}, length={"steps": 2}) == 0
    before = (tmp_path / "best.safetensors").read_bytes()
    scripted(monkeypatch, [15, 16])
    assert micro.run(data, tmp_path, run={"val_every": 1}, length={"steps": 4}) == 0
    assert (tmp_path / "best.safetensors").read_bytes() == before
    assert len(micro.lines(tmp_path, "val")) == 4


def test_a_best_that_cannot_be_written_is_said_and_stops_nothing(data, tmp_path):
    (tmp_path / "best.safetensors").mkdir()
    assert micro.run(data, tmp_path, run={"val_every": 3}) == 0
    assert "best.safetensors" in micro.lines(tmp_path, "warning")[0]["message"]
    assert not micro.lines(tmp_path, "best")


def test_a_fine_tuning_is_validated_before_it_begins(data, tmp_path, capsys):
    assert micro.run(data, tmp_path / "first", run={"val_every": 3}) == 0
    assert [line["step"] for line in micro.lines(tmp_path / "first", "val")] == [3, 6]
    tuned = {"init": tmp_path / "first", "val_every": 3}
    capsys.readouterr()
    spoiled = {"optim": {"lr": 3.0, "ema": 0.0}}
    assert micro.run(data, tmp_path / "second", run=tuned, **spoiled) == 0
    vals = micro.lines(tmp_path / "second", "val")
    assert [line["step"] for line in vals] == [0, 3, 6]
    ends = micro.lines(tmp_path / "first", "val")[-1]
    assert vals[0]["psnr_novel"] == ends["psnr_novel"]
    *_, warning = (line["message"] for line in micro.lines(tmp_path / "second", "warning"))
    assert "the last validation is worse than the first: PSNR" in warning
    assert "dB at step 0; best.safetensors has" in warning and warning in capsys.readouterr().out
    best, first = tmp_path / "second/best.safetensors", tmp_path / "first/model.safetensors"
    assert micro.same_weights(best, first)


def test_a_validation_at_the_start_changes_no_bit(data, tmp_path):
    assert micro.run(data, tmp_path / "first") == 0
    for name, every in (("with", 100), ("without", 0)):
        out = tmp_path / name
        assert micro.run(data, out, run={"init": tmp_path / "first", "val_every": every}) == 0
    files = (tmp_path / name / "model.safetensors" for name in ("with", "without"))
    assert micro.same_weights(*files)
