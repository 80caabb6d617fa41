"""Tests of minutes, for ``make ptx``: the shapes of tests/gpu, the paper's, strides near 2^31.

Run by ``-p ptx.plugin``, which executes all of it from PTX and reports what is found.
"""

import contextlib

import pytest
import torch
from gpu import checks
from helpers import assert_rel_rms
from helpers import raster as rasters
from helpers import scan as scans
from helpers.kernels import conv_inputs

from gamba_warp.kernels.causal_conv1d import causal_conv1d
from gamba_warp.kernels.rasterize import rasterization
from gamba_warp.kernels.selective_scan import selective_scan
from gamba_warp.kernels.selective_scan.cuda import launch as scan_cuda
from gamba_warp.kernels.selective_scan.cuda.launch import Tuning

from .simulated import not_simulated

HALF = 4e-3  # of numbers of 8 bits
CPU = torch.device("cpu")


@pytest.mark.parametrize("check", checks.EACH, ids=lambda x: f"{x.func.__name__} {x.args}")
def test_an_operator(check):
    check(device=CPU)


@pytest.mark.parametrize("tuning", checks.TUNINGS)
def test_tunings(monkeypatch, tuning):
    monkeypatch.setattr(scan_cuda, "choose", lambda *_: tuning)
    checks.check_scan(checks.SCANS[3], torch.float32, CPU)


def on_both(function, inputs, cotangents):
    """Results of the inputs and all gradients, by name, from PTX and by the CPU's kernels."""
    for device in (contextlib.nullcontext, not_simulated):
        mine = scans.leaves(inputs)
        with device():
            outs = function(**mine)
            grads = torch.autograd.grad(outs, [*mine.values()], cotangents)
        yield dict(enumerate(outs)) | dict(zip(mine, grads))


def few(name, x):
    """The first channels of a tensor of the scan; B and C have none."""
    dim = {"B": None, "C": None, "A": 0, "initial_state": 1}.get(name, -1)
    return x if dim is None else x.narrow(dim, 0, 8)


def test_the_papers_scan():
    def scan(**x):
        return [selective_scan(**x, delta_softplus=True)]

    def exact(**x):
        return scans.oracle(**x, delta_softplus=True)[:1]

    inputs = scans.make(1, 16_961, 1024, 16, dtype=torch.bfloat16)
    cotangents = [torch.randn_like(inputs["u"])]
    # what approximate units may add takes float64 long, and is asked of a few channels
    of_few = {k: few(k, x) for k, x in inputs.items()}
    more = scans.device_errors(exact, of_few, [few("u", cotangents[0]).double()], names=(0,))
    got, want = on_both(scan, inputs, cotangents)
    for name, x in got.items():
        limit = scans.GRADIENT if x.dtype == torch.float32 else HALF
        pair = [few(name, y) if more[name] else y for y in (x, want[name])]
        assert_rel_rms(*pair, limit + more[name], str(name))


def test_the_papers_image():
    scene = rasters.make(1, 1, num=16_384, width=512, height=512, size=0.02)
    rest = {k: scene.pop(k) for k in ("Ks", "width", "height")}

    def image(**x):
        return rasterization(**x, **rest)[:2]

    with not_simulated():
        renders, alphas = image(**scene)
    # where a Gaussian is at its faintest to within rounding, a pixel may have it or not
    alike = (image(**scene)[0] - renders).abs().amax(-1, keepdim=True) < rasters.IMAGE
    assert alike.float().mean() > 0.999
    got, want = on_both(image, scene, [torch.randn_like(x) * alike for x in (renders, alphas)])
    for name, x in got.items():
        x, y = (x * alike, want[name] * alike) if isinstance(name, int) else (x, want[name])
        assert_rel_rms(x, y, rasters.GRADIENT if name else rasters.IMAGE, str(name))


def far(x, dim, path):
    """A copy with a stride just below 2^31 bytes in a dimension, in a file that is mostly holes."""
    stride = ((1 << 31) - 256) // x.element_size()
    strides = [*x.stride()]
    strides[dim] = stride
    strides[:dim] = [1] * dim  # of length 1
    size = 1 + sum((n - 1) * s for n, s in zip(x.shape, strides))
    with open(path, "wb") as file:
        file.truncate(size * x.element_size())
    flat = torch.from_file(str(path), shared=True, size=size, dtype=x.dtype)
    path.unlink()
    return flat.as_strided(x.shape, strides).copy_(x)


@pytest.mark.parametrize("segments", [1, 2])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize(("dim", "shape"), [(0, (4, 70, 37)), (1, (1, 6, 37))])
def test_strides_near_the_limit(monkeypatch, tmp_path, dim, shape, dtype, segments):
    """The bits are those of dense tensors, and nothing beside the tensors is touched."""
    tuning = Tuning(segments=segments, back_segments=segments)
    monkeypatch.setattr(scan_cuda, "choose", lambda *_: tuning)
    cotangent = torch.randn(shape).to(dtype)
    cases = (
        (lambda x: selective_scan(**x, delta_softplus=True), scans.make(*shape, 3, dtype=dtype)),
        (lambda x: causal_conv1d(**x, activation="silu"), conv_inputs(*shape, 4, dtype)),
    )
    for function, inputs in cases:
        results = []
        for place in (lambda name, x: x, lambda name, x: far(x, dim, tmp_path / name)):
            mine = scans.leaves(inputs)
            for name in {"u", "delta", "z", "B", "C", "x"} & mine.keys():
                mine[name] = place(name, mine[name].detach()).requires_grad_()
            out = function(mine)
            grads = torch.autograd.grad(out, [*mine.values()], place("cotangent", cotangent))
            results.append([out, *grads])
        assert all(map(torch.equal, *results))
