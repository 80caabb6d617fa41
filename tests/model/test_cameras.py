"""Cameras: known answers, the bridge to OpenGL, and rays through the pixels."""

import math
from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch
from helpers.gaussians import some
from helpers.micro import write_dataset
from helpers.model import SMALLEST
from helpers.refusals import refused
from helpers.views import to_opengl
from torch.testing import assert_close

from gamba_warp import cameras as C
from gamba_warp.cameras import Cameras, intrinsics, orbit, reference_viewmat, view_angles
from gamba_warp.data.dataset import open_dataset
from gamba_warp.eval.views.compare import ViewsProtocol, load_gt
from gamba_warp.eval.views.options import ViewsOptions
from gamba_warp.eval.views.predictions import ModelPredictions, open_predictions
from gamba_warp.formats.ply import save_ply
from gamba_warp.gaussians import quat_multiply
from gamba_warp.model.checkpoint import save_model
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.posing import posed_input, reference_cameras, relative_cameras
from gamba_warp.train.batches import load_sample


def random_viewmats(*shape):
    quats = torch.nn.functional.normalize(torch.randn(*shape, 4, dtype=torch.float64), dim=-1)
    columns = []
    for axis in torch.eye(4, dtype=torch.float64)[1:]:
        conjugate = quats * torch.tensor([1.0, -1, -1, -1], dtype=torch.float64)
        columns.append(quat_multiply(quat_multiply(quats, axis.expand_as(quats)), conjugate))
    out = torch.zeros(*shape, 4, 4, dtype=torch.float64)
    out[..., :3, :3] = torch.stack([c[..., 1:] for c in columns], -1)
    out[..., :3, 3] = torch.randn(*shape, 3, dtype=torch.float64) + torch.tensor([0, 0, 3.0])
    out[..., 3, 3] = 1
    return out


def test_intrinsics_put_the_field_of_view_at_the_edges():
    K = C.intrinsics(100, 64, fov=60)
    top = torch.tensor([0.0, -math.tan(math.radians(30)), 1.0])
    assert_close(K @ top, torch.tensor([50.0, 0.0, 1.0]), atol=1e-5, rtol=0)
    assert_close(K @ torch.tensor([0.0, 0, 2.0]) / 2, torch.tensor([50.0, 32.0, 1.0]))
    assert K[0, 0] == K[1, 1]


def test_resized_cameras_see_the_same():
    cameras = C.Cameras(torch.eye(4)[None], C.intrinsics(64, 48)[None], 64, 48)
    small = cameras.resized(32, 96)
    point = torch.tensor([0.3, -0.2, 2.0])
    before, after = cameras.Ks[0] @ point / 2, small.Ks[0] @ point / 2
    assert_close(after, before * torch.tensor([0.5, 2.0, 1.0]))
    assert (small.width, small.height) == (32, 96) and cameras.width == 64


def test_indexing_and_moving():
    cameras = C.Cameras(random_viewmats(2, 3), C.intrinsics(8, 8).expand(2, 3, 3, 3), 8, 8)
    one = cameras[1, :2].to(torch.float32)
    assert one.viewmats.shape == (2, 4, 4) and one.Ks.shape == (2, 3, 3)
    assert one.viewmats.dtype == torch.float32
    assert_close(one.viewmats, cameras.viewmats[1, :2].float())


def test_opengl_bridge():
    viewmats = random_viewmats(5, 2)
    poses = to_opengl(viewmats)
    assert_close(C.from_opengl(poses), viewmats)
    # The pose's axes in the world: x right, y up, z backward; its last column is the position.
    rotation = viewmats[..., :3, :3]
    signs = torch.tensor([1.0, -1.0, -1.0]).double()
    assert_close(poses[..., :3, :3], rotation.mT * signs)
    centre = torch.cat([poses[..., :3, 3], torch.ones(5, 2, 1)], -1)[..., None].double()
    origin = torch.tensor([0.0, 0, 0, 1]).expand(5, 2, 4).double()
    assert_close((viewmats @ centre)[..., 0], origin)
    # Blender's own: identity looks along -z with y up.
    ahead_above = torch.tensor([[0.0, 0, -2, 1], [0, 1, 0, 1]])
    assert (ahead_above @ C.from_opengl(torch.eye(4)).mT).tolist() == [[0, 0, 2, 1], [0, -1, 0, 1]]


def test_orbit_begins_at_the_reference_camera():
    assert_close(C.orbit(torch.tensor([0.0]))[0], C.reference_viewmat())
    assert C.reference_viewmat(2.0)[2, 3] == 2


