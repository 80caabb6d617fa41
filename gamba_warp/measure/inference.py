"""Benchmark cases of whole models: pictures to Gaussians, also by CUDA graphs, and a view."""

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
    dtype_name,
    make_cases,
)
from ..kernels.bench.core.measure import peak_bytes, synchronize
from ..model.config import PRESETS, GambaConfig, Preset
from ..model.encoders import ImageEncoder
from ..model.gamba import Gamba
from ..model.posing import reference_cameras
from ..render import render

Result = TypeVar("Result")
OP, CASE = "inference", "one picture"
HEADLINE = "CUDA graph, bfloat16"
_GIVEN_TOKENS, _GIVEN_CHANNELS = 576, 768  # as of DINOv2 ViT-B/14 at 336 pixels
# Allowed relative rms error of a second run. Under capture torch may choose other kernels for a
# matrix product, and then the results differ by the dtype's rounding.
REPEAT_LIMITS = {torch.float32: 1e-4, torch.bfloat16: 1e-2}
HALF_LIMIT = 0.03  # allowed error of bfloat16 to float32 in the worst attribute; a CPU has 0.007


class _GivenTokens(nn.Module):
    """Stand-in of the encoder that returns the same tokens for every picture, at no cost."""

    tokens: Tensor

    def __init__(self) -> None:
        super().__init__()
        g = torch.Generator().manual_seed(0)
        tokens = torch.randn(1, _GIVEN_TOKENS, _GIVEN_CHANNELS, generator=g)
        self.register_buffer("tokens", tokens)

    def forward(self, images: Tensor) -> Tensor:
        return self.tokens.expand(len(images), -1, -1)


def without_encoder(config: GambaConfig) -> GambaConfig:
    """Return the configuration without an image encoder and its prepended tokens."""
    return replace(config, encoder="none", prepend=config.prepend and config.camera_token)


def build_model(settings: Settings) -> tuple[Gamba, str]:
    """Build the paper's model with untrained weights; also return a description of its encoder.

    A quick run has a small model, of 256 Gaussians.
    """
    torch.manual_seed(0)
    config, reason = PRESETS["paper"], ""
    if settings.level == "quick":
        config = replace(config, image_size=32, patch_size=4, width=64, depth=2, dt_rank=4)
    else:
        try:
            return _on(Gamba(config, "random"), settings), f"{config.encoder}, untrained"
        except (ImportError, UserError) as error:
            reason = f" ({error})"
    encoder = ImageEncoder(_GivenTokens(), _GIVEN_CHANNELS, config)
    given = f"{_GIVEN_TOKENS} given tokens, the encoder is not in the figure{reason}"
    return _on(Gamba(config, encoder=encoder), settings), given


def _on(model: Gamba, settings: Settings) -> Gamba:
    return model.to(settings.device).eval()


def captured(
    run: Callable[[], Result], device: torch.device
) -> tuple[torch.cuda.CUDAGraph, Result, int]:
    """Capture a function as a CUDA graph.

    Returns:
        The graph, the function's result, which each ``replay`` overwrites, and the bytes it keeps.
    """
    stream = torch.cuda.Stream(device)
    stream.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(stream):  # warm-up before the capture
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
    """A model with posed pictures on its device, run eagerly or by a CUDA graph.

    Attributes:
        model: the model.
        device: device of the model and of the pictures.
        image: ``[B, H, W, C]``, with random alpha and so without background, so that the decoder
            "rays" computes every token.
        cameras: their cameras.
    """

    def __init__(self, model: Gamba, device: torch.device, count: int = 1) -> None:
        self.model, self.device, size = model, device, model.config.image_size
        g = torch.Generator().manual_seed(1)
        shape = (count, size, size, model.config.input_channels)
        self.image = torch.rand(shape, generator=g).to(device)
        self.cameras = reference_cameras(model.config, count).to(device)
        self._graphs: dict[torch.dtype, tuple] = {}
        self._truths: dict[torch.dtype, Gaussians] = {}

    @torch.no_grad()
    def eager(self, dtype: torch.dtype = torch.float32) -> Gaussians:
        """Run the model's forward; bfloat16 means autocast."""
        mixed = dtype != torch.float32
        with torch.autocast(self.device.type, torch.bfloat16, enabled=mixed, cache_enabled=False):
            return self.model(self.image, self.cameras)

    def graph(self, dtype: torch.dtype) -> Gaussians:
        """Run the same by a CUDA graph, which the first call captures."""
        if dtype not in self._graphs:
            self._graphs[dtype] = captured(partial(self.eager, dtype), self.device)
        graph, result, _ = self._graphs[dtype]
        graph.replay()
        return result

    def peak(self, function: Callable, dtype: torch.dtype) -> dict[str, int]:
        """Measure memory besides weights and input: the growth in a run, or that of a graph."""
        if function == self.graph:
            return {"peak_bytes": self._graphs[dtype][2]}
        peak = peak_bytes(partial(function, dtype), self.device)
        return {} if peak is None else {"peak_bytes": peak}

    def view(self, gaussians: Gaussians) -> Tensor:
        """Render the reference views, ``[B, 1, H, W, 3]``."""
        viewmats, Ks = self.cameras.viewmats[:, None], self.cameras.Ks[:, None]
        return render(gaussians, replace(self.cameras, viewmats=viewmats, Ks=Ks)).rgb

    def check(self, run: Callable[[], Gaussians], truth: torch.dtype = torch.float32) -> Error:
        """Measure the error of the Gaussians of ``run`` against those of ``eager`` in ``truth``."""
        got = run()
        synchronize(self.device)
        if truth not in self._truths:
            self._truths[truth] = self.eager(truth).to("cpu")
        got, want = (
            {name: x for name, x in vars(found).items() if x is not None}
            for found in (got, self._truths[truth])
        )
        return compare(got, want)


