"""Validation on further datasets, and the best checkpoint by all of them."""

import itertools
import json
from pathlib import Path

import pytest
import torch
from helpers import micro
from helpers.refusals import refused
from helpers.views import eval_views

from gamba_warp.train import loop
from gamba_warp.train.batches import open_data
from gamba_warp.train.checkpoint import list_checkpoints


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    """Two datasets whose held-out objects differ: ``cloudc`` and ``cloudd``."""
    root = tmp_path_factory.mktemp("sets")
    return micro.write_dataset(root / "first", 3), micro.write_dataset(root / "things", 4)


def test_figures_of_a_further_set_are_those_of_eval_views(sets, tmp_path, capsys):
    first, things = sets
    out = tmp_path / "run"
    changes = {"val_every": 3, "val_extra": (things,)}
    assert micro.run(first, out, run=changes) == 0
    assert [line["step"] for line in micro.lines(out, "val/things")] == [3, 6]
    for event, data in (("val", first), ("val/things", things)):
        options = "--split", "val", "--no-baselines", "--strips", 0, "--sheet", 0, "--views", 5
        _, report = eval_views(out / "model.safetensors", data, tmp_path / data.name, *options)
        means = {"novel": report["mean"], "input": report["mean"]["input"]}
        last = micro.lines(out, event)[-1]
        for view in ("input", "novel"):
            for metric in ("psnr", "ssim", "mask_iou"):
                # The log has six digits; batches and threads change sums of float32 in the last.
                assert last[f"{metric}_{view}"] == pytest.approx(
                    means[view][metric], rel=1e-4, abs=1e-5
                ), (event, view, metric)
    assert last["psnr_novel"] != pytest.approx(micro.lines(out, "val")[-1]["psnr_novel"], abs=1e-3)
    said = capsys.readouterr().out
    assert said.count("validation on things loss") == said.count("validation loss") == 2
    assert micro.lines(out, "start")[0]["held_out"] == 2
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    board = EventAccumulator(str(out / "tensorboard")).Reload()
    assert {"val/psnr_novel", "val/things/psnr_novel", "best/psnr"} <= {*board.Tags()["scalars"]}


def scripted(monkeypatch, figures):
    """Replace the novel PSNR of validations by given values: in turn of DATA and of the other."""
    rows = [torch.zeros(1, 4, 4, 3)]
    told = iter(
        ({"loss": 1.0, "psnr_input": 50.0, "psnr_novel": psnr}, rows if psnr else [])
        for psnr in itertools.chain.from_iterable(figures)
    )
    monkeypatch.setattr(loop, "validate", lambda *_: next(told))


def test_the_best_is_by_the_mean_over_the_sets(sets, tmp_path, monkeypatch, capsys):
    # By the mean step 2 is the best; by DATA it would be step 3, by the other or by objects step 4.
    # At step 5 the other has no figure, and at step 6 none is a number.
    figures = [(20, 10), (19, 12), (25, 5), (10, 20), (40, 0), (float("nan"), 30)]
    scripted(monkeypatch, figures)
    changes = {"val_every": 1, "save_every": 1, "val_extra": (sets[1],)}
    assert micro.run(sets[0], tmp_path, run=changes) == 0
    assert [(line["step"], line["psnr"]) for line in micro.lines(tmp_path, "best")] == [
        (1, 15.0),
        (2, 15.5),
    ]
    same = [
        micro.same_weights(path / "ema.safetensors", tmp_path / "best.safetensors")
        for path in list_checkpoints(tmp_path)
    ]
    assert same == [False, True, False, False, False, False]
    assert "step 2: best so far, mean PSNR of the datasets 15.5" in capsys.readouterr().out


def test_a_run_that_goes_on_knows_its_best(sets, tmp_path, monkeypatch):
    changes = {"val_every": 1, "val_extra": (sets[1],)}
    scripted(monkeypatch, [(20, 10), (19, 12)])
    assert micro.run(sets[0], tmp_path, run=changes, length={"steps": 2}) == 0
    before = (tmp_path / "best.safetensors").read_bytes()
    scripted(monkeypatch, [(15, 16), (16, 14)])
    assert micro.run(sets[0], tmp_path, run=changes, length={"steps": 4}) == 0
    assert (tmp_path / "best.safetensors").read_bytes() == before
    assert len(micro.lines(tmp_path, "val/things")) == 4


def test_a_best_that_cannot_be_written_is_said_and_stops_nothing(sets, tmp_path):
    (tmp_path / "best.safetensors").mkdir()
    assert micro.run(sets[0], tmp_path, run={"val_every": 3}) == 0
    assert "best.safetensors" in micro.lines(tmp_path, "warning")[0]["message"]
    assert not micro.lines(tmp_path, "best")


def test_sets_that_cannot_be_validated_on_are_refused(sets, tmp_path):
    first, things = sets

    def opened(*folders: Path):
        open_data(micro.options(first, tmp_path, run={"val_extra": folders}))

    refused("--val-extra: .*nowhere: no such folder", opened, tmp_path / "nowhere")
    refused("--val-extra: two folders are called 'things'", opened, things, things)
    bare = micro.write_dataset(tmp_path / "bare", 2)
    (bare / "split.json").write_text(json.dumps({"version": 2, "train": ["clouda", "cloudb"]}))
    refused("--val-extra: .*bare: none of its 2 objects is in the val split", opened, bare)
