"""The state alone, and tokens split over threads."""

import pytest
import torch
from helpers import assert_rel_rms
from helpers.scan import (
    STATE,
    assert_gradients,
    compare,
    device_errors,
    every_discretization,
    leaves,
    make,
    on_threads,
    oracle,
)

from gamba_warp.kernels.selective_scan import selective_scan, selective_scan_state
from gamba_warp.kernels.selective_scan.cpu.launch import Extent, Layout
from gamba_warp.kernels.selective_scan.problem import Inputs


def state_of(*shape):
    inputs = make(*shape)
    return {name: inputs[name] for name in STATE}


@pytest.fixture(params=[2, 5])
def threads(request):
    with on_threads(request.param):
        yield request.param


@every_discretization
@pytest.mark.parametrize("shape", [(2, 70, 35, 5, 1), (1, 1, 12, 3, 3), (1, 131, 80, 16, 2)])
def test_state_matches_oracle(shape, discretization):
    inputs = state_of(*shape)
    options = {"delta_softplus": True, "discretization": discretization}
    mine, theirs = leaves(inputs), leaves(inputs, torch.float64)
    last, heads = (
        selective_scan_state(**mine, **options),
        [torch.randn(shape[0], *inputs["A"].shape)],
    )

    def exact(**tensors):
        return oracle(C=torch.zeros_like(tensors["B"]), **tensors)[1:]

    wants = exact(**theirs, **options)
    more = device_errors(exact, inputs, heads, names=["last"], **options)
    assert_rel_rms(last, wants[0], 1e-6 + more["last"], "last state")
    assert_gradients((mine, [last]), (theirs, wants), 1e-5, heads=heads, more=more)


def test_state_is_that_of_the_scan():
    inputs = make(2, 67, 19, 4)
    _, last = selective_scan(**inputs, delta_softplus=True, return_last_state=True)
    alone = {name: inputs[name] for name in STATE}
    assert torch.equal(selective_scan_state(**alone, delta_softplus=True), last)


def test_state_of_no_tokens_is_the_first():
    inputs = state_of(2, 0, 5, 3)
    got = selective_scan_state(**inputs, delta_softplus=True)
    assert torch.equal(got, inputs["initial_state"])


def test_state_refuses_bad_input():
    inputs = state_of(1, 4, 5, 3)
    with pytest.raises(ValueError, match="initial_state must have shape"):
        selective_scan_state(**inputs | {"initial_state": torch.zeros(1, 5, 2)})
    with pytest.raises(TypeError, match="B must be a tensor, got NoneType"):
        selective_scan_state(**inputs | {"B": None})


@every_discretization
def test_segments_match_oracle(threads, discretization):
    """Too few channels for the threads: the tokens are cut, and states carried over the cuts."""
    inputs = make(1, 1111, 21, 3)
    layout = Layout(Extent.of(Inputs(**inputs)), None, 64)
    assert layout.segments == {2: 2, 5: 4}[threads]
    compare(inputs, alone=True, discretization=discretization)


def test_segments_are_repeatable(threads):
    inputs = make(1, 700, 9, 2)
    first, again = (selective_scan(**inputs, delta_softplus=True) for _ in range(2))
    assert torch.equal(first, again)


@pytest.mark.parametrize("wild", [3.0, 30.0, 3000.0])
def test_decays_beyond_the_quick_exponential(wild):
    """Some lane groups reach x = δA < -125 log 2, where exp2 must clamp; the rest does not."""
    inputs = make(1, 70, 70, 3)
    inputs["delta"][:, 40:50, 20:30] = wild
    inputs["A"][25] = -40.0
    compare(inputs)
