"""Model cards: the text on pages, and its agreement with docs/model-card.md."""

import json
from pathlib import Path

import msgspec
import pytest
from helpers.refusals import refused
from lab.figures import model_card
from lab.figures.parts import marks

from gamba_warp.model.checkpoint import DEFAULT_CHECKPOINT
from gamba_warp.pages.card import ModelCard, about_model, card_path, read_card

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.fixture
def tool():
    return model_card


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


def test_the_shipped_model_has_a_card_and_the_page_is_made_of_it(tool):
    card = read_card(DEFAULT_CHECKPOINT)
    assert card is not None and card.objects > 100 and card.limits
    assert any(row.name == "model" and row.views == "novel" for row in card.figures)
    page = (DOCS / "model-card.md").read_text(encoding="utf-8")
    assert tool.page_of(page, card) == page, "run: make figures"
    readme = tool.README.read_text(encoding="utf-8")
    assert tool.readme_of(readme, card) == readme, "run: make figures"


def test_reports_become_figures(tool, model, tmp_path, monkeypatch):
    page = tmp_path / "page.md"
    names = ("facts", "command", "figures", "limits")
    lines = [line for name in names for line in marks("make figures", name)]
    page.write_text("# Top\n" + "\n".join(lines) + "\nlast\n")
    model.write_bytes(b"weights")
    monkeypatch.setattr(tool, "DEFAULT_CHECKPOINT", model)
    monkeypatch.setattr(tool, "PAGE", page)
    readme = tmp_path / "README.md"
    readme.write_text("\n".join(marks("make figures", "results")))
    monkeypatch.setattr(tool, "README", readme)
    metrics = {"psnr": {"mean": 21.0, "interval": [20.0, 22.0]}, "lpips": {"mean": None}}
    metrics["psnr_black"] = {"mean": 17.0, "interval": [16.0, 18.0]}
    line = {"views": "novel", "name": "model", "objects": 9, **metrics}
    (tmp_path / "views.json").write_text(json.dumps({"table": [line]}))
    shape = {"num_ok": 4, "mean": {"chamfer": 0.05, "iou": 0.4}, "interval": {"iou": [0.3, 0.5]}}
    (tmp_path / "shape.json").write_text(json.dumps(shape))
    tool.main(views=tmp_path / "views.json", geometry=tmp_path / "shape.json")
    tool.main()  # again: nothing is lost
    text = page.read_text()
    assert "| **this model** | 21.00 [20.00, 22.00] |" in text and "LPIPS" not in text
    assert "| New views on other grounds, 9 objects | PSNR on black |" in text
    assert "| **this model** | 17.00 [16.00, 18.00] |" in text
    assert "| **this model** | 0.0500 | 0.400 [0.300, 0.500] |" in text
    assert "| **shipped model** | 21.00 | – | – | – | 0.0500 | 0.400 |" in readme.read_text()
    assert text.startswith("# Top\n") and text.endswith("\nlast\n") and "seven cubes" in text
    card = read_card(model)
    assert [(row.views, row.objects) for row in card.figures] == [("novel", 9), ("shape", 4)]
    assert msgspec.convert(json.loads(card_path(model).read_text()), ModelCard) == card
