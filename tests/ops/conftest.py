"""A fixture of the operators' tests: both devices, of which CUDA is executed from PTX."""

import pytest


@pytest.fixture(params=["cpu", "ptx"])
def each_device(request, from_ptx):
    """Run a test by the CPU's kernels, and by those of CUDA, executed from PTX."""
    if request.param == "ptx":
        from_ptx()
