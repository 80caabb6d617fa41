"""Surfaces painted by their distance, and the page that shows them from best to worst."""

import json

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.cli import run
from gamba_warp.eval.shapes.painted import (
    FAR,
    SIZE,
    as_discs,
    colors_of,
    distances,
    pictures,
    refined,
)
from gamba_warp.eval.shapes.shape import Mesh, Points
from gamba_warp.render import render


def as_mesh(mesh, move=(0.0, 0, 0)):
    return Mesh(np.array(mesh.vertices) + move, np.array(mesh.faces))


def test_distances_between_balls():
    """Of a ball of 0.4 moved by 0.06, to one of 0.5: 0.04 at one pole and 0.16 at the other."""
    small = as_mesh(trimesh.creation.icosphere(5, 0.4), (0.06, 0, 0))
    large = as_mesh(trimesh.creation.icosphere(5, 0.5))
    found = distances(small, large)
    reach = np.linalg.norm(small.vertices, axis=1)
    assert np.abs(found - (0.5 - reach)).max() < 1e-3  # triangles cut the ball's corners
    assert abs(found.min() - 0.04) < 1e-3 and abs(found.max() - 0.16) < 1e-3
    cloud = distances(Points(small.vertices), Points(large.vertices))
    assert (cloud >= found - 1e-6).all() and np.abs(cloud - found).max() < 0.02


def test_colors_end_at_the_last_distance():
    dark, middle, last, beyond = colors_of(np.array([0, FAR / 2, FAR, 5 * FAR])).tolist()
    assert dark == [68, 1, 84] and middle == [33, 145, 140]
    assert last == beyond == [253, 231, 37]
    light = colors_of(np.linspace(0, FAR, 50)) @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(light) > 0).all()


def test_large_faces_are_divided_and_fine_ones_are_not():
    box = as_mesh(trimesh.creation.box((1, 1, 1)))
    fine = refined(box)
    assert 10_000 < len(fine.faces) <= 40_000
    assert np.linalg.norm(fine.normals(), axis=1).sum() == pytest.approx(12)  # twice the area
    many = as_mesh(trimesh.creation.icosphere(5, 0.5))
    assert len(refined(many).faces) == len(many.faces)


def test_pictures_show_the_colours_on_the_ground():
    ball = trimesh.creation.icosphere(4, 0.4)
    colors = colors_of(np.where(ball.vertices[:, 2] > 0, 0.0, FAR))
    for shape in (as_mesh(ball), Points(np.array(ball.vertices))):
        found = pictures(shape, colors)
        assert found.shape == (4, SIZE, SIZE, 3) and (found[:, :5] == 0.5).all()
        top, bottom = found[:, SIZE // 3, SIZE // 2 - 20 : SIZE // 2 + 20], found[:, -50, 60:100]
        assert (top[..., 2] >= top[..., 0] - 0.02).mean() > 0.9  # dark blue above
        assert (bottom[..., 0] >= bottom[..., 2]).mean() > 0.9  # yellow below


@pytest.mark.parametrize("kind", ["mesh", "normals", "bare"])
def test_discs_cover_the_surface_in_its_colours(kind):
    """Upright in the viewer's axes, without holes, and thin where a normal is known."""
    mesh = trimesh.creation.icosphere(4, 0.4)
    ball, places = as_mesh(mesh), np.array(mesh.vertices)
    shape = ball if kind == "mesh" else Points(places, places / 0.4 if kind == "normals" else None)
    other = Mesh(ball.vertices * np.where(ball.vertices[:, 2:] > 0, 1.0, 0.5), ball.faces)
    discs = as_discs(shape, other)
    assert discs.num == (6000 if kind == "mesh" else len(places))
    above = discs.means[:, 1] < -0.1  # y is down
    blue = torch.tensor([68.0, 1, 84]) / 255
    assert (discs.colors[above] - blue).abs().max() < 0.05
    assert (discs.colors[discs.means[:, 1] > 0.1] - blue).abs().max(-1).values.min() > 0.2
    viewmats = orbit(torch.tensor([0.0, 130.0, 250.0]), 20.0, 2.0)
    cameras = Cameras(viewmats, intrinsics(96, 96, 34.0).expand(3, 3, 3), 96, 96)
    alphas = render(discs, cameras).alpha[..., 0]
    steps = torch.arange(96.0) - 47.5
    away = torch.hypot(steps[:, None], steps)
    radius = 0.4 / np.sqrt(2.0**2 - 0.4**2) * 48 / np.tan(np.radians(17))
    assert (alphas[:, away < radius - 2] > 0.9).all()
    assert (alphas[:, away > radius + 5] < 0.1).all()  # balls of 2,562 points stand out by 4


def test_a_single_point_can_be_painted():
    one = Points(np.array([[0.1, 0.2, 0.3]]))
    assert as_discs(one, one).num == 1


def test_the_page_goes_from_the_best_to_the_worst(tmp_path, capfd):
    for side in ("pred", "gt"):
        (tmp_path / side / "deep").mkdir(parents=True)
    for name, move in (("far", 0.2), ("near", 0.01), ("deep/mid", 0.05)):
        box = trimesh.creation.box((1, 0.6, 0.4))
        box.export(tmp_path / "gt" / f"{name}.ply")
        box.apply_translation([move, 0, 0])
        box.export(tmp_path / "pred" / f"{name}.ply")
    words = [str(tmp_path / side) for side in ("pred", "gt")]
    options = ["--points", "500", "--paint", "3", "--out", str(tmp_path / "out")]
    assert run("eval-geometry", [*words, *options]) == 0
    page = (tmp_path / "out" / "painted.html").read_text()
    places = [page.index(f"of 3: {name}") for name in ("near", "deep-mid", "far")]
    assert places == sorted(places)
    folder = tmp_path / "out" / "painted"
    for name in ("far", "near", "deep-mid"):
        assert Image.open(folder / f"{name}.png").size == (4 * SIZE, 2 * SIZE)
        loaded = trimesh.load(folder / f"{name}.glb", force="mesh")
        assert len(loaded.faces) > 1000 and loaded.visual.vertex_colors[:, :3].std() > 1
        assert f'href="painted/{name}.truth.glb"' in page
        for side in (name, f"{name}.truth"):
            assert f'href="painted/{side}.html"' in page
            viewer = (folder / f"{side}.html").read_text()
            assert 200_000 < len(viewer) < 400_000 and f'"title": "{side}"' in viewer
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert "paint" in report["objects"][0]["seconds"]
    assert run("eval-geometry", [*words, "--paint", "3"]) == 2
    assert "--paint: needs --out" in capfd.readouterr().err
