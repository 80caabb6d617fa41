"""Checks of the kernels on a device, for a machine that has torch and warp-lang only.

Each check compares a run with the float64 oracle or with another run. ``gamba gpu-check`` runs them
all.
"""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple
from unittest.mock import patch

import torch
from torch import Tensor

from ..kernels.bench import compare
from ..kernels.bench.cases.raster_scene import Scene, orbit_cameras, shell
from ..kernels.bench.cases.scan_problem import ScanProblem, make_inputs
from ..kernels.causal_conv1d import causal_conv1d
from ..kernels.causal_conv1d.reference import causal_conv1d_reference
from ..kernels.selective_scan.cuda import launch as cuda_scan
from ..kernels.selective_scan.cuda.launch import Tuning
from .graphs import captured, no_wait, raster_graph, same, step_graph, within

# Allowed relative rms errors. A GPU's exponential is off by up to 2^-22 a step, half precision
# rounds inputs and outputs, and a few pixels may cross the cut at the faintest alpha.
LIMIT, HALF_LIMIT, PICTURE_LIMIT = 1e-5, 3e-2, 1e-3
# Each is batch, tokens, channels, states and groups.
SCANS = [
    (2, 139, 37, 3, 1), (1, 65, 40, 3, 2), (1, 1, 1, 1, 1), (1, 577, 70, 16, 1),
    (2, 128, 64, 16, 1), (1, 67, 35, 17, 1), (1, 100, 20, 40, 1), (3, 64, 96, 16, 3),
    (1, 9, 3, 256, 1), (1, 1031, 129, 16, 1), (1, 66, 5, 64, 1), (2, 200, 33, 8, 1),
]  # fmt: skip
TUNINGS = [
    Tuning(segments=2, back_segments=3),
    Tuning(segments=7, channels=1, states=16, back_channels=1, back_states=8),
    Tuning(channels=4, states=4, back_segments=4, back_channels=4, back_states=4),
    Tuning(channels=1, states=4, back_channels=2, back_states=8, block=64),
]
# Each is batch, tokens, channels and taps.
CONVS = [(2, 300, 19, 4), (1, 1, 1, 2), (1, 33, 130, 3), (3, 257, 64, 4)]
# Each is Gaussians, side of the picture, views and options; tiles of few views are cut into parts.
RASTERS = [
    (300, 75, 3, {}), (1, 33, 1, {}), (2000, 130, 1, {"rasterize_mode": "antialiased"}),
    (700, 61, 40, {}), (500, 48, 2, {"quats": None}), (4000, 257, 12, {}),
]  # fmt: skip


class LeftOut(Exception):
    """Raised by a check that cannot be done here; ``str(error)`` says why."""


class Check(NamedTuple):
    """Something that must hold on a device.

    Attributes:
        name: title of the check.
        run: function of the device that returns the finding in words, or raises what is wrong.
        cuda: whether only a GPU can do the check.
    """

    name: str
    run: Callable[[torch.device], str]
    cuda: bool = False


def checks(quick: bool) -> Iterator[Check]:
    """Yields all checks, or a few of each kind if ``quick``."""
    few = 2 if quick else None
    for shape in SCANS[:few]:
        yield Check(f"scan {shape}", partial(_scan, shape, torch.float32))
    for shape in SCANS[: few and 1]:
        yield Check(f"scan {shape}, bfloat16", partial(_scan, shape, torch.bfloat16))
    for tuning in TUNINGS:
        text = ", ".join(f"{name} {value}" for name, value in tuning._asdict().items())
        yield Check(f"scan, {text}", partial(_tuned, tuning), cuda=True)
    for shape in CONVS[:few]:
        yield Check(f"convolution {shape}", partial(_conv, shape))
    for count, size, views, options in RASTERS[:few]:
        name = f"rasterizer, {count} Gaussians, {views} views of {size}²" + str(options or "")
        yield Check(name, partial(_raster, count, size, views, options))
    yield Check("scan: two runs, the same bits", _scan_twice)
    yield Check("rasterizer: two runs, the same bits", _raster_twice)
    yield Check("torch.compile, whole graph, AOTAutograd", partial(_compiled, "aot_eager"))
    yield Check("torch.compile, whole graph, inductor", partial(_compiled, "inductor"), cuda=True)
    yield Check("scan and convolution on a stream of their own", _side_stream, cuda=True)
    yield Check("scan and convolution in a CUDA graph", _graph, cuda=True)
    yield Check("rasterizer and a training step: no wait for the device", no_wait, cuda=True)
    yield Check("rasterizer and its gradients in a CUDA graph", raster_graph, cuda=True)
    yield Check("a whole training step in a CUDA graph", step_graph, cuda=True)


def _problem(shape: tuple, device: torch.device) -> ScanProblem:
    batch, length, channels, states, groups = shape
    inputs = make_inputs(batch, length, channels, states, groups)
    g = torch.Generator().manual_seed(2)
    state = torch.randn(batch, channels, states, generator=g)
    return ScanProblem(inputs, device, length, channels, state)


def _scan(shape: tuple, dtype: torch.dtype, device: torch.device) -> str:
    """Checks the output and all gradients, from a given first state."""
    error = _problem(shape, device).check_backward(dtype)
    return within(error, LIMIT if dtype == torch.float32 else HALF_LIMIT)


