"""A training step by parts, and against the number of objects of a batch."""

from __future__ import annotations

import math
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor
from torch.profiler import record_function

from gamba_warp.cameras import Cameras
from gamba_warp.data.dataset import open_dataset
from gamba_warp.gaussians import Gaussians
from gamba_warp.kernels.bench.core.case import BOTH, Case, Settings, Variant
from gamba_warp.model.config import PRESETS, GambaConfig
from gamba_warp.model.gamba import Gamba
from gamba_warp.train.batches import Batches, TrainingData
from gamba_warp.train.config import DataConfig, OptimConfig, TrainConfig
from gamba_warp.train.ddp import World
from gamba_warp.train.optim import Ema, build_optimizer
from gamba_warp.train.step import Objective, compute_gradients
from gamba_warp.vision.lpips import load_lpips
from gamba_warp.vision.weights import lpips_available

from .made_up import write_views
from .parts import measure_parts

OP, BATCH, NOVEL, SIZE, _CROP = "step", 4, 3, 128, 64
_SLIM = "rays, slim"  # as wide and deep as preset tiny
_LOWER = ", bfloat16"  # products of the network and of LPIPS in bfloat16
_COMPARED = ("tiny", f"tiny{_LOWER}", "rays", f"rays{_LOWER}", _SLIM)
_BATCHES = {"quick": (1,), "normal": (1, 2, 4), "full": (1, 2, 4, 8)}
_WITH_LPIPS = "LPIPS of crops"
# Separate parts by region of the step: text in an operator's name -> part.
_PRODUCTS = dict.fromkeys(("aten::mm", "aten::addmm", "aten::bmm", "aten::baddbmm"), "products")
_KINDS = {
    "rest of the network": {
        "selective_scan": "scan",
        "causal_conv1d": "convolution",
        "onvolution": "convolutions of pictures",
        **_PRODUCTS,
    }
}
_REGIONS = (
    "data",
    "rest of the network",
    "rasterizer",
    "MSE and mask",
    "SSIM",
    "LPIPS",
    "optimizer",
)


def cases(settings: Settings) -> list[Case]:
    """Return the cases of a training step."""
    parts = (
        f"One optimizer step on {BATCH} objects in {NOVEL + 1} views of {SIZE}²: data, network, "
        f"rendering, MSE + mask + 0.2 (1 - SSIM), with and without LPIPS of crops of {_CROP}², "
        "gradients, clipping, AdamW and the running average; fresh weights. Views are those of "
        "--data, or made up: the objects lie in 28 % of the patches of 8² in the mean. Parts are "
        "self times of torch's profiler, whose own cost is the difference of the whole step with "
        "it and without. Convolution is that of tokens, before the scan. Rays, slim: as wide and "
        "deep as tiny; bfloat16: products of the network and of LPIPS, as the shipped model was "
        "trained. The only check is that the gradient is finite."
    )
    batch = "Cost of that step without LPIPS against the number of objects."
    return [
        Case(OP, "parts", parts, partial(_parts, settings)),
        Case(OP, "batch", batch, partial(_batches, settings), "B"),
    ]


def _config(name: str, settings: Settings) -> GambaConfig:
    """Return the configuration of a variant, by its name; a quick run's is small."""
    name = name.removesuffix(_LOWER)
    tiny, config = PRESETS["tiny"], PRESETS["tiny" if name == "tiny" else "rays"]
    if name == _SLIM:
        config = replace(config, width=tiny.width, depth=tiny.depth)
    if settings.level == "quick":
        config = replace(config, image_size=32, width=16, depth=1)
    return config


