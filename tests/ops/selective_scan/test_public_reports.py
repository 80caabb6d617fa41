"""Public reports of mamba-ssm's scan: a test for each shows that it does not happen here.

Numbers are those of issues and pull requests of the repository state-spaces/mamba.
"""

import pytest
import torch
from helpers.scan import compare, gradients, leaves, make

from gamba_warp.compat.mamba_ssm import mamba_inner_fn
from gamba_warp.kernels.selective_scan import selective_scan

pytestmark = pytest.mark.usefixtures("one_thread")
both_devices = pytest.mark.parametrize("device", ["cpu", "ptx"])


@both_devices
@pytest.mark.parametrize("length", [15, 17, 63, 65, 130])
def test_368_gradients_at_ragged_ends(length, device, from_ptx):
    """Behind the last token a step is not 0 there once bias and softplus have been applied."""
    inputs = make(1, length, 5, 3)
    inputs["delta_bias"] = torch.full((5,), 3.0)
    if device == "ptx":
        from_ptx()
    compare(inputs)


def test_885_norms_once_at_each_checkpoint_level():
    """At level 1 its gradient is made from B, C and steps that were normalised twice."""
    draw = torch.Generator().manual_seed(3)

    def normal(*shape):
        return torch.randn(shape, generator=draw).requires_grad_()

    rank, states, channels = 2, 3, 6
    weights = normal(channels, 1, 4), normal(channels), normal(rank + 2 * states, channels)
    tensors = [normal(2, 2 * channels, 9), *weights, normal(channels, rank), normal(4, channels)]
    A = (-torch.rand(channels, states, generator=draw)).requires_grad_()
    norms = [torch.rand(n, generator=draw).requires_grad_() for n in (states, states, channels)]
    names = ("b_rms_weight", "c_rms_weight", "dt_rms_weight")
    results = []
    for level in (0, 1):
        given = dict(zip(names, norms)) | {"checkpoint_lvl": level}
        out = mamba_inner_fn(*tensors, None, A, delta_bias=torch.zeros(channels), **given)
        results.append((out, *torch.autograd.grad(out.square().sum(), [*tensors, A, *norms])))
    assert all(map(torch.equal, *results))


@both_devices
def test_880_long_decays_do_not_overflow(device, from_ptx):
    """Sums of δA over a chunk pass the exponent's range, in both signs; decays stay in 0..1."""
    inputs = make(1, 200, 5, 3)
    inputs["delta"] = inputs["delta"] + 40  # steps of about 40, and A down to -16
    x = leaves(inputs)
    if device == "ptx":
        from_ptx()
    out = selective_scan(**x, delta_softplus=True)
    found = gradients(x, [out], [torch.ones_like(out)])
    assert out.isfinite().all() and all(g.isfinite().all() for g in found.values())
    compare(inputs)
