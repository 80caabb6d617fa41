"""Checks of the kernels on a device, for a machine with only torch and warp-lang.

Each check compares a run with the float64 oracle or with another run. ``gamba gpu-check`` runs them
all.
"""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import torch
from torch import Tensor

from ..kernels.bench.cases.conv import conv_problem
from ..kernels.bench.cases.raster_scene import Scene, orbit_cameras, shell
from ..kernels.bench.cases.scan_problem import allowances, make_inputs, scan_problem
from ..kernels.bench.core.case import BOTH, Error, Settings, compare
from ..kernels.bench.core.problem import Operator
from ..kernels.causal_conv1d import causal_conv1d
from ..kernels.rasterize import lists_outgrown, rasterization
from ..kernels.runtime.stand_in import kind_of
from ..kernels.selective_scan.cuda import launch as cuda_scan
from ..kernels.selective_scan.cuda.launch import Tuning
from ..measure.inference import Inference, build_model, captured

# Allowed relative rms errors: of float32 sums over a few hundred terms; for the scan plus the error
# of a GPU's exponential; of half precision, which rounds inputs and outputs; and of pictures, where
# a few pixels may cross the threshold of alpha.
LIMIT, HALF_LIMIT, PICTURE_LIMIT = 2e-6, 3e-2, 1e-3
# Under capture torch may choose other kernels for a matrix product. Adam's first steps follow the
# sign of the gradient, so weights with a gradient near 0 diverge.
LOSS_LIMIT, CHANGE_LIMIT = 1e-4, 0.05
_STEPS = 4  # of training
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
    """Raised by a check that cannot run here; ``str(error)`` is the reason."""


class Check(NamedTuple):
    """A check on a device.

    Attributes:
        name: title of the check.
        run: function of the device that returns the result in words, or raises an error.
        cuda: the check needs a GPU.
    """

    name: str
    run: Callable[[torch.device], str]
    cuda: bool = False


def checks(quick: bool) -> Iterator[Check]:
    """Yield all checks, or a few of each kind if ``quick``."""
    few = 2 if quick else None
    yield Check("operations of PTX, as the interpreter of the tests", _operations, cuda=True)
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


def _operations(device: torch.device) -> str:
    """Run the comparison of tests/ptx, which exists only in a checkout."""
    tests = Path(__file__).parents[2] / "tests" / "ptx"
    if not tests.is_dir() or importlib.util.find_spec("pytest") is None:
        raise LeftOut("needs a checkout and pytest")
    command = [sys.executable, "-m", "pytest", "-m", "gpu", str(tests)]
    done = subprocess.run(command, cwd=tests.parents[1], capture_output=True, encoding="utf-8")
    lines = [*filter(None, done.stdout.splitlines())]
    last = "".join(lines[-1:])
    if done.returncode:
        reasons = [line[1:].strip() for line in lines if line.startswith("E ")]
        raise AssertionError(": ".join([last, *reasons[:1]]))
    if "passed" not in last:  # skipped without a compiler
        raise LeftOut(last)
    return "equal bit for bit, the approximate units within their bounds"


def _problem(shape: tuple, device: torch.device) -> Operator:
    batch, length, channels, states, groups = shape
    inputs = make_inputs(batch, length, channels, states, groups)
    g = torch.Generator().manual_seed(2)
    state = torch.randn(batch, channels, states, generator=g)
    return scan_problem(inputs, device, length, channels, state)


def _scan(shape: tuple, dtype: torch.dtype, device: torch.device) -> str:
    """Check the output and all gradients, with an initial state, each by its own limit."""
    problem = _problem(shape, device)
    if dtype != torch.float32:
        return within(problem.check(BOTH, dtype), HALF_LIMIT)
    got, truth = problem.results(True), problem.truth(True)
    limits = dict.fromkeys(truth, LIMIT)
    if kind_of(device) == "cuda":
        more = allowances(lambda off: problem.truth(True, off=off))
        limits = {name: LIMIT + more[name] for name in truth}
    errors = {name: compare({name: got[name]}, {name: truth[name]}) for name in truth}
    nearest = max(truth, key=lambda name: errors[name].rel_rms / limits[name])
    return within(errors[nearest], limits[nearest])


