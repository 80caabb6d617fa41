"""Rendering of meshes to views: poses, pixels, light, resumed and sharded runs, and failures."""

import json
import os
import shutil
from pathlib import PurePath

import numpy as np
import pytest
import torch
import trimesh
from helpers.children import murderous_object
from helpers.meshes import MTL, QUAD, render_views, write_quad
from helpers.refusals import refused
from PIL import Image

from gamba_warp.cameras import from_opengl, intrinsics
from gamba_warp.cli import run
from gamba_warp.color_spaces import to_linear
from gamba_warp.data import gso
from gamba_warp.data.dataset import open_dataset, split_of
from gamba_warp.files import PART
from gamba_warp.formats.catalogue import find_meshes, object_names
from gamba_warp.formats.meshes import load_mesh
from gamba_warp.train.data import render
from gamba_warp.train.data.poses import look_at_origin, nearest_distance, sample_poses
from gamba_warp.train.data.raycast import Lights, RayCaster

FOV = 49.1
# even light from all directions: the image shows the surface's own colour
FLAT = Lights(np.full(3, 1.0), np.zeros((1, 3)), np.zeros((1, 3)), head=0.0)


def write_box(path, extents=(1.0, 0.6, 0.8), face_colors=None):
    box = trimesh.creation.box(extents=extents)
    if face_colors is not None:
        box.visual.face_colors = face_colors
    path.parent.mkdir(parents=True, exist_ok=True)
    box.export(path)
    return path


def caster(path, up="z", lights=FLAT):
    return RayCaster(load_mesh(path).normalized(up)[0], lights)


def test_poses_look_at_the_origin_from_where_they_say():
    places = ((0, 0, [0, -2, 0]), (90, 0, [2, 0, 0]), (0, 30, [0, -np.sqrt(3), 1]))
    for azimuth, elevation, place in places:
        pose = look_at_origin(azimuth, elevation, 2.0)
        np.testing.assert_allclose(pose[:3, 3], place, atol=1e-12)
        viewmat = from_opengl(torch.from_numpy(pose))
        torch.testing.assert_close(viewmat[:3, 3], torch.tensor([0, 0, 2.0]).double())
        assert viewmat[1, 2] < 0  # the world's z is up: minus the camera's y
        assert torch.linalg.det(viewmat).item() == pytest.approx(1)


def test_nothing_is_cropped_and_all_fits_the_models_cube():
    rng = np.random.default_rng(0)
    for shape in ((1, 1, 1), (1, 0.02, 0.5), (0.1, 0.1, 1)):
        points = (rng.integers(0, 2, (20, 3)) - 0.5) * shape
        poses = sample_poses(points, 12, FOV, rng)
        viewmats = from_opengl(torch.from_numpy(poses)).numpy()
        K = intrinsics(100, 100, FOV).double().numpy()
        for viewmat in viewmats:
            local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
            pixels = local @ K.T
            pixels = pixels[:, :2] / pixels[:, 2:]
            assert pixels.min() > 1 and pixels.max() < 99
            scaled = 1.5 / viewmat[2, 3] * points @ viewmat[:3, :3].T
            assert np.abs(scaled).max() <= 0.5 + 1e-9
    tall = np.array([[0, 0, -0.5], [0, 0, 0.5]])
    assert nearest_distance(tall, look_at_origin(0, 0, 1.0), FOV) == pytest.approx(1.5)


def test_view_zero_is_from_the_front():
    for seed in range(20):
        pose = sample_poses(np.ones((1, 3)), 1, FOV, np.random.default_rng(seed))[0]
        x, y, z = pose[:3, 3] / np.linalg.norm(pose[:3, 3])
        assert y < -0.7 and 0 <= z <= np.sin(np.radians(20)) + 1e-9


