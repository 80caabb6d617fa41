"""One set of predictions under many protocols, and resumed evaluations."""

import json
from dataclasses import replace

import pytest
import trimesh
from helpers.children import faulty_pair
from helpers.gaussians import some

from gamba_warp.cli import run
from gamba_warp.eval.shapes import sensitivity
from gamba_warp.eval.shapes.load import load_gt, load_prediction
from gamba_warp.eval.shapes.metrics import compare
from gamba_warp.eval.shapes.pairs import Pair, RecordCache, evaluate_pairs, find_pairs
from gamba_warp.eval.shapes.protocol import PRESETS
from gamba_warp.formats.ply import save_ply
from gamba_warp.surfaces.options import SurfaceOptions

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


def assert_as_alone(pair, protocols, found):
    """Each row is what a direct evaluation by its protocol gives."""
    gt = load_gt(pair.gt, SMALL)
    for label, protocol in protocols.items():
        shape = load_prediction(pair.pred, gt.transform, gt.axes, protocol).shape
        want, got = compare(shape, gt.shape, protocol), found[label]
        for key in ("chamfer", "iou", "noise_floor", "normal_consistency"):
            assert got[key] == want[key], (label, key)
        assert got["fscore"] == want["fscore"][f"{min(protocol.thresholds):g}"], label


def test_each_row_is_what_its_protocol_gives(folders, monkeypatch):
    """Stages that rows have in common are computed once; that must change no figure."""
    changes = {"points": "views", "num_points": 400, "seed": 1, "unit": 2.0, "iou_voxels": 24}
    changes |= {"chamfer": "squared-sum", "occupancy": "parity", "grid": "lattice"}
    changes |= {"align": ("scale", "yaw")}
    monkeypatch.setattr(sensitivity, "_CHANGES", {name: (v,) for name, v in changes.items()})
    monkeypatch.setattr(sensitivity, "PRESETS", {})
    protocols = sensitivity.variants(SMALL)
    assert len(protocols) == 1 + len(changes)
    pair = find_pairs(folders / "pred", folders / "gt")[0][0]
    found = sensitivity.vary_pair(pair, SMALL, None, protocols)["variants"]
    assert_as_alone(pair, protocols, found)


def test_sheets_of_a_command(folders, monkeypatch, capfd):
    monkeypatch.setattr(sensitivity, "_CHANGES", {"seed": (1,)})
    monkeypatch.setattr(sensitivity, "PRESETS", {"default": SMALL})
    given = ["--points", "500", "--set", "iou_voxels=16", "--sensitivity", "--out"]
    words = [str(folders / side) for side in ("pred", "gt")]
    assert run("eval-geometry", [*words, *given, str(folders / "out")]) == 0
    printed = capfd.readouterr().out
    kept = json.loads((folders / "out" / "sensitivity.json").read_text())
    assert printed == (folders / "out" / "sensitivity.md").read_text()
    assert kept["rows"].keys() == sensitivity.variants(SMALL).keys()
    assert [o["name"] for o in kept["objects"]] == ["a", "b"]
    (folders / "gt" / "b.ply").rename(folders / "gt" / "c.ply")
    assert run("eval-geometry", [*words, *given, str(folders / "fewer")]) == 1
    said = capfd.readouterr()
    assert "failed: b: no ground truth\nfailed: c: no prediction\n" in said.err
    assert "of 1 objects" in said.out


def test_rows_that_differ_by_the_surface_or_the_thresholds_alone(folders):
    save_ply(folders / "pred" / "a.ply", some(40))
    pair = find_pairs(folders / "pred", folders / "gt")[0][0]
    methods = (SurfaceOptions(method=method, voxels=16) for method in ("centers", "density"))
    centers, density = (replace(SMALL, surface=surface) for surface in methods)
    protocols = {"a": centers, "b": density, "c": replace(centers, thresholds=(0.2, 0.1))}
    found = sensitivity.vary_pair(pair, SMALL, None, protocols)["variants"]
    assert_as_alone(pair, protocols, found)
    assert len({row["chamfer"] for row in found.values()}) == 2


def test_an_interrupted_evaluation_goes_on(folders):
    """Cached records are reused unless the protocol or a file has changed."""
    pairs, _ = find_pairs(folders / "pred", folders / "gt")
    first = evaluate_pairs(pairs[:1], SMALL, None, cache=RecordCache(folders, SMALL, None))
    noted = folders / "objects.jsonl"
    lines = noted.read_text()
    # what is no record: nested too deeply, of another kind, and a line that was cut off
    noted.write_text("[" * 10**5 + '\n{"key": "a", "record": 5}\n' + lines + '{"key": "cut of')
    pairs = [pair._replace(name="bad" if pair.name == "b" else pair.name) for pair in pairs]
    again = evaluate_pairs(pairs, SMALL, None, faulty_pair, cache=RecordCache(folders, SMALL, None))
    assert again[0] == first[0] and again[1]["status"] == "failed"
    other = RecordCache(folders, replace(SMALL, seed=5), None)
    assert other.get(other.key(pairs[0])) is None
    trimesh.creation.box().export(pairs[0].pred)
    changed = RecordCache(folders, SMALL, None)
    assert changed.get(changed.key(pairs[0])) is None
    assert changed.get(changed.key(Pair("gone", folders / "gone", folders / "gone"))) is None
    changed.end()
    assert not noted.exists()