def _tuned(tuning: Tuning, device: torch.device) -> str:
    with patch.object(cuda_scan, "FORCED", tuning):
        return _scan(SCANS[3], torch.float32, device)


def _scan_twice(device: torch.device) -> str:
    problem = _problem((2, 577, 70, 16, 1), device)
    for dtype in (torch.float32, torch.bfloat16):
        same(problem.backward(dtype), problem.backward(dtype))
    return "equal"


def _conv(shape: tuple[int, int, int, int], device: torch.device) -> str:
    """Check the output and all gradients, with an initial state."""
    return within(conv_problem(device, shape, state=True).check(BOTH), LIMIT)


def _scene(count: int, size: int, views: int, options: dict, device: torch.device) -> Scene:
    gaussians: dict[str, Any] = {**shell(count, scale=3.0)}
    if "quats" in options:
        gaussians["quats"] = None
    rest = {name: value for name, value in options.items() if name != "quats"}
    return Scene(gaussians, *orbit_cameras(views, size), size, device, rest)


def _raster(count: int, size: int, views: int, options: dict, device: torch.device) -> str:
    """Check picture, alphas and all gradients on a crop of the first view."""
    scene = _scene(count, size, views, options, device)
    picture, alphas, _ = scene.forward()
    if not (picture.isfinite().all() and alphas.max() <= 1):
        raise AssertionError("the picture is not finite, or alpha is over 1")
    return within(scene.check(BOTH), PICTURE_LIMIT)


def _raster_twice(device: torch.device) -> str:
    scene = _scene(700, 75, 3, {}, device)
    same(scene.forward()[:2], scene.forward()[:2])
    same(scene.backward(), scene.backward())
    return "equal"


def _layer(problem: Operator) -> tuple[Callable[..., Tensor], list[Tensor]]:
    """Return a layer of convolution and scan, and its inputs on the device."""
    inputs = problem.at(torch.float32)
    weight = torch.linspace(-0.5, 0.5, 4 * inputs["u"].shape[2], device=problem.device)

    def layer(u: Tensor, weight: Tensor) -> Tensor:
        u = causal_conv1d(u, weight, activation="silu")
        return problem.call({**inputs, "u": u})  # torch 2.6 cannot compile "|" of two dicts

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
        for _ in range(8):  # a launch on another stream would run too early
            big = big @ big * 1e-3
        out = layer(*(x + 0 * big[0, 0].nan_to_num(0.0, 0.0, 0.0) for x in inputs))
    stream.synchronize()
    same((out,), (want,))
    return "equal"


def _graph(device: torch.device) -> str:
    """Check that replays equal plain runs bit for bit, also with changed inputs."""
    layer, inputs = _layer(_problem((1, 577, 70, 16, 1), device))
    with torch.no_grad():
        graph, out, _ = captured(lambda: layer(*inputs), device)
        for scale in (1.0, 0.5):
            inputs[0].mul_(scale)
            out.fill_(torch.nan)
            graph.replay()
            torch.cuda.synchronize(device)
            same((out,), (layer(*inputs),))
    return "equal"


def within(error: Error, limit: float) -> str:
    """Return an error as text.

    Raises:
        AssertionError: it exceeds the limit, or is NaN.
    """
    if not error.rel_rms <= limit:
        raise AssertionError(
            f"{error.worst}: relative rms error {error.rel_rms:.2g}, allowed {limit:.2g}"
        )
    return f"{error.rel_rms:.1e}"


def same(first: tuple[Tensor, ...], second: tuple[Tensor, ...]) -> None:
    """Compare results bit by bit.

    Raises:
        AssertionError: one differs.
    """
    for i, (a, b) in enumerate(zip(first, second)):
        if not a.equal(b):
            raise AssertionError(f"result {i} differs by up to {(a - b).abs().max().item():.2g}")


def render_all(scene: Scene) -> dict[str, Tensor]:
    """Render; return picture, alphas, the number of pairs and all gradients."""
    leaves = scene.leaves()
    given: dict[str, Any] = {**scene.arguments(), **leaves}
    renders, alphas, meta = rasterization(**given)
    grads = torch.autograd.grad(renders.square().sum() + alphas.sum(), [*leaves.values()])
    made = {"renders": renders.detach(), "alphas": alphas.detach(), "pairs": meta.bins.count}
    return made | dict(zip(leaves, grads))


