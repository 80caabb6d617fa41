"""Starter set: complete, small and attributed, and its views match its meshes."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from gamba_warp.data.dataset import SPLITS, open_dataset
from gamba_warp.images import load_rgba
from gamba_warp.versions import import_open3d

STARTER = Path(__file__).resolve().parents[2] / "starter"
HELD_OUT = sorted(path.stem for path in (STARTER / "meshes").glob("*.ply"))


def test_split_is_whole_and_small():
    parts = {name: open_dataset(STARTER / "data", name).uids for name in SPLITS}
    assert {name: len(uids) for name, uids in parts.items()} == {"train": 32, "val": 4, "test": 4}
    assert sorted(sum(parts.values(), [])) == open_dataset(STARTER / "data").uids
    assert HELD_OUT == sorted(parts["val"] + parts["test"])
    folders = [STARTER / name for name in ("data", "icons", "meshes")]
    assert sum(p.stat().st_size for f in folders for p in f.rglob("*") if p.is_file()) < 8e6


def test_every_object_is_there_and_attributed():
    data = open_dataset(STARTER / "data")
    assert data.check() == {}
    table = (STARTER / "ATTRIBUTION.md").read_text()
    for uid in data.uids:
        files = data.files(uid)
        assert len(files.images) == 24
        assert {"creator", "licence", "source"} <= set(files.attribution), uid
        row = next(line for line in table.splitlines() if f"`{uid}`" in line)
        assert files.attribution["creator"] in row and files.attribution["licence"] in row
    for icon in (STARTER / "icons").glob("*.png"):
        assert f"`{icon.stem}`" in table


def test_icons_are_cut_out_and_never_of_a_training_object():
    icons = sorted((STARTER / "icons").glob("*.png"))
    assert len(icons) >= 10
    train = open_dataset(STARTER / "data", "train").uids
    for path in icons:
        image = load_rgba(path)
        assert image.shape == (128, 128, 4) and image[..., 3].min() == 0, path.name
        assert path.stem not in train


def test_views_are_neither_empty_nor_cropped():
    data = open_dataset(STARTER / "data")
    for uid in data.uids:
        alpha = data.load(uid, views=[0, 7, 23]).images[..., 3]
        assert (alpha.mean((1, 2)) > 0.01).all(), uid
        for border in (alpha[:, 0], alpha[:, -1], alpha[:, :, 0], alpha[:, :, -1]):
            assert border.max() == 0, uid


@pytest.mark.parametrize("uid", HELD_OUT)
def test_geometry_lies_in_the_views_frame(uid):
    """Open3D's pinhole camera projects the stored mesh onto the stored images."""
    o3d = import_open3d()
    tensor = o3d.core.Tensor
    mesh = trimesh.load_mesh(STARTER / "meshes" / f"{uid}.ply")
    assert np.ptp(mesh.vertices, axis=0).max() == pytest.approx(1, abs=1e-5)
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    vertices, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)
    scene.add_triangles(tensor(vertices), tensor(faces))
    views = open_dataset(STARTER / "data").load(uid, views=[0, 11])
    for image, viewmat, K in zip(views.images, views.cameras.viewmats, views.cameras.Ks):
        camera = tensor(K.double().numpy()), tensor(viewmat.double().numpy())
        rays = scene.create_rays_pinhole(*camera, 128, 128)
        hit = np.isfinite(scene.cast_rays(rays, nthreads=1)["t_hit"].numpy())
        shown = image[..., 3].numpy() > 0.5
        # pixels on the outline may fall either way: up to 4 % of thin-legged objects
        assert (hit & shown).sum() / (hit | shown).sum() > 0.93, uid
