"""Helpers of the scan's tests: inputs, the oracle, and a comparison that names differences."""

import pytest
import torch

from gamba_warp.kernels.cases import case
from gamba_warp.kernels.runtime import gpu
from gamba_warp.kernels.selective_scan import selective_scan, selective_scan_state
from gamba_warp.kernels.selective_scan.problem import DISCRETIZATIONS
from gamba_warp.kernels.selective_scan.reference import EXACT, Off, selective_scan_reference
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
    """Leaves that require gradients, in another dtype if one is given, else of the same memory."""
    return {k: v.detach().to(dtype or v.dtype).requires_grad_() for k, v in inputs.items()}


def oracle(*args, **kwargs):
    """The reference on one thread: its operations are too small for more."""
    with on_threads(1):
        return selective_scan_reference(*args, **kwargs)


def gradients(leaves, outs, heads):
    """The gradients by name for cotangents of the outputs, ``heads``."""
    heads = [v.to(x.dtype) for x, v in zip(outs, heads)]
    return dict(zip(leaves, torch.autograd.grad(outs[: len(heads)], [*leaves.values()], heads)))


def run(function, inputs, heads, dtype=None, **options):
    """The results of a scan with softplus, and all gradients, by name."""
    mine = leaves(inputs, dtype)
    outs = function(**mine, delta_softplus=True, **options)
    return dict(zip(("out", "last"), outs)) | gradients(mine, outs, heads)


def of_squares(inputs, **options):
    """The output, and all gradients of the sum of its squares."""
    mine = leaves(inputs)
    out = selective_scan(**mine, delta_softplus=True, **options)
    return [out, *torch.autograd.grad(out.square().sum(), [*mine.values()])]


def assert_gradients(ours, exact, limit, half=0.0, heads=None, tiny=0.0, more=None):
    """Compare all gradients by name.

    Args:
        ours: the leaves by name, and the results.
        exact: the same in float64.
        limit: of float32 gradients.
        half: of those in half precision.
        heads: cotangents of the results; drawn if missing.
        tiny: below it, a gradient counts as 0.
        more: additions to the limits for the device, by name.
    """
    (mine, outs), (theirs, wants) = ours, exact
    heads = heads or [torch.randn_like(x) for x in outs]
    expected = gradients(theirs, wants, heads)
    for name, got in gradients(mine, outs, heads).items():
        want = expected[name]
        assert got.dtype == mine[name].dtype, name
        if want.abs().max() < tiny:
            assert got.abs().max() < tiny, name
        else:
            bound = limit if got.dtype == torch.float32 else half
            bound += (more or {}).get(name, 0)
            assert_rel_rms(got, want, bound, f"gradient of {name}")


EX2 = 2.0**-22  # the largest relative error of ex2.approx, CUDA's own figure for exp2f


def allowances(results, exponential=EX2):
    """Return the error of results that an inexact exponential may cause (CUDA.md, Exponential).

    Args:
        results: the formulas in float64, their results by name.
        exponential: its largest relative error.

    Returns:
        By name the relative rms difference that errors always to one side make: of the decays, and
        of the steps, where a reciprocal adds half as much.
    """
    exact = results(EXACT)
    found = dict.fromkeys(exact, 0.0)
    for off in (Off(decay=exponential), Off(step=1.5 * exponential)):
        for name, value in results(off).items():
            found[name] += case.compare({name: value}, {name: exact[name]}).rel_rms
    return found


# Error of a decay on CUDA, if larger than covered by the limits of float32; set by ptx.plugin.
approximate = {"decay": 0.0}


def device_errors(exact, inputs, heads=(), decays=0.0, names=("out", "last"), **options):
    """Additions to the CPU's limits for CUDA kernels, if this device runs them.

    Args:
        exact: the scan in float64, with an argument ``off``.
        inputs: its tensors by name.
        heads: cotangents of its results, if the gradients count.
        decays: error of a decay on CUDA, for any exponential.
        names: names of the results.
        options: of the scan.

    Returns:
        Additions >= 0 by name: of each result, and of each of ``inputs`` for its gradient.
    """
    error = max(decays, approximate["decay"])
    if not error or gpu.kind_of(torch.device("cpu")) != "cuda":
        return dict.fromkeys((*names, *inputs), 0.0)

    def results(off):
        given = leaves(inputs, torch.float64)
        outs = exact(**given, off=off, **options)
        grads = gradients(given, outs, heads) if heads else {}
        return dict(zip(names, outs)) | grads

    return allowances(results, error)


def assert_gradient_alone(function, inputs, name, **options):
    """Assert that the gradient of one input does not depend on the other requested ones."""
    results = []
    for asked in (leaves(inputs), {**inputs, name: leaves(inputs)[name]}):
        out = function(**asked, **options)
        results.append(torch.autograd.grad(out.square().sum(), asked[name])[0])
    assert torch.equal(*results)


def compare(inputs, forward=FORWARD, gradient=GRADIENT, state=2e-6, **options):
    """Run both sides with random cotangents for the output and the last state.

    Args:
        forward: limit of the output, and of the gradients in half precision.
        gradient: of the others.
        state: of the last state; also of the state alone, where ``alone`` says so.
        options: of the scan; a softplus is taken unless they say otherwise. Also ``exact``, the
            float64 side, ``cotangents``, made like the output and the last state, ``tiny``,
            below which a gradient counts as 0, and ``decays`` as ``device_errors``.
    """
    exact, alone = options.pop("exact", oracle), options.pop("alone", False)
    cotangents = options.pop("cotangents", (torch.randn_like, torch.randn_like))
    tiny, decays = options.pop("tiny", 0), options.pop("decays", 0.0)
    options = {"delta_softplus": True} | options
    mine, theirs = leaves(inputs), leaves(inputs, torch.float64)
    outs = selective_scan(**mine, return_last_state=True, **options)
    wants = exact(**theirs, **options)
    heads = [make(x) for make, x in zip(cotangents, outs)]
    more = device_errors(exact, inputs, heads, decays, **options)
    assert_rel_rms(outs[0], wants[0], forward + more["out"], "out")
    assert_rel_rms(outs[1], wants[1], state + more["last"], "last state")
    if alone:
        got = selective_scan_state(**{k: inputs[k] for k in STATE}, **options)
        assert_rel_rms(got, wants[1], state + more["last"], "last state alone")
    limits = gradient, max(forward, 1e-5)
    assert_gradients((mine, outs), (theirs, wants), *limits, heads, tiny, more)


def compare_state(inputs, state=1e-6, gradient=GRADIENT, **options):
    """The same for ``selective_scan_state``, of the inputs that it takes."""
    options = {"delta_softplus": True} | options
    inputs = {k: inputs[k] for k in STATE}

    def exact(**tensors):
        return oracle(C=torch.zeros_like(tensors["B"]), **tensors)[1:]

    mine, theirs = leaves(inputs), leaves(inputs, torch.float64)
    last, wants = selective_scan_state(**mine, **options), exact(**theirs, **options)
    heads = [torch.randn_like(last)]
    more = device_errors(exact, inputs, heads, names=["last"], **options)
    assert_rel_rms(last, wants[0], state + more["last"], "last state")
    assert_gradients((mine, [last]), (theirs, wants), gradient, heads=heads, more=more)
