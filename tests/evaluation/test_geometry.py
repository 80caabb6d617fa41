import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from helpers.gaussians import rotations
from helpers.meshes import cube
from helpers.refusals import refused
from helpers.views import cloud_of, evaluated
from PIL import Image

from gamba_warp import cli
from gamba_warp.cameras import fibonacci_sphere
from gamba_warp.eval.shapes.load import load_gt, load_shape
from gamba_warp.eval.shapes.metrics import compare
from gamba_warp.eval.shapes.protocol import PRESETS
from gamba_warp.eval.shapes.shape import Mesh, Points, Similarity, nearest, sample
from gamba_warp.eval.shapes.sheet import SIDE, image_of
from gamba_warp.gaussians import Gaussians
from gamba_warp.surfaces.density import opacity_volume


def join(*meshes):
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    faces = [mesh.faces + offset for mesh, offset in zip(meshes, offsets)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def protocol(**options):
    name = options.pop("name", "default")
    return replace(PRESETS[name], num_points=20000, **options)


def shell(radius, count=4000, sigma=0.012):
    return cloud_of(radius * fibonacci_sphere(count), sigma, 0.9, torch.rand(count, 3))


@pytest.mark.parametrize("name", PRESETS)
def test_a_shape_and_itself(name):
    """The identity: distance 0, F-scores 1 and Volume IoU 1 under every protocol."""
    shape = join(cube((0.25, 0, 0), 0.5), cube((-0.3, 0.1, 0.05), 0.35))
    for align in (PRESETS[name].align, ()):
        got = compare(shape, shape, protocol(name=name, align=align))
        assert got["iou"] == (None if PRESETS[name].occupancy == "none" else 1)
        # The search has turned and turned back, by rounding; without it there is no rounding.
        assert got["chamfer"] <= (2e-5 if align else 0) and set(got["fscore"].values()) == {1.0}


@pytest.mark.parametrize("count, limit", [(1, 0.0051), (40, 0.05)])
def test_density_is_the_union_of_the_gaussians(count, limit):
    """Boxes of every size are visited once; what is under 0.005 is cut."""
    generator = torch.Generator().manual_seed(0)
    made = Gaussians(
        means=torch.rand(count, 3, generator=generator) - 0.5,
        quats=torch.randn(count, 4, generator=generator),
        scales=0.005 + 0.1 * torch.rand(count, 3, generator=generator) ** 2,
        opacities=0.05 + 0.9 * torch.rand(count, generator=generator),
        colors=torch.zeros(count, 3),
    )
    volume, origin = opacity_volume(made, 16)
    axes = [torch.from_numpy(origin[k] + np.arange(volume.shape[k]) / 16) for k in range(3)]
    at = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    clear = torch.ones(at.shape[:3], dtype=torch.float64)
    for k, turn in enumerate(rotations(made.quats.double())):
        squared = ((at - made.means[k]) @ turn / made.scales[k]).square().sum(-1)
        alpha = made.opacities[k] * torch.exp(-0.5 * squared)
        clear *= 1 - torch.where(alpha < 0.005, 0.0, alpha)
    error = np.abs(volume - (1 - clear.numpy()))
    assert error.max() < limit and error.mean() < 2e-3


def test_centers_are_drawn_by_opacity():
    one = shell(0.4, count=2)
    one.opacities = torch.tensor([0.25, 0.75])
    points = sample(one, 4000, 0).positions
    fraction = np.mean(np.abs(points - one.means[1].numpy()).max(1) < 1e-6)
    assert abs(fraction - 0.75) < 0.03  # four standard deviations of 4000 draws


def test_nothing_visible():
    faint = shell(0.4, count=50)
    faint.opacities = torch.zeros(50)
    refused("Gaussian", sample, faint, 10, 0)


def test_points_are_repeatable_and_area_uniform():
    a, b, c = (sample(cube(), 30000, seed) for seed in (3, 3, 4))
    assert np.array_equal(a.positions, b.positions)
    assert not np.array_equal(a.positions, c.positions)
    top = np.mean(a.positions[:, 2] > 0.4999999)
    assert abs(top - 1 / 6) < 0.009  # four standard deviations
    assert np.abs(np.abs(a.normals).max(1) - 1).max() < 1e-6


@pytest.mark.parametrize(
    "size, far", [(1.0, 0.0), (1e-42, 0.0), (1e17, 0.0), (0.0, 0.0), (1.0, 300.0)]
)
def test_nearest_points_are_those_of_every_pair(size, far):
    """Of sets of any size and place, with repeated points, and in the order of the queries."""
    drawn = np.random.default_rng(3)
    queries, points = (size * drawn.uniform(-1, 1, (n, 3)) for n in (211, 97))
    queries[5:9], points[20:30] = queries[4], points[19]
    queries[:, 1] += far
    queries, points = Points(queries), Points(points)
    for one, two in ((queries, points), (points, queries), (queries, queries)):
        distances, index = nearest(one, two)
        here, there = (shape.positions.astype(np.float32) for shape in (one, two))
        every = np.linalg.norm(here[:, None].astype(float) - there, axis=2)
        assert distances == pytest.approx(every.min(1), rel=1e-6, abs=1e-20)
        chosen = every[np.arange(len(index)), index]
        assert chosen == pytest.approx(every.min(1), rel=1e-6, abs=1e-20)


def test_similarity_moves_all_kinds_alike():
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    transform = Similarity(turn, np.array([0.1, 0.2, 0.3]), 2.0)
    one = shell(0.4, count=9)
    moved = transform.apply(one)
    want = transform.points(one.means.double().numpy())
    assert np.abs(moved.means.numpy() - want).max() < 1e-6
    assert torch.allclose(moved.scales, 2 * one.scales)
    mesh = transform.apply(cube())
    assert np.allclose(mesh.vertices, 2 * cube().vertices @ turn.T + [0.1, 0.2, 0.3])


def test_truth_is_normalised_and_turned(tmp_path):
    trimesh.creation.box((2.0, 4.0, 1.0)).apply_translation([5, 5, 5]).export(tmp_path / "a.obj")
    gt = load_gt(tmp_path / "a.obj", protocol())  # y-up by its suffix
    mesh = gt.shape
    assert np.allclose(np.ptp(mesh.vertices, axis=0), [0.5, 0.25, 1.0])
    again = gt.transform.apply(load_shape(tmp_path / "a.obj")[0])
    assert np.allclose(np.unique(again.vertices, axis=0), mesh.vertices)


def run_geometry(tmp_path, *options):
    words = (tmp_path / "pred", tmp_path / "gt", "--points", 2000, *options)
    return evaluated("eval-geometry", tmp_path / "out", *words)


def export(path, source):
    path.parent.mkdir(parents=True, exist_ok=True)
    source.export(path)


@pytest.mark.parametrize("name", ["default", "sf3d", "syncdreamer"])
def test_what_a_protocol_needs_and_a_file_has_not(tmp_path, name):
    """Missing volume, normals, extent or alignment: reported, and the others are evaluated."""
    box = trimesh.creation.box((1.0, 0.6, 0.8))
    for uid in ("cloud", "good", "line", "open", "point", "sheet", "speck"):
        export(tmp_path / "gt" / f"{uid}.ply", box)
    for uid, shape in {
        "cloud": trimesh.PointCloud(box.sample(500)),
        "good": box,
        "line": trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], process=False),
        "open": trimesh.Trimesh(box.vertices, box.faces[:-1], process=False),
        "point": trimesh.PointCloud(np.zeros((1, 3))),
        "sheet": trimesh.Trimesh(box.vertices, box.faces[:1], process=False),
        "speck": trimesh.Trimesh(np.zeros((3, 3)), [[0, 1, 2]], process=False),
    }.items():
        export(tmp_path / "pred" / f"{uid}.ply", shape)
    code, report = run_geometry(tmp_path, "--protocol", name)
    reasons = {item["name"]: item["reason"] for item in report["failures"]}
    done = {record["name"]: record for record in report["objects"] if record["status"] == "ok"}
    # a single point has a place, but nothing that a search or ICP could align
    lone = {"point"} if name == "sf3d" else set()
    assert code == 1 and reasons.keys() == {"line", "speck", *lone}
    said = {"line": "no area", "point": "align", "speck": "coincide"}
    assert all(said[uid] in reason for uid, reason in reasons.items())
    assert done["good"]["chamfer"] == 0 and done["cloud"]["normal_consistency"] is None
    assert done["cloud"]["iou"] is None and done["cloud"]["iou_reason"]
    if name == "default":
        assert done["open"]["iou"] > 0.9 and done["open"]["pred_flags"] == ["open"]
        assert done["sheet"]["iou"] == 0


