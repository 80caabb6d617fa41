"""Covariances, relocation and the Adam of visible Gaussians, in torch: gsplat's are in CUDA."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from ..shared import check_tensor


def quat_to_rotmat(quats: Tensor) -> Tensor:
    """Convert quaternions ``[.., 4]``, wxyz of any length, to rotations ``[.., 3, 3]``."""
    check_tensor("quats", quats, ("..", 4))
    w, x, y, z = F.normalize(quats, dim=-1).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def quat_scale_to_covar_preci(
    quats: Tensor, scales: Tensor, compute_covar: bool = True, compute_preci: bool = True,
    triu: bool = False,
) -> tuple[Tensor | None, Tensor | None]:  # fmt: skip
    """Convert rotations and standard deviations to covariances and their inverses.

    Args:
        quats: ``[.., 4]`` wxyz, any length.
        scales: ``[.., 3]``.
        compute_covar: if False, the first result is None.
        compute_preci: if False, the second result is None.
        triu: return the six entries xx, xy, xz, yy, yz, zz instead of the matrix.

    Returns:
        Covariances R diag(s²) Rᵀ and their inverses, ``[.., 3, 3]``, or ``[.., 6]``.

    Raises:
        TypeError: an argument is not a tensor.
        ValueError: the shapes do not fit.
    """
    check_tensor("scales", scales, ("..", 3))
    check_tensor("quats", quats, (*scales.shape[:-1], 4))
    rotation = quat_to_rotmat(quats)

    def product(lengths: Tensor) -> Tensor:
        root = rotation * lengths[..., None, :]
        square = root @ root.mT
        return square[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]] if triu else square

    covars = product(scales) if compute_covar else None
    return covars, product(1 / scales) if compute_preci else None


def compute_relocation(
    opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor, min_opacity: float = 0.0,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Compute opacity and size of n equal Gaussians at one place that look like a single one.

    ``o' = 1 - (1 - o)^(1/n)`` and
    ``s' = s o / Σ_{i=1..n} Σ_{k<i} C(i-1, k) (-1)^k o'^(k+1)/√(k+1)``: equation 9 of "3D Gaussian
    Splatting as Markov Chain Monte Carlo". Computed in float64, because the signs alternate.

    Args:
        opacities: ``[N]`` or ``[N, 1]`` in (0, 1).
        scales: ``[N, 3]``.
        ratios: ``[N]`` integers, n of each; clamped to 1 to n_max, in place as gsplat does.
        binoms: ``[n_max, n_max]``, ``binoms[i, k]`` = C(i, k).
        min_opacity: new opacities, from which the scales follow, are at least this (gsplat 1.6).

    Returns:
        The new opacities, of their shape, and the new scales ``[N, 3]``.

    Raises:
        TypeError: an argument is not a tensor.
        ValueError: a shape is not as above.
    """
    check_tensor("scales", scales, ("N", 3))
    num, most = len(scales), len(binoms)
    check_tensor("opacities", opacities, (num,), (num, 1))
    check_tensor("ratios", ratios, (num,))
    check_tensor("binoms", binoms, (most, most))
    ratios.clamp_(min=1, max=most)
    count = ratios.long()
    old = opacities.flatten().double()
    new = -torch.expm1(torch.log1p(-old) / count).clamp_max(-min_opacity)
    power = torch.arange(1, most + 1, device=old.device)
    signs = torch.where(power % 2 == 1, 1.0, -1.0).double() / power.double().sqrt()
    weights = binoms.double().cumsum(0)[count - 1] * signs
    coefficients = old / (weights * new[:, None] ** power).sum(1)
    new_scales = (coefficients[:, None] * scales).to(scales.dtype)
    return new.to(opacities.dtype).view_as(opacities), new_scales


@contextmanager
def torch_strategies() -> Iterator[None]:
    """Replace two functions of gsplat's CUDA extension in its MCMC strategy by those here.

    They are ``compute_relocation`` and ``quat_scale_to_covar_preci`` in ``gsplat.strategy.ops``,
    and are restored at the end. All threads of the process share the module.

    Raises:
        ImportError: gsplat is not installed.
    """
    from gsplat.strategy import ops

    ours = dict(
        compute_relocation=compute_relocation, quat_scale_to_covar_preci=quat_scale_to_covar_preci
    )
    theirs = {name: getattr(ops, name) for name in ours if hasattr(ops, name)}
    try:
        for name in theirs:
            setattr(ops, name, ours[name])
        yield
    finally:
        for name, function in theirs.items():
            setattr(ops, name, function)


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
