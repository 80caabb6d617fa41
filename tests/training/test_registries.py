"""Public tables that a user's script fills: its parts in a run, and invalid ones."""

import json
import runpy
from pathlib import Path

import pytest
from helpers import micro
from helpers.micro import lines, run
from helpers.refusals import refused

from gamba_warp.data.dataset import open_dataset
from gamba_warp.data.layouts import LAYOUTS
from gamba_warp.image_metrics import METRICS
from gamba_warp.model.checkpoint import load_model, read_weights
from gamba_warp.model.encoders import ENCODERS
from gamba_warp.model.gamba import DECODERS
from gamba_warp.train.objective.losses import TERMS
from gamba_warp.train.optim import SCHEDULES

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"
SCRIPT, LOOP = EXAMPLES / "own_parts.py", EXAMPLES / "own_loop.py"
TABLES = (LAYOUTS, METRICS, ENCODERS, DECODERS, TERMS, SCHEDULES)


def restore(saved):
    for table, own in zip(TABLES, saved):
        table.clear()
        table.update(own)


@pytest.fixture(autouse=True)
def tables():
    saved = [dict(table) for table in TABLES]
    yield saved
    restore(saved)


@pytest.fixture
def script(monkeypatch):
    """Runs the example with the words of a command; returns its exit code."""

    def call(*words):
        monkeypatch.setattr("sys.argv", [str(SCRIPT), *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(SCRIPT), run_name="__main__")
        return ended.value.code

    return call


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Clouds in the layout that the example adds."""
    root = micro.write_dataset(tmp_path_factory.mktemp("data") / "clouds", 3)
    for path in root.glob("*/transforms.json"):
        names = [frame["file_path"] for frame in json.loads(path.read_text())["frames"]]
        values = {"distance": 1.8, "focal": 1.2, "images": names}
        path.with_name("orbit.json").write_text(json.dumps(values))
        path.unlink()
    return root


def test_the_example_trains_with_parts_of_each_kind(data, tables, tmp_path, script, capsys):
    out = tmp_path / "run"
    words = ["train", data, "--out", out, "--preset", "tiny", "--set", *micro.MODEL]
    words += ["encoder=patches", "encoder_size=16", "decoder=cloud"]
    words += ["--schedule", "linear", "--size", micro.SIZE]
    words += ["--lpips", "off", "--device", "cpu", "--log-every", "1", "--views-per-object", "2"]
    words += ["--warmup-steps", "1", "--batch-size", "2", "--val-every", "6"]
    assert script(*words, "--steps", "6") == 0
    assert open_dataset(data).layout == "orbit"
    first, *_, last = lines(out, "train")
    assert first["loss_edges"] > 0
    terms = sum(first[f"loss_{name}"] for name in ("rgb", "mask")) + 0.5 * first["loss_edges"]
    assert first["loss"] == pytest.approx(terms + 0.1 * first["loss_rdist"], rel=1e-4)
    # A warm-up of a tenth of six steps, then the line: the rate of the last step is 5/6 of it down.
    assert last["lr"] == pytest.approx(1e-3 * (1 - (5 - 0.6) / (6 - 0.6)), rel=1e-4)
    assert 0 < lines(out, "val")[0]["mae_novel"] < 1
    restore(tables)
    assert script(*words, "--steps", "7") == 0  # the same run goes on
    got = load_model(out / "model.safetensors")
    assert type(got.decoder).__name__ == "Cloud" and got.encoder is not None
    fresh = next(ENCODERS["patches"](None, None)[0].parameters())
    assert got.encoder.network.convolution.weight.shape == fresh.shape
    assert "encoder.network.convolution.weight" in read_weights(out / "model.safetensors", got)
    restore(tables)
    said = "model.safetensors: encoder patches: neither 'none'"
    refused(said, load_model, out / "model.safetensors")
    words = ["eval-views", "--checkpoint", out / "model.safetensors", "--data", data, "--json"]
    capsys.readouterr()
    assert script(*words, "--no-baselines", "--lpips", "off", "--split", "val") == 0
    assert "mae" in json.loads(capsys.readouterr().out)["objects"][0]


def test_unknown_names_are_refused(tmp_path):
    data, out = micro.write_dataset(tmp_path / "clouds"), tmp_path / "run"
    said = "--schedule linear: expected one of cosine, trapezoid"
    refused(said, run, data, out, optim={"schedule": "linear"})
    said = "decoder is 'cloud', expected one of bins, rays, triplane"
    refused(said, run, data, out, (*micro.MODEL, "decoder=cloud"))
    assert not (tmp_path / "run").exists()


def test_the_example_of_a_loop_trains(tmp_path, monkeypatch, capsys):
    data, out = micro.write_dataset(tmp_path / "clouds", 4), tmp_path / "run"
    words = ["--steps", "2", "--out", str(out)]
    for more in ([str(data)], [str(data)] * 2 + ["--weights", "2", "1", "--init", str(out)]):
        monkeypatch.setattr("sys.argv", [str(LOOP), *more, *words])
        runpy.run_path(str(LOOP), run_name="__main__")
        step, *figures = capsys.readouterr().out.splitlines()[-1].split()
        assert step == "2" and all(0 < float(figure) < 100 for figure in figures)
    assert load_model(out).config.depth == 2
    assert len(LOOP.read_text().splitlines()) <= 60