def test_pixels_colours_and_depth_agree_with_the_cameras(tmp_path):
    colors = np.zeros((12, 4), np.uint8)
    colors[:, 3] = 255
    folder = tmp_path / "meshes"
    plain = load_mesh(write_box(folder / "box.ply")).normalized()[0]
    normals = trimesh.triangles.cross(plain.vertices[plain.faces])
    axis = np.abs(normals).argmax(1)
    colors[np.arange(12), axis] = 255  # faces across x red, y green, z blue
    write_box(folder / "box.ply", face_colors=colors)
    render_views(folder, tmp_path / "data", views=5, size=33, depth=True, workers=1)
    data = open_dataset(tmp_path / "data")
    assert data.uids == ["box"]
    got = data.load(0)
    half = torch.tensor([0.5, 0.3, 0.4])
    y, x = torch.meshgrid(torch.arange(33) + 0.5, torch.arange(33) + 0.5, indexing="ij")
    seen = set()
    cameras = got.cameras.viewmats, got.cameras.Ks
    for image, depth, viewmat, K in zip(got.images, got.depths, *cameras):
        hit = (depth > 0) & (image[..., 3] == 1)
        assert hit.sum() > 100
        assert ((depth > 0) == (image[..., 3] >= 0.5))[image[..., 3].sub(0.5).abs() > 0.4].all()
        local = torch.stack([x, y, torch.ones_like(x)], -1) @ torch.linalg.inv(K).T
        local = local * depth[..., None]
        world = (local - viewmat[:3, 3]) @ viewmat[:3, :3]
        across = world.abs() / half
        # on the surface, to half a step of the depth file at a grazing angle
        assert (across.max(-1).values[hit] - 1).abs().max() <= 1e-3
        # away from edges, where a pixel's nine rays may meet two faces
        inner = hit & (across.sort(-1).values[..., 1] < 0.9)
        assert (image[..., :3].argmax(-1) == across.argmax(-1))[inner].all()
        seen |= set(across.argmax(-1)[inner].tolist())
    assert seen == {0, 1, 2}


def test_texture_is_upright_and_not_mirrored(tmp_path):
    image, _ = caster(write_quad(tmp_path), "y").render(look_at_origin(0, 0, 1.5), 32, FOV)
    rows, columns = np.nonzero(image[..., 3] == 1)
    top, bottom, left, right = rows.min() + 2, rows.max() - 2, columns.min() + 2, columns.max() - 2
    # as in the texture's file: red, green / blue, yellow
    corners = image[[top, top, bottom, bottom], [left, right, left, right], :3]
    assert (corners > 0.5).tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]]


def test_cut_out_and_glass_let_rays_pass(tmp_path):
    back = "v -1 0 -1\nv 1 0 -1\nv 1 2 -1\nv -1 2 -1\nusemtl red\nf 5 6 7 8\n"
    red = "newmtl red\nKd 1 0 0\n"
    write_quad(tmp_path, obj=QUAD + back, mtl=MTL + red)
    holes = np.full((16, 16, 4), [0, 255, 0, 0], np.uint8)
    holes[:, :8, 3] = 255  # left half opaque green, right half a hole
    Image.fromarray(holes).save(tmp_path / "paint.png")
    pose = look_at_origin(0, 0, 2.0)
    image, depth = caster(tmp_path / "quad.obj", "y").render(pose, 32, FOV)
    np.testing.assert_array_equal(image[16, 12, :3] > 0.5, [0, 1, 0])
    np.testing.assert_array_equal(image[16, 20, :3] > 0.5, [1, 0, 0])
    # the square's front is at y = -0.25 of the cube, the red one half a unit behind
    assert depth[16, 12] == pytest.approx(1.75) and depth[16, 20] == pytest.approx(2.25)

    path = write_quad(tmp_path, mtl="newmtl paint\nKd 1 1 1\nd 0.25\n")
    image, depth = caster(path, "y").render(pose, 32, FOV)
    assert image[16, 16, 3] == pytest.approx(0.25, abs=1e-6) and depth[16, 16] == 0
    glass = "newmtl paint\nKd 1 1 1\nd 0.25\nnewmtl red\nKd 1 0 0\nd 0.5\n"
    write_quad(tmp_path, obj=QUAD + back, mtl=glass)
    image, depth = caster(tmp_path / "quad.obj", "y").render(pose, 32, FOV)
    assert image[16, 16, 3] == pytest.approx(1 - 0.75 * 0.5, abs=1e-6)
    # red gets 1/4 of white and 3/8 of red, green only the white; mixed in linear light
    mixed = to_linear(image[16, 16, :2])
    assert mixed[1] / mixed[0] == pytest.approx(0.25 / (0.25 + 0.375), abs=0.02)
    assert depth[16, 16] == pytest.approx(2.25)  # where half the light is blocked


