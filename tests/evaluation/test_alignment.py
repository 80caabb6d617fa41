"""Alignment from any start, symmetries, and the figures of a protocol that searches."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from helpers.refusals import refused
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from gamba_warp.eval.shapes.align import STEPS, aligned, symmetry
from gamba_warp.eval.shapes.metrics import align_shape, compare
from gamba_warp.eval.shapes.protocol import PRESETS
from gamba_warp.eval.shapes.shape import Mesh, Points, Similarity, sample


def united(*parts):
    """One mesh of parts, centred, with a longest side of 1."""
    mesh = trimesh.util.concatenate(parts)
    low, high = mesh.bounds
    return Mesh((mesh.vertices - (low + high) / 2) / (high - low).max(), np.array(mesh.faces))


def box(size, at=(0.0, 0, 0)):
    return trimesh.creation.box(size, trimesh.transformations.translation_matrix(at))


CHAIR = united(
    box((0.5, 0.5, 0.05)),
    box((0.5, 0.05, 0.6), (0, 0.22, 0.3)),
    box((0.05, 0.05, 0.5), (0.2, -0.2, -0.25)),
    box((0.3, 0.05, 0.05), (-0.2, -0.2, 0.2)),
)
SHAPES = {
    "chair": CHAIR,
    "box": united(box((1, 0.6, 0.3))),
    "cube": united(box((1, 1, 1))),
    "ball": united(trimesh.creation.icosphere(3)),
}


def transforms(count):
    """Return rotations of any angle, translations of several lengths, and scales from 1/5 to 5."""
    random = np.random.default_rng(7)
    turns = Rotation.random(count, rng=8).as_matrix()
    scales = np.exp(random.uniform(-1.6, 1.6, count))
    return [Similarity(t, random.normal(size=3) * 3, float(s)) for t, s in zip(turns, scales)]


@pytest.mark.parametrize("name", ["chair", "box", "cube"])
def test_a_copy_comes_back_from_any_start(name):
    protocol = replace(PRESETS["triposr"], align=("scale", "turn", "icp"))
    for transform in transforms(3):
        moved, got = align_shape(transform.apply(SHAPES[name]), SHAPES[name], protocol)
        found = got["alignment"]
        got = compare(moved, SHAPES[name], replace(protocol, align=()))
        assert got["chamfer"] <= 1e-3 and set(got["fscore"].values()) == {1.0}
        assert abs(found["scale"] * transform.scale - 1) < 1e-3
        assert found["fitness"] > 0.99 and found["inlier_rmse"] < 0.03
        again = Similarity(*(np.array(found[k]) for k in ("rotation", "translation", "scale")))
        back = again.apply(transform.apply(SHAPES[name]))
        assert np.abs(back.vertices - moved.vertices).max() < 1e-9


def test_a_turn_about_the_upward_axis_is_found_by_its_own_search():
    turn = Rotation.from_euler("z", 143.4, degrees=True).as_matrix()
    points, gt = (sample(CHAIR, 10_000, seed) for seed in (0, 1))
    tilted = Similarity(turn, np.array([0.3, 0.1, -0.2]))
    found, residual = aligned(tilted.apply(points), gt, ("yaw",))
    assert not residual and np.allclose(found.rotation[2], [0, 0, 1])
    assert np.degrees(Rotation.from_matrix(found.rotation @ turn).magnitude()) <= 0.6 + 0.5
    assert np.abs(found.of(tilted).translation).max() < 0.02  # the noise of two centroids


@pytest.mark.parametrize("steps", [(step,) for step in STEPS])
def test_steps_are_repeatable_and_a_single_point_is_refused(steps):
    points, gt = (sample(CHAIR, 2000, seed) for seed in (0, 1))
    one, two = (aligned(points, gt, steps) for _ in range(2))
    # Open3D's ICP adds in the order in which its threads end; all else has the same bits.
    slack = 1e-12 if steps[0] in ("rigid", "icp") else 0
    for name in ("rotation", "translation", "scale"):
        apart = np.abs(np.array(getattr(one[0], name)) - getattr(two[0], name)).max()
        assert apart <= slack, name
    assert one[1] == pytest.approx(two[1], rel=slack)
    refused("the prediction's points coincide", aligned, Points(np.zeros((5, 3))), gt, steps)


def test_boxes_and_moments_are_matched():
    random = np.random.default_rng(3)
    one, two = Points(random.random((50, 3))), Points(3 * random.random((70, 3)) - 8)
    box_of = aligned(one, two, ("box",))[0].apply(one).positions
    low, high = two.positions.min(0), two.positions.max(0)
    assert np.allclose((box_of.min(0) + box_of.max(0)) / 2, (low + high) / 2)
    assert np.ptp(box_of, axis=0).max() == pytest.approx((high - low).max())
    spread = aligned(one, two, ("scale",))[0].apply(one).positions
    assert np.allclose(spread.mean(0), two.positions.mean(0))
    assert spread.var(0).sum() == pytest.approx(two.positions.var(0).sum())


def test_rigid_icp_keeps_the_size():
    points = sample(CHAIR, 4000, 0)
    larger = Similarity(np.eye(3), np.array([0.02, 0, 0]), 1.1).apply(points)
    rigid, free = (aligned(larger, points, (step,))[0] for step in ("rigid", "icp"))
    assert rigid.scale == pytest.approx(1, abs=1e-9)
    assert free.scale == pytest.approx(1 / 1.1, abs=0.01)


@pytest.mark.parametrize("name, turns", [("chair", 0), ("box", 3), ("cube", 23), ("ball", None)])
def test_symmetries_are_said(name, turns):
    found = symmetry(sample(SHAPES[name], 10_000, 0))
    if turns is None:  # by any angle
        assert len(found) > 20
        return
    assert len(found) == turns
    for *axis, degrees in found:
        assert np.linalg.norm(axis) == pytest.approx(1, abs=2e-3) and 85 < degrees < 181


def test_a_nearly_symmetric_box_has_no_symmetry():
    """A knob of 0.15 on one side: a half turn has 1.4 times the distance of none, by noise 1.1."""
    shape = united(box((1, 0.6, 0.3)), box((0.15,) * 3, (0.35, 0.2, 0.225)))
    assert symmetry(sample(shape, 10_000, 0)) == []


def test_the_figures_of_triposr_are_those_of_another_implementation():
    """Chamfer and F-scores of the points that were compared, by scipy's tree in float64."""
    protocol = replace(PRESETS["triposr"], align=())
    other = Mesh(CHAIR.vertices * [1.1, 0.9, 1] + [0.03, 0, 0], CHAIR.faces)
    got = compare(other, CHAIR, protocol)
    one, two = (2 * sample(shape, 10_000, protocol.seed).positions for shape in (other, CHAIR))
    there, back = cKDTree(two).query(one)[0], cKDTree(one).query(two)[0]
    assert got["chamfer"] == pytest.approx((there.mean() + back.mean()) / 2, abs=1e-6)
    for threshold in (0.1, 0.2, 0.5):
        a, b = (there <= threshold).mean(), (back <= threshold).mean()
        assert got["fscore"][f"{threshold:g}"] == pytest.approx(2 * a * b / (a + b), abs=1e-4)


@pytest.mark.parametrize("form, want", [("sum", 0.2), ("squared", 0.01), ("squared-sum", 0.02)])
def test_forms_of_the_chamfer_distance(form, want):
    """Two spheres of radii 0.4 and 0.5: each is 0.1 from the other, squared 0.01."""
    ball = trimesh.creation.icosphere(5)
    small, large = (Mesh(r * ball.vertices, np.array(ball.faces)) for r in (0.4, 0.5))
    protocol = replace(PRESETS["default"], num_points=50_000, chamfer=form, occupancy="none")
    for unit in (1.0, 2.0):
        got = compare(small, large, replace(protocol, unit=unit))
        scaled = want * (unit if form == "sum" else unit**2)
        assert got["chamfer"] == pytest.approx(scaled, rel=0.01)  # nearest samples lie aslant
