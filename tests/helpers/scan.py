"""Shared by the tests of the scan: inputs, the oracle, and a comparison that names what differs."""

import contextlib

import pytest
import torch

from gamba_warp.kernels.selective_scan import selective_scan, selective_scan_state
from gamba_warp.kernels.selective_scan.problem import DISCRETIZATIONS
from gamba_warp.kernels.selective_scan.reference import selective_scan_reference
from helpers import assert_rel_rms

FORWARD = 1e-6  # float32 rounding of a few hundred dependent steps; measured 1e-7 to 5e-7
GRADIENT = 1e-5  # the same, for sums over up to 2 * 577 tokens; measured below 1e-6
STATE = ("u", "delta", "A", "B", "delta_bias", "initial_state")  # of selective_scan_state
every_discretization = pytest.mark.parametrize("discretization", DISCRETIZATIONS)


@contextlib.contextmanager
def on_threads(count):
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    yield
    torch.set_num_threads(before)


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
    v_out, v_last = (v(x) for v, x in zip(cotangents, (out, last)))
    grads = torch.autograd.grad((out * v_out).sum() + (last * v_last).sum(), [*mine.values()])
    wants = torch.autograd.grad(
        (want * v_out.double()).sum() + (want_last * v_last.double()).sum(), [*theirs.values()]
    )
    for name, got, expected in zip(mine, grads, wants):
        assert got.dtype == inputs[name].dtype, name
        if expected.abs().max() < tiny:
            assert got.abs().max() < tiny, name
        else:
            limit = gradient if got.dtype == torch.float32 else max(forward, 1e-5)
            assert_rel_rms(got, expected, limit, f"gradient of {name}")
