"""Benchmark case of the training: one optimizer step, and what of it is forward."""

from __future__ import annotations

import math
from functools import partial

import torch

from gamba_warp.cameras import Cameras, intrinsics, orbit, reference_viewmat
from gamba_warp.kernels.bench import Case, Settings, Target, Variant
from gamba_warp.model.config import PRESETS
from gamba_warp.model.gamba import Gamba

from .batches import Batch
from .config import LossConfig, OptimConfig
from .optim import build_optimizer
from .step import forward

_BATCH, _NOVEL, _SIZE = 2, 2, 128
_BATCHES = {"quick": (1,), "normal": (1, 2, 4), "full": (1, 2, 4, 8)}


def cases(settings: Settings) -> list[Case]:
    """The cases of a training step."""
    text = (
        f"One step of preset tiny on {_BATCH} objects in {_NOVEL + 1} views of {_SIZE}²: model, "
        "rendering, loss without LPIPS, gradients, clipping and AdamW; no reading of files. It is "
        "checked to be finite, no more."
    )
    batches = "Cost of that step against the number of objects."
    return [
        Case("train-step", "tiny", text, partial(_steps, settings)),
        Case("train-step", "batch", batches, partial(_batches, settings), "B"),
    ]


def targets(settings: Settings) -> list[Target]:
    """None are set."""
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
            group["lr"] = 1e-5  # small: every round does the same work
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
        """Timed: the loss alone."""
        return forward(self.model, self.batch, self.weights).loss

    def step(self) -> torch.Tensor:
        """Timed: all of it. Returns the gradient's norm."""
        self.optimizer.zero_grad(set_to_none=True)
        forward(self.model, self.batch, self.weights).loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.clip)
        self.optimizer.step()
        return norm

    def check(self, run) -> None:
        """There is no oracle; the figure must be finite, and not 0."""
        value = run().item()
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"loss or gradient is {value}")


def _disc(size: int) -> torch.Tensor:
    """The silhouette of a ball in the middle, ``[size, size, 1]``."""
    x = torch.linspace(-1, 1, size)
    return ((x[:, None] ** 2 + x**2) < 0.25).float()[..., None]


def _steps(settings: Settings) -> list[Variant]:
    step = _Step(settings)
    parameters = {"B": _BATCH, "views": _NOVEL + 1, "side": _SIZE}
    return [
        Variant(
            "step",
            step.step,
            partial(step.check, step.step),
            direction="forward+backward",
            default=True,
            parameters=parameters,
        ),
        Variant(
            "loss alone",
            step.forward,
            partial(step.check, step.forward),
            parameters=parameters,
        ),
    ]


def _batches(settings: Settings) -> list[Variant]:
    made = []
    for batch in _BATCHES[settings.level]:
        step = _Step(settings, batch)
        made.append(
            Variant(
                f"{batch} object{'s' * (batch > 1)}",
                step.step,
                partial(step.check, step.step),
                direction="forward+backward",
                rounds=10,
                parameters={"B": batch, "views": _NOVEL + 1, "side": _SIZE},
            )
        )
    return made
