"""Untrusted datasets: names that leave the folder, invalid numbers, special files."""

import json
import os
import shutil

import numpy as np
import pytest
import torch
from helpers.refusals import refused
from helpers.views import to_opengl
from PIL import Image

from gamba_warp.cameras import orbit
from gamba_warp.data import dataset as module
from gamba_warp.data.dataset import open_dataset, split_of

SIZE = 8
POSE = to_opengl(orbit(torch.tensor([30.0]), 15.0, 1.7)[0].double()).tolist()


def image(path, size=(SIZE, SIZE)):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((size[1], size[0], 4), 200, np.uint8)).save(path)


def transforms(folder, frame=None, **top):
    """An object of two views; ``frame`` changes the second, ``top`` the rest."""
    frames = [{"file_path": f"{i}.png", "transform_matrix": POSE} for i in range(2)]
    frames[1] |= frame or {}
    for i in range(2):
        image(folder / f"{i}.png")
    values = {"w": SIZE, "h": SIZE, "fl_x": 9.0, "frames": frames, **top}
    (folder / "transforms.json").write_text(json.dumps(values))


def gobjaverse(folder, **camera):
    view = folder / "campos_512_v4" / "00000"
    image(view / "00000.png")
    axes = {key: [row[n] for row in POSE[:3]] for n, key in enumerate(("x", "y", "z", "origin"))}
    (view / "00000.json").write_text(json.dumps({**axes, **camera}))


def openlrm(folder, intrinsics=((9, 9), (4, 4), (SIZE, SIZE)), pose=POSE[:3]):
    image(folder / "rgba" / "000.png")
    (folder / "pose").mkdir()
    np.save(folder / "pose" / "000.npy", np.array(pose))
    np.save(folder / "intrinsics.npy", np.array(intrinsics, float))


def reason(folder):
    """Message of the error on loading the object; ``check`` never fails."""
    data = open_dataset(folder.parent)
    data.check()
    message = refused(None, data.load, folder.name)
    assert str(folder) in message and len(message) < 500
    return message


@pytest.mark.parametrize("key", ["file_path", "depth_file_path"])
@pytest.mark.parametrize(
    "name",
    ["../secret.png", "/etc/passwd.png", "a\0.png", "a" * 300, "..\\secret.png", "link.png", 7],
)
def test_names_of_images_stay_inside(tmp_path, key, name):
    image(tmp_path / "secret.png")
    transforms(tmp_path / "x", {key: name})
    (tmp_path / "x" / "link.png").symlink_to(tmp_path / "secret.png")
    assert "frame 1" in reason(tmp_path / "x")


def test_links_of_the_other_layouts_stay_inside(tmp_path):
    image(tmp_path / "secret.png")
    for write, name in ((gobjaverse, "campos_512_v4/00000/00000.png"), (openlrm, "rgba/000.png")):
        folder = tmp_path / write.__name__ / "x"
        write(folder)
        (folder / name).unlink()
        (folder / name).symlink_to(tmp_path / "secret.png")
        assert "leaves" in reason(folder)


@pytest.mark.parametrize(
    "values, message",
    [
        ({"w": 0}, "w is 0"),
        ({"h": 8.5}, "h is 8.5"),
        ({"fl_x": 1e-9}, "focal lengths of"),
        ({"fl_x": 10**400}, "fl_x is 1000"),
        ({"fl_y": -1}, "must be positive"),
        ({"cx": 1e6}, "principal point"),
        ({"depth_unit": 0}, "depth_unit is 0"),
        ({"k4": 0.1}, "k4 = 0.1: lens distortion"),
        ({"distortion_params": [0, 0.1]}, "distortion_params = [0, 0.1]: lens distortion"),
        ({"is_fisheye": True}, "is_fisheye = True"),
        ({"ftheta_p0": 0.1}, "ftheta_p0"),
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model is 'EQUIRECTANGULAR'; only pinhole"),
        ({"frame": {"camera_model": "OPENCV_FISHEYE"}}, "frame 1: camera_model"),
        ({"frame": {"mask_path": "1.png"}}, "1 of 2 frames have a mask"),
        ({"applied_transform": [[1, 0], [0, 1]]}, "applied_transform has shape (2, 2)"),
        ({"applied_transform": [[0] * 4] * 3}, "not invertible"),
        ({"applied_transform": np.eye(3, 4).tolist(), "applied_scale": 0}, "not invertible"),
        ({"frames": {"0": {}}}, "no frames"),
        ({"frames": [{}] * 10_001}, "10001 views, at most 10000"),
        ({"frame": {"file_path": "0.png"}}, "two frames name the image 0.png"),
        ({"frame": {"transform_matrix": [[1, 2], [3]]}}, "not a matrix of numbers"),
        ({"frame": {"transform_matrix": [[10**30] * 4] * 4}}, "not finite, or over"),
        ({"frame": {"transform_matrix": np.eye(4).tolist()}}, "the camera is 0 from"),
        ({"frame": {"camera_angle_x": 4, "fl_x": None}}, "fl_x is None"),
        ({"frame": {"transform_matrix": np.diag([-1.0, 1, 1, 1]).tolist()}}, "is not a rotation"),
        ({"frame": {"transform_matrix": [*POSE[:3], [0, 0, 0.5, 1]]}}, "last row is not 0 0 0 1"),
        ({"applied_transform": [*np.eye(3, 4).tolist(), [0, 0, 0, 2]]}, "is not affine"),
    ],
    ids=range(27),
)
def test_numbers_without_sense_are_one_line(tmp_path, values, message):
    transforms(tmp_path / "x", **values)
    assert message in reason(tmp_path / "x")


