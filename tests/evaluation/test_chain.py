"""``data render``, ``eval-views`` and ``eval-geometry`` on one set, with its names and axes."""

import json
import shutil

import numpy as np
import pytest
import torch
import trimesh
from helpers.micro import write_split
from helpers.refusals import refused
from helpers.views import eval_views, evaluated

from gamba_warp.cameras import relative_to_reference
from gamba_warp.cli import run
from gamba_warp.data.dataset import open_dataset
from gamba_warp.eval.shapes.pairs import find_pairs, open_objects
from gamba_warp.eval.views.baselines import NearestView, TrainingMeshes
from gamba_warp.files import STARTER
from gamba_warp.formats.meshes import Y_TO_Z_UP

NAMES = ("bench", "lamp", "table")
QUICK = ("--points", 1000, "--voxels", 24, "--views", 8, "--pixels", 32)

pytestmark = pytest.mark.usefixtures("one_thread")


def shape(seed):
    """Boxes without rotational symmetry, of one colour, away from the origin; y-up."""
    rng = np.random.default_rng(seed)
    sizes, places = rng.uniform(0.2, 1.0, (3, 3)), rng.uniform(-0.4, 0.4, (3, 3))
    parts = [trimesh.creation.box(size).apply_translation(at) for size, at in zip(sizes, places)]
    mesh = trimesh.util.concatenate(parts)
    mesh.visual.vertex_colors = [*rng.integers(0, 256, 3), 255]
    return mesh.apply_translation([0.1, 0.7, -0.2])


def z_up(mesh):
    mesh.vertices = mesh.vertices @ Y_TO_Z_UP.T
    return mesh


def write(path, mesh):
    path.parent.mkdir(parents=True, exist_ok=True)
    mesh.export(path)


def render(meshes, data, *options):
    """Renders a set of which the last object is the test split, and the others the training's."""
    words = ("--out", data, "--views", 3, "--size", 32, "--workers", 1, *options)
    assert run("data render", [str(meshes), *map(str, words)]) == 0
    uids = open_dataset(data).uids
    write_split(data, train=uids[:-1], test=uids[-1:])
    return uids


def chain(out, meshes, *options):
    """The reports of views and of shapes, as docs/evaluate.md has the commands."""
    uids, data = render(meshes, out / "data", *options), out / "data"
    words = ("--sheet", 0, "--strips", 0, "--save-gaussians", "--save-retrieval", meshes)
    code, views = eval_views(STARTER / "tiny.safetensors", data, out / "views", *words)
    assert code == 0
    where, shapes = (meshes, "--frame", "reference", "--data", data), []
    for name in ("gaussians", "retrieval"):
        words = out / "views" / name, *where, *QUICK
        code, report = evaluated("eval-geometry", out / "shapes", *words)
        assert code == 0 and report["warnings"] == report["failures"] == []
        shapes.append(report)
    return uids, views, shapes


def test_a_set_says_its_names_and_axes(tmp_path, capsys):
    """``NAME/model.obj``, z-up, one folder of them a link: the figures of the flat, y-up set."""
    for seed, name in enumerate(NAMES):
        write(tmp_path / "flat" / f"{name}.obj", shape(seed))
        write(tmp_path / "nested" / name / "model.obj", z_up(shape(seed)))
    shutil.move(tmp_path / "nested" / "table", tmp_path / "elsewhere")
    (tmp_path / "nested" / "table").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / "back").symlink_to(tmp_path / "nested")  # and no end without a check
    flat = chain(tmp_path / "1", tmp_path / "flat")
    nested = chain(tmp_path / "2", tmp_path / "nested", "--up", "z")
    assert flat[0] == nested[0] == list(NAMES)
    read = [open_dataset(tmp_path / n / "data").load("table", [0]).name for n in "12"]
    assert read == ["table", "table"]
    for key in ("psnr", "mask_iou"):  # the same images, so the same bits
        assert nested[1]["mean"][key] == flat[1]["mean"][key]
        retrieval, other = (r["baselines"]["retrieval"][key] for r in (nested[1], flat[1]))
        assert retrieval == other
    for one, other in zip(nested[2], flat[2]):
        assert one["axes"]["gt"] == {"dataset": 1}
        for key in ("chamfer", "iou"):
            assert one["mean"][key] == pytest.approx(other["mean"][key], rel=1e-6)
    model, retrieval = nested[2]
    assert model["mean"]["chamfer"] != retrieval["mean"]["chamfer"]


