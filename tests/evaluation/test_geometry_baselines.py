"""The retrieval's meshes as predicted shapes."""

import json

import numpy as np
import pytest
import torch
import trimesh
from helpers.micro import write_split
from helpers.refusals import refused
from helpers.views import around, cloud_of, eval_views, evaluated, straight, write_views

from gamba_warp.cli import run
from gamba_warp.data.dataset import open_dataset
from gamba_warp.eval.shapes.load import load_gt
from gamba_warp.eval.shapes.pairs import find_pairs, out_of_reference
from gamba_warp.eval.shapes.protocol import PRESETS
from gamba_warp.eval.views.baselines import NearestView, TrainingMeshes
from gamba_warp.formats.meshes import Y_TO_Z_UP, load_mesh
from gamba_warp.formats.ply import save_ply

SIZE = 32  # that of the thumbnails: the images are compared as they are
# A quarter turn about the vertical axis of ``orbit``: bounding boxes stay bounding boxes.
TURN = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
ON_ITS_SIDE = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # what the catalogue turns back


pytestmark = pytest.mark.usefixtures("one_thread")


def stairs():
    """Three boxes without rotational symmetry; centred, longest side 1."""
    boxes = [((1.0, 0.2, 0.3), (0, 0.3, 0)), ((0.3, 0.4, 0.3), (0.35, 0, 0))]
    boxes += [((0.2, 0.2, 0.6), (-0.4, -0.3, 0.05))]
    parts = [trimesh.creation.box(size).apply_translation(at) for size, at in boxes]
    mesh = trimesh.util.concatenate(parts)
    mesh.vertices -= mesh.bounds.mean(0)
    return mesh


def write_mesh_views(folder, mesh, azimuths):
    """Images of Gaussians all over the mesh, whose colours follow the place in the file."""
    points, _ = trimesh.sample.sample_surface(mesh, 400, seed=1)
    cloud = cloud_of(np.array(points), 0.04, 0.95, torch.linspace(0, 1, 400)[:, None])
    cameras = around(azimuths, 20.0, 1.6, SIZE)
    write_views(folder, straight(cloud, cameras), cameras)
    return cloud


@pytest.fixture
def world(tmp_path):
    """``twin`` is under test; ``seen``, in training, is the same thing after a quarter turn.

    Its file is larger, elsewhere, y-up, and on its side; its cameras have other azimuths.
    """
    meshes, data = tmp_path / "meshes", tmp_path / "data"
    (meshes / "library").mkdir(parents=True)
    twin, turned = stairs(), stairs()
    turned.vertices = turned.vertices @ TURN.T
    twin.export(meshes / "library" / "t.ply")
    filed = turned.copy()
    to_file = np.linalg.inv(Y_TO_Z_UP @ ON_ITS_SIDE)
    filed.vertices = 7 * (turned.vertices @ to_file.T) + [1.0, 2.0, 3.0]
    filed.export(meshes / "library" / "s.obj")
    trimesh.creation.box((1.0, 0.8, 0.6)).export(meshes / "library" / "other.ply")
    entries = [{"model": "library/t.ply", "uid": "twin"}]
    rotation = ON_ITS_SIDE.tolist()
    entries.append({"model": "library/s.obj", "uid": "seen", "rotation": rotation})
    entries.append({"model": "library/other.ply", "uid": "other"})
    (meshes / "catalogue.json").write_text(json.dumps({"objects": entries}))
    cloud = write_mesh_views(data / "twin", twin, [25.0, 140.0])
    write_mesh_views(data / "seen", turned, [160.0, 295.0, 115.0, 205.0, 25.0])
    write_split(data, train=["seen"], test=["twin"])
    (tmp_path / "pred").mkdir()
    save_ply(tmp_path / "pred" / "twin.ply", cloud)
    return tmp_path


def evaluate_views(world, *options):
    return eval_views(*(world / n for n in ("pred", "data", "out")), "--sheet", 0, *options)


