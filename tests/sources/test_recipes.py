"""``gamba train --recipe``: every number of the paper, batches over processes, and priority."""

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import pytest
import tyro
from helpers import micro
from helpers.gobjaverse import write_object
from helpers.micro import MODEL, lines
from helpers.refusals import refused, refused_command

from gamba_warp import cli
from gamba_warp.cli import run
from gamba_warp.data.dataset import split_of
from gamba_warp.model.config import PRESETS
from gamba_warp.train import command, optim, step
from gamba_warp.train.command import expand
from gamba_warp.train.config import TrainConfig, command_line
from gamba_warp.train.objective import losses
from gamba_warp.train.recipes import RECIPES, recipe_words, table_of

ROOT = Path(__file__).parents[2]
# Each number of the paper's training, quoted from its text.
PAPER = [
    ("views.size", 512, "not stated; the side of the input, §4.1, and of G-Objaverse"),
    ("length.epochs", 400, "§4.1: for totally 400 epochs"),
    ("optim.lr", 1e-3, "§4.1: AdamW ... with an initial learning rate of 1e-3"),
    ("views.views_per_object", None, "§3.3: we progressively increase the number of views"),
    ("loss.lpips_weight", 0.5, "§4.1: and λ_LPIPS = 0.5 for LPIPS loss"),
    ("loss.lpips", "on", "§3.3: the VGG-based perceptual loss"),
    ("loss.radial_mask", True, "§3.2: radial mask constraint"),
    ("loss.ssim_weight", 0.0, "eq. L_train has no such term"),
    ("loss.depth_weight", 0.0, "eq. L_train has no such term"),
    ("loss.novel_weight", 1.0, "eq. L_train: one mean over V + 1 views"),
    ("loss.lpips_crop", 0, "eq. L_train: whole views"),
    ("optim.schedule", "cosine", "not stated"),
    ("optim.precision", "auto", "not stated; bfloat16 in the public code"),
]
CONSTANTS = [
    (optim.WEIGHT_DECAY, 0.05, "§4.1: and a weight decay of 0.05"),
    (step.CLIP, 1.0, "§4.1: Gradient clipping of value 1.0 ... the L2 norm of gradients"),
    (optim.FIRST_VIEWS, 2, "§3.3: we progressively increase the number of views from 2"),
    (optim.LAST_VIEWS, 6, "§3.3: to 6 during training"),
    (losses.RDIST_WEIGHT, 0.1, "§4.1: λ_rdist ... is initially set at 0.1"),
    (losses.RDIST_EPOCHS, 10.0, "§4.1: gradually decayed to 0 over the first 10 epochs"),
    (losses.TERMS["mask"].weight(None, None), 1.0, "§4.1: λ_mask = 1 for the mask loss"),
]
NETWORK = [
    ("image_size", 512, "§4.1: the reference image, with a spatial resolution of 512 × 512"),
    ("patch_size", 8, "§4.1: a convolution kernel with p = 8"),
    ("depth", 14, "§4.1: N = 14 Gamba blocks"),
    ("width", 512, "§4.1: hidden dimensions D = 512"),
    ("num_gaussians", 16384, "§4.1: L = 16384"),
    ("encoder", "vit_base_patch14_reg4_dinov2", "§4.1: the pretrained DINO v2 model"),
    ("encoder_size", 336, "§4.1: tokens of length K = 576, of patches of 14 pixels"),
]


def parse(*words):
    arguments = expand([str(word) for word in words])
    return tyro.cli(tyro.conf.OmitArgPrefixes[TrainConfig], args=arguments)


@pytest.fixture(scope="module")
def paper():
    return parse("data", "--recipe", "paper")


@pytest.mark.parametrize("field, value, source", PAPER, ids=[row[0] for row in PAPER])
def test_the_recipe_has_the_papers_number(paper, field, value, source):
    group, name = field.split(".")
    assert getattr(getattr(paper, group), name) == value, source


@pytest.mark.parametrize("constant, value, source", CONSTANTS)
def test_the_constants_are_the_papers(constant, value, source):
    assert constant == value, source


