"""Google Scanned Objects in their published layout: the list, the poses, views and meshes."""

import json
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.images import bytes_of
from helpers.refusals import refused
from PIL import Image

from gamba_warp.cli import run
from gamba_warp.data import gso
from gamba_warp.data.dataset import open_dataset
from gamba_warp.formats.catalogue import find_meshes
from gamba_warp.formats.meshes import load_mesh
from gamba_warp.train.data.poses import nearest_distance, ring_poses
from gamba_warp.train.sources.gso import attribution_of, find_models, take_model

# What is read of the metadata of a model.
PBTXT = """name: "A_BOX"
authors {
  name: "Google"
  email: "scanned-objects@google.com"
}
legal {
  copyright: "Copyright 2020 Google LLC."
  license: "Creative Commons Attribution 4.0 International"
}
"""
MTL = "newmtl material_0\nmap_Kd texture.png\nKd 1.000000 1.000000 1.000000\n"
# A box of 2 x 1 x 4, z up. Its front (-y) and sides show the texture's left half, its back the
# right half.
_CORNERS = [(x, y, z) for x in (-1, 1) for y in (-0.5, 0.5) for z in (-2, 2)]
_FACES = """f 1/1 5/1 6/1 2/1
f 7/2 3/2 4/2 8/2
f 3/1 1/1 2/1 4/1
f 5/1 7/1 8/1 6/1
f 2/1 6/1 8/1 4/1
f 1/1 3/1 7/1 5/1
"""


def obj() -> str:
    """The mesh's text."""
    rows = ["mtllib model.mtl", "usemtl material_0"]
    rows += [f"v {x} {y} {z}" for x, y, z in _CORNERS]
    return "\n".join([*rows, "vt 0.25 0.5", "vt 0.75 0.5", _FACES])


def texture() -> bytes:
    """An image, red on the left and blue on the right."""
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[:, :4, 0] = pixels[:, 4:, 2] = 255
    return bytes_of(Image.fromarray(pixels))


def files() -> dict[str, bytes]:
    """Content of a model's folder."""
    return {
        "model.config": b"<model></model>",
        "model.sdf": b"<sdf></sdf>",
        "metadata.pbtxt": PBTXT.encode(),
        "meshes/model.obj": obj().encode(),
        "meshes/model.mtl": MTL.encode(),
        "materials/textures/texture.png": texture(),
        **{f"thumbnails/{number}.jpg": b"an image" for number in range(5)},
    }


def write_model(root: Path, name: str) -> Path:
    """Write a model's folder."""
    for place, data in files().items():
        path = root / name / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return root / name


def write_zip(root: Path, name: str, top: str = "") -> Path:
    """Write a model's zip like the Fuel server, or with a folder around everything."""
    root.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(root / f"{name}.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for place, data in files().items():
            archive.writestr(top + place, data)
    return root / f"{name}.zip"


FIRST, SECOND, THIRD = gso.NAMES[:3]


def test_the_list_is_sixty_names_that_never_change():
    assert len(gso.NAMES) == len(set(gso.NAMES)) == 60  # paper §4.1: totally 60 3D objects
    assert gso.SIZE == 512 and gso.NAMES == tuple(sorted(gso.NAMES))
    assert gso.protocol_of(())["list_sha256"].startswith("74699a2fdb369c23776bcc17a2d0a1c8")
    assert (FIRST, gso.NAMES[-1]) == ("11pro_SL_TRX_FG", "Whey_Protein_Vanilla")


def test_the_input_view_has_zero_elevation_and_azimuth():
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3)) * (1, 0.3, 0.7)
    poses = ring_poses(points, gso.FOV, gso.ELEVATIONS, gso.AZIMUTHS)
    assert len(poses) == gso.VIEWS == 24
    distances = np.linalg.norm(poses[:, :3, 3], axis=1)
    np.testing.assert_allclose(distances, distances[0])
    np.testing.assert_allclose(poses[0, :3, 3], [0, -distances[0], 0], atol=1e-12)
    np.testing.assert_allclose(poses[2, :3, 3], [distances[0], 0, 0], atol=1e-12)
    height = np.degrees(np.arcsin(poses[:, 2, 3] / distances))
    np.testing.assert_allclose(height, np.repeat([0, 20, 40], 8), atol=1e-9)
    assert distances[0] == pytest.approx(max(nearest_distance(points, p, gso.FOV) for p in poses))


