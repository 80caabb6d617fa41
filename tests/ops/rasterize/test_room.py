"""Lists with room on CUDA, executed from PTX: no wait for counts, the same bits without room."""

import pytest
import torch
from helpers import raster
from helpers.kernels import Watch
from helpers.raster import leaves, make

from gamba_warp.kernels.rasterize import Skip, depth_quantile, lists_outgrown, rasterization
from gamba_warp.kernels.rasterize.cuda import capacity

CPU = torch.device("cpu")
READ_BACK = {"aten::item", "aten::_local_scalar_dense"}
COUNTS = (
    *("pairs", "pairs_box", "pairs_traversed", "pairs_used", "blocks_traversed", "blocks_used"),
    *("gaussians_used", "tiles", "tiles_empty", "tiles_skipped"),
)


def crowded(channels=3, num=90):
    """As the helper's, and some Gaussians are culled."""
    scene = raster.crowded(channels, num)
    scene["opacities"][:, 1::9] = 0.001
    return scene


def the_room():
    """Return the capacity of the one shape that was rendered."""
    (room,) = capacity._counts[CPU].shapes.values()
    return room


def without_room():
    """Leaves the next call the least room that a call may have."""
    room = the_room()
    capacity._counts[CPU].on_host.numpy()[room.slot] = 0
    room.pairs = 0


def render(scene, mode="RGB", **options):
    """Pictures, gradients and depth quantiles by name, and meta."""
    g = torch.Generator().manual_seed(5)
    tensors = leaves(scene, torch.float32)
    renders, alphas, meta = rasterization(**tensors, render_mode=mode, **options)
    v_renders, v_alphas = (torch.randn(x.shape, generator=g) for x in (renders, alphas))
    v_renders[..., :16, :16, :] = v_alphas[..., :16, :16, :] = 0  # a tile without gradient
    wanted = {k: v for k, v in tensors.items() if getattr(v, "requires_grad", False)}
    grads = torch.autograd.grad([renders, alphas], [*wanted.values()], [v_renders, v_alphas])
    depths = depth_quantile(meta)
    return {"renders": renders, "alphas": alphas, "depths": depths} | dict(zip(wanted, grads)), meta


@pytest.mark.parametrize(
    "channels, mode, parts, skip",
    [
        (3, "RGB", 1, True),
        (6, "RGB+ED", 2, True),  # two chunks of channels
        (3, "RGB", 4, True),
        (1, "RGB", 1, False),
    ],
)
def test_without_room_the_bits_are_the_same(on_cuda, channels, mode, parts, skip):
    scene = crowded(channels)
    options = {} if skip else {"skip": Skip.from_bits(0)}
    lanes, _ = render(scene, mode, **options)
    on_cuda(parts)
    want, meta = render(scene, mode, **options)
    listed = meta.bins.pairs.numel()
    assert listed > meta["pairs"] > 180  # the lists had room, and had to have it
    without_room()
    got, without = render(scene, mode, **options)
    assert without.bins.pairs.numel() == 180 and not without.bins.starts.any()
    for name, value in want.items():
        assert torch.equal(got[name], value), name
        scale = lanes[name].abs().max()
        assert (value - lanes[name]).abs().max() <= 3e-5 * scale, name  # sums in another order
    assert {k: without[k] for k in COUNTS} == {k: meta[k] for k in COUNTS}
    assert without.bins.pairs.numel() == meta["pairs"]  # made once more for the counts


@pytest.mark.parametrize("channels", [3, 6])
def test_absolute_gradients_without_room(monkeypatch, on_cuda, channels):
    scene = crowded(channels)
    found = raster.absolute_gradients(monkeypatch)
    on_cuda(2)
    render(scene)
    without_room()
    _, meta = render(scene)
    assert not meta.bins.starts.any() and found[0].any() and torch.equal(*found)


def test_colours_alone_without_room(on_cuda):
    """Another kernel, without moments."""
    scene = {k: v for k, v in crowded().items() if k != "backgrounds"}
    on_cuda(2)
    results = []
    for _ in range(2):
        colors = scene["colors"].clone().requires_grad_()
        renders, _, meta = rasterization(**scene | {"colors": colors})
        results.append((renders, *torch.autograd.grad(renders.square().sum(), colors)))
        without_room()
    assert not meta.bins.starts.any() and results[0][1].any()
    assert all(torch.equal(a, b) for a, b in zip(*results))


def test_room_grows_with_what_was_told(on_cuda):
    """A scene that grows has no room once; then it has."""
    scene = crowded()
    on_cuda()
    render(scene)
    first = the_room().pairs
    scene["scales"] = scene["scales"] * 4
    listed = []
    for _ in range(3):
        _, meta = render(scene)
        listed.append(int(meta.bins.count) <= meta.bins.pairs.numel())
        pairs = int(meta.bins.count)
    assert listed == [False, True, True]
    assert first < pairs < the_room().pairs <= 1.75 * pairs