def test_edges_are_smooth_and_keep_their_colour(tmp_path):
    path = write_quad(tmp_path, mtl="newmtl paint\nKd 0.8 0.4 0.2\n")
    image, _ = caster(path, "y").render(look_at_origin(20, 10, 1.6), 40, FOV)
    alpha = image[..., 3]
    edge = (alpha > 0) & (alpha < 1)
    assert edge.sum() > 40
    spread = image[alpha > 0][:, :3]
    np.testing.assert_allclose(spread, np.broadcast_to(spread.mean(0), spread.shape), atol=1e-3)
    assert (image[alpha == 0] == 0).all()


def test_light_is_two_sided(tmp_path):
    lights = Lights(np.zeros(3), np.array([[0, -1.0, 0]]), np.ones((1, 3)), head=0.0)
    path = write_quad(tmp_path, mtl="newmtl paint\nKd 1 1 1\n")
    pose = look_at_origin(0, 0, 1.5)
    front, _ = caster(path, "y", lights).render(pose, 16, FOV)
    path.write_text(QUAD.replace("1/1 2/2 3/3 4/4", "4/4 3/3 2/2 1/1"))
    back, _ = caster(path, "y", lights).render(pose, 16, FOV)
    assert front[8, 8, 0] > 0.9
    np.testing.assert_allclose(front, back)


@pytest.fixture
def meshes(tmp_path):
    folder = tmp_path / "meshes"
    for i, name in enumerate(["a", "b", "sub/c"]):
        write_box(folder / f"{name}.ply", extents=(1, 0.3 + 0.2 * i, 0.5))
    return folder


def contents(folder):
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in files}


def test_same_seed_same_files_and_shards_add_up(meshes, tmp_path):
    options = dict(views=2, size=16, workers=1)
    assert render_views(meshes, tmp_path / "one", views=2, size=16, workers=2) == 0
    for i in range(2):
        assert render_views(meshes, tmp_path / "two", shard=f"{i}/2", **options) == 0
    one = contents(tmp_path / "one")
    assert one == contents(tmp_path / "two")
    assert {n.split("/")[0] for n in one} == {"a", "b", "sub-c", "split.json"}
    render_views(meshes, tmp_path / "other", seed=1, **options)
    assert contents(tmp_path / "other")["a/000.webp"] != one["a/000.webp"]


def test_resume_renders_only_what_is_missing(meshes, tmp_path, capsys):
    out = tmp_path / "data"
    options = dict(views=2, size=16, workers=1)
    render_views(meshes, out, **options)
    before = contents(out)
    times = {name: (out / name / "000.webp").stat().st_mtime_ns for name in ("a", "sub-c")}
    shutil.rmtree(out / "b")
    part = out / f"{PART}abcd1234"  # left by a run that was killed two days ago
    part.mkdir()
    (part / "000.webp").write_bytes(b"half")
    for path in (part / "000.webp", part):
        os.utime(path, (path.stat().st_mtime - 2 * 86400,) * 2)
    assert len(open_dataset(out)) == 2
    assert render_views(meshes, out, **options) == 0
    assert "2 of 3 objects already in" in capsys.readouterr().out
    assert contents(out) == before
    for name, time in times.items():
        assert (out / name / "000.webp").stat().st_mtime_ns == time
    refused("rendered with other settings", render_views, meshes, out, views=3, size=16, workers=1)


