"""Model cards: the text on pages."""

import json

import pytest
from helpers.refusals import refused

from gamba_warp.model.checkpoint import DEFAULT_CHECKPOINT
from gamba_warp.pages.card import about_model, read_card


def row(views, name, psnr, **more):
    return {"views": views, "name": name, "objects": 7, "psnr": {"mean": psnr}, **more}


CARD = {
    "data": "seven cubes",
    "objects": 1234,
    "steps": 5,
    "compute": "a second",
    "command": "gamba train cubes",
    "seed": 3,
    "use": "tests",
    "limits": ["No spheres.", "No cones."],
    "measured": "here",
    "figures": [
        row("novel", "model", 20.125, lpips={"mean": 0.3, "interval": [0.2, 0.4]}),
        row("novel", "billboard", 18.5, lpips={"mean": 0.25}),
        row("novel", "empty", 15.0, lpips={"mean": 0.5}),
        row("input", "model", 30.0),
        row("input", "billboard", 100.0),
    ],
}


@pytest.fixture
def model(tmp_path):
    (tmp_path / "m.json").write_text(json.dumps(CARD))
    return tmp_path / "m.safetensors"


def test_a_page_says_what_the_card_says(model):
    about = dict(about_model(model))
    assert about["Model"] == "m.safetensors" and about["Trained on"] == "seven cubes"
    assert about["Training"] == "1,234 objects, 5 steps; a second"
    # the best baseline: more is better in PSNR, less in LPIPS
    novel = about["Measured, new views"]
    assert "PSNR 20.12 dB (billboard 18.50), LPIPS 0.300 (billboard 0.250)" in novel
    assert about["Measured, input view"] == "PSNR 30.00 dB. 7 objects."
    assert about["Limits"] == "No spheres. No cones."


def test_a_model_without_a_card_says_so(tmp_path):
    assert read_card(tmp_path / "m.safetensors") is None
    assert dict(about_model(tmp_path / "m.safetensors")) == {
        "Model": "m.safetensors",
        "Trained on": "not known: this model has no card",
    }


@pytest.mark.parametrize(
    "content",
    ["", "[]", "{", '{"data": 1}', json.dumps({**CARD, "steps": -1}), '{"a":' * 3000, "NaN"],
)
def test_a_file_that_is_no_card_does_not_stop_a_page(model, content):
    (model.parent / "m.json").write_text(content)
    refused(r"m\.json: ", read_card, model)
    assert about_model(model)[1] == ("Trained on", "not known: m.json is no model card")


def test_the_shipped_model_has_a_card():
    card = read_card(DEFAULT_CHECKPOINT)
    assert card is not None and card.objects > 100 and card.limits
    assert any(row.name == "model" and row.views == "novel" for row in card.figures)