def cases(settings: Settings) -> list[Case]:
    """Return the cases of whole models without an image encoder."""
    models = [("one picture", pictures, None), ("batch", batches, "B")]
    return make_cases("model", settings, models)


def _bare(settings: Settings, preset: Preset, count: int, **changes) -> Variant:
    """Return a variant with fresh weights and no image encoder, on ``count`` pictures."""
    torch.manual_seed(0)
    model = Gamba(without_encoder(PRESETS[preset])).to(settings.device).eval()
    run = Inference(model, settings.device, count)
    check = partial(run.check, run.eager)
    oracle = "a first run (0: the same bits); the blocks have the float64 oracle"
    return Variant(run=run.eager, check=check, limit=0.0, oracle=oracle, **changes)


def pictures(settings: Settings) -> list[Variant]:
    """A posed picture to Gaussians by preset, without the image encoder. The models are whole and
    have fresh weights; two runs must give the same bits.
    """
    made = []
    for name in ("tiny", "rays") if settings.level == "quick" else PRESETS:
        sizes = {"N": PRESETS[name].num_gaussians, "side": PRESETS[name].image_size}
        rest = dict(name=name, default=True, rounds=10, parameters=sizes)
        made.append(_bare(settings, name, 1, **rest))
    return made


def batches(settings: Settings) -> list[Variant]:
    """Cost against the number of pictures in one call, preset tiny."""
    made = []
    for count in (1, 2) if settings.level == "quick" else (1, 2, 4, 8):
        sizes = {"B": count, "N": PRESETS["tiny"].num_gaussians}
        name = f"{count} picture{'s' * (count > 1)}"
        made.append(_bare(settings, "tiny", count, name=name, parameters=sizes))
    return made


def full_size(settings: Settings) -> list[Case]:
    """Return the case of the paper's model, with the variants for the device."""
    return make_cases(OP, settings, [(CASE, _variants, None)])


def _variants(settings: Settings) -> list[Variant]:
    """A posed picture to Gaussians, forward only, untrained weights; then one view of it."""
    model, encoder = build_model(settings)
    inference, size = Inference(model, settings.device), model.config.image_size
    full, half = torch.float32, torch.bfloat16
    same, eager, graph = REPEAT_LIMITS, inference.eager, inference.graph
    # Name: function and dtype; dtype, limit and name of the run that it is compared with.
    modes = {
        "eager, float32": (eager, full, full, same[full], "a second run"),
        "eager, bfloat16": (eager, half, full, HALF_LIMIT, "float32"),
    }
    if settings.device.type == "cuda":
        modes |= {
            "CUDA graph, float32": (graph, full, full, same[full], "eager"),
            HEADLINE: (graph, half, half, same[half], "eager, bfloat16"),
        }
    made = []
    for name, (function, dtype, truth, limit, oracle) in modes.items():
        run = partial(function, dtype)
        check, work = partial(inference.check, run, truth), partial(inference.peak, function, dtype)
        made.append(Variant(name, run, check, limit, f"{oracle} (0: the same bits)", work=work))
        made[-1].dtype, made[-1].default = dtype_name(dtype), name == HEADLINE
    gaussians = eager(full)
    best = graph if settings.device.type == "cuda" else eager
    shown: dict[str, Callable[[], Tensor]] = {
        f"one view of {size} x {size}": partial(inference.view, gaussians),
        "picture to view, bfloat16": lambda: inference.view(best(half)),
    }
    for name, picture in shown.items():
        picture = torch.no_grad()(picture)

        def repeat(picture=picture) -> Error:
            return compare({"picture": picture()}, {"picture": picture()})

        made.append(Variant(name, picture, repeat, 0.0, "a second run"))
    for variant in made:
        variant.parameters = {"N": model.config.num_gaussians, "side": size, "encoder": encoder}
    return made