def test_the_placed_mesh_is_the_truth(world, capsys):
    """Through both commands: the retrieval finds the rotated twin, whose mesh is the truth."""
    code, report = evaluate_views(world, "--save-retrieval", str(world / "meshes"))
    assert code == 0
    found = report["objects"][0]["retrieval"]
    assert found["uid"] == "seen" and found["view"] in (1, 2) and found["distance"] < 0.02
    placed = load_mesh(world / "out" / "retrieval" / "twin.ply")
    transform = out_of_reference(open_dataset(world / "data"), "twin", 0, 1.5)
    here = transform.points(placed.vertices)
    want = stairs().vertices
    apart = np.linalg.norm(here[:, None] - want[None], axis=-1).min(1)
    assert apart.max() < 1e-5  # float32 in the .ply and in the poses
    unturned = np.linalg.norm((want @ TURN.T)[:, None] - want[None], axis=-1).min(1)
    assert unturned.max() > 0.2  # so that the mesh as its file has it would be seen
    out = world / "shapes"
    options = ["--frame", "reference", "--data", world / "data", "--points", 3000]
    files = world / "out" / "retrieval", world / "meshes"
    code, report = evaluated("eval-geometry", out, *files, *options)
    assert code == 0
    assert [record["name"] for record in report["objects"]] == ["twin"]  # of three in the library
    assert report["mean"]["iou"] > 0.99  # rounding may move a voxel's centre across the surface
    assert report["mean"]["chamfer"] < 1.2 * report["mean"]["noise_floor"]
    assert "median" in capsys.readouterr().out and (out / "table.md").exists()


def test_distance_of_the_found_camera_does_not_matter(world):
    """The unit is that in which the input camera stands at the model's distance."""
    training = open_dataset(world / "data", "train")
    meshes = TrainingMeshes(world / "meshes", training)
    placed = meshes.place(NearestView("seen", 3, 0.1), 2.5).vertices
    viewmat = training.load("seen", [3]).cameras.viewmats[0].numpy()
    world_vertices = stairs().vertices @ TURN.T
    # seen by the found camera, moved along its axis to 2.5 / 1.6 of the distance and as much larger
    local = world_vertices @ viewmat[:3, :3].T * 2.5 / 1.6
    apart = np.linalg.norm(placed[:, None] - local[None], axis=-1).min(1)
    assert apart.max() < 1e-5
    refused("no mesh of the training object gone", meshes.place, NearestView("gone", 0, 0.1), 1.5)


@pytest.mark.parametrize("case", ["out", "baselines", "absent", "others", "train"])
def test_what_cannot_be_placed(world, case, capsys):
    options, meshes = [], world / "meshes"
    if case == "baselines":
        options = ["--no-baselines"]
    if case == "absent":
        meshes = world / "nowhere"
    if case == "others":
        (meshes / "catalogue.json").unlink()  # the files' own names are those of no object
    if case == "train":
        write_split(world / "data", test=["twin", "seen"])
    if case == "out":
        places = ["--checkpoint", str(world / "pred"), "--data", str(world / "data")]
        assert run("eval-views", [*places, "--lpips", "off", "--save-retrieval", str(meshes)]) == 2
    else:
        assert evaluate_views(world, "--save-retrieval", str(meshes), *options) == (2, None)
    error = capsys.readouterr().err
    assert error.startswith("gamba: ") and error.count("\n") == 1


def test_a_mesh_that_is_bad_stops_nothing(world, capsys):
    (world / "meshes" / "library" / "s.obj").write_text("v 0 0 0\nf 1 1 x\n")
    code, report = evaluate_views(world, "--save-retrieval", str(world / "meshes"))
    assert code == 1 and report["num_ok"] == 1 and "retrieval" in report["baselines"]
    assert [item["name"] for item in report["failures"]] == ["twin (retrieval's mesh)"]
    assert list((world / "out" / "retrieval").iterdir()) == []


def test_a_truth_is_turned_as_its_catalogue_says(world):
    pairs, failures = find_pairs(world / "pred", world / "meshes", ["seen", "unknown"])
    assert [(pair.name, pair.gt.name) for pair in pairs] == [("twin", "t.ply")]
    reasons = {item["name"]: item["reason"] for item in failures}
    assert reasons == {"seen": "no prediction", "unknown": "no prediction"}
    protocol = PRESETS["default"]
    path = world / "meshes" / "library" / "s.obj"
    gt = load_gt(path, protocol, ON_ITS_SIDE.tolist()).shape
    want = stairs().vertices @ TURN.T
    apart = np.linalg.norm(gt.vertices[:, None] - want[None], axis=-1).min(1)
    assert apart.max() < 1e-6
    turned = stairs()
    turned.vertices = want
    (world / "upright").mkdir()
    turned.export(world / "upright" / "seen.ply")
    words = [world / "upright", world / "meshes", "--frame", "unit", "--points", 500]
    code, report = evaluated("eval-geometry", world / "out", *words)
    assert code == 0
    assert report["mean"]["iou"] > 0.99  # rounding may move a voxel's centre across the surface
    for wrong in ([1.0, 1, 2], [-1.0, 1, 1]):
        refused("stretches or mirrors", load_gt, path, protocol, np.diag(wrong).tolist())
