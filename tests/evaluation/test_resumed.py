"""Resumed evaluations."""

from dataclasses import replace

import pytest
import trimesh
from helpers.children import murderous_pair

from gamba_warp.eval.shapes.pairs import Pair, RecordCache, evaluate_pairs, find_pairs
from gamba_warp.eval.shapes.protocol import PRESETS

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


def test_an_interrupted_evaluation_goes_on(folders):
    """Cached records are reused unless the protocol or a file has changed."""
    pairs, _ = find_pairs(folders / "pred", folders / "gt")
    first = evaluate_pairs(pairs[:1], SMALL, None, cache=RecordCache(folders, SMALL, None))
    noted = folders / "objects.jsonl"
    lines = noted.read_text()
    # what is no record: nested too deeply, of another kind, and a line that was cut off
    noted.write_text("[" * 10**5 + '\n{"key": "a", "record": 5}\n' + lines + '{"key": "cut of')
    pairs = [pair._replace(name="bad" if pair.name == "b" else pair.name) for pair in pairs]
    again = evaluate_pairs(
        pairs, SMALL, None, murderous_pair, cache=RecordCache(folders, SMALL, None)
    )
    assert again[0] == first[0] and again[1]["status"] == "failed"
    other = RecordCache(folders, replace(SMALL, seed=5), None)
    assert other.get(other.key(pairs[0])) is None
    trimesh.creation.box().export(pairs[0].pred)
    changed = RecordCache(folders, SMALL, None)
    assert changed.get(changed.key(pairs[0])) is None
    assert changed.get(changed.key(Pair("gone", folders / "gone", folders / "gone"))) is None
    changed.end()
    assert not noted.exists()
