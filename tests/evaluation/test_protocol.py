"""Untrusted protocol files, and reports with values that JSON cannot hold."""

import json
import math
import stat

import pytest
from helpers.refusals import refused, refused_command

from gamba_warp.cli import run
from gamba_warp.errors import UserError
from gamba_warp.eval import presets
from gamba_warp.eval import report as reports
from gamba_warp.eval.report import check_finite, failure, flat, make_report, save_report
from gamba_warp.eval.shapes.protocol import PRESETS, read_protocol


@pytest.mark.parametrize(
    "text, reason",
    [
        ("{", "not valid JSON"),
        ("[]", "object"),
        ('{"num_point": 5}', "num_point is not a known field"),
        ('{"num_points": "5"}', "Expected `int`, got `str` - at `$.num_points`"),
        ('{"thresholds": []}', "Expected `array` of length >= 1 - at `$.thresholds`"),
        ('{"occupancy": "magic"}', "Invalid enum value 'magic' - at `$.occupancy`"),
        ('{"surface": {"speed": 1}}', "surface.speed is not a known field"),
        ('{"version": 1}', "version 1"),
        ('{"definitions": {"chamfer": "mine"}}', "definitions"),
        ('{"distance": NaN}', "not valid JSON"),
        ('{"distance": 1e999}', "out of range"),
        (f'{{"distance": 1{"0" * 400}}}', "Number out of range - at `$.distance`"),
        ('{"thresholds": [0.1, 0]}', "Expected `float` > 0.0 - at `$.thresholds[1]`"),
        ('{"num_points": 1000000000}', "Expected `int` <= 10000000 - at `$.num_points`"),
        ('{"iou_voxels": 100000}', "Expected `int` <= 512 - at `$.iou_voxels`"),
        ('{"surface": {"voxels": 100000}}', "Expected `int` <= 1024 - at `$.surface.voxels`"),
        (f'{{"name": "{"x" * 1000}"}}', "Expected `str` of length <= 200 - at `$.name`"),
        (f'{{"thresholds": [{",".join(["0.1"] * 1000)}]}}', "Expected `array` of length <= 100"),
        (f'{{"surface": {"[" * 5000}}}', "nested deeper than 32 levels"),
    ],
)
def test_bad_protocols_are_one_line(tmp_path, text, reason, capsys):
    path = tmp_path / "p.json"
    path.write_text(text)
    words = [tmp_path, tmp_path, "--protocol", path]
    refused_command(capsys, "eval-geometry", words, f"gamba: {path}: ", reason)


def test_protocol_files(tmp_path):
    path = tmp_path / "p.json"
    for preset in PRESETS.values():
        path.write_text(json.dumps(preset.to_json()))
        assert read_protocol(str(path)) == preset
    path.write_text('{"name": "syncdreamer", "num_points": 5, "surface": {"voxels": 32}}')
    read = read_protocol(str(path))
    assert read.points == "views" and read.num_points == 5 and read.surface.voxels == 32


@pytest.mark.parametrize("name", ["default", *presets.PRESETS])
def test_explained_protocols_say_what_is_stated_and_what_is_open(name, capsys):
    assert run("eval-geometry", ["--protocol", name, "--explain"]) == 0
    text, preset = capsys.readouterr().out, presets.PRESETS.get(name)
    assert text.startswith(f"{name}: ")
    if preset is not None:
        words = " ".join(text.split())
        for kind, subjects in (("stated", preset.stated), ("open", preset.open)):
            for subject, said in subjects.items():
                assert subject in text and f"{kind}: {said}" in words
    if name in PRESETS:
        for field in flat(PRESETS[name].fields()):
            assert f"\n{field} " in text


