"""Shared by the tests of the scan: inputs, the oracle, and a comparison that names what differs."""

import pytest
import torch

from gamba_warp.kernels.selective_scan import selective_scan, selective_scan_state
from gamba_warp.kernels.selective_scan.problem import DISCRETIZATIONS
from gamba_warp.kernels.selective_scan.reference import selective_scan_reference
from helpers import assert_rel_rms, on_threads

FORWARD = 1e-6  # float32 rounding of a few hundred dependent steps; measured 1e-7 to 5e-7
GRADIENT = 1e-5  # the same, for sums over up to 2 * 577 tokens; measured below 1e-6
STATE = ("u", "delta", "A", "B", "delta_bias", "initial_state")  # of selective_scan_state
every_discretization = pytest.mark.parametrize("discretization", DISCRETIZATIONS)


def make(batch, length, channels, states, groups=1, dtype=torch.float32):
    """All nine tensors, with steps and decays like an initialised model's and some far larger."""
    r = torch.randn
    shape = (batch, length, channels)
    matrix = (batch, length, groups, states)
    return {
        "u": r(shape).to(dtype),
        "delta": (2 * r(shape) - 3).to(dtype),
        "A": -16 * torch.rand(channels, states) ** 2,
        "B": r(matrix).to(dtype),
        "C": r(matrix).to(dtype),
        "D": r(channels),
        "z": r(shape).to(dtype),
        "delta_bias": 0.5 * r(channels),
        "initial_state": r(batch, channels, states),
    }


def leaves(inputs, dtype=None):
    """Copies that ask for gradients, in another dtype if one is given."""
    return {k: v.detach().clone().to(dtype or v.dtype).requires_grad_() for k, v in inputs.items()}


def oracle(*args, **kwargs):
    """The reference on one thread: its operations are too small for more."""
    with on_threads(1):
        return selective_scan_reference(*args, **kwargs)


def assert_gradients(ours, exact, limit, half=0.0, cotangents=(torch.randn_like,) * 2, tiny=0.0):
    """Compares all gradients by name.

    Args:
        ours: the leaves by name, and what is computed from them.
        exact: the same in float64.
        limit: of float32 gradients.
        half: of those in half precision.
        cotangents: made like each of the results.
        tiny: below it, a gradient counts as 0.
    """
    (mine, outs), (theirs, wants) = ours, exact
    made = [v(x) for v, x in zip(cotangents, outs)]
    total = sum((x * v).sum() for x, v in zip(outs, made))
    want_total = sum((x * v.double()).sum() for x, v in zip(wants, made))
    grads = torch.autograd.grad(total, [*mine.values()])
    expected = torch.autograd.grad(want_total, [*theirs.values()])
    for (name, x), got, want in zip(mine.items(), grads, expected):
        assert got.dtype == x.dtype, name
        if want.abs().max() < tiny:
            assert got.abs().max() < tiny, name
        else:
            bound = limit if got.dtype == torch.float32 else half
            assert_rel_rms(got, want, bound, f"gradient of {name}")


def assert_gradient_alone(function, inputs, name, **options):
    """The gradient of one input has the same bits, whichever others are asked for."""
    results = []
    for asked in (leaves(inputs), {**inputs, name: leaves(inputs)[name]}):
        out = function(**asked, **options)
        results.append(torch.autograd.grad(out.square().sum(), asked[name])[0])
    assert torch.equal(*results)


def compare(inputs, forward=FORWARD, gradient=GRADIENT, state=2e-6, **options):
    """Runs both sides with random cotangents for the output and the last state.

    Args:
        forward: limit of the output, and of the gradients in half precision.
        gradient: of the others.
        state: of the last state; also of the state alone, where ``alone`` says so.
        options: of the scan; a softplus is taken unless they say otherwise. Also ``exact``, the
            float64 side, ``cotangents``, made like the output and the last state, and ``tiny``,
            below which a gradient counts as 0.
    """
    exact, alone = options.pop("exact", oracle), options.pop("alone", False)
    cotangents = options.pop("cotangents", (torch.randn_like, torch.randn_like))
    tiny, options = options.pop("tiny", 0), {"delta_softplus": True} | options
    mine, theirs = leaves(inputs), leaves(inputs, torch.float64)
    out, last = selective_scan(**mine, return_last_state=True, **options)
    want, want_last = exact(**theirs, **options)
    assert_rel_rms(out, want, forward, "out")
    assert_rel_rms(last, want_last, max(forward, state), "last state")
    if alone:
        got = selective_scan_state(**{k: inputs[k] for k in STATE}, **options)
        assert_rel_rms(got, want_last, state, "last state alone")
    limits = gradient, max(forward, 1e-5)
    sides = (mine, (out, last)), (theirs, (want, want_last))
    assert_gradients(*sides, *limits, cotangents, tiny)
