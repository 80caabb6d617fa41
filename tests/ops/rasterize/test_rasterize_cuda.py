"""The CUDA path executed from PTX beside the CPU's, and what skips change."""

from functools import partial
from pathlib import Path

import pytest
import torch
import warp as wp
from helpers import assert_rel_rms
from helpers.raster import crowded, drawn, make, mapped

from gamba_warp.kernels.rasterize import Skip, api, rasterization
from gamba_warp.kernels.rasterize.constants import ALPHA_MAX, ALPHA_MIN, T_MIN
from gamba_warp.kernels.rasterize.cuda import composite as composite_cuda
from gamba_warp.kernels.rasterize.cuda.records import make_records
from gamba_warp.kernels.rasterize.projection import Projected
from gamba_warp.kernels.rasterize.quantile import counts_in_front
from gamba_warp.kernels.rasterize.tiles import Limits, RasterParams, Size, Splats2D, raster_params
from gamba_warp.kernels.runtime import gpu
from gamba_warp.kernels.runtime.launch import launch
from gamba_warp.kernels.runtime.native import constants, native, native_kernel


def absolute_gradients(monkeypatch):
    """A list to which calls from there on add their absolute gradients of means2d."""
    found, composite = [], api.composite

    def with_sums(means2d, conics, opacities, colors, bins, skipped, absolute, *options):
        found.append(torch.zeros_like(means2d))
        return composite(means2d, conics, opacities, colors, bins, skipped, found[-1], *options)

    monkeypatch.setattr(api, "composite", with_sums)
    return found


SAME = 2e-6  # the two sum in another order
COUNTS = ("pairs_traversed", "blocks_traversed", "blocks_used", "tiles_skipped")


def run(scene, mode="RGB", **options):
    """Results of ``drawn``, and those of meta's counts that depend on the kernels."""
    found, meta = drawn(scene, mode, **options)
    return found, {name: meta[name] for name in COUNTS}


def assert_same(got, want):
    """But for rounding."""
    assert got.keys() == want.keys()
    for name, value in want.items():
        assert_rel_rms(got[name], value, SAME, name)


def on_both(on_cuda, parts, scene, *mode, **options):
    """Results on CUDA, which are those of the CPU; the counts of CUDA and of the CPU."""
    lanes, of_lanes = run(scene, *mode, **options)
    on_cuda(parts)
    blocks, of_blocks = run(scene, *mode, **options)
    assert_same(blocks, lanes)
    return blocks, of_blocks, of_lanes


def without_a_tile(v):
    """Remove the gradient of a tile, and of a sub-tile of another."""
    for x in v:
        x[:, :, :16, :16] = x[:, :, :4, 16:24] = 0


def test_skips_change_nothing(on_cuda):
    scene = crowded(3)
    on_cuda(2)
    want, counts = run(scene, edit=without_a_tile)
    got, all_counts = run(scene, edit=without_a_tile, skip=Skip.from_bits(0))
    assert_same(got, want)
    assert all_counts["pairs_traversed"] > counts["pairs_traversed"]
    assert all_counts["tiles_skipped"] < counts["tiles_skipped"]
    assert all_counts["blocks_traversed"] > counts["blocks_traversed"] > 0


@pytest.mark.parametrize(
    "channels, mode, parts",
    [(3, "RGB", 1), (3, "RGB+ED", 2), (6, "RGB", 1), (5, "RGB", 4), (2, "RGB", 2), (1, "ED", 4)],
)
def test_block_kernels_equal_lane_kernels(on_cuda, channels, mode, parts):
    found = on_both(on_cuda, parts, crowded(channels), mode, edit=without_a_tile)
    blocks, block_counts, lane_counts = found
    assert blocks["alphas"].mean() > 0.3
    # the CPU counts blocks of which only pixels outside the image are covered
    used, lanes_used = block_counts.pop("blocks_used"), lane_counts.pop("blocks_used")
    assert 0.99 * lanes_used <= used <= lanes_used
    # a sub-tile is two blocks
    assert 0 < block_counts.pop("blocks_traversed") <= lane_counts.pop("blocks_traversed")
    assert block_counts == lane_counts and lane_counts["tiles_skipped"] >= 2


