"""Benchmark of a training step: samples per second, for ``gamba bench step``."""

from __future__ import annotations

import os

import torch
from torch import Tensor
from torch.autograd.profiler import profile

from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.kernels.bench.measure import Settings, Table, Variant
from gamba_warp.kernels.cases.case import BOTH
from gamba_warp.model.config import PRESETS
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.posing import reference_cameras
from gamba_warp.vision.lpips import LPIPS, load_lpips
from gamba_warp.vision.weights import lpips_available

from .config import LossConfig, OptimConfig
from .data.samples import Batch, with_foreground
from .graphs import StepGraphs
from .objective.losses import Progress, term_weights
from .optim import Ema, build_optimizer
from .step import Objective, make_step

_VIEWS, _SIZE = 3, 128  # of an object, the input view included
_RATE = 1e-6  # the weights hardly move, so every round does the same work
# As the shipped weights were trained at last (docs/lab/rays.md, run 28).
_LOSSES = LossConfig(
    lpips_weight=0.35,
    lpips_crop=48,
    ssim_weight=0.3,
    novel_weight=3.0,
    depth_weight=0.5,
    mask_l1_weight=0.3,
    translucency_weight=0.12,
    radial_mask=False,
)
# Parts of a step, by the beginning of the names of their operators in a profile.
_PARTS = {
    "scan": ("gamba_warp::selective_scan",),
    "convolution": ("gamba_warp::causal_conv1d",),
    "rasterizer": ("gamba_warp::rasterize",),
    "products": ("aten::mm", "aten::addmm", "aten::bmm"),
    "images' convolutions": ("aten::convolution",),
}


def tables(settings: Settings) -> list[Table]:
    """Return the table of a step."""
    return [Table("step", "batch", steps)]


class Step:
    """A model of preset rays, its optimizer and a batch of random images, as in a training run."""

    def __init__(
        self,
        objects: int,
        device: torch.device,
        graph: bool = False,
        precision: torch.dtype = torch.float32,
        lpips: LPIPS | None = None,
    ) -> None:
        """Make model and batch; with ``graph`` the third and later runs repeat a CUDA graph."""
        torch.manual_seed(0)
        config = PRESETS["rays"]
        self.model = Gamba(config).to(device)
        self.optimizer = build_optimizer(self.model)
        for group in self.optimizer.param_groups:
            group["capturable"] = graph
        self.graphs = StepGraphs(device, print) if graph else None
        self.ema = Ema(self.model, OptimConfig.ema)
        self.weights = term_weights(_LOSSES, Progress(1, 1.0, 0.5))
        objective = Objective({}, lpips and lpips.to(device), _LOSSES.lpips_crop, precision)
        parts = self.model, self.optimizer, self.ema, objective
        self.plain = make_step(*parts)
        self.step = make_step(*parts, graphs=self.graphs)
        views = orbit(90.0 * torch.arange(_VIEWS), 20.0, 1.8).expand(objects, -1, -1, -1)
        Ks = intrinsics(_SIZE, _SIZE).expand(objects, _VIEWS, 3, 3)
        size = config.image_size
        y, x = torch.meshgrid(*2 * [torch.linspace(-1, 1, size)], indexing="ij")
        inputs = torch.rand(objects, size, size, config.input_channels)
        inputs[..., 3] = (x.square() + y.square() < 0.5).float()  # 39 % of the image
        self.batch = Batch(
            [str(i) for i in range(objects)],
            inputs,
            reference_cameras(config, objects),
            torch.rand(objects, _VIEWS, _SIZE, _SIZE, 4),
            Cameras(views, Ks, _SIZE, _SIZE),
            torch.ones(objects, 1, 3),
            torch.full((objects, 2, size, size), 1.8),
        )
        self.batch = with_foreground(self.batch, config)
        if device.type == "cuda":
            self.batch = self.batch.for_gpu().to(device)

    def run(self) -> Tensor:
        """Make the whole step and return loss, norm of the gradient, and 1 if skipped (timed)."""
        return self.step([self.batch], self.weights, _RATE).stats

    def work(self) -> dict[str, float]:
        """Count the samples of a step, and the fraction of each of ``_PARTS`` in one without a
        graph.

        Shares are of the time of the GPU's kernels, or of a CPU's operators.
        """
        on_gpu = self.batch.inputs.is_cuda
        kind = "device_time_total" if on_gpu else "cpu_time_total"
        # The profiler's library prints that there is no driver, and its own beginning and end.
        os.environ.setdefault("KINETO_LOG_LEVEL", "99")
        profiler = profile(use_device="cuda" if on_gpu else None, use_kineto=on_gpu)
        with profiler:
            self.plain([self.batch], self.weights, _RATE)
        events = profiler.key_averages()
        whole = sum(getattr(event, f"self_{kind}") for event in events) or 1
        fractions = {
            f"fraction of {part}": sum(getattr(e, kind) for e in events if e.key.startswith(names))
            for part, names in _PARTS.items()
        }
        return {"samples": len(self.batch.uids)} | {k: v / whole for k, v in fractions.items()}

    def check(self) -> None:
        """Check that the gradient is finite and not 0, without an oracle."""
        _, norm, skipped = self.run().tolist()
        if skipped or norm == 0:
            raise ValueError(f"gradient norm is {norm}")


def steps(settings: Settings) -> list[Variant]:
    """One optimizer step as the shipped weights were trained: network, rendering, all losses with
    LPIPS on crops, gradients, clipping, AdamW and the running average; fresh weights, discs of
    random colours; on a GPU repeated as a CUDA graph. LPIPS is left out without its weights. The
    only check is that the gradient is finite.
    """
    variants: list[Variant] = []
    on_gpu, quick = settings.device.type == "cuda", settings.level == "quick"
    lpips = load_lpips() if lpips_available() else None
    for objects in (2,) if quick else (8, 64) if on_gpu else (8, 16):
        for precision in (torch.float32, torch.bfloat16):
            step = Step(objects, settings.device, on_gpu, precision, lpips)
            variants.append(
                Variant(
                    f"rays, {objects} objects" + (", without LPIPS" if lpips is None else ""),
                    step.run,
                    step.check,
                    direction=BOTH,
                    dtype=str(precision).removeprefix("torch."),
                    rounds=5,
                    parameters={"B": objects, "views": _VIEWS, "side": _SIZE},
                    work=step.work,
                )
            )
    return variants
