"""Choices inside the kernels: each gives the default's result but for what it trades."""

from unittest.mock import patch

import pytest
import torch
from helpers import rel_rms

from gamba_warp.cameras import Cameras, intrinsics, reference_viewmat
from gamba_warp.kernels.cases.raster import orbit_cameras, raster_case, shell
from gamba_warp.kernels.cases.scan import make_inputs
from gamba_warp.kernels.rasterize.reference import rasterization_reference
from gamba_warp.kernels.selective_scan import selective_scan
from gamba_warp.kernels.selective_scan.cpu import launch as cpu_scan
from gamba_warp.model.config import GambaConfig
from gamba_warp.model.gamba import Gamba


def scan(**choice):
    """Output and gradients of 173 tokens, 24 channels, 5 states, and the bytes kept for them."""
    leaves = {k: x.requires_grad_() for k, x in make_inputs(2, 173, 24, states=5).items()}
    kept = []
    with patch.object(cpu_scan, "TUNING", cpu_scan.Tuning(**choice)):
        with torch.autograd.graph.saved_tensors_hooks(lambda x: kept.append(x) or x, lambda x: x):
            out = selective_scan(**leaves, delta_softplus=True)
        grads = torch.autograd.grad(out.square().sum(), list(leaves.values()))
    return [out.detach(), *grads], kept[-1].numel()


@pytest.mark.parametrize("chunk, strip", [(16, 8), (64, 32), (128, 128)])
def test_chunks_of_the_scan(chunk, strip):
    (want, kept), (got, other) = scan(), scan(chunk=chunk, strip=strip)
    assert all(rel_rms(a, b) < 1e-6 for a, b in zip(got, want))  # sums in another order
    assert other / kept == pytest.approx(-(-173 // chunk) / 3)


@pytest.mark.parametrize("degree, low, high", [(2, 1e-5, 1e-2), (3, 1e-7, 1e-3), (6, 0, 1e-6)])
def test_degree_of_the_decays(degree, low, high):
    (want, _), (got, _) = scan(table=False), scan(degree=degree, table=False)
    assert low < rel_rms(got[0], want[0]) < high
    assert max(rel_rms(a, b) for a, b in zip(got, want)) < 30 * high  # dA and dδ lose more


def scene(**options):
    viewmats, Ks = orbit_cameras(2, 75)
    viewmats[:, 0, 3] += 0.03
    return raster_case(shell(400, 3), (viewmats, Ks), 75, torch.device("cpu"), **options)


def results(of):
    renders, alphas, meta = of.forward()
    return [renders, alphas, *of.backward()], meta


@pytest.mark.parametrize("t_min", [0.3, 1e-2, 1e-30])
def test_the_limit_of_transmittance(t_min):
    """Against the oracle with the same limit; the default's image is another one."""
    made = scene(t_min=t_min)
    got, _ = results(made)
    x = {k: v.double() for k, v in made.inputs.items() if k != "pixels"}
    want, _, alphas = rasterization_reference(**x, width=75, height=75, t_min=t_min)
    # a pixel at a threshold may fall on its other side
    assert ((got[0] - want).abs() < 1e-4).float().mean() > 0.999
    assert ((got[1] - alphas).abs() < 1e-4).float().mean() > 0.999
    assert rel_rms(got[0], results(scene())[0][0]) > 1e-6
    assert all(g.isfinite().all() for g in got)


@pytest.mark.parametrize("t_min", [0.0, 1.0, -1e-4, float("nan")])
def test_limits_that_are_refused(t_min):
    with pytest.raises(ValueError, match="t_min must be in"):
        scene(t_min=t_min).forward()


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    config = GambaConfig(
        image_size=32, patch_size=4, width=16, depth=2, state_size=4, encoder="none",
        encoder_size=32,
    )  # fmt: skip
    return Gamba(config).eval()


def images(*squares):
    """White images with a grey pixel each, at row and column."""
    images = torch.ones(len(squares), 32, 32, 3)
    for image, (y, x) in zip(images, squares):
        image[y, x] = 0.9
    viewmats = reference_viewmat(1.9).repeat(len(squares), 1, 1)
    K = intrinsics(32, 32).repeat(len(squares), 1, 1)
    return images, Cameras(viewmats, K, 32, 32)


@torch.no_grad()
def test_background_tokens_are_dropped(model):
    full = model(*images((5, 9)))
    assert full.means.shape == (1, 4 * 64, 3)
    for margin, patches in ((0, 1), (1, 9), (2, 4 * 5), (100, 64)):  # row 1, column 2 of 8 x 8
        made = model(*images((5, 9)), background_margin=margin)
        assert made.means.shape == (1, 4 * patches, 3)
    assert torch.equal(made.means, full.means) and torch.equal(made.scales, full.scales)
    kept = model.tokens.foreground(images((5, 9))[0], 1.0, 0)
    first = 1 * 8 + 2, 64 + 2 * 8 + 1  # by rows, then by columns; then each backward
    assert kept.tolist() == [first[0], first[1], 191 - first[0], 255 - (first[1] - 64)]


@torch.no_grad()
def test_a_token_is_kept_if_any_image_of_the_batch_needs_it(model):
    both, cameras = images((5, 9), (30, 30))
    assert model(both, cameras, background_margin=0).means.shape == (2, 8, 3)
    assert model(torch.ones_like(both), cameras, background_margin=3).means.shape == (2, 0, 3)
    with pytest.raises(ValueError, match="background_margin is -1"):
        model(both, cameras, background_margin=-1)