@pytest.mark.parametrize("passes", [False, True])
@pytest.mark.parametrize("channels, parts", [(3, 1), (4, 2), (1, 4), (5, 1), (11, 2)])
def test_absolute_gradients(monkeypatch, on_cuda, channels, parts, passes):
    """Also with more channels than one launch has, and of a gradient that passes the clamp."""
    monkeypatch.setattr(api, "Limits", partial(Limits, straight_through=passes))
    scene = crowded(channels)
    plain, _ = run(scene)
    found = absolute_gradients(monkeypatch)
    blocks, *_ = on_both(on_cuda, parts, scene)
    assert_same(blocks, plain)
    assert_rel_rms(found[1], found[0], SAME, "absolute")
    assert (found[0] > 0).all(-1).float().mean() > 0.5


def test_counts_in_front_of_the_median(on_cuda):
    meta = rasterization(**crowded())[-1]
    splats = Projected(*(meta[name] for name in ("means2d", "conics", "depths", "opacities")))
    given = splats, meta.bins, meta.tiling, Limits(ALPHA_MIN, ALPHA_MAX, T_MIN)
    lanes = counts_in_front(*given)
    on_cuda()
    blocks = counts_in_front(*given)
    # T may lie on the threshold in a pixel
    assert (blocks - lanes).abs().sum() <= 2 and lanes.sum() > 1000


@pytest.mark.parametrize("parts", [1, 2])
def test_colours_alone(on_cuda, parts):
    """Another kernel, without moments."""
    blocks, *_ = on_both(on_cuda, parts, crowded(3), needs=["colors"])
    assert set(blocks) == {"renders", "alphas", "colors"}


@pytest.mark.parametrize("first, parts", [(0, 1), (4, 4)])
def test_a_chunk_without_gradients(on_cuda, first, parts):
    """Its launch writes nothing to the rows that the other one writes."""

    def without_a_chunk(v):
        v[0][..., first : first + 4] = 0
        v[1] *= first > 0

    on_both(on_cuda, parts, crowded(5), edit=without_a_chunk)


def test_too_faint_to_change_a_transmittance(on_cuda):
    """Pixels that no Gaussian reached are known by T = 1, but not among such Gaussians."""
    scene = crowded(3)
    scene["opacities"] = 1e-8 * (1 + torch.rand_like(scene["opacities"]))
    blocks, *_ = on_both(on_cuda, 1, scene, alpha_min=5e-9)
    assert (blocks["alphas"] == 0).all() and (blocks["colors"] != 0).float().mean() > 0.5


def test_without_dilation(on_cuda):
    """Gaussians of determinant 0 are culled on both devices, before the division by it."""
    scene = crowded(3)
    scene["scales"][:, ::6] = torch.tensor([0.1, 0, 0])
    scene["scales"][:, 1::6] = 1e-13
    blocks, counts, lane_counts = on_both(on_cuda, 1, scene, eps2d=0.0)
    assert all(x.isfinite().all() for x in blocks.values())
    assert all((blocks[name][:, k::6] == 0).all() for name in ("means", "scales") for k in (0, 1))
    assert blocks["alphas"].mean() > 0.3
    assert counts["pairs_traversed"] == lane_counts["pairs_traversed"] > 0


def test_a_first_gaussian_may_stop_a_pixel(on_cuda):
    """Then its transmittance is still 1, as that of no pixel outside the image may be."""
    scene = make(1, 1, num=40, width=21, height=19, channels=3, size=60.0)
    scene["opacities"][:] = 0.999999
    blocks, counts, lane_counts = on_both(on_cuda, 1, scene, alpha_max=0.999999)
    # a sub-tile is two blocks
    assert 0 < counts.pop("blocks_traversed") <= lane_counts.pop("blocks_traversed")
    assert (blocks["alphas"] == 0).any() and counts == lane_counts


def test_a_gradient_of_nan_is_not_zero(on_cuda):
    def one_nan(v):
        v[0].zero_()
        v[1].zero_()
        v[0][:, :, 5, 5, 1] = torch.nan

    on_cuda()
    result, _ = run(crowded(3), edit=one_nan)
    assert result["colors"][..., 1].isnan().any()


