"""The operators on a GPU: errors, ``torch.compile``, streams and CUDA graphs."""

import shutil

import pytest
import torch

from gpu import checks

DEVICE = torch.device("cuda")


@pytest.mark.gpu
@pytest.mark.parametrize("check", checks.EACH, ids=lambda x: f"{x.func.__name__} {x.args}")
def test_an_operator(check):
    check(device=DEVICE)


@pytest.mark.gpu
@pytest.mark.parametrize("backend", ["aot_eager", "inductor"])
def test_compile(backend):
    if backend == "inductor":
        pytest.importorskip("triton")
        if not any(map(shutil.which, ("cc", "gcc", "clang"))):
            pytest.skip("triton needs a C compiler")
    checks.check_compiled(backend, DEVICE)


@pytest.mark.gpu
@pytest.mark.parametrize(
    "check",
    [checks.check_side_stream, checks.check_layer_graph, checks.check_raster_graph],
)
def test_streams_and_graphs(check):
    check(DEVICE)


@pytest.mark.gpu
def test_a_training_step():
    for name in ("msgspec", "tyro"):
        pytest.importorskip(name)
    checks.check_step_graph(DEVICE)
