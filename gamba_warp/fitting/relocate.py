"""Relocates hardly visible Gaussians to where the pictures still differ."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..cameras import Cameras
from ..conventions import over_background
from ..gaussians import Gaussians, quat_multiply
from ..render import render
from .config import BETAS, FitConfig, RasterizeMode
from .start import activate


class Fixed:
    """Fit with a constant number of Gaussians; hardly visible ones are relocated at intervals.

    Attributes:
        parameters: as from ``random_start``; changed in place.
        optimizers: one Adam for all.
    """

    def __init__(
        self,
        parameters: dict[str, Tensor],
        images: Tensor,
        cameras: Cameras,
        config: FitConfig,
        rng: torch.Generator,
    ) -> None:
        groups = [{"params": [p.requires_grad_()], "name": name} for name, p in parameters.items()]
        self.parameters = parameters
        # The gradients of single Gaussians are far below Adam's default eps.
        self.optimizers = {"all": torch.optim.Adam(groups, betas=BETAS, eps=1e-15)}
        self._scene, self._config, self._rng = (images, cameras), config, rng

    def draw(self, cameras: Cameras, backgrounds: Tensor) -> tuple[Tensor, Tensor]:
        """Render ``[V, H, W, 3]`` on ``backgrounds [V, 3]``, and alpha ``[V, H, W, 1]``."""
        mode = self._config.rasterize_mode
        picture = render(activate(self.parameters), cameras, backgrounds, rasterize_mode=mode)
        return picture.rgb, picture.alpha

    def penalty(self) -> float:
        """Regularization loss: none."""
        return 0.0

    def after(self, step: int, done: float) -> int:
        """Relocate Gaussians after a step of Adam, if it is due.

        Args:
            step: its number, from 1.
            done: share of the fit done before it.

        Returns:
            The number of moved Gaussians.
        """
        config = self._config
        if not config.relocate_every or step % config.relocate_every:
            return 0
        if done >= config.relocate_until:
            return 0
        weight, error = shares(activate(self.parameters), *self._scene, config.rasterize_mode)
        optimizer = self.optimizers["all"]
        return relocate(self.parameters, optimizer, weight, error, config, self._rng)


def shares(
    gaussians: Gaussians, images: Tensor, cameras: Cameras, mode: RasterizeMode = "classic"
) -> tuple[Tensor, Tensor]:
    """Compute each Gaussian's blending weight and share in the error by one backward pass.

    A rendered channel is linear in the colours, so the gradient of ``Σ_p u_p C_p`` with respect to
    a colour is ``Σ_p u_p w_p`` with the blending weight w: for u = 1 its weight, for u = the
    squared error of the pixel its share in the error.

    Args:
        gaussians: ``[N]``.
        images: ``[V, H, W, 4]``.
        cameras: V cameras.
        mode: the ``rasterize_mode`` of ``rasterization``.

    Returns:
        The weight in pixels and the share in the squared error, each ``[N]``, over all views.
    """
    gaussians = gaussians.detach()
    gaussians.colors.requires_grad_()
    rgb = render(gaussians, cameras, images.new_ones(3), rasterize_mode=mode).rgb
    error = (rgb.detach() - over_background(images, 1.0)).square().mean(-1)
    upstream = torch.stack([torch.ones_like(error), error, torch.zeros_like(error)], -1)
    (gradient,) = torch.autograd.grad(rgb, gaussians.colors, upstream)
    return gradient[:, 0], gradient[:, 1]


@torch.no_grad()
def relocate(
    parameters: dict[str, Tensor],
    optimizer: torch.optim.Adam,
    weight: Tensor,
    error: Tensor,
    config: FitConfig,
    rng: torch.Generator,
) -> int:
    """Move Gaussians of too little weight onto others, drawn by their share in the error.

    Moved Gaussians become copies, offset by a random draw from the Gaussian itself. All copies of
    one together have about its opacity (Kheradmand et al. 2024, with a fixed shrinking of the
    scales), and their moments in Adam are reset to 0.

    Args:
        parameters: as from ``random_start``; changed in place.
        optimizer: the parameters' Adam; its state is changed in place.
        weight: ``[N]``, see ``shares``.
        error: ``[N]``, see ``shares``.
        config: options of the fit, of which ``min_weight`` and ``relocate_share`` are used.
        rng: generator on the parameters' device.

    Returns:
        The number of moved Gaussians.
    """
    order = weight.argsort()
    least = order[: int(config.relocate_share * len(order))]
    moved = least[weight[least] < config.min_weight]
    stay = torch.ones_like(weight, dtype=torch.bool)
    stay[moved] = False
    chances = torch.where(stay, error, 0.0)
    if len(moved) == 0 or not chances.sum() > 0:
        return 0
    onto = torch.multinomial(chances, len(moved), replacement=True, generator=rng)
    chosen, copies = onto.unique(return_counts=True)
    clear = 1 - parameters["opacities"][chosen].sigmoid()
    opacity = 1 - clear ** (1.0 / (copies + 1))
    parameters["opacities"][chosen] = opacity.clamp(0.005, 0.995).logit()
    parameters["scales"][chosen] -= math.log(1.25)
    for value in parameters.values():
        value[moved] = value[onto]
        for moment in ("exp_avg", "exp_avg_sq"):
            optimizer.state[value][moment][moved] = 0
            optimizer.state[value][moment][chosen] = 0
    draw = torch.randn(len(moved), 3, generator=rng, device=weight.device)
    parameters["means"][moved] += _rotate(
        parameters["quats"][moved], draw * parameters["scales"][moved].exp()
    )
    return len(moved)


def _rotate(quats: Tensor, vectors: Tensor) -> Tensor:
    """Rotate ``vectors [N, 3]`` by ``quats [N, 4]`` of any length > 0."""
    unit = torch.nn.functional.normalize(quats, dim=-1)
    inverse = unit * unit.new_tensor([1.0, -1.0, -1.0, -1.0])
    pure = torch.cat([torch.zeros_like(vectors[:, :1]), vectors], -1)
    return quat_multiply(quat_multiply(unit, pure), inverse)[:, 1:]