def test_orbit_looks_at_the_origin_from_where_it_says():
    azimuths = torch.tensor([0.0, 33, 90, 180, 270, -45])
    elevations = torch.tensor([0.0, 20, -10, 45, 89, 0])
    viewmats = C.orbit(azimuths, elevations, 2.5).double()
    rotation, translation = viewmats[:, :3, :3], viewmats[:, :3, 3]
    identity = torch.eye(3).double().expand(6, 3, 3)
    assert_close(rotation @ rotation.mT, identity, atol=1e-6, rtol=0)
    assert_close(torch.linalg.det(rotation), torch.ones(6).double())
    assert_close(translation, torch.tensor([0, 0, 2.5]).double().expand(6, 3))
    centres = -(rotation.mT @ translation[..., None])[..., 0]
    a, e = azimuths.double().deg2rad(), elevations.double().deg2rad()
    # y is down, so above is negative; azimuth 90 is on the reference camera's right.
    want = 2.5 * torch.stack([a.sin() * e.cos(), -e.sin(), -a.cos() * e.cos()], -1)
    assert_close(centres, want, atol=1e-6, rtol=0)
    assert rotation[:, 0, 1].abs().max() < 1e-6  # right stays horizontal
    assert (rotation[:, 1, 1] > 0).all()  # the image's down is the world's


def test_relative_to_reference():
    viewmats, reference = random_viewmats(2, 3), random_viewmats(2)
    # A reference camera that looks at the origin, as the data's do.
    reference[:, :3, 3] = torch.tensor([[0, 0, 2.0], [0, 0, 3.0]])
    out, scale = C.relative_to_reference(viewmats, reference, 1.5)
    assert_close(scale, torch.tensor([0.75, 0.5]).double())
    same, _ = C.relative_to_reference(reference[:, None], reference, 1.5)
    assert_close(same[:, 0], C.reference_viewmat(1.5).double().expand(2, 4, 4))
    # A point of the world projects to the same position in each camera, up to scale.
    point = torch.randn(2, 1, 3, 1).double()
    moved = scale[:, None, None, None] * (reference[:, None, :3, :3] @ point)
    before = viewmats[..., :3, :3] @ point + viewmats[..., :3, 3:]
    after = out[..., :3, :3] @ moved + out[..., :3, 3:]
    assert_close(after, scale[:, None, None, None] * before)


@pytest.mark.parametrize("lead", [(), (2,), (2, 3)])
def test_plucker_rays_pass_through_the_pixels(lead):
    viewmats = random_viewmats(*lead)
    K = C.intrinsics(7, 5, 40).double()
    K[0, 2] += 0.4
    rays = C.plucker_rays(viewmats, K.expand(*lead, 3, 3), 7, 5)
    assert rays.shape == (*lead, 5, 7, 6)
    moment, direction = rays[..., :3], rays[..., 3:]
    assert_close(direction.norm(dim=-1), torch.ones(*lead, 5, 7).double())
    assert (moment * direction).sum(-1).abs().max() < 1e-12
    # The point two units along a ray from the centre projects to that pixel's centre.
    rotation, translation = viewmats[..., :3, :3], viewmats[..., :3, 3]
    centre = -(rotation.mT @ translation[..., None])[..., 0]
    point = centre[..., None, :] + 2 * direction[..., 4, :, :]
    assert_close(torch.linalg.cross(point, direction[..., 4, :, :]), moment[..., 4, :, :])
    seen = point @ rotation.mT + translation[..., None, :]
    pixels = seen @ K.mT
    pixels = pixels[..., :2] / pixels[..., 2:]
    want = torch.stack([torch.arange(7) + 0.5, torch.full((7,), 4.5)], -1).double()
    assert_close(pixels, want.expand(*lead, 7, 2))
    assert (seen[..., 2] > 0).all()


def test_angles_between_viewpoints():
    """From the first one, whatever the world's axes and the distances."""
    viewmats = orbit(torch.tensor([0.0, 60.0, 180.0, 0.0]), torch.tensor([0.0, 0.0, 0.0, 30.0]))
    viewmats[1, :3, 3] *= 3
    turn = orbit(torch.tensor([40.0]), 25.0)[0].clone()
    turn[:3, 3] = 0
    for moved in (viewmats, viewmats @ turn):
        cameras = Cameras(moved, intrinsics(8, 8).expand(4, 3, 3), 8, 8)
        want = torch.tensor([0.0, 60.0, 180.0, 30.0])
        torch.testing.assert_close(view_angles(cameras), want, atol=0.1, rtol=0)


