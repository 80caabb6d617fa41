"""Errors of plans: one line that names the row, before anything runs."""

import inspect
import json

import msgspec
import pytest
from ablation.fake import plan, write_plan

from gamba_warp import cli
from gamba_warp.ablation import jobs
from gamba_warp.ablation.plan import PLANS, FitOptions, open_plan, read_plan, shipped
from gamba_warp.commands.fit import fit_command
from gamba_warp.errors import UserError


def settings(tmp_path, chosen, budget=("steps", 4), **more):
    values = {"evaluation": chosen.evaluation, "meshes": None, "device": "cpu", **more}
    return jobs.Settings(chosen, tmp_path / "data", tmp_path / "out", budget=budget, **values)


def told(path, tmp_path):
    with pytest.raises(UserError) as caught:
        chosen = read_plan(path)
        jobs.budget_of(chosen, None, None)
        jobs.check(settings(tmp_path, chosen))
    return str(caught.value)


@pytest.mark.parametrize(
    "b, reason",
    [
        ({"name": "a"}, "row a: there are two"),
        ({"name": "../b"}, "$.rows[1].name"),
        ({"sett": {}}, "unknown field `sett`"),
        ({"background_margin": -1}, "background_margin"),
        ({"kind": "fit", "background_margin": 0}, "row b: a fit has no model, so it has no back"),
        ({"kind": "fit", "set": {"width": 8}}, "row b: a fit has no model, so it has no set"),
        ({"kind": "fit", "options": {"gaussians": 1}}, "row b: gamba fit: Expected `int` >= 2"),
        ({"kind": "fit", "options": {"views": 1}}, "row b: gamba fit: Object contains unknown"),
        ({"set": {"widht": 4}}, "row b: set: GambaConfig has no field wid"),
        ({"set": {"width": 0}}, "row b: --set: config: width is 0"),
        ({"set": {"patch_size": 5}}, "row b: --set: config: image_size"),
        ({"options": {"clap": 4}}, "row b: not the options of a run (unknown run.clap)"),
        ({"options": {"lr": -1}}, "row b: lr: Expected `float` > 0"),
        ({"options": {"lr": "fast"}}, "row b: lr: Expected `float`, got `str`"),
        ({"options": {"radial_mask": 3}}, "row b: radial_mask: Expected `bool`, got `int`"),
        ({"options": {"seed": 3}}, "row b: options: seed cannot be set"),
        ({"options": {"out": "x"}}, "row b: options: out cannot be set"),
        ({"options": {"steps": 9}}, "row b: steps: the budget is the same"),
        ({"options": {"lr": "--x"}}, "row b: lr: '--x' is not a valid value"),
        ({"options": {"lr": "a\0"}}, "row b: lr: 'a\\x00' is not a valid value"),
        ({"note": "a\nb"}, "a title or note has an unprintable"),
        ({"seeds": [1, 1]}, "row b: a seed is repeated"),
        ({"paper": {"speed": 1}}, "row b: paper: no metric speed"),
    ],
)
def test_what_is_wrong_is_told_with_the_rows_name(b, reason, tmp_path):
    text = told(write_plan(tmp_path, "a", {"name": "b", **b}), tmp_path)
    assert reason in text and "\n" not in text and len(text) < 300


IN_SERIES = {"name": "a", "series": "n"}
FIT = {"name": "b", "kind": "fit"}


@pytest.mark.parametrize(
    "rows, more, reason",
    [
        ("a", {"compare_with": "c"}, "plan trial has no row c; it has a"),
        (["a", FIT], {"compare_with": "b"}, "compare_with b: rows can be compared with a model"),
        ([IN_SERIES, {**FIT, "series": "n"}], {}, "series n: it mixes models and fits"),
        ([IN_SERIES, {**IN_SERIES, "name": "b"}], {}, "series n: two of its rows have the same nu"),
        ("a", {"base": {"options": {}}}, "the budget of a row: expected steps or minutes"),
        ("a", {"base": {"options": {"steps": 1, "minutes": 1}}}, "expected steps or minutes"),
        ("a", {"base": {"preset": "huge"}}, "row a: preset: Invalid enum value 'huge'"),
        ([], {}, "$.rows"),
    ],
)
def test_what_is_wrong_with_the_whole_plan_is_told(rows, more, reason, tmp_path):
    text = told(write_plan(tmp_path, *rows, **more), tmp_path)
    assert reason in text and "\n" not in text and len(text) < 300


