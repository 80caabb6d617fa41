"""Checks of CUDA graphs, and that nothing waits: the rasterizer both ways, a whole training step.

A graph may hold nothing that makes the host wait, and its replays must give what plain calls give,
also after inputs have changed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from ..gaussians import Gaussians
from ..kernels.bench import Error, Settings, compare
from ..kernels.bench.cases.raster_scene import orbit_cameras, shell
from ..kernels.rasterize import lists_outgrown, rasterization
from ..measure.inference import build_model
from ..model.posing import reference_cameras
from ..render import render

_Result = TypeVar("_Result")
# Under capture torch may choose other kernels for a product; Adam's first steps go by the sign of
# a gradient, so where that is a rounding, weights go apart.
LOSS_LIMIT, CHANGE_LIMIT = 1e-4, 0.05
_STEPS = 4


def within(error: Error, limit: float) -> str:
    """Returns an error in words.

    Raises:
        AssertionError: it is over the limit, or not a number.
    """
    if not error.rel_rms <= limit:
        raise AssertionError(
            f"{error.worst}: relative rms error {error.rel_rms:.2g}, allowed {limit:.2g}"
        )
    return f"{error.rel_rms:.1e}"


def same(first: tuple[Tensor, ...], second: tuple[Tensor, ...]) -> None:
    """Compares results bit by bit.

    Raises:
        AssertionError: one differs.
    """
    for i, (a, b) in enumerate(zip(first, second)):
        if not a.equal(b):
            raise AssertionError(f"result {i} differs by up to {(a - b).abs().max().item():.2g}")


def captured(run: Callable[[], _Result], device: torch.device) -> tuple[Any, _Result]:
    """Captures a function; what it returns is filled again by each ``replay`` of the graph."""
    stream = torch.cuda.Stream(device)
    stream.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(stream):  # kernels are loaded, and room for the lists is known, before
        for _ in range(3):
            run()
    torch.cuda.current_stream(device).wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        result = run()
    return graph, result


class Splats:
    """Gaussians and cameras that stay where they are in memory, rendered with all gradients."""

    def __init__(self, device: torch.device, count: int = 700, views: int = 3, size: int = 75):
        gaussians = {name: x.to(device) for name, x in shell(count, scale=3.0).items()}
        self.leaves: dict[str, Any] = {k: x.requires_grad_() for k, x in gaussians.items()}
        self.cameras = [x.to(device) for x in orbit_cameras(views, size)]
        self.size = size

    def run(self) -> dict[str, Tensor]:
        """Renders, and returns picture, alphas, the number of pairs and the gradients."""
        renders, alphas, meta = rasterization(
            **self.leaves,
            viewmats=self.cameras[0],
            Ks=self.cameras[1],
            width=self.size,
            height=self.size,
            render_mode="RGB+D",
        )
        grads = torch.autograd.grad(renders.square().sum() + alphas.sum(), [*self.leaves.values()])
        made = {"renders": renders.detach(), "alphas": alphas.detach(), "pairs": meta.bins.count}
        return made | dict(zip(self.leaves, grads))

    @torch.no_grad()
    def grow(self, factor: float) -> None:
        """Multiplies the sizes of the Gaussians, and with these the number of pairs."""
        self.leaves["scales"].mul_(factor)


def no_wait(device: torch.device) -> str:
    """Checks that torch waits for the device in no call but the first, neither graph nor not."""
    splats, steps = Splats(device), TrainingStep(device)
    for run in (splats.run, steps.run):
        run()
        before = torch.cuda.get_sync_debug_mode()
        torch.cuda.set_sync_debug_mode("error")
        try:
            run()
        finally:
            torch.cuda.set_sync_debug_mode(before)
    return "rendering with gradients and a training step go on"


def raster_graph(device: torch.device) -> str:
    """Checks bits of replays, with sizes changed meanwhile, and with more pairs than have room."""
    splats = Splats(device)
    graph, made = captured(splats.run, device)
    found = []
    for factor in (1.0, 0.8, 6.0, 0.25):
        splats.grow(factor)
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
        same(tuple(replayed.values()), tuple(splats.run().values()))
    return "equal, with " + ", ".join(map(str, found)) + " pairs"


class TrainingStep:
    """A small model, its rendering, a loss of pictures and AdamW, all of fixed shapes.

    The model is that of a quick run of ``gamba bench inference``, in training.
    """

    def __init__(self, device: torch.device):
        torch.manual_seed(0)
        self.model, _ = build_model(Settings(device, level="quick"))
        self.model.train()
        side = self.model.config.image_size
        g = torch.Generator().manual_seed(1)
        self.images = torch.rand(2, side, side, 3, generator=g).to(device)
        self.cameras = reference_cameras(self.model.config, 2).to(device)
        self.parameters = [p for p in self.model.parameters() if p.requires_grad]
        rate = torch.tensor(1e-3, device=device) if device.type == "cuda" else 1e-3
        self.optimizer = torch.optim.AdamW(
            self.parameters, lr=rate, capturable=device.type == "cuda", fused=True
        )

    def run(self) -> Tensor:
        """Makes a step and returns its loss."""
        self.optimizer.zero_grad(set_to_none=True)
        gaussians: Gaussians = self.model(self.images, self.cameras)
        views = replace(
            self.cameras, viewmats=self.cameras.viewmats[:, None], Ks=self.cameras.Ks[:, None]
        )
        picture = render(gaussians, views).rgb[:, 0]
        loss = (picture - self.images).square().mean()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, 1.0)
        self.optimizer.step()
        return loss.detach()

    @torch.no_grad()
    def begin(self, weights: list[Tensor]) -> None:
        """Sets weights and the optimizer's state to those of a beginning, in place."""
        for parameter, weight in zip(self.parameters, weights):
            parameter.copy_(weight)
        for state in self.optimizer.state.values():
            for value in state.values():
                value.zero_()

    def weights(self) -> list[Tensor]:
        """Returns a copy of the weights."""
        return [p.detach().clone() for p in self.parameters]

    def train(self, step: Callable[[], Tensor], first: list[Tensor]) -> dict[str, Tensor]:
        """Makes steps from a beginning; returns losses, and how far the weights went."""
        self.begin(first)
        losses = torch.stack([step().clone() for _ in range(_STEPS)])
        change = [(now - old).flatten() for now, old in zip(self.weights(), first)]
        return {"losses": losses, "change": torch.cat(change)}


def step_graph(device: torch.device) -> str:
    """Checks that replays of a captured training step train as plain steps do."""
    steps = TrainingStep(device)
    first = steps.weights()
    graph, loss = captured(steps.run, device)

    def replay() -> Tensor:
        graph.replay()
        return loss

    got, want = (steps.train(step, first) for step in (replay, steps.run))
    if not want["losses"][-1] < want["losses"][0]:
        raise AssertionError("the loss does not fall")
    text = within(compare({"losses": got["losses"]}, {"losses": want["losses"]}), LOSS_LIMIT)
    change = within(compare({"change": got["change"]}, {"change": want["change"]}), CHANGE_LIMIT)
    return f"losses to {text}, the weights' change to {change}"
