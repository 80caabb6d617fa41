"""Training rejects Google Scanned Objects, which are for evaluation."""

import json

import pytest
from helpers import micro
from helpers.refusals import refused


@pytest.fixture
def sets(tmp_path):
    """Two datasets; the second has a scanned object for training and one for validation."""
    first = micro.write_dataset(tmp_path / "first", 3)
    things = micro.write_dataset(tmp_path / "things", 3)
    for old, new in (("clouda", "Dino_4"), ("cloudc", "Elephant")):
        (things / old).rename(things / new)
    split = {"version": 2, "train": ["Dino_4", "cloudb"], "val": ["Elephant"], "test": []}
    (things / "split.json").write_text(json.dumps(split))
    return first, things


SAID = "the data has Google Scanned Objects.*\\({}\\): leave them out"


@pytest.mark.parametrize(
    "place, groups, names",
    [
        (1, {}, ["Dino_4", "Elephant"]),
        (0, {"views": {"extra": True}}, ["things/Dino_4"]),
    ],
    ids=["data", "extra"],
)
def test_their_names_are_refused_wherever_they_come_from(sets, tmp_path, place, groups, names):
    out = tmp_path / "run"
    groups = {
        group: {name: (sets[1],) if value is True else value for name, value in options.items()}
        for group, options in groups.items()
    }
    refused(SAID.format(", ".join(names)), micro.run, sets[place], out, **groups)
    assert not out.exists()
