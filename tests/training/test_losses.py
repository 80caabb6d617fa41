"""Loss terms against values worked out by hand."""

import math

import pytest
import torch

from gamba_warp.images import over_background
from gamba_warp.train.losses import mse, rendered_psnr, total_loss, view_losses


def test_composite_is_straight_alpha():
    pictures = torch.tensor([0.5, 1.0, 0.0, 0.25]).expand(2, 1, 3, 5, 4)
    background = torch.tensor([[[1.0, 0.0, 1.0]], [[0.0, 0.0, 0.0]]])  # [2, 1, 3]
    got = over_background(pictures, background[..., None, None, :])
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


def test_view_losses_and_weights():
    rgb, target = torch.zeros(2, 3, 8, 8, 3), torch.full((2, 3, 8, 8, 3), 0.5)
    alpha, target_alpha = torch.ones(2, 3, 8, 8, 1), torch.zeros(2, 3, 8, 8, 1)
    terms = view_losses(rgb, alpha, target, target_alpha, lambda a, b: (b - a).mean((-3, -2, -1)))
    assert {name: tuple(term.shape) for name, term in terms.items()} == {
        "rgb": (2, 3),
        "mask": (2, 3),
        "lpips": (2, 3),
    }
    loss = total_loss(terms, {"rgb": 1.0, "mask": 2.0, "lpips": 0.5})
    assert loss.item() == pytest.approx(0.25 + 2.0 + 0.25)
    assert set(view_losses(rgb, alpha, target, target_alpha)) == {"rgb", "mask"}
    with pytest.raises(KeyError, match="lpips"):
        total_loss(terms, {"rgb": 1.0, "mask": 1.0})


def test_non_finite_pictures_are_not_hidden():
    rgb = torch.full((1, 4, 4, 3), math.nan)
    loss = total_loss({"rgb": mse(rgb, torch.zeros(1, 4, 4, 3))}, {"rgb": 1.0})
    assert not torch.isfinite(loss)