def test_failures_are_listed_and_do_not_stop_the_rest(meshes, tmp_path, capsys):
    (meshes / "bad.obj").write_text("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (meshes / "points.obj").write_text("v 0 0 0\n")
    write_quad(meshes, mtl=None)
    out = tmp_path / "data"
    options = ["--out", str(out), "--views", "1", "--size", "16", "--workers", "1"]
    assert run("data render", [str(meshes), *options]) == 1
    captured = capsys.readouterr()
    assert "4 objects" in captured.out and "2 failed" in captured.out
    assert "warning: quad: quad.mtl: not found" in captured.out
    assert "failed: bad: " in captured.err and "not finite" in captured.err
    assert "failed: points: " in captured.err and "no faces" in captured.err
    assert open_dataset(out).uids == ["a", "b", "quad", "sub-c"]
    stored = json.loads((out / "quad" / "transforms.json").read_text())
    assert any("not found" in line for line in stored["warnings"])


def test_catalogue_names_and_groups(meshes, tmp_path):
    entry = {"uid": "box-1", "name": "A box", "group": "boxes", "model": "a.ply"}
    entry |= {"attribution": {"creator": "me"}, "rotation": [[0, 0, 1], [1, 0, 0], [0, 1, 0]]}
    twin = {**entry, "uid": "box-2", "model": "b.ply"}
    (meshes / "catalogue.json").write_text(json.dumps({"objects": [entry, twin]}))
    out = tmp_path / "data"
    render_views(meshes, out, views=1, size=16, workers=1, format="png")
    views = open_dataset(out).load("box-1")
    assert (views.name, views.attribution) == ("A box", {"creator": "me"})
    stored = json.loads((out / "box-1" / "transforms.json").read_text())
    np.testing.assert_allclose(np.array(stored["applied_transform"])[:, :3], entry["rotation"])
    parts = json.loads((out / "split.json").read_text())
    assert sum({"box-1", "box-2"} <= set(parts[name]) for name in ("train", "val", "test")) == 1
    # A catalogue with better groups needs no new images.
    better = {"objects": [{**entry, "group": "g5"}, {**twin, "group": "g3"}]}
    (meshes / "catalogue.json").write_text(json.dumps(better))
    render_views(meshes, out, views=1, size=16, workers=1, format="png")
    parts = json.loads((out / "split.json").read_text())
    assert parts["version"] == 2
    assert [split_of(group) for group in ("g5", "g3")] == ["test", "train"]
    assert "box-1" in parts["test"] and "box-2" in parts["train"]


def test_uids_of_paths(tmp_path):
    for name in ("chair/chair.ply", "chair.stl", "old chair (2).ply", ".hidden/x.ply"):
        write_box(tmp_path / name)
    assert [mesh.uid for mesh in find_meshes(tmp_path)] == ["chair", "chair-stl", "old_chair_2_"]
    entries = [{"uid": "same", "model": name} for name in ("chair/chair.ply", "chair.stl")]
    (tmp_path / "catalogue.json").write_text(json.dumps({"objects": entries}))
    refused("would both be named 'same'", find_meshes, tmp_path)
    entries = [{"uid": "x", "model": "chair.stl"}, {"uid": "y", "model": "./chair.stl"}]
    (tmp_path / "catalogue.json").write_text(json.dumps({"objects": entries}))
    refused("occurs twice", find_meshes, tmp_path)


def test_where_a_file_says_nothing_its_folder_gives_the_name(tmp_path):
    names = ["a/model.obj", "a/model.ply", "set/b/models/model_normalized.obj", "c/Scene.glb"]
    names += ["d/mesh.obj", "d/textured.obj", "e/e.stl", "f/g.off", "model.off"]
    for name in names:
        write_box(tmp_path / name)
    found = {mesh.uid: mesh.name for mesh in find_meshes(tmp_path)}
    told = {"a": "a", "a-ply": "a", "set-b": "b", "c": "c", "e": "e", "f-g": "g", "model": "model"}
    assert found == told | {"d-mesh": "mesh", "d-textured": "textured"}


def test_a_name_of_an_object_is_its_own_name():
    """Files saved by uid are found again, whatever the uid was made of."""
    paths = ["a/b/model", "old chair (2)", "Ä" * 120, "b" * 240, "b" * 239 + "c", "..", "x/x/x"]
    paths.append("__")
    names = object_names([PurePath(path) for path in paths])
    assert len(set(names)) == len(paths) and names[-1] == "__"
    assert max(len(name.encode()) for name in names) <= 120
    assert object_names([PurePath(name) for name in names]) == names
    scanned = [PurePath(name) for name in gso.NAMES]
    assert names[0] == "a-b" and object_names(scanned) == list(gso.NAMES)


def test_linked_folders_of_meshes_are_read_once(tmp_path):
    meshes, other = tmp_path / "meshes", tmp_path / "other"
    for path in (meshes / "a.ply", meshes / "z" / "b.ply", other / "deep" / "model.ply"):
        write_box(path)
    write_box(other / ".hidden" / "c.ply")
    (meshes / "c").symlink_to(other / "deep")
    (meshes / "again").symlink_to(meshes / "z")  # the name without a link stays
    (meshes / "z" / "up").symlink_to(meshes)
    (meshes / "above").symlink_to(tmp_path)
    (meshes / "loop").symlink_to(meshes / "loop")
    (other / "deep" / "loop").symlink_to(other / "deep")
    assert [mesh.uid for mesh in find_meshes(meshes)] == ["a", "c", "z-b"]
    (meshes / "more").symlink_to(other)
    assert [mesh.uid for mesh in find_meshes(meshes)] == ["a", "c", "z-b"]


def test_bad_options_and_folders(meshes, tmp_path):
    for shard in ("2/2", "x", "-1/2", "0/" + "9" * 5000):
        refused(f"--shard {shard[:6]}", render_views, meshes, tmp_path / "data", shard=shard)
    refused("--seed 1844", render_views, meshes, tmp_path / "data", seed=2**64)
    refused("no such folder", render_views, tmp_path / "nowhere", tmp_path / "data")
    (tmp_path / "empty").mkdir()
    refused("no mesh files", render_views, tmp_path / "empty", tmp_path / "data")
    (tmp_path / "file").write_text("")
    refused("cannot write into", render_views, meshes, tmp_path / "file")
    (meshes / "catalogue.json").write_text('{"objects": [{}]}')
    refused("catalogue.json", render_views, meshes, tmp_path / "data")


def test_limit(meshes, tmp_path, capsys):
    assert render_views(meshes, tmp_path / "data", views=1, size=16, limit=2, workers=1) == 0
    assert len(open_dataset(tmp_path / "data")) == 2
    without = "training does not validate; eval-views needs --split"
    assert f"\nthe val and test splits are empty; {without}\n" in capsys.readouterr().out
    words = [str(tmp_path / "data"), str(tmp_path / "pack"), "--size", "16"]
    assert run("data pack", words) == 0
    assert f"\nthe val and test splits are empty; {without}\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    "entry, reason",
    [
        ({"uid": "/../x"}, "relative"),
        ({"uid": "a/b"}, "plain file name"),
        ({"uid": "a" * 300}, "too long"),
        ({"uid": 3}, "uid"),
        ({"model": "../a.ply"}, "leaves"),
        ({"model": None}, "model"),
        ({"attribution": "me"}, "attribution"),
        ({"attribution": {"creator": ["me"]}}, "attribution"),
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 0]]}, "rotation"),
        ({"rotation": [[1e200, 0, 0], [0, 1, 0], [0, 0, 1]]}, "rotation"),
    ],
    ids=range(10),
)
def test_hostile_catalogues_are_one_line(tmp_path, entry, reason):
    """Name and numbers of a catalogue; nothing is rendered, and nothing is written outside."""
    folder = tmp_path / "in" / "meshes"
    write_box(folder / "a.ply")
    entries = [{"uid": "box", "model": "a.ply", **entry}]
    (folder / "catalogue.json").write_text(json.dumps({"objects": entries}))
    message = refused(None, render_views, folder, tmp_path / "out", views=1, size=16, workers=1)
    assert "catalogue.json: " in message and reason in message
    assert [p.name for p in tmp_path.iterdir()] == ["in"]


