"""Limits of the scan on a GPU: an exponential as bad as documented passes, a fault does not."""

import pytest
import torch
from gpu.checks import check_scan

from gamba_warp.kernels.cases.case import Case
from gamba_warp.kernels.selective_scan.cuda import launch as scan_cuda
from gamba_warp.kernels.selective_scan.cuda.launch import Tuning

from .launch import interpreted

# in order: it was 1.7e-5 off where 1e-5 was allowed; groups; segments in both directions
SHAPES = {
    (2, 139, 37, 3, 1): Tuning(),
    (1, 65, 40, 3, 2): Tuning(),
    (1, 200, 5, 3, 1): Tuning(segments=3, back_segments=2),
}


def check(shape, approximate):
    with interpreted(approximate=approximate) as machine:
        error = check_scan(shape, torch.float32, torch.device("cpu"))
    assert not machine.findings
    return error


@pytest.mark.parametrize("shape", SHAPES)
def test_an_exponential_that_errs_to_one_side_passes(monkeypatch, shape):
    monkeypatch.setattr(scan_cuda, "choose", lambda *_: SHAPES[shape])
    assert check(shape, approximate=1) > 3e-6 and check(shape, approximate=0) < 1e-6


def lose_carry(monkeypatch, backwards):
    """Segments begin at 0, not where the one before them ended, in one direction."""
    carried = scan_cuda._Operands.carried

    def lost(self, kernel, inputs, outputs, reverse):
        states = carried(self, kernel, inputs, outputs, reverse)
        own = states.view(self.batch, self.segments, -1)
        if reverse == backwards:
            (own[:, :-1] if reverse else own[:, 1:]).zero_()
        return states

    monkeypatch.setattr(scan_cuda._Operands, "carried", lost)


def lose_token(monkeypatch):
    """One token of all adds nothing to the state, in one channel."""
    call = Case.call

    def lost(self, inputs, **options):
        u = inputs["u"].clone()
        u[0, 100, 2] = 0
        return call(self, inputs | {"u": u}, **options)

    monkeypatch.setattr(Case, "call", lost)


@pytest.mark.parametrize(
    "fault",
    [lambda m: lose_carry(m, False), lambda m: lose_carry(m, True), lose_token],
    ids=["carry", "carry of the gradient", "a token"],
)
def test_a_fault_does_not(monkeypatch, fault):
    shape = (1, 200, 5, 3, 1)
    monkeypatch.setattr(scan_cuda, "choose", lambda *_: SHAPES[shape])
    fault(monkeypatch)
    with pytest.raises(AssertionError, match="relative rms error"):
        check(shape, approximate=1)