def no_wait(device: torch.device) -> str:
    """Check that torch synchronises with the device in no call after the first."""
    scene = _scene(700, 75, 3, {"render_mode": "RGB+D"}, device)
    for run in (partial(render_all, scene), TrainingStep(device).run):
        run()
        before = torch.cuda.get_sync_debug_mode()
        torch.cuda.set_sync_debug_mode("error")
        try:
            run()
        finally:
            torch.cuda.set_sync_debug_mode(before)
    return "rendering with gradients and a training step go on"


def raster_graph(device: torch.device) -> str:
    """Check replays bit by bit, with changed sizes, and with more pairs than the capacity."""
    scene = _scene(700, 75, 3, {"render_mode": "RGB+D"}, device)
    graph, made, _ = captured(partial(render_all, scene), device)
    found = []
    for factor in (1.0, 0.8, 6.0, 0.25):
        scene.gaussians["scales"].mul_(factor)  # and with the sizes the number of pairs
        for value in made.values():
            value.fill_(-1)
        graph.replay()
        torch.cuda.synchronize(device)
        replayed = {name: value.clone() for name, value in made.items()}
        found.append(int(replayed["pairs"]))
        if factor == 6.0 and not lists_outgrown():
            raise AssertionError(
                f"{found[-1]} pairs after {found[0]} had room, which was not meant"
            )
        same(tuple(replayed.values()), tuple(render_all(scene).values()))
    return "equal, with " + ", ".join(map(str, found)) + " pairs"


class TrainingStep:
    """Training step of a small model with rendering, an image loss and AdamW, in fixed shapes.

    The model is that of a quick run of ``gamba bench inference``, in training mode.
    """

    def __init__(self, device: torch.device):
        torch.manual_seed(0)
        model, _ = build_model(Settings(device, level="quick"))
        self.inputs = Inference(model.train(), device, 2)
        self.parameters = [p for p in model.parameters() if p.requires_grad]
        rate = torch.tensor(1e-3, device=device) if device.type == "cuda" else 1e-3
        self.optimizer = torch.optim.AdamW(
            self.parameters, lr=rate, capturable=device.type == "cuda", fused=True
        )

    def run(self) -> Tensor:
        """Make a step and return its loss."""
        self.optimizer.zero_grad(set_to_none=True)
        x = self.inputs
        picture = x.view(x.model(x.image, x.cameras))[:, 0]
        loss = (picture - x.image).square().mean()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, 1.0)
        self.optimizer.step()
        return loss.detach()

    @torch.no_grad()
    def begin(self, weights: list[Tensor]) -> None:
        """Reset weights and the optimizer's state in place."""
        for parameter, weight in zip(self.parameters, weights):
            parameter.copy_(weight)
        for state in self.optimizer.state.values():
            for value in state.values():
                value.zero_()

    def weights(self) -> list[Tensor]:
        """Return a copy of the weights."""
        return [p.detach().clone() for p in self.parameters]

    def train(self, step: Callable[[], Tensor], first: list[Tensor]) -> dict[str, Tensor]:
        """Make steps after a reset; return losses and the change of the weights."""
        self.begin(first)
        losses = torch.stack([step().clone() for _ in range(_STEPS)])
        change = [(now - old).flatten() for now, old in zip(self.weights(), first)]
        return {"losses": losses, "change": torch.cat(change)}


def step_graph(device: torch.device) -> str:
    """Check that replays of a captured training step train like plain steps."""
    steps = TrainingStep(device)
    first = steps.weights()
    graph, loss, _ = captured(steps.run, device)

    def replay() -> Tensor:
        graph.replay()
        return loss

    got, want = (steps.train(step, first) for step in (replay, steps.run))
    if not want["losses"][-1] < want["losses"][0]:
        raise AssertionError("the loss does not fall")
    text = within(compare({"losses": got["losses"]}, {"losses": want["losses"]}), LOSS_LIMIT)
    change = within(compare({"change": got["change"]}, {"change": want["change"]}), CHANGE_LIMIT)
    return f"losses to {text}, the weights' change to {change}"