def test_a_damaged_object_in_the_dataset_stops_no_other(meshes, tmp_path, capsys):
    out, options = tmp_path / "data", dict(views=1, size=16, workers=1)
    render_views(meshes, out, **options)
    (out / "a" / "transforms.json").write_text("")
    shutil.rmtree(out / "b")
    assert render_views(meshes, out, **options) == 1
    captured = capsys.readouterr()
    assert "1 of 3 objects already in" in captured.out and "rendered 1 object into" in captured.out
    assert "failed: a: " in captured.err and "remove" in captured.err
    parts = json.loads((out / "split.json").read_text())
    assert sorted(sum((parts[name] for name in ("train", "val", "test")), [])) == ["b", "sub-c"]


@pytest.mark.parametrize("workers", [1, 2])
def test_one_that_kills_its_process_is_one_failure(meshes, tmp_path, monkeypatch, workers):
    monkeypatch.setattr(render, "_attempt", murderous_object)
    out = tmp_path / "data"
    found = find_meshes(meshes)
    settings = render.Settings(1, 16, 50.0, 0, False, "png", "auto")
    out.mkdir()
    _, failures = render.render_meshes(found, out, settings, workers)
    assert list(failures) == ["b"] and "its process died of signal 9 (SIGKILL)" in failures["b"]
    assert open_dataset(out).uids == ["a", "sub-c"]
    monkeypatch.undo()
    assert render.render_meshes(found[1:2], out, settings, workers)[1] == {}
    assert len(open_dataset(out)) == 3
