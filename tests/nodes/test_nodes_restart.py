"""Two torchruns, as on two machines: a killed process is restarted, with the same result."""

import os
import random

import pytest
import torch
from helpers import micro, on_threads
from helpers.micro import lines, run
from helpers.nodes.killing import kill_one_of_two, steps_for
from helpers.nodes.processes import words
from safetensors.torch import load_file

pytestmark = pytest.mark.slow
KILLS = int(os.environ.get("GAMBA_ENDURANCE_NODES", "2"))  # `make endurance` asks for more


def test_killed_processes_start_anew_and_end_as_if_nothing_was(tmp_path):
    """Kill the writing process and the other one: one during training, one at its start."""
    data = micro.write_dataset(tmp_path / "clouds", 4)
    rng = random.Random(23)  # those moments
    options = words(data, tmp_path / "none")
    at = options.index("--out")  # it has its own
    del options[at : at + 2]
    found = kill_one_of_two(options, tmp_path / "two", KILLS, rng)
    steps = steps_for(KILLS)
    assert 1 <= found.main < KILLS and found.resumed >= 1, found
    assert found.steps == steps and "Traceback" not in found.said, found
    assert {line["step"] for line in lines(tmp_path / "two", "train")} == {*range(1, steps + 1)}
    assert [line["code"] for line in lines(tmp_path / "two", "end")] == [0]
    with on_threads(1):  # two halves of each batch in turn are the same sums, see test_nodes.py
        views = {"batch_size": 2, "accumulate": 2, "views_per_object": None}
        options = {"length": {"steps": steps}, "views": views}
        assert run(data, tmp_path / "one", **options) == 0
    one, two = (load_file(tmp_path / name / "model.safetensors") for name in ("one", "two"))
    assert one.keys() == two.keys() and all(torch.equal(one[n], two[n]) for n in one)
