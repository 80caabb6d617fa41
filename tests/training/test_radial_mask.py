"""The radial mask constraint: known answers in units of half the image's height, and gradients."""

import math

import pytest
import torch

from gamba_warp.cameras import Cameras, intrinsics, reference_viewmat
from gamba_warp.train.objective.radial_mask import contour_distances, radial_mask_loss

SIZE = 96
CONTOUR = 0.5 / (SIZE / 2)  # half a pixel: accuracy of a curve in a 0/1 pixel mask


def disc(radius: float, width=SIZE, height=SIZE, centre=(0.0, 0.0)) -> torch.Tensor:
    """A disc of ``radius`` half heights about ``centre`` (from the image centre, same unit)."""
    x = (torch.arange(width) + 0.5 - width / 2) / (height / 2) - centre[0]
    y = (torch.arange(height) + 0.5 - height / 2) / (height / 2) - centre[1]
    return (x * x + (y * y)[:, None] < radius * radius).float()


def camera(width=SIZE, height=SIZE, views=1) -> Cameras:
    viewmats = reference_viewmat(1.5).expand(views, 4, 4).clone()
    return Cameras(viewmats, intrinsics(width, height).expand(views, 3, 3), width, height)


def mean_at(distance: float, angle: float, depth: float = 1.5) -> torch.Tensor:
    """A centre that projects to ``distance`` half heights from the image centre."""
    reach = distance * math.tan(math.radians(49.1 / 2)) * depth
    return torch.tensor([[reach * math.cos(angle), reach * math.sin(angle), depth - 1.5]])


def square() -> torch.Tensor:
    mask = torch.zeros(SIZE, SIZE)
    mask[24:72, 24:72] = 1  # half an image wide: sides at 0.5
    return mask


ANGLES = torch.arange(256) * (2 * math.pi / 256)


@pytest.mark.parametrize(
    "mask, want",
    [
        (disc(0.6)[None], 0.6),
        (disc(0.6, 131)[None], 0.6),
        (disc(0.8) - disc(0.4), 0.8),
        (square(), 0.5 / torch.maximum(ANGLES.cos().abs(), ANGLES.sin().abs())),
    ],
    ids=["disc", "disc in a wide image", "the outermost of a ring", "square"],
)
def test_contours(mask, want):
    contours = contour_distances(mask)
    assert contours.shape == (*mask.shape[:-2], 256)
    assert (contours - want).abs().max() < CONTOUR


def test_full_image_ends_at_its_border():
    got = contour_distances(torch.ones(32, 48), rays=4)
    torch.testing.assert_close(got, torch.tensor([1.5, 1.0, 1.5, 1.0]), atol=1e-5, rtol=0)


def test_rays_that_meet_nothing_are_zero():
    contours = contour_distances(disc(0.2, centre=(0.6, 0.0)))
    assert abs(contours[0].item() - 0.8) < CONTOUR
    assert contours[128] == 0 and contours[64] == 0
    loss = radial_mask_loss(mean_at(0.5, math.pi), camera(), contours[None])
    assert loss.item() == pytest.approx(0.25, rel=1e-4)
    assert (contour_distances(torch.zeros(3, 8, 8)) == 0).all()


@pytest.mark.parametrize("size", [SIZE, 256])
@pytest.mark.parametrize("angle", [0.0, 0.7, 2.5, -1.9, math.pi])
def test_loss_outside_a_disc(angle, size):
    """A Gaussian at distance d outside a disc of radius r costs (d - r)²."""
    contours = contour_distances(disc(0.5, size, size)[None])
    loss = radial_mask_loss(mean_at(0.9, angle), camera(size, size), contours)
    assert loss.shape == (1,)
    assert abs(loss.item() ** 0.5 - 0.4) < CONTOUR


def test_no_loss_inside_and_mean_over_all():
    contours = contour_distances(disc(0.5)[None])
    inside = torch.cat([mean_at(0.45, 1.0), torch.zeros(1, 3)])
    assert radial_mask_loss(inside, camera(), contours).item() == 0
    both = torch.cat([inside, mean_at(0.9, 1.0)])
    alone = radial_mask_loss(both[2:], camera(), contours)
    torch.testing.assert_close(radial_mask_loss(both, camera(), contours), alone / 3)


def test_interpolates_between_rays():
    """Half-way between a ray at 0.2 and one at 0.6 the contour is 0.4."""
    for ray, angle in ((1, math.pi / 8), (7, -math.pi / 8)):  # the last and the first, too
        contours = torch.full((1, 8), 0.2)
        contours[0, ray] = 0.6
        loss = radial_mask_loss(mean_at(0.9, angle), camera(), contours)
        assert loss.item() == pytest.approx(0.25, rel=1e-4)  # float32 projection


def test_empty_mask_and_behind_the_camera_cost_nothing():
    means = torch.cat([mean_at(0.9, 1.0, depth=depth) for depth in (1.5, -0.5, 0)])
    means.requires_grad_()
    empty = radial_mask_loss(means, camera(), torch.zeros(1, 256))
    assert empty.item() == 0
    contours = contour_distances(disc(0.3)[None])
    loss = radial_mask_loss(means, camera(), contours).sum()
    gradient = torch.autograd.grad(loss, means)[0]
    assert torch.isfinite(gradient).all()
    assert (gradient[1:] == 0).all() and (gradient[0] != 0).any()


def test_gradient_at_the_image_centre_is_finite():
    means = torch.zeros(2, 3, requires_grad=True)
    contours = torch.cat([torch.zeros(255), torch.ones(1)])[None]
    radial_mask_loss(means, camera(), contours).sum().backward()
    assert (means.grad == 0).all()


def test_gradient_by_finite_differences():
    generator = torch.Generator().manual_seed(1)
    means = torch.rand(2, 7, 3, dtype=torch.float64, generator=generator) - 0.5
    cameras = camera(views=3).to(torch.float64)
    turn = torch.tensor([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]], dtype=torch.float64)
    cameras.viewmats[1, :3, :3] = turn
    viewmats, Ks = (value.expand(2, *value.shape) for value in (cameras.viewmats, cameras.Ks))
    cameras = Cameras(viewmats, Ks, SIZE, SIZE)
    contours = 0.1 + 0.2 * torch.rand(2, 3, 16, dtype=torch.float64, generator=generator)
    cotangent = torch.randn(2, 3, dtype=torch.float64, generator=generator)

    def weighed(x):
        return (radial_mask_loss(x, cameras, contours) * cotangent).sum()

    assert weighed(means) != 0
    assert torch.autograd.gradcheck(weighed, (means.requires_grad_(),), eps=1e-6, atol=1e-7)
