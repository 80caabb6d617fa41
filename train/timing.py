"""Benchmark of a training step: samples per second, for ``gamba bench step``."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.profiler import profile

from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.kernels.bench.measure import Case, Settings, Variant
from gamba_warp.kernels.cases.problem import BOTH
from gamba_warp.model.config import PRESETS, Preset
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.posing import reference_cameras

from .config import OptimConfig
from .data.samples import Batch, with_foreground
from .graphs import StepGraphs
from .loop import CLIP
from .optim import Ema, build_optimizer
from .step import Objective, compute_gradients, update

_VIEWS, _SIZE = 4, 128  # of an object, the input view included
# Parts of a step, by the beginning of the names of their operators in a profile.
_PARTS = {
    "scan": ("gamba_warp::selective_scan",),
    "convolution": ("gamba_warp::causal_conv1d",),
    "rasterizer": ("gamba_warp::rasterize",),
    "products": ("aten::mm", "aten::addmm", "aten::bmm", "aten::convolution"),
}


def cases(settings: Settings) -> list[Case]:
    """Return the case of a step."""
    return [Case("step", "batch", steps)]


class Step:
    """A model with its optimizer and a batch of random pictures, as in a training run."""

    def __init__(
        self, preset: Preset, objects: int, device: torch.device, graph: bool = False
    ) -> None:
        """Make model and batch; with ``graph`` the third and later runs repeat a CUDA graph."""
        torch.manual_seed(0)
        config = PRESETS[preset]
        self.model = Gamba(config).to(device)
        self.optimizer = build_optimizer(self.model)
        for group in self.optimizer.param_groups:
            group["lr"] = 1e-6  # the weights hardly move, so every round does the same work
            group["capturable"] = graph
        self.graphs = StepGraphs(device, print) if graph else None
        self.ema = Ema(self.model, OptimConfig.ema)
        self.objective = Objective({"rgb": 1.0, "mask": 1.0, "ssim": 0.2, "rdist": 0.0})
        views = orbit(90.0 * torch.arange(_VIEWS), 20.0, 1.8).expand(objects, -1, -1, -1)
        Ks = intrinsics(_SIZE, _SIZE).expand(objects, _VIEWS, 3, 3)
        size = config.image_size
        y, x = torch.meshgrid(*2 * [torch.linspace(-1, 1, size)], indexing="ij")
        inputs = torch.rand(objects, size, size, config.input_channels)
        if config.input_channels == 4:
            inputs[..., 3] = (x.square() + y.square() < 0.5).float()  # 39 % of the picture
        self.batch = Batch(
            [str(i) for i in range(objects)],
            inputs,
            reference_cameras(config, objects),
            torch.rand(objects, _VIEWS, _SIZE, _SIZE, 4),
            Cameras(views, Ks, _SIZE, _SIZE),
            torch.ones(objects, 1, 3),
        )
        self.batch = with_foreground(self.batch, config)
        if device.type == "cuda":
            self.batch = self.batch.for_gpu().to(device)

    def run(self) -> Tensor:
        """Make the whole step and return loss and norm of the gradient (timed)."""
        share = self.ema.next_share()
        if self.graphs is None:
            return self._step(self.batch, share)
        given = self.graphs.number("share", share)
        return self.graphs.run(self.batch, None, lambda batch: self._step(batch, given))

    def _step(self, batch: Batch, share: float | Tensor) -> Tensor:
        made = compute_gradients(self.model, self.optimizer, [batch], self.objective, clip=CLIP)
        return update(self.optimizer, self.ema, share, made, self.model)

    def work(self) -> dict[str, float]:
        """Count the samples of a step, and the share of each of ``_PARTS`` in one without a graph.

        Shares are of the time of the GPU's kernels, or of a CPU's operators.
        """
        on_gpu = self.batch.inputs.is_cuda
        kind = "device_time_total" if on_gpu else "cpu_time_total"
        # Without a driver kineto prints that there is no driver.
        found = profile(use_device="cuda" if on_gpu else None, use_kineto=on_gpu)
        with found:
            self._step(self.batch, 0.0)
        events = found.key_averages()
        whole = sum(getattr(event, f"self_{kind}") for event in events) or 1
        shares = {
            f"share of {part}": sum(getattr(e, kind) for e in events if e.key.startswith(names))
            for part, names in _PARTS.items()
        }
        return {"samples": len(self.batch.uids)} | {k: v / whole for k, v in shares.items()}

    def check(self) -> None:
        """Check that the gradient is finite and not 0, without an oracle."""
        _, norm, skipped = self.run().tolist()
        if skipped or norm == 0:
            raise ValueError(f"gradient norm is {norm}")


def steps(settings: Settings) -> list[Variant]:
    """One optimizer step on objects in four views of 128²: network, rendering, MSE + mask +
    0.2 (1 - SSIM), gradients, clipping, AdamW and the running average; fresh weights, discs of
    random colours, no LPIPS; on a GPU repeated as a CUDA graph. The only check is that the
    gradient is finite.
    """
    made: list[Variant] = []
    presets: tuple[Preset, ...] = "tiny", "rays"
    for preset in presets:
        counts, graph = ((8, 64), True) if settings.device.type == "cuda" else ((1, 4), False)
        for objects in counts[:1] if settings.level == "quick" else counts:
            step = Step(preset, objects, settings.device, graph)
            name = f"{preset}, {objects} object{'s' * (objects > 1)}"
            made.append(
                Variant(
                    name,
                    step.run,
                    step.check,
                    direction=BOTH,
                    rounds=5,
                    parameters={"B": objects, "views": _VIEWS, "side": _SIZE},
                    work=step.work,
                )
            )
    return made
