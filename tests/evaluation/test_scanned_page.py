"""The table of scanned objects in the model card is what the reports hold."""

import json

import pytest
from lab import scanned
from lab.figures.parts import marks
from PIL import Image


def figures_of(psnr):
    return {"psnr": psnr, "ssim": 0.8, "lpips": None, "mask_iou": 0.5}


def row(name, psnr, views="novel"):
    cells = {key: None if v is None else {"mean": v} for key, v in figures_of(psnr).items()}
    return {"views": views, "name": name, **cells}


VIEWS = {
    "protocol": {"source": {"path": "m.safetensors", "sha256": "0123456789abcdef77"}},
    "num_ok": 2,
    "table": [row("model", 20.5), row("retrieval", 99.0), row("billboard", 17.0)]
    + [row("model", 38.0, "input")],
}
SHAPES = {
    "mean": {"chamfer": 0.04321, "normal_consistency": 0.7, "iou": 0.5},
}


def cells(table):
    return [[cell.strip() for cell in line.strip("| ").split("|")] for line in table.splitlines()]


def test_the_means_are_of_new_views_and_the_shapes_stand_with_the_model():
    head, _, *rows = cells(scanned.figures(VIEWS, SHAPES).partition("\n\n")[0])
    assert head[0] == "2 objects" and head[-3:] == ["Chamfer", "normals", "Volume IoU"]
    assert rows == [
        ["**this project**", "20.50", "0.800", "–", "0.500", "0.0432", "0.700", "0.500"],
        ["billboard", "17.00", "0.800", "–", "0.500", "–", "–", "–"],
    ]
    assert scanned.figures(VIEWS, SHAPES).endswith("`m.safetensors`, SHA-256 0123456789abcdef.")


def test_one_command_renders_evaluates_and_writes_the_page(tmp_path, monkeypatch):
    ran = []

    def run(command, words):
        ran.append([command, *words])
        name = {"eval-views": "eval", "eval-geometry": "shapes"}.get(command, "views")
        folder, report = tmp_path / "out" / name, VIEWS if command == "eval-views" else SHAPES
        folder.mkdir(parents=True)
        (folder / "report.json").write_text(json.dumps(report))
        if command == "eval-views":
            Image.new("RGB", (9, 14), "red").save(folder / "contact_sheet.png")
        return int(command == "eval-views")

    monkeypatch.setattr(scanned.cli, "run", run)
    (tmp_path / "images").mkdir()
    page = tmp_path / "page.md"
    parts = "\n".join(marks("make scanned", "figures"))
    page.write_text(f"before\n{parts}\nafter\n")
    assert scanned.main(tmp_path / "glb", out=tmp_path / "out", page=page) == 1
    assert [words[0] for words in ran] == ["data render", "eval-views", "eval-geometry"]
    assert ran[1][-1] == "auto" and str(tmp_path / "out" / "views") in ran[1]
    assert ran[2][1:3] == [str(tmp_path / "out" / "eval" / "gaussians"), str(tmp_path / "glb")]
    text = page.read_text()
    assert text.startswith("before\n") and text.endswith("after\n")
    assert "**this project**" in text
    assert Image.open(tmp_path / "images" / "scanned.webp").size == (5, 7)


@pytest.mark.parametrize("code", [2, 130])
def test_a_command_that_was_refused_ends_it(tmp_path, monkeypatch, code):
    monkeypatch.setattr(scanned.cli, "run", lambda command, words: code)
    with pytest.raises(scanned.UserError, match=f"gamba data render: failed with exit code {code}"):
        scanned.main(tmp_path, out=tmp_path / "out")
