"""One set of predictions under many protocols, and evaluations that go on after an interruption."""

import json
from dataclasses import replace

import pytest
import trimesh
from helpers.children import murderous_pair

from gamba_warp.cli import run
from gamba_warp.eval.shapes import sensitivity
from gamba_warp.eval.shapes.metrics import compare
from gamba_warp.eval.shapes.pairs import Journal, Pair, evaluate_pairs, find_pairs
from gamba_warp.eval.shapes.protocol import PRESETS
from gamba_warp.eval.tables import latex

SMALL = replace(PRESETS["default"], num_points=500, iou_voxels=16)


@pytest.fixture
def folders(tmp_path):
    for side, radius in (("pred", 0.45), ("gt", 0.5)):
        (tmp_path / side).mkdir()
        for name in ("a", "b"):
            ball = trimesh.creation.icosphere(2, radius)
            ball.apply_scale([1, 0.7, 0.5] if name == "a" else [1, 1, 0.8])
            ball.export(tmp_path / side / f"{name}.ply")
    return tmp_path


def test_variants_change_one_field_and_keep_the_place():
    base = replace(SMALL, frame="unit", up="y")
    found = sensitivity.variants(base)
    assert found.pop(sensitivity.CHOSEN) == base
    for label, protocol in found.items():
        assert (protocol.frame, protocol.up) == ("unit", "y")
        if not label.startswith("protocol "):
            field = label.partition(" =")[0]
            changed = {k for k in base.fields() if base.fields()[k] != protocol.fields()[k]}
            assert changed == {field.partition(".")[0]}
    names = {n for label in found if label.startswith("protocol ") for n in label[9:].split(", ")}
    assert names == PRESETS.keys()


def test_each_row_is_what_its_protocol_gives(folders, monkeypatch, capfd):
    """Stages that rows have in common are computed once; that must change no figure."""
    fields = ("points", "num_points", "seed", "unit", "chamfer", "align", "occupancy", "grid")
    changes = {name: sensitivity._CHANGES[name][-1:] for name in (*fields, "iou_voxels")}
    monkeypatch.setattr(sensitivity, "_CHANGES", changes)
    given = ["--points", "500", "--set", "iou_voxels=16", "--sensitivity", "--out"]
    words = [str(folders / side) for side in ("pred", "gt")]
    assert run("eval-geometry", [*words, *given, str(folders / "out")]) == 0
    printed = capfd.readouterr().out
    kept = json.loads((folders / "out" / "sensitivity.json").read_text())
    assert printed == (folders / "out" / "sensitivity.md").read_text()
    assert "</svg>" in (folders / "out" / "sensitivity.svg").read_text()
    (folders / "gt" / "b.ply").rename(folders / "gt" / "c.ply")
    assert run("eval-geometry", [*words, *given, str(folders / "fewer")]) == 1
    said = capfd.readouterr()
    assert "failed: b: no ground truth\nfailed: c: no prediction\n" in said.err
    assert "of 1 objects" in said.out
    from gamba_warp.eval.shapes.load import load_prediction, load_truth

    protocols = sensitivity.variants(SMALL)
    assert kept["rows"].keys() == protocols.keys() and len(protocols) > 8
    pair = find_pairs(folders / "pred", folders / "gt")[0][0]
    truth = load_truth(pair.gt, SMALL)
    for label, protocol in protocols.items():
        shape = load_prediction(pair.pred, truth.motion, truth.axes, protocol).shape
        want = compare(shape, truth.shape, protocol)[1]
        got = next(o for o in kept["objects"] if o["name"] == "a")["variants"][label]
        for key in ("chamfer", "iou", "noise_floor", "normal_consistency"):
            assert got[key] == want[key], (label, key)
        least = f"{min(protocol.thresholds):g}"
        assert got["fscore"] == want["fscore"][least], label


def test_an_interrupted_evaluation_goes_on(folders):
    """What is noted is not evaluated again, unless the protocol or a file has changed."""
    pairs, _ = find_pairs(folders / "pred", folders / "gt")
    first = evaluate_pairs(pairs[:1], SMALL, None, journal=Journal(folders, SMALL, None))
    noted = folders / "objects.jsonl"
    lines = noted.read_text()
    # what is no record: nested too deeply, of another kind, and a line that was cut off
    noted.write_text("[" * 10**5 + '\n{"key": "a", "record": 5}\n' + lines + '{"key": "cut of')
    pairs = [pair._replace(name="bad" if pair.name == "b" else pair.name) for pair in pairs]
    again = evaluate_pairs(
        pairs, SMALL, None, murderous_pair, journal=Journal(folders, SMALL, None)
    )
    assert again[0] == first[0] and again[1]["status"] == "failed"
    other = Journal(folders, replace(SMALL, seed=5), None)
    assert other.get(other.key(pairs[0])) is None
    trimesh.creation.box().export(pairs[0].pred)
    changed = Journal(folders, SMALL, None)
    assert changed.get(changed.key(pairs[0])) is None
    assert changed.get(changed.key(Pair("gone", folders / "gone", folders / "gone"))) is None
    changed.end()
    assert not noted.exists()


def test_rows_of_latex_are_escaped():
    text = latex([["", "F-score at 50 %"], ["a_b & c#1", "0.5 [0.4, 0.6]"]])
    assert r"a\_b \& c\#1 & 0.5 [0.4, 0.6] \\" in text and r"50 \%" in text
    assert text.count("&") == 3 and text.startswith(r"\begin{tabular}{lr}")
