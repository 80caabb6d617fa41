"""Every CUDA kernel's PTX, executed: no finding, the same bits in any order, float64's values."""

from dataclasses import replace

import pytest
import torch
from helpers import assert_rel_rms, first_splatting
from helpers import raster as rasters
from helpers import scan as scans
from helpers.kernels import conv_inputs
from helpers.model import SMALLEST, inputs
from ops.causal_conv1d import test_causal_conv1d as conv
from ops.rasterize import test_harmonics as harmonics

from gamba_warp.cameras import Cameras
from gamba_warp.kernels.rasterize import depth_quantile
from gamba_warp.kernels.rasterize.cuda.bin import bin_views
from gamba_warp.kernels.rasterize.projection import Projected
from gamba_warp.kernels.rasterize.skip import TILE_TEST
from gamba_warp.kernels.rasterize.tiles import Tiling, make_grid
from gamba_warp.kernels.selective_scan.cuda import launch as scan_cuda
from gamba_warp.kernels.selective_scan.cuda.launch import Tuning
from gamba_warp.model.gamba import Gamba
from gamba_warp.train.data.samples import Batch
from gamba_warp.train.step import Objective, forward

from .launch import interpreted
from .simulated import not_simulated

HALF = 4e-3  # of numbers of 8 bits, rounded in the inputs' gradients and in the output
# Multiprocessors for which the tiles of two images, 24 or 12, are cut into so many parts.
PARTS = {4: 132, 2: 1, 1: 0}


def check(function, multiprocessors=132):
    """Runs a test in order and in a drawn one, its launches executed from PTX."""
    traces = []
    for seed in (0, 1):
        torch.manual_seed(0)
        with interpreted(multiprocessors, seed=seed) as machine:
            function()
        assert not machine.findings, "\n".join(machine.findings)
        traces.append(machine.trace)
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
    monkeypatch.setattr(scan_cuda, "choose", lambda *_: tuning)
    dtype = options.get("dtype", torch.float32)
    forward = scans.FORWARD if dtype == torch.float32 else HALF
    rest = {name: x for name, x in options.items() if name != "dtype"}
    check(lambda: scans.compare(scans.make(*shape, dtype=dtype), forward, **rest))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_convolution(dtype):
    limits = () if dtype == torch.float32 else (HALF, HALF)

    def run():
        for shape in ((2, 300, 19, 4), (1, 33, 130, 3), (1, 1, 1, 2)):
            conv.compare(conv_inputs(*shape, dtype), "silu", *limits)

    check(run)


def images(scene, mode):
    """A comparison of images, and of the depth at which half of the light is gone."""
    meta = rasters.compare(scene, mode)
    got = depth_quantile(meta)
    with not_simulated():
        want = depth_quantile(meta)
    # a ray that is half clear to within rounding may take either of two depths
    assert (got - want).abs().gt(1e-6).float().mean() <= 1e-3 and (got > 0).any()


# 1, 2 and 4 warps a tile; chunks of 1 to 4 channels, and of several
@pytest.mark.parametrize(
    ("channels", "mode", "parts"),
    [(3, "RGB+ED", 4), (3, "RGB", 2), (3, "RGB", 1), (1, "ED", 4), (2, "D", 4), (9, "RGB", 4)],
)
def test_rasterizer(channels, mode, parts):
    def run():
        images(rasters.make(1, 2, channels=channels), mode)
        images(rasters.crowded(channels), mode)

    check(run, PARTS[parts])


@pytest.mark.parametrize("name", ["colours", "covariances", "antialiased"])
def test_original_rasterizer(name):
    check(lambda: first_splatting.compare(name), PARTS[2])


def test_sizes():
    def run():
        for width, height, num in ((16, 16, 33), (17, 15, 9), (3, 1, 60)):
            rasters.compare(rasters.make(2, 1, num, width, height, size=0.3))

    check(run)


@pytest.mark.parametrize("degree", [0, 3])
def test_harmonics(degree):
    check(lambda: harmonics.check(degree, harmonics.make(num=300, degree=degree)))


def test_only_one_kernel_contracts():
    """Counting and writing pairs round alike or not: no Gaussian's pairs fall upon another's."""
    torch.manual_seed(2)  # counting finds more pairs of two Gaussians, and fewer of one
    num, width, height = 900, 1 << 16, 1024
    grid = make_grid(Tiling(width, height), num=num, alpha_min=1 / 255, skip=TILE_TEST)
    # slanting needles, of many rows of tiles: at each row's ends rounding may decide upon a tile
    heights = 400 + 400 * torch.rand(1, num, 1)
    splats = Projected(
        torch.rand(1, num, 2) * torch.tensor([width, height]),
        torch.cat([0.1 + torch.rand(1, num, 1), 8 * torch.randn(1, num, 1), heights**-2], -1),
        torch.rand(1, num),
        torch.full((1, num), 0.9),
        heights.expand(1, num, 2) * 4,
    )
    bins = []
    for contract in ("", "count", "emit"):
        with interpreted(contract=contract) as machine:
            bins.append(bin_views(grid, splats, lambda count: None))
        assert not machine.findings, "\n".join(machine.findings)
    plain, counted, emitted = bins
    more = counted.offsets.diff() - plain.offsets.diff()
    assert (more > 0).any() and (more < 0).any() and (more != 0).sum() < 0.01 * num
    for x in bins:
        owners = torch.repeat_interleave(x.order, x.offsets.diff())
        inside = x.starts[-1]
        assert torch.equal(x.pairs[:inside], owners[x.rows[:inside]])
        assert inside >= x.count - 0.001 * x.count
    # what was not written belongs to no tile
    assert emitted.starts[-1] < emitted.count or counted.starts[-1] < counted.count


def test_a_training_step():
    """Network, images, losses and all gradients, beside those of the CPU's kernels."""
    size, config = 32, replace(SMALLEST, image_size=32, encoder_size=32, depth=2)
    images, lone = inputs(2, size)
    poses, Ks = rasters.look(2, 3, size, size)
    views, grounds = Cameras(poses, Ks, size, size), torch.ones(2, 1, 3)
    batch = Batch([*"ab"], images, lone, torch.rand(2, 3, size, size, 4), views, grounds)
    model = Gamba(config, "random")
    weights = {"rgb": 1.0, "mask": 1.0, "ssim": 0.2}

    def gradients():
        model.zero_grad()
        loss = forward(model, batch, Objective(weights)).loss
        loss.backward()
        named = {k: p.grad for k, p in model.named_parameters() if p.grad is not None}
        return {"loss": loss.detach()} | named

    want = gradients()

    def run():
        got = gradients()
        assert got.keys() == want.keys()
        for name, value in got.items():
            # measured 3e-6: both sum in float32, each in its own order
            limit = rasters.IMAGE if name == "loss" else rasters.GRADIENT
            assert_rel_rms(value, want[name], limit, name)

    check(run)
