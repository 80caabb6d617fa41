"""A fixture of the rasterizer's tests: its CUDA path, executed from PTX."""

import pytest

from gamba_warp.kernels.rasterize.cuda import capacity
from gamba_warp.kernels.rasterize.cuda import composite as composite_cuda


@pytest.fixture
def on_cuda(monkeypatch, from_ptx):
    """Called, has calls from there on made on CUDA, tiles cut into ``parts``; no shape is known."""

    def switch(parts=1):
        monkeypatch.setattr(composite_cuda, "parts_of_tile", lambda tiles, device: parts)
        from_ptx()

    capacity.clear()
    yield switch
    capacity.clear()