def write_seen(data, folder):
    """Write the depth maps as clouds in the input camera's world, on the true surface."""
    folder.mkdir()
    dataset = open_dataset(data)
    for uid in dataset.uids:
        views = dataset.load(uid)
        viewmats, points = views.cameras.viewmats.double(), []
        places = torch.arange(views.cameras.width) + 0.5
        rows, columns = torch.meshgrid(places, places, indexing="ij")
        pixels = torch.stack([columns, rows, torch.ones_like(rows)], -1).double()
        for depth, viewmat, K in zip(views.depths, viewmats, views.cameras.Ks.double()):
            local = depth[..., None] * (pixels @ torch.linalg.inv(K).T)
            points.append((local[depth > 0] - viewmat[:3, 3]) @ viewmat[:3, :3])
        _, scale = relative_to_reference(viewmats, viewmats[0], 1.5)
        cloud = scale * torch.cat(points) @ viewmats[0, :3, :3].T
        trimesh.PointCloud(cloud.numpy()).export(folder / f"{uid.replace('/', '-')}.ply")


def geometry(out, pred, gt, data, *options):
    words = ("--frame", "reference", "--data", data, "--points", 20_000, *options)
    return evaluated("eval-geometry", out, pred, gt, *words)


ON_ITS_SIDE = [[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]
TAKEN = 0.01  # of points on a surface from 20,000 others on it


@pytest.fixture(params=["up", "rotation", "stretch"])
def rendered(request, tmp_path):
    """Meshes, and depth views of them that their suffix alone does not explain."""
    meshes, options = tmp_path / "meshes", ["--depth"]
    for seed, name in enumerate(NAMES[:2]):
        write(meshes / f"{name}.obj", shape(seed))
    if request.param == "up":
        options += ["--up", "z"]
    if request.param == "stretch":
        options += ["--stretch", 3]
    if request.param == "rotation":
        objects = [{"model": f"{n}.obj", "uid": n, "rotation": ON_ITS_SIDE} for n in NAMES[:2]]
        (meshes / "catalogue.json").write_text(json.dumps({"objects": objects}))
    render(meshes, tmp_path / "data", *options)
    write_seen(tmp_path / "data", tmp_path / "seen")
    return tmp_path


def test_truths_and_retrieved_meshes_lie_where_the_views_show_them(rendered):
    meshes, data = rendered / "meshes", rendered / "data"
    (meshes / "catalogue.json").unlink(missing_ok=True)  # the set has it
    code, report = geometry(rendered / "out", rendered / "seen", meshes, data)
    assert code == 0 and report["mean"]["accuracy"] < TAKEN and report["num_ok"] == 2
    assert report["axes"]["gt"] == {"dataset": 2} and report["warnings"] == []
    placed = TrainingMeshes(meshes, open_dataset(data))
    for name in NAMES[:2]:
        placed.save(rendered / "placed" / f"{name}.ply", NearestView(name, 0, 0.0), 1.5)
    code, report = geometry(rendered / "out", rendered / "placed", meshes, data)
    assert code == 0 and report["mean"]["chamfer"] < 1e-5  # float32 in the .ply


def test_what_contradicts_a_set_is_told(tmp_path, capsys):
    """A requested axis, and meshes that were not rendered, which are not placed either."""
    write(tmp_path / "meshes" / "lamp.obj", shape(1))
    render(tmp_path / "meshes", tmp_path / "data", "--depth", "--up", "z")
    data, seen = tmp_path / "data", tmp_path / "seen"
    write_seen(data, seen)
    out = tmp_path / "out"
    _, report = geometry(out, seen, tmp_path / "meshes", data, "--up", "z")
    assert report["mean"]["accuracy"] < TAKEN and report["warnings"] == []
    _, report = geometry(out, seen, tmp_path / "meshes", data, "--up", "y")
    assert report["mean"]["accuracy"] > 3 * TAKEN and report["axes"]["gt"] == {"opengl": 1}
    said = "1 of 1 ground truths: --up y contradicts DATA"
    assert report["warnings"][0].startswith(said) and f"warning: {said}" in capsys.readouterr().err
    write(tmp_path / "others" / "lamp.ply", shape(1).apply_scale(2))
    _, report = geometry(out, seen, tmp_path / "others", data)
    assert report["mean"]["accuracy"] < TAKEN and report["axes"]["gt"] == {"unknown": 1}
    (said,) = report["warnings"]
    assert said.startswith("1 of 1 ground truths: other bounding boxes than")
    _, report = geometry(out, seen, tmp_path / "others", data, "--up", "z")
    assert report["warnings"] == [] and report["axes"]["gt"] == {"z-up": 1}
    meshes = TrainingMeshes(tmp_path / "others", open_dataset(data))
    said = "lamp.ply: not the mesh that DATA's lamp was"
    refused(said, meshes.place, NearestView("lamp", 0, 0.0), 1.5)


def test_who_is_missing_of_a_set(tmp_path):
    """All missing objects of the predicted split, and none of others or unrendered ones."""
    for name in (*NAMES, "vase"):
        write(tmp_path / "meshes" / name / "model.glb", shape(0))
        write(tmp_path / "meshes" / name / "model.obj", shape(0))
    data, pred = tmp_path / "data", tmp_path / "pred"
    uids = render(tmp_path / "meshes", data)
    assert uids == [f"{n}{end}" for n in (*NAMES, "vase") for end in ("", "-obj")]
    write_split(data, train=["bench", "bench-obj"], test=["lamp", "lamp-obj", "table"])
    shutil.rmtree(data / "vase")
    pred.mkdir()
    for uid in ("lamp", "lamp-obj"):
        shutil.copy(tmp_path / "meshes" / "bench" / "model.obj", pred / f"{uid}.obj")
    known = open_objects(data)[1]
    pairs, failures = find_pairs(pred, tmp_path / "meshes", known=known)
    found = {pair.name: pair.gt.name for pair in pairs}
    assert found == {"lamp": "model.glb", "lamp-obj": "model.obj"}
    assert [(item["name"], item["reason"]) for item in failures] == [("table", "no prediction")]


def test_a_set_of_folders_in_folders(tmp_path):
    """Uids with slashes; predictions are found in such folders, or by name in a single one."""
    write(tmp_path / "meshes" / "a" / "b.obj", shape(0))
    render(tmp_path / "meshes", tmp_path / "flat", "--depth")
    shutil.move(tmp_path / "flat" / "a-b", tmp_path / "data" / "a" / "b")
    write_seen(tmp_path / "data", tmp_path / "1")
    (tmp_path / "2" / "a").mkdir(parents=True)
    shutil.copy(tmp_path / "1" / "a-b.ply", tmp_path / "2" / "a" / "b.ply")
    known = open_objects(tmp_path / "data")[1]
    for pred in (tmp_path / "1", tmp_path / "2"):
        pairs, failures = find_pairs(pred, tmp_path / "meshes", known=known)
        assert [pair.name for pair in pairs] == ["a/b"] and not failures
    assert [pair.name for pair in find_pairs(tmp_path / "1", tmp_path / "meshes")[0]] == ["a-b"]
