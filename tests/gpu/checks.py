"""Checks of the operators on a device: against float64, or against another run.

The tests marked ``gpu`` run them on a GPU; ``tests/ptx`` runs the first three on the CUDA kernels'
PTX, and ``tests/graphs`` those of CUDA graphs with a graph that runs its function on a CPU.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from helpers.scan import allowances
from torch import Tensor

from gamba_warp.kernels.cases.case import BOTH, Case, Error, compare, wanted
from gamba_warp.kernels.cases.conv import conv_case
from gamba_warp.kernels.cases.raster import orbit_cameras, raster_case, shell
from gamba_warp.kernels.cases.scan import make_inputs, scan_case
from gamba_warp.kernels.causal_conv1d import causal_conv1d
from gamba_warp.kernels.rasterize import lists_outgrown
from gamba_warp.kernels.runtime import gpu
from gamba_warp.kernels.selective_scan.cuda.launch import Tuning
from gamba_warp.measure.models import captured

# Allowed relative rms errors: of float32 sums over a few hundred terms; for the scan plus the error
# of a GPU's exponential; of half precision, which rounds inputs and outputs; and of images, where
# a few pixels may cross the threshold of alpha.
LIMIT, HALF_LIMIT, IMAGE_LIMIT = 2e-6, 3e-2, 1e-3
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
# Each is Gaussians, side of the image, views and options; tiles of few views are cut into parts.
RASTERS = [
    (300, 75, 3, {}), (1, 33, 1, {}), (2000, 130, 1, {"rasterize_mode": "antialiased"}),
    (700, 61, 40, {}), (500, 48, 2, {"quats": None}), (4000, 257, 12, {}),
]  # fmt: skip


def assert_within(error: Error, limit: float) -> float:
    """Return a relative rms error that is within its limit."""
    assert error.rel_rms <= limit, (
        f"{error.worst}: relative rms error {error.rel_rms:.2g}, allowed {limit:.2g}"
    )
    return error.rel_rms


def assert_same(first: tuple[Tensor, ...], second: tuple[Tensor, ...]) -> None:
    """Compare results bit by bit."""
    for i, (a, b) in enumerate(zip(first, second, strict=True)):
        assert a.equal(b), f"result {i} differs by up to {(a - b).abs().max().item():.2g}"


def scan_of(shape: tuple, device: torch.device) -> Case:
    """Return a scan with an initial state."""
    batch, length, channels, states, groups = shape
    inputs = make_inputs(batch, length, channels, states, groups)
    state = torch.randn(batch, channels, states, generator=torch.Generator().manual_seed(2))
    return scan_case(inputs, device, length, channels, state)


def check_scan(shape: tuple, dtype: torch.dtype, device: torch.device) -> float:
    """Check the output and all gradients, each by its own limit; return the worst error."""
    case = scan_of(shape, device)
    if dtype != torch.float32:
        return assert_within(case.check(BOTH, dtype), HALF_LIMIT)
    got, expected = case.results(BOTH), case.exact(BOTH)
    limits = dict.fromkeys(expected, LIMIT)
    if gpu.kind_of(device) == "cuda":
        more = allowances(lambda off: case.exact(BOTH, off=off))
        limits = {name: LIMIT + more[name] for name in expected}
    errors = {name: compare({name: got[name]}, {name: expected[name]}) for name in expected}
    nearest = max(expected, key=lambda name: errors[name].rel_rms / limits[name])
    return assert_within(errors[nearest], limits[nearest])


def check_conv(shape: tuple[int, int, int, int], device: torch.device) -> None:
    """Check the output and all gradients, with an initial state."""
    assert_within(conv_case(device, shape, state=True).check(BOTH), LIMIT)


def scene_of(count: int, size: int, views: int, options: dict, device: torch.device) -> Case:
    """Return a shell, without quaternions if ``options`` have None for them."""
    gaussians: dict[str, Any] = {**shell(count, scale=3.0)}
    if "quats" in options:
        gaussians["quats"] = None
    rest = {name: value for name, value in options.items() if name != "quats"}
    return raster_case(gaussians, orbit_cameras(views, size), size, device, **rest)


def check_raster(count: int, size: int, views: int, options: dict, device: torch.device) -> None:
    """Check image, alphas and all gradients on a crop of the first view."""
    scene = scene_of(count, size, views, options, device)
    image, alphas, _ = scene.forward()
    assert image.isfinite().all() and alphas.max() <= 1
    assert_within(scene.check(BOTH), IMAGE_LIMIT)


# All of these, for each of the shapes; they are given the device.
EACH = [
    *(partial(check_scan, x, kind) for x in SCANS for kind in (torch.float32, torch.bfloat16)),
    *(partial(check_conv, x) for x in CONVS),
    *(partial(check_raster, *x) for x in RASTERS),
]


def layer_of(shape: tuple, device: torch.device) -> tuple[Callable[..., Tensor], list[Tensor]]:
    """Return a layer of convolution and scan, and its inputs on the device."""
    case = scan_of(shape, device)
    inputs = case.at(torch.float32)
    weight = torch.linspace(-0.5, 0.5, 4 * inputs["u"].shape[2], device=device)

    def layer(u: Tensor, weight: Tensor) -> Tensor:
        u = causal_conv1d(u, weight, activation="silu")
        return case.call({**inputs, "u": u})  # torch 2.6 cannot compile "|" of two dicts

    return layer, [inputs["u"], weight.view(-1, 4)]


def check_compiled(backend: str, device: torch.device) -> None:
    """Check ``torch.compile`` of a layer and its gradients, without graph breaks."""
    layer, inputs = layer_of((1, 139, 37, 16, 1), device)
    results = []
    for function in (layer, torch.compile(layer, fullgraph=True, backend=backend)):
        leaves = [x.detach().clone().requires_grad_() for x in inputs]
        out = function(*leaves)
        results.append({"out": out} | dict(zip("uw", torch.autograd.grad(out.sum(), leaves))))
    assert_within(compare(results[1], results[0]), 1e-6)


def check_side_stream(device: torch.device) -> None:
    """Check a layer on a stream of its own, after work that takes longer than its launch."""
    layer, inputs = layer_of((1, 577, 70, 16, 1), device)
    want = layer(*inputs)
    stream = torch.cuda.Stream(device)
    torch.cuda.synchronize(device)
    with torch.cuda.stream(stream):
        big = torch.randn(4096, 4096, device=device)
        for _ in range(8):  # a launch on another stream would run too early
            big = big @ big * 1e-3
        out = layer(*(x + 0 * big[0, 0].nan_to_num(0.0, 0.0, 0.0) for x in inputs))
    stream.synchronize()
    assert_same((out,), (want,))


def check_layer_graph(device: torch.device) -> None:
    """Check that replays equal plain runs bit for bit, also with changed inputs."""
    layer, inputs = layer_of((1, 577, 70, 16, 1), device)
    with torch.no_grad():
        graph, out = captured(lambda: layer(*inputs), device)
        for scale in (1.0, 0.5):
            inputs[0].mul_(scale)
            out.fill_(torch.nan)
            graph.replay()
            torch.cuda.synchronize(device)
            assert_same((out,), (layer(*inputs),))


def render_all(scene: Case) -> dict[str, Tensor]:
    """Render; return image, alphas, the number of pairs and all gradients."""
    given = scene.leaves()
    leaves = wanted(given)
    renders, alphas, meta = scene.call(given)
    grads = torch.autograd.grad(renders.square().sum() + alphas.sum(), [*leaves.values()])
    made = {"renders": renders.detach(), "alphas": alphas.detach(), "pairs": meta.bins.count}
    return made | dict(zip(leaves, grads))


def check_step_graph(device: torch.device) -> None:
    """Check a step that is repeated by a CUDA graph bit by bit against steps one by one."""
    from gamba_warp.train.timing import Step

    plain, repeated = (Step(3, device, graph) for graph in (False, True))
    for _ in range(5):
        assert_same((plain.run(),), (repeated.run().clone(),))
    assert repeated.graphs is not None and repeated.graphs.count == 1
    pairs = zip(plain.model.parameters(), repeated.model.parameters(), strict=True)
    averages = zip(plain.ema.model.parameters(), repeated.ema.model.parameters(), strict=True)
    for ours, theirs in (*pairs, *averages):
        assert_same((ours,), (theirs,))


def check_raster_graph(device: torch.device) -> list[int]:
    """Check replays bit by bit with changed sizes; with more pairs than the capacity they are NaN.

    Returns the numbers of pairs.
    """
    scene = scene_of(700, 75, 3, {"render_mode": "RGB+D"}, device)
    graph, made = captured(partial(render_all, scene), device)
    found = []
    for factor in (1.0, 0.8, 6.0, 0.25):
        scene.at()["scales"].mul_(factor)  # and with the sizes the number of pairs
        for value in made.values():
            value.fill_(-1)
        graph.replay()
        torch.cuda.synchronize(device)
        replayed = {name: value.clone() for name, value in made.items()}
        found.append(int(replayed["pairs"]))
        if factor == 6.0:
            assert lists_outgrown(), f"the lists hold {found[-1]} pairs after {found[0]}"
            assert replayed["renders"].isnan().all() and replayed["alphas"].isnan().all()
        else:
            assert_same(tuple(replayed.values()), tuple(render_all(scene).values()))
    return found