def test_room_shrinks_slowly():
    capacity.clear()
    room = capacity.add_shape("shape", CPU, 100_000)
    assert 150_000 <= room.pairs <= 165_000
    sizes = []
    for _ in range(400):
        capacity.add_count(room, torch.tensor([1000]))
        sizes.append(capacity.find("shape", CPU).pairs)
    assert sizes[44] == sizes[0] and sizes == sorted(sizes, reverse=True)
    assert 1500 <= sizes[-1] < 10_000
    capacity.add_count(room, torch.tensor([2_000_000_000]))
    assert capacity.find("shape", CPU).pairs == 2**31 - 1
    capacity.add_count(room, torch.tensor([1000]))
    room.pairs = sizes[-1]
    capacity.add_count(room, torch.tensor([3_000_000_000]))  # no list holds so many
    assert capacity.find("shape", CPU).pairs == sizes[-1]
    assert capacity.find("another shape", CPU) is None
    capacity.clear()


def test_about_as_many_gaussians_share_their_room(on_cuda):
    """A model of pictures gives another number each time; each would be read back else."""
    on_cuda()
    rasterization(**crowded(num=90))
    for num, read in ((95, 0), (96, 0), (97, 1)):
        scene = crowded(num=num)
        with Watch() as watch:
            rasterization(**scene)
        assert len(watch.found) == read


def test_old_shapes_are_forgotten(monkeypatch):
    monkeypatch.setattr(capacity, "_SLOTS", 3)
    monkeypatch.setattr(capacity, "_counts", {})
    places = [capacity.add_shape(i, CPU, 10).slot for i in range(5)]
    assert places == [0, 1, 2, 0, 1]
    assert [capacity.find(i, CPU) is None for i in range(5)] == [True, True, False, False, False]


@pytest.mark.parametrize("num, views, far", [(0, 2, False), (5, 0, False), (20, 2, True)])
def test_nothing_to_see(on_cuda, num, views, far):
    """No Gaussian, no view, or none that is seen, as a first and as a second call."""
    scene = make(1, views, num=num, width=21, height=19)
    if far:
        scene["means"] += 1000.0
    on_cuda(2)
    for _ in range(2):
        result, meta = render(scene)
        assert not result["alphas"].any() and not result["means"].any()
        assert result["alphas"].shape == (1, views, 19, 21, 1)
        assert meta["pairs"] == 0 and meta["pairs_used"] == 0
        assert meta["tiles_empty"] == meta["tiles"] == 4 * views


def test_a_first_scene_may_be_empty(on_cuda):
    """Then the second has no room, and its picture is right."""
    scene = crowded()
    on_cuda()
    want, _ = render(scene)
    capacity.clear()
    rasterization(**scene | {"means": scene["means"] + 1000.0})
    got, meta = render(scene)
    assert meta.bins.pairs.numel() == 180 < int(meta.bins.count)
    assert all(torch.equal(got[name], value) for name, value in want.items())


def test_no_call_but_the_first_reads_a_number_back(on_cuda):
    scene = crowded(6)
    tensors = leaves(scene, torch.float32)
    on_cuda()

    def call():
        renders, alphas, meta = rasterization(**tensors, render_mode="RGB+ED")
        depth_quantile(meta)
        (renders.sum() + alphas.sum()).backward()
        return meta

    for read in (1, 0, 0):
        with Watch() as watch:
            meta = call()
        assert len(watch.found) == read and len(watch.names) > 20
        assert {*watch.found} <= READ_BACK
    without_room()
    with Watch() as watch:
        meta = call()
    assert watch.found == []
    with Watch() as watch:
        assert meta["pairs"] > 0
    assert len(watch.found) == 1 and {*watch.found} <= READ_BACK


def test_a_graph_needs_a_call_before_it(on_cuda, monkeypatch):
    scene = crowded()
    on_cuda()
    monkeypatch.setattr(capacity, "is_capturing", lambda device: True)
    with pytest.raises(RuntimeError, match="never rendered"):
        rasterization(**scene)


def test_a_graph_is_told_to_be_too_small(on_cuda, monkeypatch):
    """A capture keeps its room; ``lists_outgrown`` says when replays need more."""
    scene = crowded()
    on_cuda()
    rasterization(**scene)
    assert not lists_outgrown()
    with monkeypatch.context() as capture:
        capture.setattr(capacity, "is_capturing", lambda device: True)
        rasterization(**scene)
    assert not lists_outgrown()
    room = the_room()
    capacity.add_count(room, torch.tensor([room.in_graph + 1]))
    assert lists_outgrown()
