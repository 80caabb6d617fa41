"""Training rejects Google Scanned Objects unless requested; then the card states it."""

import json

import pytest
from helpers import micro
from helpers.refusals import refused

from gamba_warp.pages.card import about_model, read_card
from gamba_warp.train.batches import open_data


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


SAID = "the data has Google Scanned Objects.*\\({}\\): leave them out, or give --train-on-gso"


@pytest.mark.parametrize(
    "place, groups, names",
    [
        (1, {}, ["Dino_4", "Elephant"]),
        (0, {"views": {"extra": True}}, ["things/Dino_4"]),
        (0, {"run": {"val_extra": True}}, ["Elephant"]),
        (1, {"views": {"overfit": "Dino_4"}}, ["Dino_4"]),
    ],
    ids=["data", "extra", "val-extra", "overfit"],
)
def test_their_names_are_refused_wherever_they_come_from(sets, tmp_path, place, groups, names):
    out = tmp_path / "run"
    groups = {
        group: {name: (sets[1],) if value is True else value for name, value in options.items()}
        for group, options in groups.items()
    }
    refused(SAID.format(", ".join(names)), micro.run, sets[place], out, **groups)
    assert not out.exists()
    views = {**groups.get("views", {}), "train_on_gso": True}
    asked = micro.options(sets[place], out, **{**groups, "views": views})
    assert open_data(asked).scanned == names


def test_the_card_states_what_was_asked_for(sets, tmp_path):
    views = {"extra": (sets[1],), "train_on_gso": True}
    changes = {"val_every": 6, "val_extra": (sets[1],)}
    assert micro.run(sets[0], tmp_path / "run", views=views, run=changes) == 0
    for name in ("model", "best"):
        path = tmp_path / "run" / f"{name}.safetensors"
        card = read_card(path)
        assert card is not None and (card.objects, card.steps) == (4, 6)
        assert "--train-on-gso" in card.command and card.data == "first, things"
        told = dict(about_model(path))["Limits"]
        assert "2 of Google Scanned Objects" in told and told.endswith("Elephant, things/Dino_4")
    assert micro.run(sets[0], tmp_path / "other", run={"val_every": 6}) == 0
    assert read_card(tmp_path / "other" / "model.safetensors") is None
