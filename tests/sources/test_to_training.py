"""From published files to a step of ``gamba train --recipe paper``."""

import json

from helpers.micro import MODEL, lines
from helpers.published.gobjaverse import write_object

from gamba_warp.cli import run
from gamba_warp.data.dataset import split_of


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
