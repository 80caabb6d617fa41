"""Benchmark case of inference at full size: a picture to Gaussians by a CUDA graph, and a view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TypeVar

import torch
from torch import Tensor, nn

from ..errors import UserError
from ..gaussians import Gaussians
from ..kernels.bench.core.case import (
    Case,
    Error,
    Settings,
    Variant,
    compare,
    make_cases,
)
from ..kernels.bench.core.measure import peak_bytes
from ..model.config import PRESETS
from ..model.encoders import ImageEncoder
from ..model.gamba import Gamba
from ..model.posing import reference_cameras
from ..render import render

Result = TypeVar("Result")
OP, CASE = "inference", "one picture"
HEADLINE = "CUDA graph, bfloat16"
_GIVEN_TOKENS, _GIVEN_CHANNELS = 576, 768  # those of DINOv2 ViT-B/14 at 336 pixels
# Allowed relative rms error of a second run. A graph runs the same kernels, but under capture torch
# may choose other kernels for a product, and then the results differ by roundings of the dtype.
REPEAT_LIMITS = {torch.float32: 1e-4, torch.bfloat16: 1e-2}
HALF_LIMIT = 0.03  # allowed error of bfloat16 to float32 in the worst attribute; a CPU has 0.007


class _GivenTokens(nn.Module):
    """Takes the encoder's part and gives the same tokens for every picture, at no cost."""

    tokens: Tensor

    def __init__(self) -> None:
        super().__init__()
        g = torch.Generator().manual_seed(0)
        tokens = torch.randn(1, _GIVEN_TOKENS, _GIVEN_CHANNELS, generator=g)
        self.register_buffer("tokens", tokens)

    def forward(self, images: Tensor) -> Tensor:
        return self.tokens.expand(len(images), -1, -1)


def build_model(settings: Settings) -> tuple[Gamba, str]:
    """Builds the paper's model with untrained weights; the second value names its encoder in words.

    A quick run has a small model, of 256 Gaussians.
    """
    torch.manual_seed(0)
    config = PRESETS["paper"]
    if settings.level == "quick":
        config = replace(config, image_size=32, patch_size=4, width=64, depth=2, dt_rank=4)
    else:
        try:
            return _on(Gamba(config, "random"), settings), f"{config.encoder}, untrained"
        except (ImportError, UserError) as error:
            reason = str(error)
    given = f"{_GIVEN_TOKENS} given tokens, the encoder is not in the figure"
    if settings.level != "quick":
        given += f" ({reason})"
    encoder = ImageEncoder(_GivenTokens(), _GIVEN_CHANNELS, config)
    return _on(Gamba(config, encoder=encoder), settings), given


def _on(model: Gamba, settings: Settings) -> Gamba:
    return model.to(settings.device).eval()


def captured(
    run: Callable[[], Result], device: torch.device
) -> tuple[torch.cuda.CUDAGraph, Result, int]:
    """Captures a function as a CUDA graph.

    Returns:
        The graph, the function's result, which each ``replay`` fills again, and the bytes kept.
    """
    stream = torch.cuda.Stream(device)
    stream.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(stream):  # torch wants everything set up before the capture
        for _ in range(3):
            run()
    torch.cuda.current_stream(device).wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    torch.cuda.empty_cache()
    before = torch.cuda.memory_reserved(device)
    with torch.cuda.graph(graph):
        result = run()
    return graph, result, torch.cuda.memory_reserved(device) - before