@pytest.mark.parametrize("field, value, source", NETWORK, ids=[row[0] for row in NETWORK])
def test_the_recipes_network_is_the_papers(paper, field, value, source):
    assert getattr(paper.model_config(), field) == value, source
    assert paper.preset == "paper" and (336 // 14) ** 2 == 576


@pytest.mark.parametrize(
    "processes, words, fraction",
    [("", [], 256), ("16", [], 16), ("4", ["--accumulate", "8"], 8), ("2", ["--accumulate=4"], 32)],
)
def test_a_batch_of_256_over_all_processes(monkeypatch, processes, words, fraction):
    if processes:
        monkeypatch.setenv("WORLD_SIZE", processes)
    views = parse("data", "--recipe", "paper", *words).views
    assert views.batch_size == fraction  # §4.1: with a batch size of 256
    assert fraction * int(processes or 1) * views.accumulate == 256


@pytest.mark.parametrize(
    "processes, words",
    [("3", []), ("16", ["--accumulate", "3"]), ("512", []), ("1", ["--accumulate", "x"])],
)
def test_a_batch_that_does_not_divide_is_one_line(monkeypatch, capsys, processes, words):
    monkeypatch.setenv("WORLD_SIZE", processes)
    reason = "expected a number" if words[1:] == ["x"] else "does not divide"
    refused_command(capsys, "train", ["data", "--recipe", "paper", *words], reason)
    assert parse("data", "--recipe", "paper", "--batch-size", 5).views.batch_size == 5


def test_a_given_option_wins_wherever_it_stands():
    for words in (["data", "--lr", 1, "--recipe", "paper"], ["--recipe=paper", "data", "--lr", 1]):
        config = parse(*words, "--size", 128, "--no-radial-mask", "--batch_size", 3)
        assert (config.optim.lr, config.views.size, config.views.batch_size) == (1, 128, 3)
        assert not config.loss.radial_mask
        assert config.data.name == "data" and config.run.recipe == "paper"
        # The recorded command is equivalent without the recipe, even if a default was given.
        text = command_line(config.to_dict())
        again = tyro.cli(tyro.conf.OmitArgPrefixes[TrainConfig], args=shlex.split(text)[2:])
        first, second = config.to_dict(), again.to_dict()
        assert first["run"].pop("recipe") and not second["run"].pop("recipe")
        assert first == second


def test_the_shipped_models_recipe():
    config, card = parse("data", "--recipe", "rays"), (ROOT / "docs/model-card.md").read_text()
    assert config.preset == "rays" and config.model_config() == PRESETS["rays"]
    assert (config.length.steps, config.views.batch_size, config.optim.lr) == (5500, 16, 3e-4)
    shipped = re.search(r"gamba train (.*?)```", card, re.DOTALL)[1].replace("\\\n", "")
    shipped = parse(*shlex.split(shipped))  # its losses are those of the recipe from the start
    assert config.loss == replace(shipped.loss, lpips_after=1500)
    for name in "front_fraction flip color_jitter procedural background views_per_object".split():
        assert getattr(config.views, name) == getattr(shipped.views, name), name
    assert "not measured" in RECIPES["rays"].about


def test_the_small_models_recipe_is_its_command():
    command = json.loads((ROOT / "starter/tiny.json").read_text())["command"]
    recipe, wanted = parse("data", "--recipe", "tiny"), parse(*shlex.split(command)[2:])
    assert replace(recipe, data=wanted.data, run=wanted.run) == wanted


def test_the_recipe_takes_data_without_depth(tmp_path, capsys):
    data = micro.write_dataset(tmp_path / "data")
    words = [str(data), "--recipe", "rays", "--set", *micro.MODEL, "ray_cells=4", "ray_features=8"]
    words += "--batch-size 2 --steps 1 --size 16 --lpips off --procedural 0".split()
    words += ["--lpips-crop", "0", "--device", "cpu", "--out", str(tmp_path / "run")]
    assert cli.run("train", words) == 0
    assert "has no depth images (gamba data render --depth): its" in capsys.readouterr().out


def test_a_run_records_its_recipe(tmp_path, capsys):
    data = micro.write_dataset(tmp_path / "data")
    words = [str(data), "--recipe", "paper", "--preset", "tiny", "--set", *micro.MODEL]
    words += ["--batch-size", "1", "--steps", "1", "--size", "16", "--lpips", "off"]
    words += ["--precision", "float32", "--val-every", "0", "--device", "cpu"]
    assert cli.run("train", [*words, "--out", str(tmp_path / "one")]) == 0
    assert "recipe paper: --preset paper --size 512 --epochs 400" in capsys.readouterr().out
    assert json.loads((tmp_path / "one/config.json").read_text())["run"]["recipe"] == "paper"
    two = ["--config", str(tmp_path / "one"), "--out", str(tmp_path / "two")]
    assert cli.run("train", two) == 0
    one, two = (json.loads((tmp_path / n / "config.json").read_text()) for n in ("one", "two"))
    assert one["run"].pop("out") != two["run"].pop("out")
    assert one == two


def test_help_shows_what_a_recipe_sets(capsys):
    assert cli.run("train", ["--recipe", "paper", "--help"]) == 0
    text = capsys.readouterr().out
    assert table_of("paper") in text and "usage: gamba train" in text
    for words in ("--lr 1e-3", "--batch-size 256 / (processes x accumulate)"):
        assert words in table_of("paper")


@pytest.mark.parametrize(
    "words, reason",
    [
        (["--recipe", "rats"], "--recipe rats: expected one of paper, rays, tiny"),
        (["--recipe", "rats", "--help"], "--recipe rats: expected one of"),
        (["--recipe"], "--recipe: expected a recipe's name"),
        (["--recipe", "tiny", "--config", "run"], "--recipe and --config: give one of them"),
    ],
)
def test_bad_recipes_are_one_line(words, reason):
    refused(reason, command.expand, ["data", *words])


def test_one_of_several_processes_says_it(monkeypatch, capsys):
    words = recipe_words("rays", (), {})
    for rank, count in (("0", 1), ("1", 0)):
        monkeypatch.setenv("RANK", rank)
        command.announce(words)
        assert capsys.readouterr().out.count("recipe rays: ") == count


def test_a_copy_of_gobjaverse_trains(tmp_path):
    names = [f"0/{number}" for number in range(10010, 10040)]
    chosen = [n for n in names if split_of(n) == "train"][:2]
    chosen += [n for n in names if split_of(n) == "val"][:1]
    for name in chosen:  # a choice of objects is a folder of links (docs/data.md)
        write_object(tmp_path / "set" / name)
        (tmp_path / "data" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "data" / name).symlink_to(tmp_path / "set" / name)
    words = [tmp_path / "data", "--recipe", "paper", "--accumulate", 128]
    # A small model instead of the paper's, without downloaded weights.
    words += ["--preset", "tiny", "--set", *MODEL, "--size", 16, "--lpips", "off", "--steps", 1]
    words += ["--precision", "float32", "--device", "cpu", "--log-every", 1]
    assert run("train", [str(word) for word in [*words, "--out", tmp_path / "run"]]) == 0
    record = lines(tmp_path / "run", "train")[-1]
    assert record["loss_rdist"] > 0 and record["loss"] > 0
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["views"]["batch_size"] * config["views"]["accumulate"] == 256
    assert config["run"]["recipe"] == "paper"