def _tuned(tuning: Tuning, device: torch.device) -> str:
    with patch.object(cuda_scan, "FORCED", tuning):
        return _scan(SCANS[3], torch.float32, device)


def _scan_twice(device: torch.device) -> str:
    problem = _problem((2, 577, 70, 16, 1), device)
    for dtype in (torch.float32, torch.bfloat16):
        same(problem.backward(dtype), problem.backward(dtype))
    return "equal"


def _conv(shape: tuple, device: torch.device) -> str:
    """Checks the output and all gradients, from given first tokens."""
    batch, length, channels, taps = shape
    g = torch.Generator().manual_seed(0)
    sizes = {"x": (batch, length, channels), "weight": (channels, taps), "bias": (channels,)}
    sizes["initial_state"] = (batch, taps - 1, channels)
    inputs = {name: torch.randn(*size, generator=g) for name, size in sizes.items()}
    cotangent = torch.randn(*sizes["x"], generator=g)
    mine: dict[str, Any] = {k: x.to(device).requires_grad_() for k, x in inputs.items()}
    exact = {name: x.double().requires_grad_() for name, x in inputs.items()}
    out = causal_conv1d(**mine, activation="silu")
    want, _ = causal_conv1d_reference(**exact, activation="silu")
    grads = torch.autograd.grad(out, list(mine.values()), cotangent.to(device))
    wants = torch.autograd.grad(want, list(exact.values()), cotangent.double())
    got = {"out": out} | dict(zip(mine, grads))
    return within(compare(got, {"out": want} | dict(zip(exact, wants))), LIMIT)


def _scene(count: int, size: int, views: int, options: dict, device: torch.device) -> Scene:
    gaussians: dict[str, Any] = {**shell(count, scale=3.0)}
    if "quats" in options:
        gaussians["quats"] = None
    rest = {name: value for name, value in options.items() if name != "quats"}
    return Scene(gaussians, *orbit_cameras(views, size), size, device, rest)


def _raster(count: int, size: int, views: int, options: dict, device: torch.device) -> str:
    """Checks picture, alphas and all gradients on a crop of the first view."""
    scene = _scene(count, size, views, options, device)
    picture, alphas, _ = scene.forward()
    if not (picture.isfinite().all() and alphas.max() <= 1):
        raise AssertionError("the picture is not finite, or alpha is over 1")
    return within(scene.check(backward=True), PICTURE_LIMIT)


def _raster_twice(device: torch.device) -> str:
    scene = _scene(700, 75, 3, {}, device)
    same(scene.forward()[:2], scene.forward()[:2])
    same(scene.backward(), scene.backward())
    return "equal"


def _layer(problem: ScanProblem) -> tuple[Callable[..., Tensor], list[Tensor]]:
    """Makes a layer of convolution and scan, and its inputs on the device."""
    inputs = problem.at(torch.float32)
    weight = torch.linspace(-0.5, 0.5, 4 * inputs["u"].shape[2], device=problem.device)

    def layer(u: Tensor, weight: Tensor) -> Tensor:
        u = causal_conv1d(u, weight, activation="silu")
        return problem.call({**inputs, "u": u})  # torch 2.6 compiles no "|" of two dicts

    return layer, [inputs["u"], weight.view(-1, 4)]


def _compiled(backend: str, device: torch.device) -> str:
    if backend == "inductor":
        if importlib.util.find_spec("triton") is None:
            raise LeftOut("triton is not installed")
        if not any(map(shutil.which, ("cc", "gcc", "clang"))):
            raise LeftOut("triton needs a C compiler, and there is none")
    layer, inputs = _layer(_problem((1, 139, 37, 16, 1), device))
    results = []
    for function in (layer, torch.compile(layer, fullgraph=True, backend=backend)):
        leaves = [x.detach().clone().requires_grad_() for x in inputs]
        out = function(*leaves)
        results.append({"out": out} | dict(zip("uw", torch.autograd.grad(out.sum(), leaves))))
    return within(compare(results[1], results[0]), 1e-6)


def _side_stream(device: torch.device) -> str:
    layer, inputs = _layer(_problem((1, 577, 70, 16, 1), device))
    want = layer(*inputs)
    stream = torch.cuda.Stream(device)
    torch.cuda.synchronize(device)
    with torch.cuda.stream(stream):
        big = torch.randn(4096, 4096, device=device)
        for _ in range(8):  # whatever is launched on another stream would come too early
            big = big @ big * 1e-3
        out = layer(*(x + 0 * big[0, 0].nan_to_num(0.0, 0.0, 0.0) for x in inputs))
    stream.synchronize()
    same((out,), (want,))
    return "equal"


def _graph(device: torch.device) -> str:
    """Checks that a replay gives the bits of a plain run, also with inputs changed meanwhile."""
    layer, inputs = _layer(_problem((1, 577, 70, 16, 1), device))
    with torch.no_grad():
        graph, out = captured(lambda: layer(*inputs), device)
        for scale in (1.0, 0.5):
            inputs[0].mul_(scale)
            out.fill_(torch.nan)
            graph.replay()
            torch.cuda.synchronize(device)
            same((out,), (layer(*inputs),))
    return "equal"
