"""What the rasterizer's tests share: fixtures of others, and the CUDA kernels on CPU blocks."""

from functools import partial

import pytest
import torch
import warp as wp
from helpers.raster_accuracy import cuts

from gamba_warp.kernels.rasterize import ops
from gamba_warp.kernels.rasterize.cuda import bin as bin_cuda
from gamba_warp.kernels.rasterize.cuda import capacity
from gamba_warp.kernels.rasterize.cuda import composite as composite_cuda

__all__ = ["cuts", "on_blocks"]


@pytest.fixture
def on_blocks(monkeypatch):
    """CUDA's compositor in place of the CPU's, with real blocks and memory full of NaN.

    With ``lists`` also CUDA's lists, of which nothing is known yet.
    """
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)

    def switch(parts=1, lists=False):
        if lists:
            monkeypatch.setattr(
                ops, "_bin_views", lambda device, exact: partial(bin_cuda.bin_views, exact=exact)
            )
        monkeypatch.setattr(ops, "_compositor", lambda device: composite_cuda)
        monkeypatch.setattr(composite_cuda, "parts_of_tile", lambda tiles, device: parts)
        new_empty = torch.Tensor.new_empty

        def poisoned(tensor, *shape, **options):
            x = new_empty(tensor, *shape, **options)
            return x.fill_(torch.nan) if x.is_floating_point() else x.fill_(77)

        monkeypatch.setattr(torch.Tensor, "new_empty", poisoned)

    capacity.forget()
    yield switch
    capacity.forget()
