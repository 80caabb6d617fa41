"""Errors of plans: one line that names the row, before anything runs; commands of rows."""

import pytest
from ablation.fake import write_plan
from helpers.refusals import refused, refused_command

from gamba_warp.ablation.plan import PLANS, commands, open_plan


def told(path, tmp_path):
    return refused(None, open_plan, str(path), tmp_path / "data")


@pytest.mark.parametrize(
    "b, reason",
    [
        ({"name": "a"}, "row a: duplicate name"),
        ({"name": "../b"}, "$.rows[1].name"),
        ({"sett": {}}, "unknown field `sett`"),
        ({"background_margin": -1}, "background_margin"),
        ({"set": {"widht": 4}}, "row b: set: GambaConfig has no field wid"),
        ({"set": {"width": 0}}, "row b: --set: config: width is 0"),
        ({"set": {"patch_size": 5}}, "row b: --set: config: image_size"),
        ({"options": {"clap": 4}}, "row b: not the options of a run (unknown run.clap)"),
        ({"options": {"plugins": ["a.py"]}}, "unknown run.plugins"),
        ({"options": {"lr": -1}}, "row b: lr: Expected `float` > 0"),
        ({"options": {"lr": "fast"}}, "row b: lr: Expected `float`, got `str`"),
        ({"options": {"radial_mask": 3}}, "row b: radial_mask: Expected `bool`, got `int`"),
        ({"options": {"seed": 3}}, "row b: options: seed cannot be set"),
        ({"options": {"out": "x"}}, "row b: options: out cannot be set"),
        ({"options": {"steps": 9}}, "row b: steps: the budget is the same"),
        ({"options": {"lr": "--x"}}, "row b: lr: '--x' is not a valid value"),
        ({"options": {"lr": "a\0"}}, "row b: lr: 'a\\x00' is not a valid value"),
        ({"note": "a\nb"}, "a title or note has an unprintable"),
        ({"paper": {"speed": 1}}, "row b: paper: unknown metric speed"),
    ],
)
def test_errors_name_the_row(b, reason, tmp_path):
    text = told(write_plan(tmp_path, "a", {"name": "b", **b}), tmp_path)
    assert reason in text and len(text) < 300


@pytest.mark.parametrize(
    "rows, more, reason",
    [
        ("a", {"compare_with": "c"}, "plan trial has no row c; it has a"),
        ("a", {"seeds": [1, 1]}, "a seed is given twice"),
        ("a", {"base": {"options": {}}}, "the budget of a row: expected either steps or minutes"),
        ("a", {"base": {"options": {"steps": 1, "minutes": 1}}}, "either steps or minutes"),
        ("a", {"base": {"options": {"epochs": 1}}}, "either steps or minutes"),
        ("a", {"base": {"preset": "huge"}}, "row a: preset: Invalid enum value 'huge'"),
        ("a", {"plugin": ["a.py"]}, "unknown field `plugin`"),
        ([], {}, "$.rows"),
    ],
)
def test_errors_of_the_whole_plan(rows, more, reason, tmp_path):
    text = told(write_plan(tmp_path, *rows, **more), tmp_path)
    assert reason in text and len(text) < 300


def test_errors_end_the_command_before_it_writes(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path, data = str(write_plan(tmp_path, "a")), str(tmp_path)
    bad = str(write_plan(tmp_path, "a", {"name": "b", "options": {"clap": 1}}, name="bad"))
    for words, reason in (
        ([bad, data], "row b"),
        (["tabel2", data], "no such plan; give ours, paper-table2, questions"),
        ([path, data, "--rows", "z"], "has no row z; it has a"),
    ):
        refused_command(capsys, "ablate", words, reason)
    assert {path.name for path in tmp_path.iterdir()} == {"trial.json", "bad.json"}


def test_the_row_changes_the_base(tmp_path):
    row = {"name": "b", "set": {"depth": 2}, "options": {"lr": None, "radial-mask": False}}
    row["background_margin"] = 0
    base = {"options": {"minutes": 3, "lr": 0.5, "novel_weight": 2, "extra": ["x", "y"]}}
    chosen = open_plan(str(write_plan(tmp_path, "a", row, base=base)), tmp_path / "data")
    made = [commands(chosen, r, tmp_path, tmp_path) for r in chosen.rows]
    (first, views), (second, dropped) = (words.values() for words in made)
    assert first[2:6] == ["--preset", "tiny", "--set", "width=16"]
    assert "--lr" in first and "--lr" not in second and "--no-radial-mask" in second
    assert second[second.index("--set") :][1:3] == ["width=16", "depth=2"]
    assert second[second.index("--minutes") + 1] == "3.0" and second.count("--minutes") == 1
    assert second[second.index("--extra") :][1:3] == ["x", "y"]
    assert second[-2:] == ["--out", str(tmp_path / "run")]
    assert "--background-margin" not in views
    assert dropped[dropped.index("--background-margin") + 1] == "0"


def test_every_file_of_the_folder_is_a_shipped_plan(tmp_path):
    names = {path.stem for path in PLANS.iterdir()}
    assert names == {"ours", "paper-table2", "questions"}
    for name in names:
        chosen = open_plan(name, tmp_path)
        assert chosen.name == name and len(chosen.seeds) >= 2
