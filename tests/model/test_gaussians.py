"""Container of Gaussians: checks, conversions, and rigid motions."""

import math

import pytest
import torch
from helpers.gaussians import covariances, rotations, some
from torch.testing import assert_close

from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.gaussians import Gaussians, matrix_to_quat, quat_multiply
from gamba_warp.render import render


def batch(*lead, n=5, rotated=True):
    def rand(*size):
        return torch.rand(*lead, n, *size)

    quats = torch.randn(*lead, n, 4) if rotated else None
    return Gaussians(rand(3), quats, rand(3), rand(), rand(3))


@pytest.mark.parametrize("name", ["means", "quats", "scales", "colors"])
def test_shapes_that_do_not_fit_are_named(name):
    values = vars(batch(2)).copy()
    values[name] = values[name][:, :-1]
    with pytest.raises(ValueError, match=rf"{name} has shape \(2, 4, .\), expected \(2, 5, .\)"):
        Gaussians(**values)


def test_containers_index_select_and_convert_alike():
    for rotated in (True, False):
        gaussians = batch(2, 3, rotated=rotated)
        one = gaussians[1, 2]
        assert gaussians.num == one.num == 5 and one.opacities.shape == (5,)
        assert_close(one.colors, gaussians.colors[1, 2])
        keep = torch.tensor([True, False, True, False, True])
        assert_close(one.select(keep).means, one.means[keep])
        assert one.to(torch.float64).scales.dtype == torch.float64
        assert (one.quats is None) == (not rotated)
        doubled = gaussians.map(lambda value: 2 * value)
        assert_close(doubled.opacities, 2 * gaussians.opacities)


def test_what_is_faint_is_not_drawn_and_what_is_not_finite_stays():
    gaussians = batch(n=4)
    gaussians.opacities = torch.tensor([0.5, 0.001, math.nan, 0.01])
    for least, kept in ((None, [0, 2, 3]), (0.1, [0, 2])):
        assert_close(gaussians.drawn(least).opacities, gaussians.opacities[kept], equal_nan=True)


def test_quaternion_product_is_the_matrix_product():
    p, q = torch.randn(2, 4, dtype=torch.float64)
    got = rotations(quat_multiply(p, q))
    assert_close(got, rotations(p) @ rotations(q))


ANGLES = [0, 1e-4, 1, math.pi / 2, math.pi - 1e-4, math.pi]


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, -2, 0.5), (-1, -1, -1)])
def test_quaternion_of_a_matrix(axis, angle):
    axis = torch.nn.functional.normalize(torch.tensor(axis, dtype=torch.float64), dim=0)
    quat = torch.cat([torch.tensor([math.cos(angle / 2)]).double(), math.sin(angle / 2) * axis])
    matrix = rotations(quat)
    got = matrix_to_quat(matrix)
    assert got[0] >= 0
    assert_close(got.norm(), torch.tensor(1.0).double())
    assert_close(rotations(got), matrix, atol=1e-9, rtol=0)
    # float32 entries: their rounding and no more
    assert_close(rotations(matrix_to_quat(matrix.float())), matrix.float(), atol=3e-7, rtol=0)


@pytest.mark.parametrize("rotated", [True, False])
def test_rigid_motion_moves_means_and_covariances(rotated):
    gaussians = some(6, rotated).to(torch.float64)
    rotation = rotations(torch.randn(4, dtype=torch.float64))
    shift = torch.randn(3, dtype=torch.float64)
    moved = gaussians.transformed(rotation, shift, 1.7)
    assert_close(moved.means, torch.stack([1.7 * rotation @ m + shift for m in gaussians.means]))
    before = gaussians
    if not rotated:
        quats = torch.eye(4, dtype=torch.float64)[:1].expand(6, 4)
        before = Gaussians(**{**vars(gaussians), "quats": quats})
    want, got = (torch.tensor(covariances(g.quats, g.scales)) for g in (before, moved))
    assert_close(got, 1.7**2 * rotation @ want @ rotation.T)
    assert_close(moved.opacities, gaussians.opacities)
    assert_close(moved.colors, gaussians.colors)


def test_rigid_motion_of_a_batch_with_gradients():
    gaussians = batch(2, 3)
    gaussians.means.requires_grad_()
    rotation = rotations(torch.randn(4))
    moved = gaussians.transformed(rotation, torch.zeros(3))
    cotangent = torch.randn(2, 3, 5, 3)
    (gradient,) = torch.autograd.grad((moved.means * cotangent).sum(), gaussians.means)
    assert_close(gradient, cotangent @ rotation)
    assert moved.quats.shape == (2, 3, 5, 4)


@pytest.mark.parametrize("count", [3, 8, 15])
def test_an_object_that_turns_with_the_camera_keeps_its_image(count):
    """The harmonics rotate with the object; otherwise the colours would be of another side."""
    torch.manual_seed(3)
    gaussians = some(7)
    gaussians.harmonics = 0.3 * torch.randn(7, count, 3)
    turn = rotations(torch.tensor([0.7, -0.2, 0.5, 0.4], dtype=torch.float64)).float()
    shift = torch.tensor([0.1, -0.2, 0.05])
    motion = torch.eye(4)
    motion[:3, :3], motion[:3, 3] = turn, shift
    cameras = Cameras(orbit(torch.tensor([35.0]), 20.0), intrinsics(33, 33)[None], 33, 33)
    moved = Cameras(cameras.viewmats @ motion.inverse(), cameras.Ks, 33, 33)
    still = render(gaussians, cameras).rgb
    turned = gaussians.transformed(turn, shift)
    assert turned.degree == gaussians.degree == {3: 1, 8: 2, 15: 3}[count]
    assert_close(render(turned, moved).rgb, still, atol=2e-5, rtol=0)  # float32 of the rotation
    flat = render(Gaussians(**{**vars(gaussians), "harmonics": None}), cameras).rgb
    assert (flat - still).abs().max() > 0.05


def test_harmonics_of_no_whole_degree_are_refused():
    with pytest.raises(ValueError, match=r"harmonics has shape \(5, 4, 3\)"):
        Gaussians(**{**vars(batch()), "harmonics": torch.zeros(5, 4, 3)})