class _Step:
    """Model with its optimizer and its data, as in a training run."""

    def __init__(
        self, settings: Settings, name: str, batch: int = BATCH, lpips: bool = False
    ) -> None:
        torch.manual_seed(0)
        config = _config(name, settings)
        self.device, self.number = settings.device, 0
        self.precision = torch.bfloat16 if name.endswith(_LOWER) else torch.float32
        self.model = Gamba(config).to(settings.device)
        options = OptimConfig()
        self.clip = options.clip
        self.optimizer = build_optimizer(self.model, options)
        for group in self.optimizer.param_groups:
            group["lr"] = 1e-6  # the weights hardly move, so every round does the same work
        self.ema = Ema(self.model, options.ema)
        self.lpips = load_lpips().to(settings.device) if lpips else None
        self.weights = {"rgb": 1.0, "mask": 1.0, "ssim": 0.2, "rdist": 0.0}
        self.weights["lpips"] = 0.2 if lpips else 0.0
        size = min(SIZE, config.image_size)
        folder = getattr(settings, "data", None)
        if folder is None:
            self.folder = tempfile.TemporaryDirectory(prefix="gamba-bench-")  # as long as the step
            folder = Path(self.folder.name) / "views"
            write_views(folder, batch, NOVEL + 3, size)
        data = open_dataset(folder, cache=True)
        self.source = Batches(
            TrainingData(data, list(range(len(data.uids))), batch_size=batch),
            TrainConfig(data=folder, views=DataConfig(size=size, mirror=0.5, recolor=0.3)),
            World(0, 1, torch.device("cpu")),
        )
        self.source.model = config

    def _network(self, images: Tensor, cameras: Cameras) -> Gaussians:
        with record_function("rest of the network"):
            return self.model(images, cameras)

    def step(self) -> Tensor:
        """Make the whole step and return the gradient's norm; timed."""
        with record_function("data"):
            batch = self.source.batch(self.number, NOVEL).to(self.device)
        self.number += 1
        made = compute_gradients(
            self._network,
            self.optimizer,
            [batch],
            Objective(self.weights, self.lpips, _CROP, self.precision),
            clip=self.clip,
        )
        with record_function("optimizer"):
            self.optimizer.step()
            self.ema.update()
        return made.norm

    def check(self) -> None:
        """Check that the gradient is finite and not 0, without an oracle."""
        value = self.step().item()
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"gradient is {value}")

    def work(self, rounds: int) -> dict[str, float]:
        """Count samples and Gaussians, and on a CPU the milliseconds of each part."""
        batch = self.source.batch(0, NOVEL).to(self.device)
        with torch.no_grad():
            opacities = self.model(batch.inputs, batch.input_cameras).opacities
        drawn = int((opacities > 0).sum()) // len(batch.uids)
        counts: dict[str, float] = {"samples": len(batch.uids), "drawn": drawn}
        if self.device.type != "cpu":  # its calls return before the work is done
            return counts
        return counts | measure_parts(self.step, _REGIONS, _KINDS, rounds)


def _parts(settings: Settings) -> list[Variant]:
    with_lpips = (False,) if settings.level == "quick" or not lpips_available() else (False, True)
    made, rounds = [], 1 if settings.level == "quick" else 5
    for lpips in with_lpips:
        for name in _COMPARED:
            step = _Step(settings, name, lpips=lpips)
            made.append(
                Variant(
                    name=f"{name}, {_WITH_LPIPS}" if lpips else name,
                    run=step.step,
                    check=step.check,
                    direction=BOTH,
                    dtype="bfloat16" if name.endswith(_LOWER) else "float32",
                    default=name == "rays" and not lpips,
                    rounds=7,
                    parameters={"B": BATCH, "views": NOVEL + 1, "side": SIZE},
                    work=partial(step.work, rounds),
                )
            )
    return made


def _batches(settings: Settings) -> list[Variant]:
    made = []
    for name in ("tiny", "rays"):
        for batch in _BATCHES[settings.level]:
            step = _Step(settings, name, batch)
            made.append(
                Variant(
                    name=f"{name}, {batch} object{'s' * (batch > 1)}",
                    run=step.step,
                    check=step.check,
                    direction=BOTH,
                    rounds=5,
                    parameters={"B": batch, "views": NOVEL + 1, "side": SIZE, "series": name},
                )
            )
    return made
