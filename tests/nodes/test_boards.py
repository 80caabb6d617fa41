"""TensorBoard and Weights & Biases beside the log: their data; failures never stop a run."""

import json
import sys
from importlib.util import find_spec

import pytest
from helpers import micro
from helpers.micro import lines, run

from gamba_warp import cli
from gamba_warp.train import boards
from gamba_warp.train.config import RunConfig, config_differences

# Stand-in for the used calls of wandb 0.31, recorded in a list.
FAKE = """
calls = []
fails = ""

def note(name):
    def called(*arguments, **options):
        calls.append((name, arguments, options))
        if name == fails:
            raise OSError(f"{name} has no network\\nand says so at length")
    return called

def Settings(**options):
    return options

def Image(pixels):
    return ("picture", pixels.shape, str(pixels.dtype))

class config:
    update = note("config")

class Run:
    config = config
    define_metric, log, finish = note("define_metric"), note("log"), note("finish")

def init(**options):
    note("init")(**options)
    return Run
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return micro.write_dataset(tmp_path_factory.mktemp("data") / "clouds")


@pytest.fixture
def fake(tmp_path, monkeypatch):
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "wandb.py").write_text(FAKE)
    monkeypatch.syspath_prepend(tmp_path / "site")
    for name in [name for name in sys.modules if name.split(".")[0] == "wandb"]:
        monkeypatch.delitem(sys.modules, name)
    import wandb

    yield wandb
    sys.modules.pop("wandb", None)


def called(module, name):
    return [(arguments, options) for known, arguments, options in module.calls if known == name]


def test_wandb_gets_the_lines_of_the_log_and_goes_on_with_the_same_run(data, tmp_path, fake):
    out = tmp_path / "run"
    with_it = {"log": ("wandb",), "val_every": 2}
    assert run(data, out, run=with_it, length={"steps": 2}) == 0
    ((_, options),) = called(fake, "init")
    assert options["id"] == json.loads((out / "wandb.json").read_text())["id"]
    assert options["resume"] == "allow" and options["dir"] == str(out) and options["name"] == "run"
    ((sent,), how) = called(fake, "config")[0]
    assert how == {"allow_val_change": True} and sent["optim"]["lr"] == 1e-3
    got = [values for ((values,), _) in called(fake, "log")]
    losses = {values["step"]: values["train/loss"] for values in got if "train/loss" in values}
    wanted = {line["step"]: line["loss"] for line in lines(out, "train")}
    assert losses == pytest.approx(wanted, rel=1e-5) and set(losses) == {1, 2}
    assert any("val/psnr_novel" in values and values["step"] == 2 for values in got)
    (picture,) = [values for values in got if "val/pictures" in values]
    # True views above the predicted ones, the input and three others of 16 pixels (fewer exist).
    assert picture == {"step": 2, "val/pictures": ("picture", (32, 80, 3), "uint8")}
    assert [how for _, how in called(fake, "finish")] == [{"exit_code": 0}]
    assert run(data, out, run=with_it, length={"steps": 3}) == 0
    assert [how["id"] for _, how in called(fake, "init")] == [options["id"]] * 2


def test_tensorboard_gets_the_pictures(data, tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    options = {"tensorboard": True, "val_every": 2}
    assert run(data, tmp_path, run=options, length={"steps": 2}) == 0
    board = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    (picture,) = board.Images("val/pictures")
    assert (picture.step, picture.height, picture.width) == (2, 32, 80)


def test_a_damaged_number_begins_another_run(data, tmp_path, fake):
    out = tmp_path / "run"
    out.mkdir()
    (out / "wandb.json").write_text('{"id": "../../x"}')
    assert run(data, out, run={"log": ("wandb",)}, length={"steps": 1}) == 0
    ((_, options),) = called(fake, "init")
    assert len(options["id"]) == 16 and json.loads((out / "wandb.json").read_text()) == {
        "id": options["id"]
    }


@pytest.mark.parametrize("call", ["init", "define_metric", "config", "log", "finish"])
def test_wandb_never_stops_a_run(data, tmp_path, fake, capsys, call):
    fake.fails = call
    out = tmp_path / "run"
    assert run(data, out, run={"log": ("wandb",)}, length={"steps": 3}) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if "cannot be written" in line]
    (line,) = said
    assert line.startswith(f"gamba train: wandb cannot be written, the run goes on: {call} has no")
    assert len(called(fake, call)) == 1  # it is not tried again
    assert len(lines(out, "train")) == 3


def test_wandb_that_is_not_installed_is_said_before_anything(data, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(boards, "find_spec", lambda name: None)
    out = tmp_path / "run"
    arguments = [str(data), "--out", str(out), "--log", "wandb", "--device", "cpu", "--steps", "1"]
    assert cli.run("train", arguments) == 2
    assert capsys.readouterr().err == (
        "gamba: --log wandb: not installed: pip install '.[wandb]' in the checkout, or "
        "'FILE.whl[wandb]'\n"
    )
    assert not out.exists()


def test_a_configuration_of_before_means_no_other_boards(data, tmp_path):
    now = micro.options(data, tmp_path).to_dict()
    before = json.loads(json.dumps(now))
    del before["run"]["log"]
    assert config_differences(before, now, free=True) == []
    assert RunConfig().boards == ("tensorboard",)
    assert RunConfig(tensorboard=False).boards == ()
    assert RunConfig(log=("wandb", "wandb")).boards == ("tensorboard", "wandb")


@pytest.mark.skipif(find_spec("wandb") is None, reason="wandb is not installed")
def test_wandb_itself_offline(data, tmp_path, monkeypatch, capsys):
    for name in ("CONFIG", "CACHE", "DATA"):
        monkeypatch.setenv(f"WANDB_{name}_DIR", str(tmp_path))
    monkeypatch.setenv("WANDB_MODE", "offline")
    out = tmp_path / "run"
    for steps in (2, 4):
        assert run(data, out, run={"log": ("wandb",)}, length={"steps": steps}) == 0
    assert "wandb cannot be written" not in capsys.readouterr().out
    number = json.loads((out / "wandb.json").read_text())["id"]
    found = list((out / "wandb").glob(f"offline-run-*-{number}/run-{number}.wandb"))
    assert [path for path in found if path.stat().st_size > 1000], found
    assert b"psnr" in max(found, key=lambda path: path.stat().st_size).read_bytes()
