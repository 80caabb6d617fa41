"""Benchmark case of a training step: the patches of the background that are not computed."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from gamba_warp.cameras import Cameras
from gamba_warp.gaussians import Gaussians
from gamba_warp.kernels.bench.core.case import Error, Settings, Variant, compare
from gamba_warp.kernels.bench.core.measure import peak_bytes
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.parts.patches import foreground_patches
from gamba_warp.render import render
from gamba_warp.train.data.samples import Batch
from gamba_warp.train.step import Objective, compute_gradients

from .made_up import BOTH, NOVEL, SPREAD, WEIGHTS, step_model, step_source

_SHARES = {"quick": (0.1,), "normal": (0.05, 0.1, 0.2, 0.4, 0.7, 1.0)}
_ALONE_LIMIT = 1e-4  # the same sums in products of other shapes


class _Covered:
    """Model of preset rays, and a batch whose objects cover a share of the picture."""

    def __init__(self, settings: Settings, model: Gamba, share: float) -> None:
        torch.manual_seed(1)
        self.model, self.device = model, settings.device
        made_up = Settings(settings.device, settings.level, threads=settings.threads)
        source = step_source(model.config, made_up, len(SPREAD), share)
        self.batch = source.batch(0, NOVEL).to(settings.device)
        self.optimizer = torch.optim.SGD(model.parameters(), lr=0.0)

    def _run(self, margin: int, images: Tensor, cameras: Cameras) -> Gaussians:
        return self.model(images, cameras, background_margin=margin)

    @torch.no_grad()
    def forward(self, margin: int) -> Gaussians:
        """Run the network; timed."""
        return self._run(margin, self.batch.inputs, self.batch.input_cameras)

    def gradients(self, margin: int, batch: Batch | None = None) -> dict[str, Tensor]:
        """Make the gradients of the weights; timed."""
        run = partial(self._run, margin)
        compute_gradients(
            run, self.optimizer, [batch or self.batch], Objective(WEIGHTS), clip=math.inf
        )
        named = self.model.named_parameters()
        return {name: p.grad for name, p in named if p.grad is not None}

    def _alone(self) -> list[Batch]:
        """The objects of the batch, each as a batch."""
        one = (slice(i, i + 1) for i in range(len(self.batch.uids)))
        fields = {k: v for k, v in vars(self.batch).items() if v is not None}
        return [Batch(**{k: v[i] for k, v in fields.items()}) for i in one]

    def check(self, margin: int) -> Error:
        """Measure the error of the batch's Gaussians to those of each object alone."""
        together, got, want = self.forward(margin), {}, {}
        for i, one in enumerate(self._alone()):
            with torch.no_grad():
                alone = self._run(margin, one.inputs, one.input_cameras)
            for name, value in vars(alone).items():
                if value is not None:
                    want[f"{name} of object {i}"] = value[0]
                    got[f"{name} of object {i}"] = getattr(together, name)[i, : alone.num]
        return compare(got, want)

    def check_gradients(self, margin: int) -> Error:
        """Measure the error of all weights' gradient to the mean of those of each object alone."""
        got = {name: value.clone() for name, value in self.gradients(margin).items()}
        sums: dict[str, Tensor] = {}
        alone = self._alone()
        for one in alone:
            for name, value in self.gradients(margin, one).items():
                sums[name] = sums.get(name, 0.0) + value.double() / len(alone)
        flat = [torch.cat([v[name].double().flatten() for name in sums]) for v in (got, sums)]
        return compare({"gradient": flat[0]}, {"gradient": flat[1]})

    @torch.no_grad()
    def _pictures(self, margin: int) -> Tensor:
        return render(self.forward(margin), self.batch.cameras, self.batch.background).rgb

    def work(self, margin: int, whole: int, run: Callable[[], object]) -> dict[str, float]:
        """Count tokens and memory, and the PSNR to the pictures of all patches, in dB."""
        alpha = self.batch.inputs[..., 3]
        patches = foreground_patches(alpha, self.model.config.patch_size, margin)
        counts: dict[str, float] = {"tokens": 4 * len(patches.position)}
        if margin != whole:
            error = (self._pictures(margin) - self._pictures(whole)).square().mean()
            counts["psnr_to_full"] = round(-10 * error.clamp_min(1e-12).log10().item(), 1)
        peak = peak_bytes(run, self.device)
        return counts | ({} if peak is None else {"peak_bytes": peak})


def background(settings: Settings) -> list[Variant]:
    """The variants of the case background."""
    model, _ = step_model("rays", settings)
    whole = model.config.grid_size  # a margin that takes every patch
    made = []
    for share in _SHARES.get(settings.level, _SHARES["normal"]):
        covered = _Covered(settings, model, share)
        for margin, name in ((0, "object's patches"), (whole, "all patches")):
            percent = round(100 * covered.batch.inputs[..., 3].mean().item())
            runs = {
                "forward": (covered.forward, covered.check),
                BOTH: (covered.gradients, covered.check_gradients),
            }
            for direction, (run, check) in runs.items():
                made.append(
                    Variant(
                        name=f"{percent} %, {name}",
                        run=partial(run, margin),
                        check=partial(check, margin),
                        limit=_ALONE_LIMIT,
                        oracle="each object alone (not float64)",
                        direction=direction,
                        rounds=5,
                        default=margin == 0,
                        parameters={"B": len(SPREAD), "share": percent, "series": name},
                        work=partial(covered.work, margin, whole, partial(run, margin)),
                    )
                )
    return made
