import json
import math

import numpy as np
import pytest
import torch
from helpers.gaussians import some
from helpers.refusals import refused

from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.render import render
from gamba_warp.trajectories.files import load_path, save_path
from gamba_warp.trajectories.paths import (
    SWING,
    Viewpoint,
    placed,
    spiral,
    to_unit,
    turntable,
    upright,
)

FLIP = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))


def rigid(count):
    """Random rotations with a place ``[count, 4, 4]`` float64."""
    out = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    turn = torch.linalg.qr(torch.randn(count, 3, 3, dtype=torch.float64)).Q
    out[:, :3, :3] = turn * torch.linalg.det(turn)[:, None, None]
    out[:, :3, 3] = torch.randn(count, 3, dtype=torch.float64) * 3
    return out


def seen_at(cameras, points):
    """Pixels ``[V, N, 2]`` and depths ``[V, N]`` of points ``[N, 3]``, by the formula."""
    at = points.double() @ cameras.viewmats[:, :3, :3].double().mT
    at = at + cameras.viewmats[:, None, :3, 3].double()
    pixels = at @ cameras.Ks.double().mT
    return pixels[..., :2] / pixels[..., 2:], at[..., 2]


def write(path, value):
    path.write_text(json.dumps(value), encoding="utf-8")
    return path


def test_a_turntable_begins_in_front_and_turns_once():
    cameras = turntable(5, Viewpoint(20.0, 2.5, 30.0), (70, 50))
    torch.testing.assert_close(cameras.viewmats, orbit(torch.arange(5) * 72.0, 20.0, 2.5))
    torch.testing.assert_close(cameras.Ks, intrinsics(70, 50, 30.0).expand(5, 3, 3))
    assert (cameras.width, cameras.height) == (70, 50)
    # The field of view is that of the shorter side, so a tall image shows a ball whole as well.
    tall = turntable(1, Viewpoint(0.0, 2.5, 30.0), (50, 70))
    focal = 25 / math.tan(math.radians(15))
    assert tall.Ks[0].diagonal().tolist() == pytest.approx([focal, focal, 1])


def test_a_spiral_rises_falls_and_closes():
    count = 32
    cameras = spiral(count, Viewpoint(10.0, 1.7))
    centers = -(cameras.viewmats[:, :3, :3].mT @ cameras.viewmats[:, :3, 3:])[..., 0]
    assert torch.allclose(centers.norm(dim=-1), torch.tensor(1.7), atol=1e-5)
    heights = torch.rad2deg(torch.asin(-centers[:, 1] / 1.7))  # up is -y
    assert float(heights[0]) == pytest.approx(10.0, abs=1e-3)
    assert float(heights.max()) == pytest.approx(10 + SWING, abs=1e-3)
    assert float(heights.min()) == pytest.approx(10 - SWING, abs=1e-3)
    steps = (centers.roll(-1, 0) - centers).norm(dim=-1)
    assert float(steps.max()) < 1.5 * float(steps.min())  # also from the last to the first
    assert len(spiral(3, Viewpoint(80.0)).viewmats) == 3  # beyond the pole it stays at the pole


def test_another_field_of_view_keeps_the_object_as_large():
    before, after = Viewpoint(), Viewpoint().changed(fov=20.0, elevation=12.0)
    assert after.elevation == 12.0 and after.fov == 20.0
    # The half height of the image at the object's centre.
    heights = [p.distance * math.tan(math.radians(p.fov / 2)) for p in (before, after)]
    assert heights == pytest.approx([1.5 * math.tan(math.radians(49.1 / 2))] * 2)
    assert Viewpoint().changed(fov=20.0, distance=3.0).distance == 3.0


def test_upright_puts_the_camera_where_it_stood():
    """The image of a camera at 35 degrees does not change."""
    gaussians = some(30, rotated=True)
    seen = orbit(torch.zeros(1), 0.0, 2.0)
    plain = render(gaussians, Cameras(seen, intrinsics(41, 41)[None], 41, 41)).rgb
    moved = gaussians.transformed(upright(35.0), torch.zeros(3))
    above = orbit(torch.zeros(1), 35.0, 2.0)
    again = render(moved, Cameras(above, intrinsics(41, 41)[None], 41, 41)).rgb
    assert float((plain - again).abs().max()) < 1e-4  # rounding of the rotated quaternions
    # A pole along the true up, as a camera of 35 degrees sees it, stands along -y.
    a = math.radians(35.0)
    pole = torch.tensor([[0.0, -math.cos(a), -math.sin(a)]])
    torch.testing.assert_close(pole @ upright(35.0).T, torch.tensor([[0.0, -1.0, 0.0]]))


def test_cameras_move_with_their_object():
    points, center, side = torch.randn(9, 3), torch.tensor([3.0, -20.0, 7.0]), 0.4
    cameras = turntable(3, Viewpoint(15.0))
    pixels, depths = seen_at(cameras, points)
    there = placed(cameras, center, side)
    pixels2, depths2 = seen_at(there, points.double() * side + center)
    assert torch.allclose(pixels2, pixels) and torch.allclose(depths2, depths * side)
    back = to_unit(there, center, side)
    assert torch.allclose(back.viewmats, cameras.viewmats, atol=1e-6)


