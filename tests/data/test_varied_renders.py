"""Varied data: stretched objects, other fields of view, views from the front."""

import json

import numpy as np
import pytest
import torch
import trimesh
from helpers.meshes import render_views
from helpers.refusals import refused

from gamba_warp.data.dataset import open_dataset, split_of
from gamba_warp.formats.meshes import load_mesh
from gamba_warp.train.data.poses import FRONT, front_views, look_at_origin, sample_poses
from gamba_warp.train.data.raycast import Lights

QUICK = {"views": 3, "size": 17, "workers": 1}


@pytest.fixture
def boxes(tmp_path):
    """Two flat boxes; x, y and z of a .ply are the world's."""
    for name in ("a", "b"):
        (tmp_path / "meshes").mkdir(exist_ok=True)
        trimesh.creation.box(extents=(1.0, 0.2, 0.5)).export(tmp_path / "meshes" / f"{name}.ply")
    return tmp_path / "meshes"


def test_stretch_and_field_of_view_are_drawn_for_each_object_and_stated(boxes, tmp_path):
    out = tmp_path / "data"
    render_views(boxes, out, stretch=1.5, fov_spread=1.3, depth=True, **QUICK)
    found = [json.loads((out / uid / "transforms.json").read_text()) for uid in ("a", "b")]
    angles = [2 * np.degrees(np.arctan(17 / 2 / one["fl_x"])) for one in found]
    assert all(49.1 / 1.3 <= angle <= 49.1 * 1.3 for angle in angles) and angles[0] != angles[1]
    for uid, values in zip(("a", "b"), found):
        # A box stretched along its own axes has the sides of the transform.
        turn = np.array(values["applied_transform"])[:, :3] * values["applied_scale"]
        sides = np.abs(turn @ np.diag([1.0, 0.2, 0.5])).sum(1)
        assert sides.max() == pytest.approx(1)
        factors = np.diag(turn) / values["applied_scale"]
        assert ((factors >= 1 / 1.5) & (factors <= 1.5)).all() and np.ptp(factors) > 0.01
        # The depth at the middle of a view ends on the stretched box's surface.
        views = open_dataset(out).load(uid)
        for depth, viewmat in zip(views.depths.double(), views.cameras.viewmats.double()):
            point = (torch.tensor([0, 0, depth[8, 8]]).double() - viewmat[:3, 3]) @ viewmat[:3, :3]
            assert (point.abs().numpy() / sides).max() == pytest.approx(0.5, abs=1e-3)


def test_without_the_new_options_nothing_changes_and_older_sets_go_on(boxes, tmp_path, capsys):
    out = tmp_path / "data"
    render_views(boxes, out, **QUICK)
    path = out / "a" / "transforms.json"
    values = json.loads(path.read_text())
    for name in ("fronts", "spread", "stretch", "fov_spread", "light"):
        del values["settings"][name]
    for older in ({}, {"light": "usual"}):
        path.write_text(json.dumps(values | {"settings": values["settings"] | older}))
        assert render_views(boxes, out, **QUICK) == 0
        assert "2 of 2 objects already in" in capsys.readouterr().out
    path.write_text(json.dumps(values | {"settings": values["settings"] | {"light": ["usual"]}}))
    refused("rendered with other settings", render_views, boxes, out, **QUICK)
    path.write_text(json.dumps(values))
    refused("rendered with other settings", render_views, boxes, out, stretch=1.2, **QUICK)


def test_only_the_objects_of_one_part(tmp_path):
    names = [f"m{i}" for i in range(12)]
    (tmp_path / "meshes").mkdir()
    for name in names:
        trimesh.creation.box().export(tmp_path / "meshes" / f"{name}.ply")
    wanted = sorted(name for name in names if split_of(name) == "train")
    assert 0 < len(wanted) < 12
    out = tmp_path / "data"
    render_views(tmp_path / "meshes", out, views=1, size=8, workers=1, split="train")
    assert open_dataset(out).uids == wanted


def test_fields_of_view_that_no_camera_has_are_refused(boxes, tmp_path):
    said = "--fov-spread 1.3: makes fields of view outside"
    for fov in (100.0, 6.0):
        refused(said, render_views, boxes, tmp_path / "data", fov=fov, fov_spread=1.3)
    assert not (tmp_path / "data").exists()


def test_views_from_the_front_are_found_by_their_poses():
    rng = np.random.default_rng(2)
    poses = sample_poses(np.ones((1, 3)), 9, 40.0, rng, fronts=4)
    assert front_views(poses)[:4] == [0, 1, 2, 3]
    low, high = FRONT[1:]
    for azimuth, elevation, front in (
        (FRONT[0] - 1, low + 1, True),
        (-FRONT[0] - 1, low + 1, False),
        (0, high + 1, False),
        (0, low - 1, False),
        (180, 10, False),
        (359, 10, True),
    ):
        pair = np.stack([look_at_origin(90, 80, 2.0), look_at_origin(azimuth, elevation, 2.0)])
        assert front_views(pair) == ([0, 1] if front else [0])


def test_varied_lights_differ_more():
    def strengths(varied):
        drawn = [Lights.sample(np.random.default_rng(seed), varied) for seed in range(60)]
        return np.array([light.ambient[0] for light in drawn])

    assert np.std(strengths(True)) > 2 * np.std(strengths(False))


def test_normals_of_a_stretched_mesh_stay_across_its_faces(tmp_path):
    cone = trimesh.creation.cone(radius=1.0, height=1.0, sections=40)
    cone.export(tmp_path / "cone.ply")
    mesh = load_mesh(tmp_path / "cone.ply").normalized("z", np.diag([1.0, 1.0, 3.0]))[0]
    across = trimesh.triangles.cross(mesh.vertices[mesh.faces])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    side = across[:, 2] > 0.01  # not the base
    assert np.allclose(np.linalg.norm(mesh.normals, axis=-1), 1, atol=1e-5)
    # Smooth over the side; 40 faces turn by 9 degrees each.
    assert ((mesh.normals[side].mean(1) * across[side]).sum(1) > 0.95).all()
