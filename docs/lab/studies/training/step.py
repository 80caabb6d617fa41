"""Benchmark cases of the training: a step by parts, its batch, and the dropped background."""

from __future__ import annotations

import math
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import cosine_similarity
from torch.profiler import record_function

from gamba_warp.cameras import Cameras
from gamba_warp.devices import float32_products
from gamba_warp.gaussians import Gaussians
from gamba_warp.kernels.bench.core.case import Case, Error, Settings, Variant, compare
from gamba_warp.model.gamba import Gamba
from gamba_warp.train.config import OptimConfig
from gamba_warp.train.optim import Ema, build_optimizer
from gamba_warp.train.step import Objective, compute_gradients
from gamba_warp.vision.lpips import load_lpips
from gamba_warp.vision.weights import lpips_available

from ..parts import measure_parts
from ..targets import Key, Target
from . import losses, optimizer
from .background import background
from .made_up import (
    BATCH,
    BOTH,
    LOWER,
    NOVEL,
    OP,
    SIZE,
    SLIM,
    WEIGHTS,
    step_config,
    step_model,
    step_source,
)

_CROP = 64
_COMPARED = ("tiny", f"tiny{LOWER}", "rays", f"rays{LOWER}", SLIM)
_BATCHES = {"quick": (1,), "normal": (1, 2, 4), "full": (1, 2, 4, 8)}
_WITH_LPIPS = "LPIPS of crops"
# Allowed errors of the whole gradient; a bfloat16 has 8 binary digits, and errors add up.
_ROUNDED = {torch.float32: 1e-3, torch.bfloat16: 0.3}
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
    precision = (
        "The gradient of a step without data and optimizer, in both precisions of the products, "
        "the shipped models' weights where a preset has them. Error: of the whole gradient to "
        "float32's with MKL's products; and the PSNR of the rendered pictures to its pictures."
    )
    text = (
        "Preset rays computes the patches that see the object; here also all patches, against the "
        "share of the picture that the object covers in the mean of a batch of 4. Forward is the "
        "network alone without gradients, forward+backward a step without data and optimizer. "
        "Error: a batch padded to its largest object must give the Gaussians, and the gradient, "
        "that each object gives alone. All patches is another function, since the network then "
        "sees tokens of the background, which it was not trained with; how far its pictures are is "
        "a PSNR. Weights: the shipped model's, or fresh ones."
    )
    builders = {
        "parts": (parts, _parts, "parts"),
        "batch": (batch, _batches, "B"),
        "background": (text, background, "share"),
        "precision": (precision, _precisions, "error"),
        "SSIM": (losses.SSIM_TEXT, losses.ssim_variants, None),
        "LPIPS": (losses.LPIPS_TEXT, losses.lpips_variants, "error"),
        "optimizer": (optimizer.TEXT, optimizer.variants, None),
    }
    return [
        Case(op=OP, name=name, text=text, build=partial(build, settings), axis=axis)
        for name, (text, build, axis) in builders.items()
    ]


def targets(settings: Settings) -> list[Target]:
    """Return the targets; none at a quick run's sizes."""
    if settings.level == "quick":
        return []
    ends = ["", *([f", {_WITH_LPIPS}"] if lpips_available() else [])]
    faster = [
        Target(
            text=f"samples a second, {name} over tiny{end}",
            times=(Key(OP, "parts", f"tiny{end}", BOTH),),
            over=(Key(OP, "parts", f"{name}{end}", BOTH),),
            at_least=4.0,
        )
        for end in ends
        for name in ("rays", f"rays{LOWER}", SLIM)
    ]
    return [*faster, *losses.ssim_targets(settings)]


class _Step:
    """Model with its optimizer and its data, as in a training run."""

    def __init__(
        self, settings: Settings, name: str, batch: int = BATCH, lpips: bool = False
    ) -> None:
        torch.manual_seed(0)
        config = step_config(name, settings)
        self.device, self.number = settings.device, 0
        self.precision = torch.bfloat16 if name.endswith(LOWER) else torch.float32
        self.model = Gamba(config).to(settings.device)
        options = OptimConfig()
        self.clip = options.clip
        self.optimizer = build_optimizer(self.model, options.weight_decay, options.beta2)
        for group in self.optimizer.param_groups:
            group["lr"] = 1e-6  # the weights hardly move, so every round does the same work
        self.ema = Ema(self.model, options.ema)
        self.lpips = load_lpips().to(settings.device) if lpips else None
        self.weights = WEIGHTS | {"lpips": 0.2 if lpips else 0.0}
        self.source = step_source(config, settings, batch)

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
                    dtype="bfloat16" if name.endswith(LOWER) else "float32",
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


class _Precise:
    """Model and batch, for gradients in a precision of the products."""

    def __init__(self, settings: Settings, name: str) -> None:
        self.model, self.trained = step_model(name, settings)
        self.batch = step_source(self.model.config, settings, BATCH).batch(0, NOVEL)
        self.batch = self.batch.to(settings.device)
        self.optimizer = torch.optim.SGD(self.model.parameters(), lr=0.0)
        with float32_products():
            self.truth = self.gradient(torch.float32)

    def gradient(self, precision: torch.dtype) -> tuple[Tensor, Tensor]:
        """Make the gradient of all weights, and the pictures; timed."""
        objective = Objective(WEIGHTS, precision=precision)
        made = compute_gradients(self.model, self.optimizer, [self.batch], objective, clip=math.inf)
        grads = [p.grad.flatten() for p in self.model.parameters() if p.grad is not None]
        return torch.cat(grads), made.result.rendering.rgb.detach()

    def check(self, precision: torch.dtype) -> Error:
        """Measure the error of the gradient to the truth."""
        return compare({"gradient": self.gradient(precision)[0]}, {"gradient": self.truth[0]})

    def work(self, precision: torch.dtype) -> dict[str, float]:
        """Measure the errors of the gradient and of the pictures."""
        gradient, pictures = self.gradient(precision)
        cosine = 1 - cosine_similarity(gradient.double(), self.truth[0].double(), 0)
        error = (pictures - self.truth[1]).square().mean().clamp_min(1e-12)
        return {
            "gradient_angle": float(f"{cosine:.2g}"),
            "psnr_to_float32": round(-10 * error.log10().item(), 1),
        }


def _precisions(settings: Settings) -> list[Variant]:
    made = []
    for name in ("tiny", "rays"):
        precise = _Precise(settings, name)
        for precision in (torch.float32, torch.bfloat16):
            kind = str(precision).removeprefix("torch.")
            made.append(
                Variant(
                    name=f"{name}, {kind}",
                    run=partial(precise.gradient, precision),
                    check=partial(precise.check, precision),
                    limit=_ROUNDED[precision],
                    oracle="float32",
                    direction=BOTH,
                    dtype=kind,
                    default=precision == torch.float32,
                    rounds=5,
                    parameters={"B": BATCH, "weights": "shipped" if precise.trained else "fresh"},
                    work=partial(precise.work, precision),
                )
            )
    return made
