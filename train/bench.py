"""Benchmark cases of the training: one optimizer step, and the forward part of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch

from gamba_warp.cameras import Cameras, intrinsics, orbit, reference_viewmat
from gamba_warp.kernels.bench import Case, Settings, Target, Variant
from gamba_warp.model.config import PRESETS
from gamba_warp.model.gamba import Gamba

from .batches import Batch
from .config import LossConfig, OptimConfig
from .optim import build_optimizer
from .step import compute_gradients, forward

_BATCH, _NOVEL, _SIZE = 2, 2, 128
_BATCHES = {"quick": (1,), "normal": (1, 2, 4), "full": (1, 2, 4, 8)}


def cases(settings: Settings) -> list[Case]:
    """Returns the cases of a training step."""
    text = (
        f"One step of preset tiny on {_BATCH} objects in {_NOVEL + 1} views of {_SIZE}²: model, "
        "rendering, loss without LPIPS, gradients, clipping and AdamW, without reading files. The "
        "only check is that the result is finite."
    )
    batches = "Cost of that step against the number of objects."
    return [
        Case(op="train-step", name="tiny", text=text, build=partial(_steps, settings)),
        Case(
            op="train-step",
            name="batch",
            text=batches,
            build=partial(_batches, settings),
            axis="B",
        ),
    ]


def targets(settings: Settings) -> list[Target]:
    """Returns the targets, of which there are none."""
    return []


class _Step:
    """A model with its optimizer, and one batch of made-up views."""

    def __init__(self, settings: Settings, batch: int = _BATCH) -> None:
        torch.manual_seed(0)
        config = PRESETS["tiny"]
        self.model = Gamba(config).to(settings.device)
        options, losses = OptimConfig(), LossConfig()
        self.clip = options.clip
        self.optimizer = build_optimizer(self.model, options.weight_decay, options.beta2)
        for group in self.optimizer.param_groups:
            group["lr"] = 1e-5  # the weights hardly move, so every round does the same work
        self.weights = {"rgb": 1.0, "mask": losses.mask_weight, "rdist": losses.rdist_weight}
        size = config.image_size
        first = reference_viewmat(config.distance)
        novel = orbit(torch.linspace(0, 360, _NOVEL + 2)[1:-1], distance=config.distance)
        viewmats = torch.cat([first[None], novel]).repeat(batch, 1, 1, 1)
        K = intrinsics(_SIZE, _SIZE, config.fov).repeat(batch, _NOVEL + 1, 1, 1)
        alpha = _disc(_SIZE).expand(batch, _NOVEL + 1, -1, -1, 1)
        self.batch = Batch(
            uids=[str(i) for i in range(batch)],
            inputs=torch.rand(batch, size, size, 3),
            input_cameras=Cameras(
                viewmats[:, 0], intrinsics(size, size, config.fov).repeat(batch, 1, 1), size, size
            ),
            targets=torch.cat([torch.rand(*alpha.shape[:-1], 3), alpha], -1),
            cameras=Cameras(viewmats, K, _SIZE, _SIZE),
            background=torch.ones(batch, 1, 3),
        ).to(settings.device)

    @torch.no_grad()
    def forward(self) -> torch.Tensor:
        """Computes the loss alone; this is what is timed."""
        return forward(self.model, self.batch, self.weights).loss

    def step(self) -> torch.Tensor:
        """Makes the whole step and returns the gradient's norm; this is what is timed."""
        made = compute_gradients(
            self.model, self.optimizer, [self.batch], self.weights, clip=self.clip
        )
        self.optimizer.step()
        return made.norm

    def check(self, run: Callable[[], torch.Tensor]) -> None:
        """Checks that the loss or gradient is finite and not 0; there is no oracle."""
        value = run().item()
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"loss or gradient is {value}")


def _disc(size: int) -> torch.Tensor:
    """Draws the silhouette of a ball in the middle, ``[size, size, 1]``."""
    x = torch.linspace(-1, 1, size)
    return ((x[:, None] ** 2 + x**2) < 0.25).float()[..., None]


def _steps(settings: Settings) -> list[Variant]:
    step = _Step(settings)
    parameters = {"B": _BATCH, "views": _NOVEL + 1, "side": _SIZE}
    return [
        Variant(
            name="step",
            run=step.step,
            check=partial(step.check, step.step),
            direction="forward+backward",
            default=True,
            parameters=parameters,
        ),
        Variant(
            name="loss alone",
            run=step.forward,
            check=partial(step.check, step.forward),
            parameters=parameters,
        ),
    ]


def _batches(settings: Settings) -> list[Variant]:
    made = []
    for batch in _BATCHES[settings.level]:
        step = _Step(settings, batch)
        made.append(
            Variant(
                name=f"{batch} object{'s' * (batch > 1)}",
                run=step.step,
                check=partial(step.check, step.step),
                direction="forward+backward",
                rounds=10,
                parameters={"B": batch, "views": _NOVEL + 1, "side": _SIZE},
            )
        )
    return made