@pytest.mark.parametrize("angle", [0, -1, 3.1416, 200, 1e-9])
def test_fields_of_view(tmp_path, angle):
    transforms(tmp_path / "a" / "x", camera_angle_x=angle)
    values = json.loads((tmp_path / "a" / "x" / "transforms.json").read_text())
    del values["fl_x"]
    (tmp_path / "a" / "x" / "transforms.json").write_text(json.dumps(values))
    gobjaverse(tmp_path / "b" / "x", x_fov=angle)
    gobjaverse(tmp_path / "c" / "x", x_fov=0.8, y_fov=angle)
    for name in "abc":
        message = reason(tmp_path / name / "x")
        assert "field of view" in message or "focal lengths" in message


def test_gobjaverse_and_openlrm(tmp_path):
    bad = {"x": 3}, {"x": ["a", 0, 0]}, {"origin": [0, 0, 0]}, {"x_fov": "1"}, {"z": [[1], 2, 3]}
    for number, camera in enumerate(bad):
        gobjaverse(tmp_path / f"g{number}" / "x", **camera)
        assert "00000.json" in reason(tmp_path / f"g{number}" / "x")
    wide, nowhere = ((9, 9), (4, 4), (10**9, 8)), ((9, 9), (4e6, 4), (8, 8))
    for number, values in enumerate((wide, nowhere, ((0, 9), (4, 4), (8, 8)))):
        openlrm(tmp_path / f"o{number}" / "x", values)
        assert "intrinsics.npy" in reason(tmp_path / f"o{number}" / "x")
    openlrm(tmp_path / "p" / "x", pose=[[1e200] * 4] * 3)
    assert "000.npy" in reason(tmp_path / "p" / "x")
    (tmp_path / "p" / "x" / "pose" / "000.npy").unlink()
    assert "000.npy: cannot be read" in reason(tmp_path / "p" / "x")


def test_files_that_are_folders_and_folders_that_are_files(tmp_path):
    (tmp_path / "a" / "x").mkdir(parents=True)
    (tmp_path / "a" / "x" / "campos_512_v4").write_text("")
    for name, mark in (("b", "transforms.json"), ("c", "intrinsics.npy")):
        (tmp_path / name / "x" / mark).mkdir(parents=True)
    gobjaverse(tmp_path / "d" / "x")
    shutil.rmtree(tmp_path / "d" / "x" / "campos_512_v4" / "00000")
    os.mkfifo(tmp_path / "d" / "x" / "campos_512_v4" / "00000")
    transforms(tmp_path / "e" / "x")
    (tmp_path / "e" / "x" / "0.png").unlink()
    os.mkfifo(tmp_path / "e" / "x" / "0.png")
    for name in "abcde":
        reason(tmp_path / name / "x")
    deep = tmp_path / "deep"
    folder = deep.joinpath(*("d" * 70))
    folder.mkdir(parents=True)
    refused("nested deeper", open_dataset, deep)


@pytest.mark.parametrize(
    "content, message",
    [
        ("[]", "split.json"),
        ("{", "not valid JSON"),
        ('{"version": 7}', "split.json: version 7"),
        ('{"version": 1, "train": ["x"], "test": ["x"]}', "in both train and test"),
        ('{"version": "1"}', "version"),
        ('{"version": 1, "train": "x"}', "train"),
        ('{"version": 1, "train": [["x"]]}', "train"),
        ("[" * 100_000, "split.json"),
    ],
)
def test_bad_splits(tmp_path, content, message):
    transforms(tmp_path / "x")
    (tmp_path / "split.json").write_text(content)
    refused(message, open_dataset, tmp_path, "train")


def test_a_split_may_name_more_than_is_there(tmp_path):
    transforms(tmp_path / "x")
    for version in (1, 2):  # both are read and reported
        split = {"version": version, "train": ["x", "gone"], "val": [3]}
        (tmp_path / "split.json").write_text(json.dumps(split))
        found = open_dataset(tmp_path, "train")
        assert found.uids == ["x"] and found.split_version == version
    assert split_of("\udcff\ud800") in ("train", "val", "test")


def test_depth_is_finite_and_not_negative(tmp_path):
    frames = [{"file_path": f"{i}.png", "transform_matrix": POSE} for i in range(2)]
    for i, frame in enumerate(frames):
        frame["depth_file_path"] = f"d{i}.tiff"
    for value in (np.nan, np.inf, -1.0):
        transforms(tmp_path / "x", frames=frames)
        for i, depth in enumerate((1.0, value)):
            image = Image.fromarray(np.full((SIZE, SIZE), depth, np.float32))
            image.save(tmp_path / "x" / f"d{i}.tiff")
        assert "d1.tiff: a depth is negative or not finite" in reason(tmp_path / "x")


def test_images_that_would_fill_the_memory(tmp_path, monkeypatch):
    transforms(tmp_path / "x")
    frames = [{"file_path": "wide.png", "transform_matrix": POSE}]
    values = {"camera_angle_x": 1.0, "camera_angle_y": 1.0, "frames": frames}
    (tmp_path / "x" / "transforms.json").write_text(json.dumps(values))
    image(tmp_path / "x" / "wide.png", (20_000, 1))
    data = open_dataset(tmp_path)
    assert data.load("x").images.shape == (1, 1, 20_000, 4)
    refused("wide.png: at height 128: 2560000x128 is over", data.load, "x", size=128)
    monkeypatch.setattr(module, "MAX_LOADED", 19_999)
    refused("x: 1 views of 20000x1 are over", data.load, "x")
