"""Operators on float32 where torch's default dtype is float64: the same bits, of the same dtype."""

import pytest
import torch
from helpers import assert_default_dtype_changes_nothing
from helpers.kernels import conv_inputs
from helpers.raster import drawn, make
from helpers.scan import STATE, gradients, leaves
from helpers.scan import make as scan_inputs

from gamba_warp.kernels import causal_conv1d, selective_scan, selective_scan_state
from gamba_warp.kernels.ssim import dissimilarity

LENGTH, CHANNELS, STATES = 70, 10, 5
PACKED = {"cu_seqlens": torch.tensor([0, 3, 3, LENGTH])}
REQUIRED = ("u", "delta", "A", "B", "C", "x", "weight")


def assert_same(function, inputs, options, packed, **more):
    """Results and all gradients, without the inputs that may be missing unless ``options``."""
    unused = {"initial_state"} | (set() if options else {*inputs} - {*REQUIRED})
    inputs = {k: x for k, x in inputs.items() if k not in unused}
    more |= PACKED if packed else {}

    def run():
        mine = leaves(inputs)
        outs = function(**mine, **more)
        return [*outs, *gradients(mine, outs, map(torch.ones_like, outs)).values()]

    assert_default_dtype_changes_nothing(run)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("options", [False, True])
def test_scan(packed, options):
    inputs = scan_inputs(1, LENGTH, CHANNELS, STATES)
    scan = {"delta_softplus": True, "return_last_state": True}
    assert_same(selective_scan, inputs, options, packed, **scan)
    of_state = {k: inputs[k] for k in STATE[:5]}
    more = PACKED if packed else {}
    assert_default_dtype_changes_nothing(lambda: [selective_scan_state(**of_state, **more)])


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("options", [False, True])
def test_convolution(packed, options):
    inputs, more = conv_inputs(1, LENGTH, CHANNELS, 3), {"activation": "silu" if options else None}
    assert_same(causal_conv1d, inputs, options, packed, return_final_state=True, **more)


@pytest.mark.parametrize("degree", [None, 2])
def test_rasterization(degree):
    scene = make(1, 1, 40, 32, 32)
    if degree is not None:
        scene["colors"] = torch.randn(1, 40, 9, 3)

    def run():
        found, meta = drawn(scene, "RGB+ED", sh_degree=degree)
        return [*found.values(), meta["means2d"], meta["conics"]]

    assert_default_dtype_changes_nothing(run)


def test_ssim():
    got, want = torch.rand(2, 2, 20, 24, 3)
    assert_default_dtype_changes_nothing(lambda: dissimilarity(got, want, slope=True))


def test_the_cuda_path(from_ptx):
    from_ptx()
    test_scan(packed=False, options=True)
    test_convolution(packed=False, options=True)
