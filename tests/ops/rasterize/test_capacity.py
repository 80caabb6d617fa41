"""Lengths of the lists on CUDA, executed from PTX: exact, and with the capacity of a graph."""

import pytest
import torch
from helpers.kernels import Watch
from helpers.raster import NAMES, crowded, drawn, leaves, make

from gamba_warp.kernels import rasterize
from gamba_warp.kernels.rasterize import depth_quantile, lists_outgrown, rasterization
from gamba_warp.kernels.rasterize.cuda import capacity


def render(scene, mode="RGB"):
    """Images, gradients and depth quantiles by name, and meta."""
    found, meta = drawn(scene, mode)
    return found | {"depths": depth_quantile(meta)}, meta


@pytest.fixture
def capturing(monkeypatch):
    """Function after which calls take a graph's capacity."""
    return lambda: monkeypatch.setattr(capacity, "is_capturing", lambda device: True)


@pytest.mark.parametrize("channels, mode, parts", [(3, "RGB", 1), (6, "RGB+ED", 2)])
def test_a_capacity_changes_no_bits(on_cuda, capturing, channels, mode, parts):
    scene = crowded(channels)
    scene["opacities"][:, 1::9] = 0.001  # culled
    on_cuda(parts)
    want, meta = render(scene, mode)
    assert meta["pairs"] == meta.bins.pairs.numel() > 180
    capturing()
    got, meta = render(scene, mode)
    assert meta["pairs"] < meta.bins.pairs.numel() and not lists_outgrown()
    for name, value in want.items():
        assert torch.equal(got[name], value), name


def test_too_many_pairs_for_a_graph(on_cuda, capturing):
    """The images are NaN, and the next capture has the capacity."""
    scene = crowded()
    on_cuda()
    rasterization(**scene | {"scales": scene["scales"] / 4})
    capturing()
    renders, alphas, meta = rasterization(**scene)
    assert meta.bins.pairs.numel() < meta["pairs"]
    assert renders.isnan().all() and alphas.isnan().all() and lists_outgrown()
    rasterize.forget_graphs()
    renders, alphas, _ = rasterization(**scene)
    assert renders.isfinite().all() and alphas.isfinite().all() and not lists_outgrown()


def test_a_call_waits_once_and_a_graph_never(on_cuda, capturing):
    tensors = leaves(crowded(6), torch.float32)
    on_cuda()

    def waits():
        with Watch() as watch:
            renders, alphas, meta = rasterization(**tensors, render_mode="RGB+ED")
            depth_quantile(meta)
            (renders.sum() + alphas.sum()).backward()
        assert len(watch.names) > 20
        return watch.found

    assert len(waits()) == len(waits()) == 1
    capturing()
    assert waits() == []


def test_a_graph_needs_a_call_before_it(on_cuda, capturing):
    on_cuda()
    rasterization(**crowded(num=80))
    capturing()
    with pytest.raises(RuntimeError, match="never rendered"):
        rasterization(**crowded())


def test_old_shapes_are_forgotten(monkeypatch):
    monkeypatch.setattr(capacity, "_SLOTS", 3)
    monkeypatch.setattr(capacity, "_counts", {})
    cpu = torch.device("cpu")
    for count, key in enumerate("abcdeb"):
        capacity.note_count(key, cpu, count)
    assert {k: v.slot for k, v in capacity._counts[cpu].shapes.items()} == {"d": 0, "e": 1, "b": 2}
    assert capacity.graph_capacity("b", torch.tensor([7])) == 7
    assert lists_outgrown() is False
    with pytest.raises(RuntimeError, match="never rendered"):
        capacity.graph_capacity("a", torch.tensor([7]))


@pytest.mark.usefixtures("each_device")
@pytest.mark.parametrize("num, views, far", [(0, 2, False), (5, 0, False), (20, 2, True)])
def test_nothing_to_see(num, views, far):
    """No Gaussian, no view, or none that is seen: the background alone, and no gradient."""
    scene = make(1, views, num=num, width=21, height=19)
    if far:
        scene["means"] += 1000.0
    result, meta = render(scene)
    assert result["alphas"].shape == (1, views, 19, 21, 1) and not result["alphas"].any()
    ground = scene["backgrounds"][:, :, None, None].expand_as(result["renders"])
    assert torch.equal(result["renders"], ground)
    assert not any(result[name].any() for name in NAMES[:5])
    assert meta["pairs"] == meta["pairs_used"] == meta["pairs_traversed"] == 0
    assert meta["tiles_empty"] == meta["tiles"] == 4 * views
    assert sum(meta["culled"].values()) == num * views
