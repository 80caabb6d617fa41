"""The CPU's tile lists, sorted by view or tile by tile, and the kernels that go with them."""

import pytest
import torch
from helpers import on_threads
from helpers.raster import drawn, make

from gamba_warp.kernels.rasterize import Skip, autograd, rasterization
from gamba_warp.kernels.rasterize.cpu import bin as bin_cpu
from gamba_warp.kernels.rasterize.cuda import bin as bin_cuda
from gamba_warp.kernels.rasterize.projection import LANES, Projected
from gamba_warp.kernels.rasterize.skip import TILE_TEST
from gamba_warp.kernels.rasterize.tiles import Tiling, make_grid

LISTS = ("pairs", "starts")


def call(scene, **options):
    """Results of ``drawn``, with the gradient of the lower half alone."""

    def without_upper(v):
        v[0][..., : v[0].shape[-3] // 2, :, :] = 0

    return drawn(scene, edit=without_upper, **options)


def assert_same(want, got):
    for name, value in want[0].items():
        assert torch.equal(got[0][name], value), name
    for name in LISTS:
        assert torch.equal(getattr(got[1].bins, name), getattr(want[1].bins, name)), name


def assert_lists(monkeypatch, scene, **options):
    """Lists sorted before they are written or after are those of CUDA's scalar kernels."""
    with monkeypatch.context() as patch:
        patch.setattr(autograd, "_bin_views", lambda device: bin_cuda.bin_views)
        want = call(scene, **options)
    for many in (1 << 30, 0):
        monkeypatch.setattr(bin_cpu, "MANY", many)
        assert_same(want, call(scene, **options))
    return want[1]


@pytest.mark.parametrize("size", [0.004, 0.03, 0.5])  # from a pixel to most rows of tiles
@pytest.mark.parametrize("shape", [(33, 41), (300, 17), (19, 600)])
def test_same_lists_images_and_gradients(monkeypatch, size, shape):
    scene = make(2, 2, 333, *shape, size=size)
    scene["opacities"][0, :50] = 1e-3  # culled
    scene["means"][1, :50, 2] = torch.nan
    assert assert_lists(monkeypatch, scene)["pairs"] > 100


@pytest.mark.parametrize("options", [{"skip": Skip(tile_test=False)}, {"mode": "RGB+ED"}])
def test_same_with_options(monkeypatch, options):
    assert_lists(monkeypatch, make(1, 2, 200, 50, 70), **options)


def test_lists_of_a_wide_image():
    """CUDA keeps columns in 16 bits where they have room, and finds them again elsewhere."""
    num, width, height = 60, (1 << 19) + 100, 200
    sides = torch.tensor([3e5, 60.0]) * torch.rand(1, num, 2)  # of the box, at alpha_min
    opacities = 0.1 + 0.9 * torch.rand(1, num)
    a, e = (2 * (255 * opacities).log()[..., None] / sides**2).unbind(-1)
    means2d = torch.rand(1, num, 2) * torch.tensor([width, height])
    conics = torch.stack([a, torch.zeros(1, num), e], -1)
    splats = Projected(means2d, conics, torch.rand(1, num), opacities, sides)
    grid = make_grid(Tiling(width, height), num=num, alpha_min=1 / 255, skip=TILE_TEST)
    want = bin_cpu.bin_views(grid, splats, lambda count: None)
    got = bin_cuda.bin_views(grid, splats, lambda count: None)
    assert want.count == got.count > 32768
    for name in LISTS:
        assert torch.equal(getattr(got, name), getattr(want, name)), name


def test_lists_are_in_order_of_depth_then_of_index(monkeypatch):
    """Lists of a few pairs and of thousands take different ways; many depths are equal."""
    monkeypatch.setattr(bin_cpu, "MANY", 0)
    num = 7001
    scene = make(1, 1, num, 40, 40, size=0.01)
    scene["means"] = scene["means"].mul(20).round().div(20)  # stacked at a few places
    scene["viewmats"][:] = torch.eye(4)
    scene["viewmats"][..., 2, 3] = 2.0
    meta = rasterization(**scene)[2]
    bins, depths = meta.bins, meta["depths"].flatten()
    lengths = bins.starts.diff()
    assert (lengths.max() > 1500) & ((lengths > 0) & (lengths <= 24)).any()
    tile = torch.arange(len(lengths)).repeat_interleave(lengths)
    key = depths[bins.pairs.long()].double()
    same = tile[1:] == tile[:-1]
    rises = (key.diff() > 0) | ((key.diff() == 0) & (bins.pairs.diff() > 0))
    assert rises[same].all()
    assert (key.diff() == 0)[same].float().mean() > 0.5


@pytest.mark.parametrize("many", [0, 1 << 30])
def test_repeatable_with_any_number_of_threads(monkeypatch, many):
    monkeypatch.setattr(bin_cpu, "MANY", many)
    scene = make(2, 3, 400, 90, 61)
    want = call(scene, mode="RGB+ED")
    for threads in (1, 2, 2, 5):
        with on_threads(threads):
            assert_same(want, call(scene, mode="RGB+ED"))


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("rotated, unused", [(True, True), (False, True), (True, False)])
def test_gradient_of_the_projection_on_lanes(monkeypatch, rotated, unused, mode):
    """To the bit that on threads, also by viewmats."""
    scene = make(2, 3, 331, 45, 60, size=0.03)
    scene["means"][0, :40] *= 6  # beside the image, where the slopes are clamped, or behind
    scene["means"][1, :9, 0] = torch.nan
    scene["quats"][0, 50:60] = 0
    scene["quats"][1, 50:90] *= 1e20
    if not rotated:
        scene["quats"] = None
    scene["skip"] = Skip(unused=unused)
    made = []
    for lanes in (LANES["cpu"], LANES["cuda"]):
        monkeypatch.setitem(LANES, "cpu", lanes)
        made.append(drawn(scene, "RGB+ED", rasterize_mode=mode)[0])
    assert torch.equal(made[1]["viewmats"], made[0]["viewmats"])
    assert (made[0]["viewmats"] != 0).any()
    for name in ("means", "scales", "opacities", *(["quats"] if rotated else [])):
        assert torch.equal(made[1][name], made[0][name]), name
        assert (made[0][name] != 0).any(-1).float().mean() > 0.2, name
