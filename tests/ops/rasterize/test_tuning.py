"""The CPU's tuning is chosen when a call begins, and goes with its lists to all that follows."""

import pytest
import torch
from helpers import assert_rel_rms
from helpers.raster import NAMES, leaves, make

from gamba_warp.kernels.bench.static.dry_run import can_dry_run, dry_run
from gamba_warp.kernels.rasterize import depth_quantile, ops, rasterization
from gamba_warp.kernels.rasterize.cpu.tuning import Tuning, use_tuning
from gamba_warp.kernels.rasterize.tiles import Limits, Size

SMALL = Tuning(tile=8)
COARSE = Tuning(degree=2)
SAME = 1e-6  # sums over tiles of another size, in another order


def forward(scene, tuning=None):
    """Leaves, results and meta of a call on a tuning, or on the one in force."""
    tensors = leaves(scene, torch.float32)
    if tuning is None:
        return tensors, *rasterization(**tensors, render_mode="RGB+ED")
    with use_tuning(tuning):
        return tensors, *rasterization(**tensors, render_mode="RGB+ED")


def gradients(tensors, renders, alphas, meta):
    generator = torch.Generator().manual_seed(1)
    v = [torch.randn(x.shape, generator=generator) for x in (renders, alphas)]
    torch.autograd.backward([renders, alphas], v)
    return {name: tensors[name].grad for name in NAMES}


@pytest.mark.parametrize("tuning", [SMALL, COARSE])
def test_a_gradient_runs_on_the_tuning_of_its_forward(tuning):
    scene = make(num=200)
    with use_tuning(tuning):
        want = gradients(*forward(scene))
    outside = gradients(*forward(scene, tuning))
    default = forward(scene)
    with use_tuning(tuning):
        inside = gradients(*default)
    plain = gradients(*forward(scene))
    for name in NAMES:
        assert torch.equal(outside[name], want[name]), name
        assert torch.equal(inside[name], plain[name]), name
    if tuning is SMALL:
        for name in NAMES:
            assert_rel_rms(outside[name], plain[name], SAME, name)
    assert not torch.equal(outside["means"], plain["means"])


def test_counts_are_those_of_the_forward():
    *_, meta = forward(make(num=200, width=37, height=53), SMALL)
    assert meta["tile_size"] == 8 and meta["tiles"] == 2 * 3 * 5 * 7
    assert meta.tiling.count == 5 * 7 and meta.tiling.tile == 8


@pytest.mark.parametrize("transmittance", [0.9, 0.5])
def test_a_quantile_of_depth_is_read_from_the_lists_as_they_were_cut(transmittance):
    scene = make(num=200)
    want = depth_quantile(forward(scene)[-1], transmittance)
    assert (want > 0).float().mean() > 0.3 and (want == 0).any()
    meta = forward(scene, SMALL)[-1]
    outside = depth_quantile(meta, transmittance)
    with use_tuning(SMALL):
        inside = depth_quantile(meta, transmittance)
        other = depth_quantile(forward(scene, Tuning())[-1], transmittance)
    for got in (outside, inside, other):
        assert torch.equal(got, want)


@pytest.mark.parametrize("tuning", [Tuning(), SMALL])
def test_fake_results_have_the_tunings_shapes(tuning):
    """A tile has 16 blocks or 4, and a smaller tile makes more tiles."""
    num, views, width, height = 40, 2, 37, 21
    meta = forward(make(1, views, num=num, width=width, height=height), tuning)[-1]
    names = ("means2d", "conics", "depths", "opacities")
    means2d, conics, depths, opacities = (meta[k].detach().flatten(0, 1) for k in names)
    extents = torch.full_like(means2d, 5.0)
    bins = (means2d, conics, depths, opacities, extents, width, height, 1 / 255, 127)
    checks = ("test_schema", "test_faketensor")
    torch.library.opcheck(ops.bin_op, (*bins, tuning.numbers()), test_utils=checks)
    size = Size(width=width, height=height, views=views, colors_per_view=0, skip=127)
    limits = Limits(alpha_min=1 / 255, alpha_max=0.99, t_min=1e-4)
    lists = [list(meta.bins), list(size), list(limits), tuning.numbers()]
    arguments = (means2d, conics, opacities, torch.rand(num, 3), *lists, None)
    torch.library.opcheck(ops.composite, arguments, test_utils=checks)


def test_a_compiled_call_runs_on_the_tuning_in_force():
    scene = make(1, 1, num=40, width=37, height=21)
    names = ("means", "quats", "scales", "opacities", "colors")

    def call(*gaussians):
        rest = {k: scene[k] for k in ("viewmats", "Ks", "width", "height")}
        return rasterization(**dict(zip(names, gaussians)), **rest, render_mode="RGB+ED")[:2]

    # torch 2.6 cuts the graph at the lists, whose length is not known before, and at ``Meta``.
    whole = torch.__version__ >= "2.10"
    compiled = torch.compile(call, fullgraph=whole, backend="aot_eager")
    for tuning in (Tuning(), SMALL):
        results = []
        for function in (call, compiled):
            gaussians = [scene[name].clone().requires_grad_() for name in names]
            with use_tuning(tuning):
                renders, alphas = function(*gaussians)
            grads = torch.autograd.grad((renders.square() + alphas).sum(), gaussians)
            results.append([renders, alphas, *grads])
        assert all(torch.equal(a, b) for a, b in zip(*results))


@pytest.mark.skipif(not can_dry_run(), reason="this torch lists no kernels without a GPU")
def test_cuda_has_one_tuning():
    def call():
        tensors = {
            name: torch.empty(shape, device="cuda")
            for name, shape in dict(
                means=(9, 3), quats=(9, 4), scales=(9, 3), opacities=(9,), colors=(9, 3),
                viewmats=(1, 4, 4), Ks=(1, 3, 3),
            ).items()
        }  # fmt: skip
        return rasterization(**tensors, width=32, height=32)

    with dry_run() as launches:
        for tuning in (SMALL, COARSE):
            with use_tuning(tuning), pytest.raises(ValueError, match="device is cuda"):
                call()
        assert not launches
        with use_tuning(Tuning()):
            call()
        assert launches