CONFIG = replace(SMALLEST, distance=1.7, fov=40.0, background="black")


@pytest.fixture
def dataset(tmp_path):
    return open_dataset(write_dataset(tmp_path / "data", objects=1), "all")


def test_reference_cameras():
    cameras = reference_cameras(CONFIG, 3)
    assert cameras.viewmats.shape == (3, 4, 4) and cameras.Ks.shape == (3, 3, 3)
    assert (cameras.width, cameras.height) == (16, 16)
    assert torch.equal(cameras.viewmats[2], reference_viewmat(1.7))
    assert torch.equal(cameras.Ks[1], intrinsics(16, 16, 40.0))


def test_the_first_camera_becomes_the_reference(dataset):
    views = dataset.load(dataset.uids[0], views=[2, 0, 5])
    cameras = relative_cameras(views.cameras, 1.7)
    # the dataset's cameras look at the origin; float32 rotations
    torch.testing.assert_close(cameras.viewmats[0], reference_viewmat(1.7), atol=1e-5, rtol=0)
    centres = -(cameras.viewmats[:, :3, :3].mT @ cameras.viewmats[:, :3, 3:])[..., 0]
    before = views.cameras.viewmats
    old = -(before[:, :3, :3].mT @ before[:, :3, 3:])[..., 0]
    scale = 1.7 / before[0, :3, 3].norm()
    torch.testing.assert_close(centres, scale * old @ before[0, :3, :3].mT, atol=1e-5, rtol=0)
    assert torch.equal(cameras.Ks, views.cameras.Ks) and cameras.width == views.cameras.width


def test_the_input_lies_on_the_model_s_background(dataset):
    views = dataset.load(dataset.uids[0], views=[1, 3], size=16)
    images, cameras = posed_input(views, CONFIG)
    assert images.shape == (1, 16, 16, 3) and cameras.viewmats.shape == (1, 4, 4)
    empty = views.images[0, ..., 3] == 0
    assert empty.any() and (images[0][empty] == 0).all()


def test_training_and_evaluation_see_the_same_input(dataset, tmp_path, monkeypatch):
    """Bit-identical, for any other views and any size of the target images."""
    uid = dataset.uids[0]
    want = posed_input(dataset.load(uid, views=[4], size=16), CONFIG)
    for size in (16, 24):
        batch = load_sample(dataset, 0, [4, 1, 2], size, CONFIG, torch.ones(3))
        assert torch.equal(batch.inputs, want[0])
        assert torch.equal(batch.input_cameras.viewmats, want[1].viewmats)
        assert torch.equal(batch.input_cameras.Ks, want[1].Ks)

    (tmp_path / "model").mkdir()
    save_model(tmp_path / "model" / "model.safetensors", Gamba(CONFIG))
    options = ViewsOptions(checkpoint=tmp_path / "model", data=tmp_path)
    predictions = ModelPredictions(options, "cpu")
    forward = Mock(wraps=predictions.model.forward)
    monkeypatch.setattr(predictions.model, "forward", forward)
    predictions.gaussians(dataset, uid, 4)
    images, cameras, *_ = forward.call_args.args
    assert torch.equal(images, want[0]) and torch.equal(cameras.Ks, want[1].Ks)
    assert torch.equal(cameras.viewmats, want[1].viewmats)

    protocol = ViewsProtocol("all", 4, None, None, None, None, predictions.distance)
    gt = load_gt(dataset, uid, protocol, "cpu")
    assert torch.equal(gt.cameras.viewmats[:1], want[1].viewmats)


def test_an_evaluation_states_the_precision_of_its_model(dataset, tmp_path):
    model = tmp_path / "model.safetensors"
    save_model(model, Gamba(CONFIG))
    uid, made = dataset.uids[0], {}
    for precision in ("float32", "bfloat16"):
        options = ViewsOptions(checkpoint=model, data=tmp_path, precision=precision)
        predictions = open_predictions(options, "cpu")
        made[precision] = predictions.gaussians(dataset, uid, 4).means
        said = predictions.source.get("precision")
        assert said == (None if precision == "float32" else precision)
    assert 0 < (made["bfloat16"] - made["float32"]).abs().max() < 0.02
    (tmp_path / "plys").mkdir()
    save_ply(tmp_path / "plys" / "a.ply", some(3))
    options = replace(options, checkpoint=tmp_path / "plys")
    refused("--precision: .*plys holds no model", open_predictions, options, "cpu")
