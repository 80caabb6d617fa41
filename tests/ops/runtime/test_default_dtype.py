"""Operators on float32 where torch's default dtype is float64: the same bits, of the same dtype."""

import pytest
import torch
from helpers import assert_default_dtype_changes_nothing

from gamba_warp.kernels import causal_conv1d, rasterization, selective_scan, selective_scan_state
from gamba_warp.kernels.ssim import dissimilarity

LENGTH, CHANNELS, STATES = 70, 10, 5


def drawing():
    """A function that draws float32 leaves, the same from one call of this to the next."""
    rng = torch.Generator().manual_seed(0)

    def leaf(*shape):
        values = torch.randn(*shape, generator=rng, dtype=torch.float32)
        return values.requires_grad_()

    return leaf


def with_gradients(outputs, leaves):
    total = sum(output.sum() for output in outputs)
    return [*outputs, *torch.autograd.grad(total, leaves)]


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("options", [False, True])
def test_scan(packed, options):
    def run():
        leaf = drawing()
        u, delta, B, C = (leaf(1, LENGTH, n) for n in (CHANNELS, CHANNELS, STATES, STATES))
        A = -leaf(CHANNELS, STATES).detach().exp()
        more = {"cu_seqlens": torch.tensor([0, 3, 3, LENGTH])} if packed else {}
        state = selective_scan_state(u, delta, A, B, delta_softplus=True, **more)
        if options:
            more |= {"D": leaf(CHANNELS), "z": leaf(1, LENGTH, CHANNELS)}
            more |= {"delta_bias": leaf(CHANNELS)}
        scan = selective_scan(u, delta, A, B, C, delta_softplus=True, **more)
        return with_gradients([scan, state], [u, delta, B, C])

    assert_default_dtype_changes_nothing(run)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("options", [False, True])
def test_convolution(packed, options):
    def run():
        leaf = drawing()
        x, weight = leaf(1, LENGTH, CHANNELS), leaf(CHANNELS, 3)
        more = {"cu_seqlens": torch.tensor([0, 3, 3, LENGTH])} if packed else {}
        more |= {"bias": leaf(CHANNELS), "activation": "silu"} if options else {}
        outputs = causal_conv1d(x, weight, return_final_state=True, **more)
        return with_gradients(outputs, [x, weight])

    assert_default_dtype_changes_nothing(run)


@pytest.mark.parametrize("degree", [None, 2])
def test_rasterization(degree):
    def run():
        leaf = drawing()
        means, quats, scales = leaf(40, 3), leaf(40, 4), leaf(40, 3)
        opacities, colors = leaf(40), leaf(40, 3) if degree is None else leaf(40, 9, 3)
        viewmat, K = torch.eye(4, dtype=torch.float32), torch.eye(3, dtype=torch.float32)
        viewmat[2, 3], K[:2, 2], K[:2, :2] = 4, 16, 32 * K[:2, :2]
        sizes = (0.3 * scales).exp() / 9
        splats = means, quats, sizes, opacities.sigmoid(), colors
        renders, alphas, meta = rasterization(
            *splats, viewmat[None], K[None], 32, 32, render_mode="RGB+ED", sh_degree=degree
        )
        leaves = [means, quats, scales, opacities, colors]
        return [*with_gradients([renders, alphas], leaves), meta["means2d"], meta["conics"]]

    assert_default_dtype_changes_nothing(run)


def test_ssim():
    def run():
        leaf = drawing()
        got, want = (leaf(2, 20, 24, 3).sigmoid() for _ in range(2))
        return dissimilarity(got, want, slope=True)

    assert_default_dtype_changes_nothing(run)


def test_the_cuda_path(from_ptx):
    from_ptx()
    test_scan(packed=False, options=True)
    test_convolution(packed=False, options=True)
