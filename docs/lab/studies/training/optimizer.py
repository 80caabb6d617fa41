"""Benchmark case of a step after the gradient: clipping, AdamW, zeroing, the average."""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor, nn

from gamba_warp.kernels.bench.core.case import Error, Settings, Variant, compare
from gamba_warp.model.gamba import Gamba
from gamba_warp.train.config import OptimConfig
from gamba_warp.train.optim import Ema, build_optimizer

from .made_up import step_config

TEXT = (
    "What follows the gradient in a step, on the weights of preset rays: the norm that clips it, "
    "AdamW, the gradient's end, and the running average of the weights. Single works on a tensor "
    "at a time, foreach on lists of them, fused in one kernel. Error of AdamW: of the weights "
    "after three steps to float64's; of the others: to the single one's."
)
_LIMIT = 1e-5


class _Weights:
    """Weights with gradients, and one implementation of their optimizer."""

    def __init__(self, settings: Settings, way: str, kind: torch.dtype = torch.float32) -> None:
        torch.manual_seed(0)
        self.model = Gamba(step_config("rays", settings)).to(settings.device, kind)
        options = OptimConfig()
        made = build_optimizer(self.model, options.weight_decay, options.beta2)
        flags = {name: name == way for name in ("fused", "foreach")}
        self.optimizer = torch.optim.AdamW(made.param_groups, lr=1e-3, betas=made.defaults["betas"])
        for group in self.optimizer.param_groups:
            group.update(flags, lr=1e-3)
        self.weights = [p for group in made.param_groups for p in group["params"]]
        g = torch.Generator().manual_seed(1)
        self.gradients = [
            torch.randn(p.shape, generator=g).to(settings.device, kind) for p in self.weights
        ]
        self.foreach, self.clip = way != "single", options.clip
        self.ema = Ema(self.model, options.ema)
        self.start = copy.deepcopy(self.model.state_dict())
        self.put()

    def put(self) -> None:
        """Put the gradients in place."""
        for p, gradient in zip(self.weights, self.gradients):
            p.grad = gradient

    def step(self) -> None:
        """Make a step of AdamW."""
        self.optimizer.step()

    def norm(self) -> Tensor:
        """Compute the norm of the whole gradient."""
        return nn.utils.get_total_norm(self.gradients, foreach=self.foreach)

    def zero(self, to_none: bool) -> None:
        """Set the gradients, then zero them."""
        self.put()
        self.optimizer.zero_grad(set_to_none=to_none)

    @torch.no_grad()
    def average(self) -> None:
        """Move the running average."""
        if self.foreach:
            self.ema.update()
            return
        for average, p in zip(self.ema.model.parameters(), self.model.parameters()):
            average.lerp_(p, 0.001)


def _after_steps(weights: _Weights) -> dict[str, Tensor]:
    """The weights after three steps from the start."""
    weights.model.load_state_dict(weights.start)
    weights.optimizer.state.clear()
    for _ in range(3):
        weights.step()
    return {"weights": torch.cat([p.detach().double().flatten() for p in weights.weights])}


def variants(settings: Settings) -> list[Variant]:
    """The variants of the case optimizer."""
    ways = {way: _Weights(settings, way) for way in ("fused", "foreach", "single")}
    truth = _after_steps(_Weights(settings, "single", torch.float64))
    norm = {"norm": ways["single"].norm()}
    size = sum(p.numel() for p in ways["fused"].weights)
    made: list[Variant] = []

    def add(
        name: str,
        run: Callable[[], object],
        check: Callable[[], Error] | None,
        default: bool,
        oracle: str = "",
    ) -> None:
        made.append(
            Variant(
                name=name,
                run=run,
                check=check,
                limit=_LIMIT,
                oracle=oracle,
                default=default,
                parameters={"weights": size},
            )
        )

    for way, weights in ways.items():
        check = lambda weights=weights: compare(_after_steps(weights), truth)  # noqa: E731
        add(f"AdamW, {way}", weights.step, check, way == "fused", "float64")
    for way in ("foreach", "single"):
        check = lambda w=ways[way]: compare({"norm": w.norm()}, norm)  # noqa: E731
        add(f"norm, {way}", ways[way].norm, check, way == "foreach", "single")
        add(f"average, {way}", ways[way].average, None, way == "foreach")
    for to_none in (True, False):
        name = "gradients to None" if to_none else "gradients to zero"
        add(name, partial(ways["foreach"].zero, to_none), None, to_none)
    return made
