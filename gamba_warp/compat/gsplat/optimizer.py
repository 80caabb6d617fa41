"""gsplat's Adam of visible Gaussians, in torch."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor


@torch.no_grad()
def adam(
    param: Tensor, param_grad: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, valid: Tensor | None,
    lr: float, b1: float, b2: float, eps: float,
) -> None:  # fmt: skip
    """Update rows of a parameter and of its averages in place, by Adam without bias correction.

    Args:
        param: ``[N, ..]``.
        param_grad: its gradient, of the same shape.
        exp_avg: average of the gradient, of the same shape.
        exp_avg_sq: average of its square, of the same shape.
        valid: ``[N]``, not 0 for the rows to update; None: all.
        lr: learning rate.
        b1: decay of ``exp_avg``.
        b2: decay of ``exp_avg_sq``.
        eps: added to the root.

    Raises:
        ValueError: ``valid`` has another number of rows.
    """
    if valid is not None and valid.numel() != len(param):
        raise ValueError(f"valid must have {len(param)} rows, got {valid.numel()}")
    rows = slice(None) if valid is None else valid.flatten().nonzero()[:, 0]
    grad = param_grad[rows]
    exp_avg[rows] = mean = b1 * exp_avg[rows] + (1 - b1) * grad
    exp_avg_sq[rows] = square = b2 * exp_avg_sq[rows] + (1 - b2) * grad * grad
    param[rows] -= lr * mean / (square.sqrt() + eps)


class SelectiveAdam(torch.optim.Adam):
    """Adam that updates only the parameters and averages of Gaussians that a step has seen.

    Without bias correction, as gsplat's (Mallick et al. 2024, "Taming 3DGS").

    Args:
        params: tensors ``[N, ..]``, or groups of them with their ``lr``.
        eps: added to the root of the average square.
        betas: decays of the two averages.
    """

    def __init__(self, params: Iterable[Any], eps: float, betas: tuple[float, float]):
        super().__init__(params, eps=eps, betas=betas)

    @torch.no_grad()
    def step(self, visibility: Tensor) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Update the rows ``[N]`` of which ``visibility`` is not 0."""
        for group in self.param_groups:
            for param in group["params"]:
                if param.grad is None:
                    continue
                state = self.state[param]
                if not state:
                    state["step"] = torch.tensor(0.0)
                    state |= {k: torch.zeros_like(param) for k in ("exp_avg", "exp_avg_sq")}
                averages, (b1, b2) = (state["exp_avg"], state["exp_avg_sq"]), group["betas"]
                adam(param, param.grad, *averages, visibility, group["lr"], b1, b2, group["eps"])