def test_a_written_file_comes_back(tmp_path):
    cameras = Cameras(rigid(4), intrinsics(35, 21, 40.0).double().repeat(4, 1, 1), 35, 21)
    cameras.Ks[2, 0, 2] += 3.25
    save_path(tmp_path / "a.json", cameras, 12.5, [{"file_path": "0.png"}] * 4)
    path = load_path(tmp_path / "a.json")
    assert path.fps == 12.5 and (path.cameras.width, path.cameras.height) == (35, 21)
    torch.testing.assert_close(path.cameras.viewmats, cameras.viewmats, rtol=1e-12, atol=1e-12)
    assert torch.equal(path.cameras.Ks, cameras.Ks)


def test_two_forms_of_the_same_cameras(tmp_path):
    viewmats, width, height, fov = rigid(3), 64, 36, 50.0
    poses = torch.linalg.inv(viewmats)
    focal = 18 / math.tan(math.radians(25))
    opengl = poses @ FLIP
    nerfstudio = {"camera_type": "perspective", "render_width": width, "render_height": height}
    nerfstudio |= {"seconds": 2, "fps": 24, "keyframes": []}
    path = [{"camera_to_world": p.flatten().tolist(), "fov": fov, "aspect": 1.5} for p in opengl]
    nerfstudio["camera_path"] = path
    transforms = {"w": width, "h": height, "fl_x": focal}
    transforms["frames"] = [{"transform_matrix": pose.tolist()} for pose in opengl]
    forms = {"nerfstudio": nerfstudio, "transforms": transforms}
    points = torch.randn(7, 3)
    ours = Cameras(viewmats, intrinsics(width, height, fov).double().repeat(3, 1, 1), width, height)
    want, want_depths = seen_at(ours, points)
    for name, value in forms.items():
        path = load_path(write(tmp_path / f"{name}.json", value))
        pixels, depths = seen_at(path.cameras, points)
        assert torch.allclose(pixels, want, rtol=1e-5, atol=1e-3), name  # K is float32 above
        assert torch.allclose(depths, want_depths, atol=1e-9), name
        assert path.fps == (1.5 if name == "nerfstudio" else None)


def test_another_size_keeps_the_vertical_field_of_view(tmp_path):
    K = intrinsics(40, 20, 50.0).double()
    save_path(tmp_path / "a.json", Cameras(rigid(1), K[None], 40, 20))
    for given, size in (((80, None), (80, 40)), ((60, 60), (60, 60))):
        cameras = load_path(tmp_path / "a.json", given).cameras
        assert (cameras.width, cameras.height) == size
        want = intrinsics(*size, 50.0).double()
        torch.testing.assert_close(cameras.Ks[0], want, rtol=1e-6, atol=1e-5)


EYE = {"transform_matrix": np.eye(4).tolist()}
TWICE = {"transform_matrix": (2 * np.eye(4)).tolist()}
MIRROR = {"transform_matrix": np.diag([1.0, 1, -1, 1]).tolist()}
HEAD = {"w": 32, "h": 32, "fl_x": 9}
NERFSTUDIO = {"render_width": 9, "render_height": 9}
FLAT = {"camera_to_world": np.eye(4).ravel().tolist(), "fov": 50}
TORN = {"camera_to_world": [*np.eye(4).ravel()[:14], 1, 1], "fov": 50}
BAD = {
    "not a known camera file": {"a": 1},
    "camera file": 3,
    "no frames": {**HEAD, "frames": []},
    "no camera: needs w, h, fl_x": {"frames": [EYE]},
    "fps": {**HEAD, "fps": 0, "frames": [EYE]},
    "frame 1: the": {**HEAD, "frames": [EYE, TWICE]},
    "frame 0: the": {**HEAD, "frames": [MIRROR]},
    "frame 0: ": {**HEAD, "fl_x": 1e-3, "frames": [EYE]},
    "only perspective": {**NERFSTUDIO, "camera_type": "fisheye", "camera_path": [FLAT]},
    "frame 0: the pose's last row is not 0 0 0 1": {**NERFSTUDIO, "camera_path": [TORN]},
    "the pose has shape": {**HEAD, "k1": 0.5, "frames": [{"transform_matrix": [[1]]}]},
    "cx is in pixels, so w and h are needed": {"camera_angle_x": 1, "cx": 9, "frames": [EYE]},
    "cameras of different sizes": {
        "camera_angle_x": 1,
        "frames": [EYE | {"w": side, "h": 9} for side in (8, 9)],
    },
}


@pytest.mark.parametrize("words", BAD)
def test_bad_files_are_one_line(tmp_path, words):
    path = write(tmp_path / "cameras.json", BAD[words])
    text = refused(None, load_path, path)
    assert text.startswith(str(path)) and words in text