def test_what_is_wrong_ends_the_command_before_it_writes(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path, data = str(write_plan(tmp_path, "a")), str(tmp_path)
    bad = str(write_plan(tmp_path, "a", {"name": "b", "options": {"clap": 1}}, name="bad"))
    for words, reason in (
        ([bad, data], "row b"),
        (["tabel2", data], "no such plan; give ours, paper-table2, questions"),
        ([path, data, "--rows", "z"], "has no row z; it has a"),
        ([path, data, "--steps", "1", "--minutes", "1"], "give one of them"),
        ([path, f"{data}/none", "--dry-run"], "none"),
    ):
        assert cli.run("ablate", words) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert reason in line
    assert {path.name for path in tmp_path.iterdir()} == {"trial.json", "bad.json"}


def test_a_row_is_evaluated_without_its_background(tmp_path):
    chosen = read_plan(write_plan(tmp_path, "a", {"name": "b", "background_margin": 0}))
    given = settings(tmp_path, chosen)
    (_, with_all), (_, dropped) = (jobs.stages(given, row, 0) for row in chosen.rows)
    assert "--background-margin" not in with_all.words
    at = dropped.words.index("--background-margin")
    assert dropped.words[at + 1] == "0"


def test_the_row_changes_the_base(tmp_path):
    row = {"name": "b", "set": {"depth": 2}, "options": {"lr": None, "radial-mask": False}}
    base = {"options": {"minutes": 3, "lr": 0.5, "clip": 2, "extra": ["x", "y"]}}
    chosen = read_plan(write_plan(tmp_path, "a", row, base=base))
    given = settings(tmp_path, chosen, ("minutes", 1.5))
    first, second = (jobs.stages(given, r, 7)[0].words_in(tmp_path) for r in chosen.rows)
    assert first[2:6] == ["--preset", "tiny", "--set", "width=16"]
    assert "--lr" in first and "--lr" not in second and "--no-radial-mask" in second
    assert second[second.index("--set") :][1:3] == ["width=16", "depth=2"]
    assert second[second.index("--minutes") + 1] == "1.5" and second.count("--minutes") == 1
    assert second[second.index("--extra") :][1:3] == ["x", "y"]
    assert second[second.index("--seed") + 1] == "7"
    assert second[-2:] == ["--out", str(tmp_path / "run")]


@pytest.mark.parametrize("name", ["paper-table2", "questions", "ours"])
def test_the_shipped_plans_are_sound(name, tmp_path):
    chosen = open_plan(name)
    assert chosen.name == name and len(chosen.seeds) >= 2
    given = settings(tmp_path, chosen, jobs.budget_of(chosen, None, None), meshes=tmp_path)
    for row in chosen.rows:
        assert jobs.stages(given, row, 0)
    jobs.check(given)
    numbers = {r.name: jobs.gaussians_of(given, r) for r in chosen.rows if r.series}
    if name == "questions":
        want = {"1k": 1024, "2k": 2304, "4k": 4096, "9k": 9216, "16k": 16384}
        assert {n[10:]: v for n, v in numbers.items() if n.startswith("gau")} == want


def test_every_file_of_the_folder_is_a_shipped_plan():
    assert shipped() == ["ours", "paper-table2", "questions"]
    for path in PLANS.iterdir():
        assert read_plan(path).name == path.stem


def test_a_fits_options_are_those_of_the_command():
    theirs = inspect.signature(fit_command).parameters
    for field in msgspec.structs.fields(FitOptions):
        assert field.name in theirs
        if field.name not in ("limit", "held_out"):
            assert field.default == theirs[field.name].default, field.name


def test_a_plan_is_kept_as_it_is(tmp_path):
    path = write_plan(tmp_path, "a", {"name": "b", "paper": {"psnr": 12.72}, "seeds": [3]})
    built = msgspec.to_builtins(read_plan(path))
    again = tmp_path / "again.json"
    again.write_text(json.dumps(built))
    assert msgspec.to_builtins(read_plan(again)) == built
    assert plan("a")["name"] == "trial"


def test_the_difference_of_two_commands_is_named():
    old = {"train": ["train", "D", "--set", "a=1", "b=2", "--lr", "1"], "views": ["eval-views"]}
    assert jobs.difference(old, {name: [*words] for name, words in old.items()}) is None
    other = {**old, "train": ["train", "D", "--set", "a=3", "b=2", "--lr", "1"]}
    assert jobs.difference(old, other) == "train --set a=1 b=2 then, train --set a=3 b=2 now"
    fewer = {**old, "train": old["train"][:-2]}
    assert jobs.difference(old, fewer) == "train --lr 1 then, nothing now"
    more = {**old, "shapes": ["eval-geometry", "P"]}
    assert jobs.difference(old, more) == "nothing then, eval-geometry P now"
    assert jobs.difference(more, old) == "eval-geometry P then, nothing now"
