"""Lengths of the lists on CUDA, executed from PTX: exact, and with the capacity of a graph."""

import pytest
import torch
from helpers.kernels import Watch
from helpers.raster import crowded, leaves, make

from gamba_warp.kernels.rasterize import (
    depth_quantile,
    forget_graphs,
    lists_outgrown,
    rasterization,
)
from gamba_warp.kernels.rasterize.cuda import capacity


def render(scene, mode="RGB", **options):
    """Images, gradients and depth quantiles by name, and meta."""
    g = torch.Generator().manual_seed(5)
    tensors = leaves(scene, torch.float32)
    renders, alphas, meta = rasterization(**tensors, render_mode=mode, **options)
    v_renders, v_alphas = (torch.randn(x.shape, generator=g) for x in (renders, alphas))
    wanted = {k: v for k, v in tensors.items() if getattr(v, "requires_grad", False)}
    grads = torch.autograd.grad([renders, alphas], [*wanted.values()], [v_renders, v_alphas])
    depths = depth_quantile(meta)
    return {"renders": renders, "alphas": alphas, "depths": depths} | dict(zip(wanted, grads)), meta


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
    forget_graphs()
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


@pytest.mark.parametrize("num, views, far", [(0, 2, False), (5, 0, False), (20, 2, True)])
def test_nothing_to_see(on_cuda, num, views, far):
    """No Gaussian, no view, or none that is seen."""
    scene = make(1, views, num=num, width=21, height=19)
    if far:
        scene["means"] += 1000.0
    on_cuda(2)
    result, meta = render(scene)
    assert not result["alphas"].any() and not result["means"].any()
    assert result["alphas"].shape == (1, views, 19, 21, 1)
    assert meta["pairs"] == 0 and meta["pairs_used"] == 0
    assert meta["tiles_empty"] == meta["tiles"] == 4 * views
