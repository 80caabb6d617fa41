"""Resumed runs: with another length, from other weights, or rejected with advice."""

import json
import shlex
import shutil

import pytest
import torch
import tyro
from helpers import micro
from helpers.micro import lines, run, same_weights
from helpers.refusals import refused
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from gamba_warp.files import sha256
from gamba_warp.model.checkpoint import load_model
from gamba_warp.train import config as options
from gamba_warp.train.checkpoint import list_checkpoints, save_checkpoint
from gamba_warp.train.config import command_line, config_differences
from gamba_warp.train.step import weigh_views

STILL = {"optim": {"lr": 1e-30, "ema": 0.0}, "length": {"steps": 1}}


def times(folder):
    """Times of the last change of each file but the lock."""
    return {p: p.stat().st_mtime_ns for p in folder.rglob("*") if p.name != ".lock"}


@pytest.fixture(scope="module")
def done(data, tmp_path_factory):
    """A run of eight steps, with a checkpoint at four."""
    out = tmp_path_factory.mktemp("runs") / "done"
    assert run(data, out, length={"steps": 8}, run={"save_every": 4}, optim={"ema": 0.5}) == 0
    return out


@pytest.mark.parametrize("total", [6, 12])
def test_another_length_goes_on_at_the_rate_of_the_checkpoint(data, done, tmp_path, total):
    """A cosine over 8 steps, at step 4: the rest is shortened or lengthened, with a note."""
    source = str(list_checkpoints(done)[0])
    groups = {"length": {"steps": total}, "optim": {"ema": 0.5}}
    resumed = {"resume": source, "save_every": 1}
    assert run(data, tmp_path, run=resumed, **groups) == 0
    (note,) = (line["message"] for line in lines(tmp_path, "warning"))
    assert f"length is now {total} steps, not 8 steps" in note and "continues from" in note
    rates = [line["lr"] for line in lines(tmp_path, "train")]
    assert rates[0] == pytest.approx(lines(done, "train")[4]["lr"], rel=1e-4)
    assert rates == sorted(rates, reverse=True) and len(rates) == total - 4
    # A second resumption continues the same fall.
    again = tmp_path / "again"
    resumed["resume"] = str(list_checkpoints(tmp_path)[0])
    assert run(data, again, run=resumed, **groups) == 0
    assert not lines(again, "warning")
    assert [line["lr"] for line in lines(again, "train")] == rates[1:]


def test_a_finished_run_says_that_its_rate_rises_again(data, done, tmp_path, capsys):
    shutil.copytree(done, tmp_path / "run")
    out = tmp_path / "run"
    assert run(data, out, length={"steps": 8}, optim={"ema": 0.5}) == 0
    assert same_weights(out / "model.safetensors", done / "model.safetensors")  # left alone
    assert run(data, out, length={"steps": 40}, optim={"ema": 0.5}) == 0
    assert "goes to 0.000923, the new length's own, in a tenth of" in capsys.readouterr().out
    rates = [line["lr"] for line in lines(out, "train")][8:]
    assert rates[0] < 0.4 * max(rates) and max(rates) < 1e-3 and rates[-1] < 1e-5


def test_other_losses_are_refused_and_init_is_named(data, done, tmp_path, capsys):
    shutil.copytree(done, tmp_path / "run")
    other = {"loss": {"novel_weight": 0.5}, "length": {"steps": 9}, "optim": {"ema": 0.5}}
    before = times(tmp_path / "run")
    said = refused(r"novel_weight \(1\.0 there, 0\.5 here\)", run, data, tmp_path / "run", **other)
    way = f"--init {list_checkpoints(tmp_path / 'run')[-1]}, and another --out"
    assert way in said
    assert times(tmp_path / "run") == before, "nothing is written by a run that is refused"
    resumed = {"resume": str(list_checkpoints(done)[-1])}
    refused(r"loss\.novel_weight", run, data, tmp_path / "other", run=resumed, **other)
    assert not (tmp_path / "other").exists()
    init = list_checkpoints(done)[-1]
    capsys.readouterr()
    assert run(data, tmp_path / "new", run={"init": init}, **other) == 0
    assert f"starts from the weights of {init / 'ema.safetensors'}\n" in capsys.readouterr().out