def test_any_field_can_be_changed_and_the_change_is_named(capsys):
    words = ["--protocol", "triposr", "--explain", "--align", "box", "none", "--set"]
    given = ["unit=1", "thresholds=[0.05]", "surface.voxels=64", "chamfer=sum", "occupancy=solid"]
    assert run("eval-geometry", [*words, *given]) == 0
    text = capsys.readouterr().out
    for shown in ("unit 1.0", "thresholds [0.05]", "surface.voxels 64", 'chamfer "sum"'):
        assert shown in " ".join(text.split())
    names = "unit, chamfer, thresholds, occupancy, align, surface.voxels"
    assert text.endswith(f"changed: {names}\n")


@pytest.mark.parametrize(
    "text, reason",
    [
        ("unit", "expected FIELD=JSON"),
        ("speed=1", "expected FIELD=JSON, FIELD one of name, points,"),
        ("unit=0", "Expected `float` >= 0.001 - at `$.unit`"),
        ("chamfer=half", "Invalid enum value 'half' - at `$.chamfer`"),
        ("unit=" + "[" * 10**5, "--set unit=[[["),
        ("surface.voxels=many", "Expected `int`, got `str` - at `$.surface.voxels`"),
    ],
)
def test_bad_fields_are_one_line(text, reason, capsys):
    refused_command(capsys, "eval-geometry", ["--explain", "--set", text], "gamba: --set ", reason)


@pytest.fixture
def odd():
    objects = [
        {"name": "good", "status": "ok", "x": 1.0, "nest": {"y": 2.0}},
        {"name": "bad", "status": "ok", "x": 1.0, "nest": {"y": math.nan}},
        {"name": "list", "status": "ok", "x": 1.0, "views": [{"z": math.inf}]},
        {"name": "huge", "status": "ok", "x": 1.7e308, "nest": {"y": 2.0}},
        {"name": "huger", "status": "ok", "x": 1.7e308, "nest": {"y": 2.0}},
        {"name": "not \udcff UTF-8", "status": "failed", "reason": "\udcff"},
        failure("a", ValueError("first line\nsecond line")),
    ]
    return make_report({"p": math.nan}, objects, {"v": "1"}, more=[math.inf, (1.0,)])


def test_what_is_not_finite_is_a_failure_of_its_object_and_nothing_is_lost(tmp_path, odd):
    done = [o["name"] for o in odd["objects"] if o["status"] == "ok"]
    assert done == ["good", "huge", "huger"] and odd["objects"][0]["name"] == "a"
    assert (odd["num_ok"], odd["num_failed"]) == (3, 4)
    reasons = {f["name"]: f["reason"] for f in odd["failures"]}
    assert reasons["bad"] == "nest.y is nan" and "inf" in reasons["list"]
    assert reasons["a"] == "first line"
    assert odd["mean"]["x"] is None and odd["mean"]["nest"]["y"] == 2.0  # the sum is no number
    assert odd["protocol"] == {"p": None} and odd["more"] == [None, [1.0]]
    save_report(odd, tmp_path)
    assert json.loads((tmp_path / "report.json").read_text()) == json.loads(json.dumps(odd))
    rows = (tmp_path / "objects.csv").read_text().splitlines()
    assert rows[:2] == ["name,status,reason,x,nest.y", "a,failed,first line,,"] and len(rows) == 8
    assert "good,ok,,1.0,2.0" in rows
    refused(r"^a.b is inf", check_finite, {"a": {"b": [1.0, math.inf]}})


def test_a_report_that_cannot_be_written_goes_elsewhere(tmp_path, odd, monkeypatch):
    real = reports.write_json

    def full(path, value):
        if path.parent == tmp_path / "out":
            raise UserError(f"cannot write {path}: No space left on device")
        real(path, value)

    monkeypatch.setattr(reports, "write_json", full)
    monkeypatch.setattr(reports.tempfile, "tempdir", str(tmp_path))
    (tmp_path / "out").mkdir()
    said = refused("No space left on device; the report is in ", save_report, odd, tmp_path / "out")
    other = tmp_path / said.rpartition("/")[2]
    assert json.loads((other / "report.json").read_text())["num_ok"] == 3
    assert stat.S_ISREG((other / "objects.csv").stat().st_mode)