def test_a_model_in_one_folder(tmp_path):
    write_model(tmp_path / "set", FIRST)
    write_zip(tmp_path / "set", SECOND)
    write_zip(tmp_path / "set" / "models", THIRD, top=f"{THIRD}/")
    found = find_models(tmp_path / "set")
    assert sorted(found) == [FIRST, SECOND, THIRD]
    for name, path in found.items():
        take_model(name, path, tmp_path / "out")
        names = {p.name for p in (tmp_path / "out" / name).iterdir()}
        assert names == {"model.obj", "model.mtl", "texture.png", "metadata.pbtxt"}
        mesh = load_mesh(tmp_path / "out" / name / "model.obj")
        assert not mesh.warnings  # the texture is found
        known = attribution_of(tmp_path / "out" / name)
        assert known["creator"] == "Google" and "4.0 International" in known["licence"]


def test_views_and_meshes_of_a_copy_of_the_set(tmp_path, capsys):
    write_model(tmp_path / "set", FIRST)
    write_zip(tmp_path / "set", SECOND)
    words = [str(tmp_path / "out"), "--source", str(tmp_path / "set")]
    words += ["--size", "24", "--workers", "1", "--limit", "3"]
    assert run("data gso", words) == 1
    said = capsys.readouterr()
    assert f"missing: {THIRD}: not in {tmp_path / 'set'}" in said.err
    assert "rendered 2 objects" in said.out and "1 of 3 missing" in said.out
    data = open_dataset(tmp_path / "out" / "views", "test")
    assert data.uids == [FIRST, SECOND] and data.num_views(0) == 24
    reason = "none of its 2 objects is in the train split"
    refused(reason, open_dataset, tmp_path / "out" / "views", "train")
    views = data.load(0)
    # The model's box is 2 x 1 x 4 with z up in its file: upright in the image, from the front.
    rows, columns = ((views.images[0, ..., 3].amax(axis) > 0.5).sum() for axis in (1, 0))
    assert rows > 1.5 * columns
    # Its front, at -y, has the texture's left half, red; its back the right half, blue.
    for number, channel in ((0, 0), (4, 2)):
        colour = views.images[number, 12, 12, :3]
        assert int(colour.argmax()) == channel, number
    place = -views.cameras.viewmats[0, :3, :3].T @ views.cameras.viewmats[0, :3, 3]
    torch.testing.assert_close(place / place.norm(), torch.tensor([0.0, -1, 0]), atol=1e-6, rtol=0)
    entries = json.loads((tmp_path / "out/meshes/catalogue.json").read_text())["objects"]
    assert [entry["uid"] for entry in entries] == [FIRST, SECOND]
    assert find_meshes(tmp_path / "out" / "meshes")[0].attribution["creator"] == "Google"
    # The same command continues: existing objects are neither read nor rendered again.
    shutil.rmtree(tmp_path / "set" / FIRST)
    write_model(tmp_path / "set", THIRD)
    assert run("data gso", words) == 0
    assert "rendered 1 object into" in capsys.readouterr().out
    assert run("data gso", [word if word != "24" else "16" for word in words]) == 2
    assert "rendered with other settings" in capsys.readouterr().err


def test_shards_part_the_list(tmp_path, capsys):
    write_model(tmp_path / "set", SECOND)
    words = [str(tmp_path / "out"), "--source", str(tmp_path / "set"), "--size", "16"]
    assert run("data gso", [*words, "--shard", "1/60", "--workers", "1"]) == 0
    assert open_dataset(tmp_path / "out" / "views", "test").uids == [SECOND]
    assert run("data gso", [*words, "--shard", "0/60"]) == 2  # this shard has no objects
    assert "contains none of the 1 models" in capsys.readouterr().err


@pytest.mark.parametrize(
    "change, reason",
    [
        (lambda path: path.write_bytes(b"no zip"), "cannot be unpacked"),
        (lambda path: zipfile.ZipFile(path, "w").writestr("meshes/model.mtl", ""), "is missing"),
        (lambda path: zipfile.ZipFile(path, "a").writestr("meshes/../../x.obj", "v"), "leaves"),
        (lambda path: zipfile.ZipFile(path, "a").writestr("meshes/texture.png", "v"), "two files"),
    ],
)
def test_bad_models_are_one_line_and_leave_nothing(tmp_path, capsys, change, reason):
    path = write_zip(tmp_path / "set", FIRST)
    change(path)
    words = [str(tmp_path / "out"), "--source", str(tmp_path / "set"), "--limit", "1"]
    assert run("data gso", words) == 1
    error = capsys.readouterr().err
    told = [line for line in error.splitlines() if line.startswith("missing: ")]
    assert len(told) == 1 and reason in told[0]
    assert [p.name for p in (tmp_path / "out" / "meshes").iterdir()] == ["catalogue.json"]


def test_all_names_hold_the_evaluation_and_are_told_by_the_last_part():
    assert len(gso.all_names()) == 1033 and {*gso.NAMES} < gso.all_names()
    uids = ["things/Dino_4", "Dino_4", "dino_4", "my_Dino_4", "Dino_4/x", "chair"]
    assert gso.scanned(uids) == ["Dino_4", "things/Dino_4"]
