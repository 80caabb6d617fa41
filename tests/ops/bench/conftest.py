"""Every benchmark of these tests has three rounds."""

import pytest
import torch

from gamba_warp.kernels.bench.measure import LEVELS, Level


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """Three rounds of everything; torch's threads as before."""
    monkeypatch.setitem(LEVELS, "quick", Level(0.0, 3, 3))
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)
