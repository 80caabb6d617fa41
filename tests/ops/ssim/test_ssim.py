"""1 - SSIM against its definition in float64, its gradient against autograd's."""

import pytest
import torch
from helpers import assert_same_on_threads

from gamba_warp.kernels.ssim import dissimilarity, lanes, products
from gamba_warp.kernels.ssim.reference import dissimilarity_reference

# Of kernels and of products.
every_dtype = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)


def images(shape, seed=0):
    """Noise within a frame of white, and a smoother, noisier copy."""
    g = torch.Generator().manual_seed(seed)
    want = torch.ones(shape)
    want[:, 2:-3, 1:-2] = torch.rand(want[:, 2:-3, 1:-2].shape, generator=g)
    got = (want + 0.2 * torch.randn(shape, generator=g) * (want < 1)).clamp(0, 1)
    return got, want


def expected(got, want):
    got = got.double().requires_grad_()
    value = dissimilarity_reference(got, want.double())
    return value.detach(), torch.autograd.grad(value.sum(), got)[0]


@pytest.mark.parametrize(
    "shape", [(1, 11, 11, 1), (3, 11, 40, 3), (2, 37, 13, 3), (2, 29, 33, 4), (5, 20, 21, 2)]
)
@pytest.mark.parametrize("together", [1, 1 << 20])
def test_value_and_gradient_are_those_of_the_definition(monkeypatch, shape, together):
    monkeypatch.setattr(lanes, "_TOGETHER", together)
    got, want = images(shape)
    value, slope = dissimilarity(got, want, True)
    wanted, gradient = expected(got, want)
    torch.testing.assert_close(value.double(), wanted, rtol=0, atol=1e-6)
    # Variances have 24 bits, and C2 = 9e-4 stands beside them: some digits are lost.
    error = (slope.double() - gradient).norm() / gradient.norm()
    assert error < 2e-5, error
    alone, none = dissimilarity(got, want, False)
    assert none is None and torch.equal(alone, value)


@pytest.mark.parametrize("together", [1, 2 * 37 * 75 * 2, 1 << 20])
@pytest.mark.parametrize("shape", [(1, 11, 11, 1), (3, 11, 43, 3), (5, 37, 75, 2)])
def test_products_in_float64(monkeypatch, shape, together):
    """Images of up to three tiles of columns, one at a time, two and all together."""
    monkeypatch.setattr(products, "_TOGETHER", together)
    got, want = (x.double() for x in images(shape))
    value, slope = dissimilarity(got, want, True)
    wanted, gradient = expected(got, want)
    torch.testing.assert_close(value, wanted, rtol=0, atol=1e-13)
    # C2 stands beside variances that are differences: three of sixteen digits are lost.
    torch.testing.assert_close(slope, gradient, rtol=1e-9, atol=1e-13)
    assert dissimilarity(got, want, False)[1] is None


def test_flat_images_keep_their_digits():
    """A variance is the difference of two means; without the corner's colour it would be noise."""
    g = torch.Generator().manual_seed(2)
    want = torch.full((1, 24, 24, 3), 0.9)
    got = want + 1e-3 * torch.randn(want.shape, generator=g)
    wanted, gradient = expected(got, want)
    value, slope = dissimilarity(got, want, True)
    torch.testing.assert_close(value.double(), wanted, rtol=1e-3, atol=0)
    assert (slope.double() - gradient).norm() < 1e-3 * gradient.norm()


@every_dtype
@pytest.mark.parametrize("place", [(0, 0), (24, 30), (0, 30), (12, 15)])
def test_one_differing_pixel_is_found_anywhere(place, dtype):
    torch.manual_seed(1)
    want = torch.rand(2, 25, 31, 3, dtype=dtype)
    got = want.clone()
    got[1, place[0], place[1]] += 0.5
    value, slope = dissimilarity(got, want, True)
    wanted, gradient = expected(got, want)
    exact, rtol, atol = (1e-6, 1e-3, 1e-7) if dtype == torch.float32 else (1e-12, 1e-9, 1e-12)
    torch.testing.assert_close(value.double(), wanted, rtol=0, atol=exact)
    torch.testing.assert_close(slope.double(), gradient, rtol=rtol, atol=atol)
    assert value[0] == 0 and slope[0].eq(0).all() and slope[1].ne(0).any()


def test_threads_and_runs_change_no_bit():
    got, want = images((6, 40, 50, 3))
    assert_same_on_threads(lambda: dissimilarity(got, want, True), 1, 2, 3, 1)


@every_dtype
def test_nan_stays_in_its_image(dtype):
    got, want = (x.to(dtype) for x in images((3, 20, 20, 3)))
    got[1, 5, 5] = torch.nan
    value, slope = dissimilarity(got, want, True)
    assert value[1].isnan() and value[[0, 2]].isfinite().all()
    assert slope[1].isnan().any() and slope[[0, 2]].isfinite().all()


def test_none_and_equal_images():
    got, want = images((2, 12, 12, 3))
    value, slope = dissimilarity(want, want, True)
    assert value.eq(0).all() and slope.eq(0).all()
    value, slope = dissimilarity(got[:0], want[:0], True)
    assert value.shape == (0,) and slope.shape == (0, 12, 12, 3)


@pytest.mark.parametrize(
    ("got", "want", "error"),
    [
        (torch.rand(1, 10, 11, 3), torch.rand(1, 10, 11, 3), ValueError),
        (torch.rand(1, 11, 12, 3), torch.rand(1, 11, 11, 3), ValueError),
        (torch.rand(11, 11, 3), torch.rand(11, 11, 3), ValueError),
        (torch.rand(1, 11, 11, 3).double(), torch.rand(1, 11, 11, 3), TypeError),
        (torch.ones(1, 11, 11, 3).int(), torch.ones(1, 11, 11, 3).int(), TypeError),
    ],
)
def test_bad_images_are_refused_by_name(got, want, error):
    with pytest.raises(error, match="got|want"):
        dissimilarity(got, want, False)
