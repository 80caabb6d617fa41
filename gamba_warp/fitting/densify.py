"""Fitting with gsplat's strategies, which add, move and remove Gaussians, up to a limit."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..cameras import Cameras
from ..compat.gsplat import rasterization
from ..render import render
from .config import BETAS, FitConfig
from .start import activate


def start_count(config: FitConfig) -> int:
    """Initial number of Gaussians of a fit with a strategy, at least 2."""
    return max(2, round(config.start_share * config.gaussians))


def make_strategy(config: FitConfig) -> Any:
    """Make gsplat's strategy, with its schedule scaled to the fit's number of steps.

    Args:
        config: options of the fit, with a strategy other than "fixed".

    Raises:
        ModuleNotFoundError: gsplat is not installed.
    """
    from ..compat.gsplat.strategy import DefaultStrategy, MCMCStrategy

    times: dict[str, Any] = {
        "refine_start_iter": int(config.refine_start * config.steps),
        "refine_stop_iter": int(config.refine_stop * config.steps),
        "refine_every": max(1, config.steps // config.refine_times),
    }
    if config.strategy == "mcmc":
        return MCMCStrategy(cap_max=config.gaussians, noise_lr=config.noise, **times)
    # No pruning by size: the fit bounds the scales itself.
    reset_every = max(1, config.steps // 4)
    return DefaultStrategy(reset_every=reset_every, prune_scale3d=float("inf"), **times)


class Densified:
    """Fit with a number of Gaussians controlled by one of gsplat's strategies.

    Attributes:
        parameters: as from ``random_start``; the strategy replaces the tensors in the dict.
        optimizers: one Adam per parameter, by name, as the strategies require.
    """

    def __init__(
        self, parameters: dict[str, Tensor], config: FitConfig, rng: torch.Generator
    ) -> None:
        self.parameters: dict[str, Any] = {
            name: torch.nn.Parameter(p) for name, p in parameters.items()
        }
        self.optimizers: dict[str, Any] = {
            name: torch.optim.Adam([{"params": [p], "name": name}], betas=BETAS, eps=1e-15)
            for name, p in self.parameters.items()
        }
        self._strategy, self._config, self._rng = make_strategy(config), config, rng
        self._strategy.check_sanity(self.parameters, self.optimizers)
        self._state = self._strategy.initialize_state()
        self._info: dict[str, Any] = {}

    def draw(self, cameras: Cameras, backgrounds: Tensor) -> tuple[Tensor, Tensor]:
        """Render ``[V, H, W, 3]`` on ``backgrounds [V, 3]``, and alpha ``[V, H, W, 1]``."""
        now, mode = activate(self.parameters), self._config.rasterize_mode
        if self._config.strategy == "mcmc":  # needs no information from rendering
            picture = render(now, cameras, backgrounds, rasterize_mode=mode)
            return picture.rgb, picture.alpha
        assert now.quats is not None
        rgb, alpha, self._info = rasterization(
            now.means, now.quats, now.scales, now.opacities, now.colors, cameras.viewmats,
            cameras.Ks, cameras.width, cameras.height, packed=False, backgrounds=backgrounds,
            rasterize_mode=mode,
        )  # fmt: skip
        self._strategy.step_pre_backward(
            self.parameters, self.optimizers, self._state, 0, self._info
        )
        return rgb, alpha

    def penalty(self) -> Tensor | float:
        """Regularization loss: the weighted mean opacity of "mcmc"."""
        if self._config.strategy == "default":
            return 0.0
        return self._config.weight_opacity * self.parameters["opacities"].sigmoid().mean()

    def after(self, step: int, done: float) -> int:
        """Run the strategy after a step of Adam.

        Args:
            step: its number, from 1.
            done: share of the fit done before it; unused, since the strategy counts steps.

        Returns:
            0: moves of the strategies are not counted.
        """
        device = self.parameters["means"].device
        seed = int(torch.randint(2**62, (), generator=self._rng, device=device))
        # gsplat draws from torch's global generators: seed them temporarily from the fit's own.
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            torch.manual_seed(seed)
            if self._config.strategy == "mcmc":
                rate = self.optimizers["means"].param_groups[0]["lr"]
                self._run(step, lr=rate)
            else:
                self._grow(step)
        return 0

    def _run(self, step: int, **more: Any) -> None:
        self._strategy.step_post_backward(
            self.parameters, self.optimizers, self._state, step, self._info, **more
        )

    @torch.no_grad()
    def _grow(self, step: int) -> None:
        """Run a step of "default", with a limit on the number of Gaussians that it lacks itself."""
        from gsplat.strategy.ops import remove

        free = self._config.gaussians - len(self.parameters["means"])
        self._strategy.grow_grad2d = max(self._config.grow_grad, self._grow_threshold(free))
        self._run(step, packed=False)
        surplus = len(self.parameters["means"]) - self._config.gaussians
        if surplus > 0:
            mask = torch.zeros_like(self.parameters["opacities"], dtype=torch.bool)
            mask[self.parameters["opacities"].argsort()[:surplus]] = True
            remove(self.parameters, self.optimizers, self._state, mask)

    def _grow_threshold(self, free: int) -> float:
        """Gradient in the picture exceeded by about ``free`` Gaussians; each adds one."""
        if free <= 0:
            return float("inf")
        if self._state["grad2d"] is None:
            return 0.0
        mean = self._state["grad2d"] / self._state["count"].clamp_min(1)
        return 0.0 if free >= len(mean) else mean.topk(free + 1).values[-1].item()