def test_other_images_of_the_same_names_are_refused(data, done, tmp_path):
    """A copy, whose files have other times, resumes; a checkpoint that knows no content does."""
    other, groups = tmp_path / "clouds", {"length": {"steps": 9}, "optim": {"ema": 0.5}}
    shutil.copytree(data, other, copy_function=shutil.copyfile)
    last = list_checkpoints(done)[-1]
    assert run(other, tmp_path / "a", run={"resume": str(last)}, **groups) == 0
    image = other / "cloudb" / "004.png"
    shutil.copyfile(other / "cloudc" / "004.png", image)
    assert image.stat().st_size != (data / "cloudb" / "004.png").stat().st_size
    words = r"images and cameras of these objects \(\w+ there, \w+ here\)"
    refused(words, run, other, tmp_path / "b", run={"resume": str(last)}, **groups)
    state = torch.load(last / "state.pt", weights_only=True)
    del state["content"]
    views, length = state["config"]["views"], state["new_length"]  # with older names
    views["made"], length["share"] = views.pop("procedural"), length.pop("fraction")
    views["mirror"], views["front_share"] = views.pop("flip"), views.pop("front_fraction")
    older = save_checkpoint(tmp_path / "older", 8, {}, state, keep=1)
    for name in ("model", "ema"):
        shutil.copy(last / f"{name}.safetensors", older)
    sums = {path.name: sha256(path) for path in older.iterdir() if path.suffix != ".json"}
    (older / "checksums.json").write_text(json.dumps(sums))
    assert run(other, tmp_path / "c", run={"resume": str(older)}, **groups) == 0
    first = other / "clouda" / "000.png"  # an image of the same size
    first.write_bytes(bytes([*first.read_bytes()[:-1], 0]))
    resumed = {"resume": str(list_checkpoints(tmp_path / "c")[-1])}
    refused(words, run, other, tmp_path / "d", run=resumed, **groups)


def test_init_takes_a_checkpoint_a_run_or_a_model(data, done, tmp_path):
    newest = list_checkpoints(done)[-1]
    finished = tmp_path / "moved"  # a finished run without its checkpoints
    finished.mkdir()
    shutil.copy(done / "model.safetensors", finished)
    sources = {done: newest / "ema.safetensors", newest: newest / "ema.safetensors"}
    sources |= {finished: finished / "model.safetensors"}
    for number, (source, wanted) in enumerate(sources.items()):
        out = tmp_path / str(number)
        assert run(data, out, run={"init": source}, **STILL) == 0
        assert same_weights(out / "model.safetensors", wanted)
    for file in ("ema.safetensors", "model.safetensors"):
        assert not same_weights(newest / file, list_checkpoints(done)[0] / file)
    refused("holds neither a model nor a checkpoint", run, data, tmp_path / "x", run={"init": data})
    refused("no such file", run, data, tmp_path / "x", run={"init": tmp_path / "none"})
    assert not (tmp_path / "x").exists()