@pytest.mark.parametrize(
    "case, options, said",
    [
        ("missing", [], "pred"),
        ("empty", [], "pred"),
        ("mixed", [], "two files"),
        ("data", ["--frame", "reference"], "--data"),
    ],
)
def test_what_cannot_start(tmp_path, case, options, said, capsys):
    export(tmp_path / "gt" / "a.obj", trimesh.creation.box((1.0, 1, 1)))
    if case == "mixed":
        shutil.copy(tmp_path / "gt" / "a.obj", tmp_path / "pred")
    elif case != "missing":
        (tmp_path / "pred").mkdir()
    code, report = run_geometry(tmp_path, *options)
    assert code == 2 and report is None
    assert (str(tmp_path / said) if said == "pred" else said) in capsys.readouterr().err


@pytest.fixture
def folders(tmp_path):
    """A box that is right, and one that is half as high."""
    for name, height in (("good", 1.0), ("bad", 0.5)):
        for side, extents in (("pred", (0.6, 0.8, height)), ("gt", (0.6, 0.8, 1.0))):
            (tmp_path / side).mkdir(exist_ok=True)
            trimesh.creation.box(extents).export(tmp_path / side / f"{name}.ply")
    return tmp_path / "pred", tmp_path / "gt"


def test_the_worst_pair_comes_first(folders, tmp_path):
    options = "--set", "num_points=500", "iou_voxels=16", "--out", tmp_path / "out"
    assert cli.run("eval-geometry", [*map(str, (*folders, *options))]) == 0
    sheet = np.asarray(Image.open(tmp_path / "out" / "sheet.png"))
    assert sheet.shape[1] == 4 * SIDE
    box = trimesh.creation.box((0.6, 0.8, 1.0))
    want = image_of(Mesh(box.vertices, box.faces))
    first, second = (sheet[top + 40 : top + 40 + SIDE] for top in (0, SIDE + 26))
    for row, same in ((first, False), (second, True)):
        assert np.array_equal(row[:, 2 * SIDE :], want)  # the ground truth
        assert np.array_equal(row[:, : 2 * SIDE], want) == same
    rest = *options[:-1], tmp_path / "no", "--no-sheet"
    assert cli.run("eval-geometry", [*map(str, (*folders, *rest))]) == 0
    assert not (tmp_path / "no" / "sheet.png").exists()


def test_points_are_drawn_where_they_are():
    image = image_of(Points(np.array([[0.0, 0, 0], [0, 0, 0.4]])))
    for view in np.hsplit(image, 2):
        row, column = np.nonzero(view < 255)
        assert len(row) == 2 and abs(column - SIDE / 2).max() < 1  # upright
        assert row.min() < 0.35 * SIDE and abs(row.max() - SIDE / 2) <= 1