def test_two_runs_and_any_parts(on_cuda):
    """The same bits twice; images do not depend on the parts, gradients by rounding only."""
    scene, results = crowded(3), []
    for parts in (1, 1, 4):
        on_cuda(parts)
        results.append(run(scene))
    (first, counts), (second, _), (cut, cut_counts) = results
    assert counts == cut_counts
    for name, value in first.items():
        assert torch.equal(value, second[name]), name
        assert_rel_rms(cut[name], value, 0 if name in ("renders", "alphas") else 1e-6, name)
    assert any(not torch.equal(first[name], cut[name]) for name in first)


def test_many_tiles_are_not_cut(monkeypatch):
    monkeypatch.setattr(gpu, "multiprocessors_of", lambda device: 132)
    device = torch.device("cuda", 0)
    views = [1, 2, 3, 32]
    assert [composite_cuda.parts_of_tile(1024 * n, device) for n in views] == [4, 2, 1, 1]


_HEADER = Path(composite_cuda.__file__).with_name("tile.cuh")
_SUB_TILES = """
namespace gamba::raster {
template<class K, class Params>
static void test_sub_tiles(
    int i, const Params& params, const wp::array_t<float>& records, const wp::array_t<int>& bits) {
    const Record record = ((const Record*)records.data)[i];
    const Place<K> first_lane(params, 0, 0);
    bits.data[i] = touched(first_lane, record.shape, record.level);
}
}
"""
_test_sub_tiles = native_kernel(
    "test_sub_tiles",
    "gamba::raster::test_sub_tiles<Config>",
    {"params": RasterParams, "records": wp.array2d[wp.float32]},
    {"bits": wp.array[wp.int32]},
    constants("Config", PARTS=1) + native(_HEADER) + _SUB_TILES,
)


@pytest.mark.parametrize("longest", [3.0, 2000.0])
def test_no_sub_tile_is_missed(from_ptx, longest):
    """Ellipses from round to needles, in and around the tile, against every pixel in float64."""
    count = 4000
    means = torch.rand(count, 2) * 48 - 16
    angle = torch.rand(count) * torch.pi
    radii = 0.55 * (torch.rand(count, 2) * torch.log(torch.tensor(longest))).exp()
    c, s = angle.double().cos(), angle.double().sin()
    xx, yy = (radii.double() ** 2).unbind(1)
    cov = xx * c * c + yy * s * s, (xx - yy) * c * s, xx * s * s + yy * c * c
    conics = torch.stack([cov[2] / (xx * yy), -cov[1] / cov[2], 1 / cov[2]], 1).float()
    opacities = 0.01 + 0.98 * torch.rand(count)
    bits = torch.zeros(count, dtype=torch.int32)
    splats = Splats2D(means, conics, opacities, torch.rand(count, 3))
    params = raster_params(Size(16, 16, 1, True, 0), Limits(ALPHA_MIN, 1.0, 0.0), num=count)
    from_ptx()
    records = make_records(splats, params)
    launch(_test_sub_tiles, count, [params, records], [bits], bits.device)
    centre = torch.arange(16).double() + 0.5
    a, k, e = conics.double()[:, :, None, None].unbind(1)
    dy = centre[:, None] - means.double()[:, 1, None, None]
    u = centre - means.double()[:, 0, None, None] + k * dy
    falloff = (-0.5 * (a * u * u + e * dy * dy)).exp()
    inside = opacities.double()[:, None, None] * falloff >= ALPHA_MIN
    needed = inside.view(count, 4, 4, 2, 8).any(4).any(2).view(count, 8)
    got = (bits[:, None] >> torch.arange(8) & 1).bool()
    assert not (needed & ~got).any()
    assert 0.05 < needed.float().mean() < 0.8
    # no pixel centre need lie in an ellipse that touches a sub-tile, so some are kept in vain
    assert (got & ~needed).sum() < 0.2 * needed.sum()


@pytest.mark.gpu
@pytest.mark.parametrize("parts", [1, 2, 4])
def test_on_a_gpu(monkeypatch, parts):
    monkeypatch.setattr(composite_cuda, "parts_of_tile", lambda tiles, device: parts)
    scene = make(2, 3, num=300, width=75, height=53)
    want, _ = run(scene, "RGB+D")
    there = mapped(scene, torch.Tensor.cuda)
    results = [run(there, "RGB+D")[0] for _ in range(2)]
    for name, value in want.items():
        # the exponential is an approximation there; a few pixels cross the cut at alpha_min
        assert_rel_rms(results[0][name].cpu(), value, 1e-3, name)
        assert torch.equal(results[0][name], results[1][name]), name