class Inference:
    """A model with one posed picture on its device, run as it is or by a CUDA graph.

    Attributes:
        device: device of the model and of the picture.
        parameters: Gaussians, side of the picture and name of the encoder, for tables.
    """

    def __init__(self, settings: Settings) -> None:
        self.device = settings.device
        self.model, encoder = build_model(settings)
        config = self.model.config
        size = config.image_size
        self.parameters = {"N": config.num_gaussians, "side": size, "encoder": encoder}
        g = torch.Generator().manual_seed(1)
        self.image = torch.rand(1, size, size, 3, generator=g).to(self.device)
        self.cameras = reference_cameras(config, 1).to(self.device)
        self._graphs: dict[torch.dtype, tuple] = {}
        self._truths: dict[torch.dtype, Gaussians] = {}

    @torch.no_grad()
    def eager(self, dtype: torch.dtype) -> Gaussians:
        """Runs the model's forward; bfloat16 means autocast."""
        mixed = dtype != torch.float32
        with torch.autocast(self.device.type, torch.bfloat16, enabled=mixed, cache_enabled=False):
            return self.model(self.image, self.cameras)

    def graph(self, dtype: torch.dtype) -> Gaussians:
        """Runs the same by a CUDA graph, which the first call captures."""
        if dtype not in self._graphs:
            self._graphs[dtype] = captured(partial(self.eager, dtype), self.device)
        graph, result, _ = self._graphs[dtype]
        graph.replay()
        return result

    def peak(self, function: Callable, dtype: torch.dtype) -> dict[str, int]:
        """Measures memory beside weights and input: the growth of a run, or what a graph keeps."""
        if function == self.graph:
            return {"peak_bytes": self._graphs[dtype][2]}
        peak = peak_bytes(partial(function, dtype), self.device)
        return {} if peak is None else {"peak_bytes": peak}

    @torch.no_grad()
    def view(self, gaussians: Gaussians) -> Tensor:
        """Renders the reference view."""
        viewmats, Ks = self.cameras.viewmats[:, None], self.cameras.Ks[:, None]
        return render(gaussians, replace(self.cameras, viewmats=viewmats, Ks=Ks)).rgb

    def check(self, run: Callable[[], Gaussians], truth: torch.dtype) -> Error:
        """Measures the error of the Gaussians of ``run`` to those of ``eager`` in ``truth``."""
        got = run()
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        if truth not in self._truths:
            self._truths[truth] = self.eager(truth).to("cpu")
        got, want = (
            {name: x for name, x in vars(found).items() if x is not None}
            for found in (got, self._truths[truth])
        )
        return compare(got, want)


def cases(settings: Settings) -> list[Case]:
    """Returns the one case, with the variants that the device can run."""
    return make_cases(OP, settings, [(CASE, _variants, None)])


def _variants(settings: Settings) -> list[Variant]:
    """A posed picture to Gaussians, forward only, untrained weights; then one view of it."""
    inference = Inference(settings)
    full, half = torch.float32, torch.bfloat16
    same, eager, graph = REPEAT_LIMITS, inference.eager, inference.graph
    # Name: how it runs, in which dtype; the run that it is compared with: dtype, limit and name.
    ways = {
        "eager, float32": (eager, full, full, same[full], "a second run"),
        "eager, bfloat16": (eager, half, full, HALF_LIMIT, "float32"),
    }
    if settings.device.type == "cuda":
        ways |= {
            "CUDA graph, float32": (graph, full, full, same[full], "eager"),
            HEADLINE: (graph, half, half, same[half], "eager, bfloat16"),
        }
    made = []
    for name, (function, dtype, truth, limit, oracle) in ways.items():
        run = partial(function, dtype)
        made.append(
            Variant(
                name=name,
                run=run,
                check=partial(inference.check, run, truth),
                limit=limit,
                oracle=f"{oracle} (0: the same bits)",
                dtype=str(dtype).removeprefix("torch."),
                default=name == HEADLINE,
                parameters=inference.parameters,
                work=partial(inference.peak, function, dtype),
            )
        )
    gaussians, size = eager(full), inference.parameters["side"]
    best = graph if settings.device.type == "cuda" else eager
    pictures: dict[str, Callable[[], Tensor]] = {
        f"one view of {size} x {size}": partial(inference.view, gaussians),
        "picture to view, bfloat16": lambda: inference.view(best(half)),
    }
    for name, picture in pictures.items():

        def check(picture=picture) -> Error:
            return compare({"picture": picture()}, {"picture": picture()})

        oracle, parameters = "a second run", inference.parameters
        made.append(Variant(name, picture, check, 0.0, oracle, parameters=parameters))
    return made
