"""Forward-mode derivatives: refused by operators, carried on by steps that have a formula."""

import importlib
import pkgutil

import pytest
import torch
from torch.autograd import forward_ad

from gamba_warp import kernels
from gamba_warp.compat.causal_conv1d import causal_conv1d_fn, causal_conv1d_update
from gamba_warp.compat.gsplat import rasterization
from gamba_warp.compat.mamba_ssm import Mamba, selective_scan_fn
from gamba_warp.compat.mamba_ssm.ops.triton.selective_state_update import selective_state_update
from gamba_warp.kernels.rasterize.harmonics import colors_seen_from
from gamba_warp.train.objective.losses import structure


def calls():
    """A function and its input, by name, for each operator that has a gradient."""
    torch.manual_seed(0)
    layer = Mamba(16).requires_grad_(False)  # as frozen weights
    delta, A, B = torch.rand(1, 8, 6), -torch.rand(8, 4), torch.randn(1, 4, 6)
    viewmats, Ks = torch.eye(4)[None], torch.tensor([[[9.0, 0, 8], [0, 9, 6], [0, 0, 1]]])
    rest = torch.randn(3, 4), torch.rand(3, 3), torch.rand(3)
    means, colors = torch.rand(3, 3) + 1, torch.rand(3, 3)
    image = torch.rand(1, 16, 16, 3)

    def drawn(means, colors):
        return rasterization(means, *rest, colors, viewmats, Ks, 16, 12)[0]

    return {
        "layer": (layer, torch.randn(1, 6, 16)),
        "scan": (lambda u: selective_scan_fn(u, delta, A, B, B), torch.randn(1, 8, 6)),
        "convolution": (
            lambda x: causal_conv1d_fn(x, torch.ones(8, 4)), torch.randn(1, 8, 6)
        ),
        "projection": (lambda means: drawn(means, colors), means),
        "compositing": (lambda colors: drawn(means, colors), colors),
        "harmonics": (
            lambda c: colors_seen_from(1, c, means[None], torch.zeros(1, 1, 3)),
            torch.randn(1, 3, 4, 3),
        ),
        "structure": (lambda got: structure(got, image), torch.rand(1, 16, 16, 3)),
    }  # fmt: skip


def by_dual_number(function, x):
    with forward_ad.dual_level():
        return forward_ad.unpack_dual(function(forward_ad.make_dual(x, torch.ones_like(x))))


@pytest.mark.parametrize("name", calls())
def test_a_derivative_that_is_not_there_is_refused(name):
    function, x = calls()[name]
    # torch itself refuses an autograd.Function under torch.func, as RuntimeError.
    with pytest.raises((NotImplementedError, RuntimeError), match="forward-mode|jvp|transforms"):
        torch.func.jvp(function, (x,), (torch.ones_like(x),))
    with pytest.raises((NotImplementedError, RuntimeError), match="forward-mode|jvp|transforms"):
        torch.func.jacfwd(function)(x)
    with pytest.raises(NotImplementedError, match="forward"):
        by_dual_number(function, x)
    with forward_ad.dual_level():  # without a tangent nothing changes
        assert torch.equal(function(x), function(x))


def test_every_operator_has_the_check():
    for info in pkgutil.walk_packages(kernels.__path__, kernels.__name__ + "."):
        if info.name.endswith(".ops"):
            for name, value in vars(importlib.import_module(info.name)).items():
                assert type(value).__name__ != "CustomOpDef", name


def test_a_single_step_carries_the_tangent_on():
    torch.manual_seed(0)
    x, delta, A, B = torch.randn(2, 16), torch.rand(2, 16), -torch.rand(16, 16), torch.randn(2, 16)
    steps = (
        lambda x: selective_state_update(torch.zeros(2, 16, 16), x, delta, A, B, B),
        lambda x: causal_conv1d_update(x, torch.zeros(2, 16, 4), A[:, :4].contiguous()),
    )
    for step in steps:  # linear in the token, so that the difference is exact but for rounding
        wanted = step(x + 0.5) - step(x - 0.5)
        assert torch.allclose(by_dual_number(step, x).tangent, wanted, atol=1e-5)
        tangent = torch.func.jvp(step, (x,), (torch.ones_like(x),))[1]
        assert torch.allclose(tangent, wanted, atol=1e-5)
