"""Loss terms against values worked out by hand."""

import math

import pytest
import torch

from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.conventions import over_background
from gamba_warp.image_metrics import ssim
from gamba_warp.train.objective.losses import (
    LossInputs,
    excess_translucency,
    loss_terms,
    mse,
    random_crops,
    rendered_psnr,
    structure,
    total_loss,
)


def test_composite_is_straight_alpha():
    images = torch.tensor([0.5, 1.0, 0.0, 0.25]).expand(2, 1, 3, 5, 4)
    background = torch.tensor([[[1.0, 0.0, 1.0]], [[0.0, 0.0, 0.0]]])  # [2, 1, 3]
    got = over_background(images, background[..., None, None, :])
    assert got.shape == (2, 1, 3, 5, 3)
    torch.testing.assert_close(got[0, 0, 1, 2], torch.tensor([0.875, 0.25, 0.75]))
    torch.testing.assert_close(got[1, 0, 1, 2], torch.tensor([0.125, 0.25, 0.0]))


def test_mse_and_psnr():
    want = torch.zeros(2, 3, 4, 5, 3)
    got = want.clone()
    got[1] = 0.1
    assert mse(got, want).shape == (2, 3)
    torch.testing.assert_close(mse(got, want)[1], torch.full((3,), 0.01))
    torch.testing.assert_close(rendered_psnr(got, want)[1], torch.full((3,), 20.0).double())
    assert (rendered_psnr(want, want) == 100).all()
    assert (rendered_psnr(want - 5, want) == 100).all(), "out-of-range values are clamped first"


def test_loss_terms_and_weights():
    """Terms are those that are asked for; the crops are what LPIPS sees."""
    rgb, target = torch.zeros(2, 3, 16, 16, 3), torch.full((2, 3, 16, 16, 3), 0.5)
    alpha, target_alpha = torch.ones(2, 3, 16, 16, 1), torch.zeros(2, 3, 16, 16, 1)
    seen: list = []

    def lpips(got, want):
        seen.append(got.shape)
        return (want - got).mean((-3, -2, -1))

    inputs = LossInputs(rgb, alpha, target, target_alpha, lpips)
    terms = loss_terms(inputs, {"lpips": 0.5})
    shapes = {name: tuple(term.shape) for name, term in terms.items()}
    assert shapes == dict.fromkeys(("rgb", "mask", "lpips"), (2, 3))
    loss = total_loss(terms, {"rgb": 1.0, "mask": 2.0, "lpips": 0.5})
    assert loss.item() == pytest.approx(0.25 + 2.0 + 0.25)
    assert set(loss_terms(inputs, {})) == {"rgb", "mask"}
    with pytest.raises(KeyError, match="lpips"):
        total_loss(terms, {"rgb": 1.0, "mask": 1.0})
    assert set(loss_terms(inputs._replace(lpips=None), {"lpips": 1.0})) == {"rgb", "mask"}
    cropped = LossInputs(rgb, alpha, rgb, alpha, lpips, lpips_crop=8)
    terms = loss_terms(cropped, {"lpips": 1.0, "ssim": 1.0})
    shapes = {name: tuple(term.shape) for name, term in terms.items()}
    assert shapes == dict.fromkeys(("rgb", "mask", "ssim"), (2, 3)) | {"lpips": (2,)}
    assert seen == [(2, 3, 16, 16, 3), (2, 8, 8, 3)]
    assert all(term.abs().max() < 1e-6 for term in terms.values())


def test_non_finite_images_are_not_hidden():
    rgb = torch.full((1, 4, 4, 3), math.nan)
    loss = total_loss({"rgb": mse(rgb, torch.zeros(1, 4, 4, 3))}, {"rgb": 1.0})
    assert not torch.isfinite(loss)


@pytest.mark.parametrize("shape", [(3, 40, 40, 3), (2, 2, 13, 37, 3), (11, 29, 1)])
def test_structure_is_one_minus_ssim_and_its_gradient_kornias(shape):
    torch.manual_seed(3)
    want = torch.ones(shape, dtype=torch.float64)
    want[..., 2:-3, 4:-9, :] = torch.rand(want[..., 2:-3, 4:-9, :].shape, dtype=torch.float64)
    got = (want + 0.2 * torch.randn_like(want) * (want < 1)).clamp(0, 1).requires_grad_()
    made = structure(got, want)
    assert made.shape == shape[:-3]
    torch.testing.assert_close(made, 1 - ssim(got, want), rtol=0, atol=1e-12)
    # float32: windows of plain background are exact, in the others a variance has 24 bits.
    single = structure(got.float(), want.float()).double()
    torch.testing.assert_close(single, made, rtol=0, atol=1e-6)
    cotangent = torch.randn_like(made)
    ours = torch.autograd.grad(made, got, cotangent)[0]
    theirs = torch.autograd.grad(1 - ssim(got, want), got, cotangent)[0]
    torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-12)


def test_crops_are_of_one_place_in_both_around_the_object():
    torch.manual_seed(0)
    values = torch.arange(2 * 3 * 8 * 9.0).view(2, 3, 8, 9, 1)
    alpha = torch.zeros(2, 3, 8, 9, 1)
    alpha[:, 0] = 1  # the input view gets no crop
    alpha[:, 1, 4, 5:7] = 1  # the third view has no object: its crops may be anywhere
    seen, pairs = set(), []
    for _ in range(300):
        got, want = random_crops(values, values + 1000, alpha, 5)
        places = []
        assert got.shape == (2, 5, 5, 1) and want.equal(got + 1000)
        for index, crop in enumerate(got[..., 0]):
            corner = int(crop[0, 0]) - index * 216
            view, rest = divmod(corner, 72)
            y, x = divmod(rest, 9)
            assert crop.equal(values[index, view, y : y + 5, x : x + 5, 0])
            places.append((view, y, x))
        seen |= {*places}
        pairs.append(places)
    # Each object has its own view, row and column.
    assert all(any(a[k] != b[k] for a, b in pairs) for k in range(3))
    around = {(1, 2, x) for x in (3, 4)}
    assert seen == around | {(2, y, x) for y in range(4) for x in range(5)}
    only = random_crops(values[:, :1], values[:, :1], alpha[:, :1], 5)[0]
    assert (only[0] < 72).all(), "without novel views it is the input"


def test_translucency_beyond_the_true_one():
    viewmats = orbit(torch.tensor([0.0, 10.0, 90.0]))
    cameras = Cameras(viewmats, intrinsics(2, 2).expand(3, 3, 3), 2, 2)[None]
    alpha = torch.tensor([0.5, 1.0, 0.0, 0.5]).view(1, 1, 2, 2, 1).expand(1, 3, 2, 2, 1)
    target = torch.tensor([1.0, 1.0, 0.5, 0.5]).view(1, 1, 2, 2, 1).expand(1, 3, 2, 2, 1)
    got = excess_translucency(alpha, target, cameras)
    torch.testing.assert_close(got, torch.tensor([[0.0, 0.0, 0.25]]))
    given = LossInputs(alpha.expand(-1, -1, -1, -1, 3), alpha, alpha, target, cameras=cameras)
    terms = loss_terms(given, {"mask_l1": 1.0, "translucency": 1.0})
    torch.testing.assert_close(terms["translucency"], got)
    torch.testing.assert_close(terms["mask_l1"], torch.full((1, 3), 0.25))
