"""Validation from the start on, the best weights by a named figure, and a worse end."""

import pytest
import torch
from helpers import micro
from helpers.micro import lines, run, same_weights
from helpers.refusals import refused

from gamba_warp.train import loop
from gamba_warp.train.loop import Score, Trainer


def test_a_fine_tuning_is_validated_before_it_begins(data, tmp_path, capsys):
    assert run(data, tmp_path / "first", run={"val_every": 3}) == 0
    assert [line["step"] for line in lines(tmp_path / "first", "val")] == [3, 6]
    tuned = {"init": tmp_path / "first", "val_every": 3}
    capsys.readouterr()
    spoiled = {"optim": {"lr": 3.0, "ema": 0.0}}
    assert run(data, tmp_path / "second", run=tuned, **spoiled) == 0
    vals = lines(tmp_path / "second", "val")
    assert [line["step"] for line in vals] == [0, 3, 6]
    ends = lines(tmp_path / "first", "val")[-1]
    assert vals[0]["psnr_novel"] == ends["psnr_novel"]
    *_, warning = (line["message"] for line in lines(tmp_path / "second", "warning"))
    assert "the last validation is worse than the first: PSNR" in warning
    assert "dB at step 0; best.safetensors has" in warning and warning in capsys.readouterr().out
    assert same_weights(
        tmp_path / "second" / "best.safetensors", tmp_path / "first" / "model.safetensors"
    )


def test_a_validation_at_the_start_changes_no_bit(data, tmp_path):
    assert run(data, tmp_path / "first") == 0
    for name, every in (("with", 100), ("without", 0)):
        out = tmp_path / name
        assert run(data, out, run={"init": tmp_path / "first", "val_every": every}) == 0
    assert same_weights(tmp_path / "with/model.safetensors", tmp_path / "without/model.safetensors")


def scripted(monkeypatch, *figures):
    """Replace the PSNR and mask IoU of novel views of the validations by given values."""
    told = iter(
        {"loss": 1.0, "psnr_novel": psnr, "psnr_input": 9.0, "mask_iou_novel": iou}
        | {"mask_iou_input": 0.0}
        for psnr, iou in figures
    )
    rows = [torch.zeros(1, 4, 4, 3)]
    monkeypatch.setattr(loop, "validate", lambda *_: (next(told), rows))


def test_the_best_by_another_figure(data, tmp_path, monkeypatch, capsys):
    scripted(monkeypatch, (20, 0.5), (19, 0.3), (25, 0.4))
    changes = {"val_every": 1, "best_by": "mask_iou"}
    assert run(data, tmp_path, run=changes, length={"steps": 3}) == 0
    assert [(line["step"], line["mask_iou"]) for line in lines(tmp_path, "best")] == [(1, 0.5)]
    assert "worse than the first: mask IoU 0.4 at step 3, 0.5 at step 1" in capsys.readouterr().out
    # Scores by another figure are not compared when the run goes on.
    scripted(monkeypatch, (11, 0.9))
    assert run(data, tmp_path, run={"val_every": 1}, length={"steps": 4}) == 0
    assert lines(tmp_path, "best")[-1]["psnr"] == 11.0


def test_a_less_lpips_is_better(data, tmp_path):
    trainer = Trainer.__new__(Trainer)
    trainer.config = micro.options(data, tmp_path, run={"best_by": "lpips"}, loss={"lpips": "auto"})
    trainer.scores = {"best": Score(1, 0.3)}
    assert trainer._better(Score(2, 0.2), "best") and not trainer._better(Score(2, 0.4), "best")
    assert not trainer._better(Score(2, float("nan")), "best")


@pytest.mark.parametrize(
    "groups, words",
    [
        ({"loss": {"lpips": "off"}, "run": {"best_by": "lpips"}}, "--best-by lpips: --lpips off"),
        ({"views": {"size": 8}, "run": {"best_by": "ssim"}}, "--best-by ssim: needs --size 11"),
    ],
)
def test_a_figure_that_a_run_lacks_is_refused(data, tmp_path, groups, words):
    refused(words, micro.options, data, tmp_path, **groups)