def test_init_passes_over_a_damaged_checkpoint(data, done, tmp_path, capsys):
    copy = tmp_path / "copy"
    shutil.copytree(done, copy)
    first, last = list_checkpoints(copy)
    (last / "ema.safetensors").write_bytes(b"")
    assert run(data, tmp_path / "a", run={"init": copy}, **STILL) == 0
    assert same_weights(tmp_path / "a" / "model.safetensors", first / "ema.safetensors")
    assert f"resuming from {first}" in capsys.readouterr().out
    line = "--init .*step_000008/ema.safetensors: damaged"
    refused(line, run, data, tmp_path / "b", run={"init": last}, **STILL)


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16])
def test_init_takes_half_precision(data, done, tmp_path, kind):
    source = done / "model.safetensors"
    with safe_open(source, framework="pt") as file:
        header = file.metadata()
    half = {name: value.to(kind) for name, value in load_file(source).items()}
    save_file(half, tmp_path / "half.safetensors", metadata=header)
    out = tmp_path / "run"
    assert run(data, out, run={"init": tmp_path / "half.safetensors"}, **STILL) == 0
    got = load_file(out / "model.safetensors")
    assert all(torch.equal(got[name], value.float()) for name, value in half.items())
    assert load_model(out / "model.safetensors")


def test_an_option_that_an_older_run_did_not_know_has_its_default(data, tmp_path):
    now = micro.options(data, tmp_path).to_dict()
    old = json.loads(json.dumps(now))
    del old["loss"]["novel_weight"], old["optim"]["schedule"], old["model"]["ray_cells"]
    assert config_differences(old, now) == []
    now["loss"]["novel_weight"] = 0.5
    assert config_differences(old, now) == ["loss.novel_weight (1.0 there, 0.5 here)"]


def test_a_config_file_of_an_earlier_version_is_read(data, tmp_path):
    """As ``--config`` does; something else in place of a group or an option is named."""
    config = micro.options(data, tmp_path, views={"flip": 0.5}, optim={"decay_fraction": 0.3})
    values = config.to_dict()
    del values["model"]
    views, optim = values["views"], values["optim"]
    views["mirror"], optim["decay_share"] = views.pop("flip"), optim.pop("decay_fraction")
    assert options.config_of(values, "a") == config
    odd = config.to_dict() | {"views": {**views, "mirrored": 1}}
    refused("a: .*unknown views.mirrored", options.config_of, odd, "a")
    refused("a: ", options.config_of, values | {"optim": ["decay_share"]}, "a")


def test_the_command_of_a_configuration_means_the_same_configuration(data, tmp_path):
    groups = {"loss": {"lpips": "off", "radial_mask": False}, "length": {"minutes": 2.5}}
    config = micro.options(data, tmp_path / "a run", **groups)
    command = command_line(config.to_dict())
    assert "--no-radial-mask" in command and f"'{tmp_path}/a run'" in command
    kind = tyro.conf.OmitArgPrefixes[options.TrainConfig]
    assert tyro.cli(kind, args=shlex.split(command)[2:]) == config


def test_views_are_weighed_and_their_mean_stays_one():
    terms = {"rgb": torch.tensor([[4.0, 1.0, 1.0], [1.0, 2.0, 3.0]]), "lpips": torch.ones(2)}
    assert weigh_views(terms, 1.0, 3) is terms
    weighed = weigh_views(terms, 0.5, 3)
    want = torch.tensor([[6.0, 0.75, 0.75], [1.5, 1.5, 2.25]])  # fractions 1.5, 0.75, 0.75
    torch.testing.assert_close(weighed["rgb"], want)
    assert weighed["lpips"] is terms["lpips"]
    torch.testing.assert_close(weigh_views(terms, 0.0, 3)["rgb"].mean(), torch.tensor(2.5))
    constant = {"rgb": torch.full((2, 5), 0.3)}
    assert weigh_views(constant, 7.0, 5)["rgb"].mean() == pytest.approx(0.3)


def test_the_weight_of_novel_views_reaches_the_training(data, tmp_path):
    losses = []
    for weight in (1.0, 0.0):
        out = tmp_path / str(weight)
        loss = {"novel_weight": weight}
        assert run(data, out, length={"steps": 1}, loss=loss, views={"views_per_object": 2}) == 0
        losses.append(lines(out, "train")[0])
    assert losses[0]["loss_rgb"] == losses[1]["loss_rgb"]  # terms are logged unweighted
    assert losses[0]["loss"] != losses[1]["loss"]
