"""Every CUDA kernel's PTX, executed: no finding, the same bits in any order, float64's values."""

import pytest
import torch
from helpers import assert_rel_rms
from helpers import raster as rasters
from helpers import scan as scans
from helpers.kernels import conv_inputs

from gamba_warp.kernels.causal_conv1d import causal_conv1d
from gamba_warp.kernels.causal_conv1d.reference import causal_conv1d_reference
from gamba_warp.kernels.rasterize.cuda import capacity
from gamba_warp.kernels.selective_scan.cuda import launch as scan_cuda
from gamba_warp.kernels.selective_scan.cuda.launch import Tuning

from .launch import interpreted

HALF = 4e-3  # of numbers of 8 bits, rounded in the inputs' gradients and in the output
PARTS = {4: 132, 2: 1}  # multiprocessors for which the pictures below are cut into so many parts


def check(function, multiprocessors=132):
    """Runs a test in order and in a drawn one, its launches executed from PTX."""
    traces = []
    for seed in (0, 1):
        torch.manual_seed(0)
        capacity.forget()
        with interpreted(multiprocessors, seed=seed) as machine:
            function()
        assert not machine.findings, "\n".join(machine.findings)
        traces.append(machine.trace)
    capacity.forget()
    assert traces[0] and traces[0] == traces[1], "the order of execution changes bits"


SEGMENTS = Tuning(segments=3, back_segments=2)


@pytest.mark.parametrize(
    ("shape", "options", "tuning"),
    [
        ((2, 139, 37, 16, 1), {}, Tuning()),
        ((1, 577, 70, 16, 1), {}, Tuning()),
        ((1, 15, 66, 16, 2), {}, Tuning()),
        ((2, 139, 37, 16, 1), {}, SEGMENTS),
        ((1, 200, 70, 16, 1), {"dtype": torch.bfloat16}, SEGMENTS),
        ((1, 67, 35, 16, 1), {"discretization": "zoh"}, Tuning()),
        ((1, 65, 40, 1, 2), {}, Tuning()),
        ((1, 66, 5, 70, 1), {}, Tuning()),
    ],
)
def test_scan(monkeypatch, shape, options, tuning):
    monkeypatch.setattr(scan_cuda, "FORCED", tuning)
    options = dict(options)
    dtype = options.pop("dtype", torch.float32)
    forward = scans.FORWARD if dtype == torch.float32 else HALF
    check(lambda: scans.compare(scans.make(*shape, dtype=dtype), forward, **options))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_convolution(dtype):
    def run():
        for shape in ((2, 300, 19, 4), (1, 33, 130, 3), (1, 1, 1, 2)):
            inputs = conv_inputs(*shape, dtype)
            exact, mine = scans.leaves(inputs, torch.float64), scans.leaves(inputs)
            out, _ = causal_conv1d_reference(**exact, activation="silu")
            got = causal_conv1d(**mine, activation="silu")
            half = dtype != torch.float32
            assert_rel_rms(got, out, HALF if half else 2e-7, "out")
            scans.assert_gradients((mine, [got]), (exact, [out]), HALF if half else 2e-6, HALF)

    check(run)


@pytest.mark.parametrize("parts", [4, 2])
@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
def test_rasterizer(mode, parts):
    check(lambda: rasters.compare(rasters.make(1, 2), mode), PARTS[parts])


@pytest.mark.parametrize("channels", [1, 2, 9])
def test_channels(channels):
    check(lambda: rasters.compare(rasters.make(1, 2, channels=channels)))
