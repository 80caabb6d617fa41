"""Relocation of Gaussians (Kheradmand et al. 2024) in torch, and gsplat's strategies with it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from .checks import shape
from .shapes import quat_scale_to_covar_preci


def compute_relocation(
    opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor
) -> tuple[Tensor, Tensor]:
    """Opacity and size of n equal Gaussians in one place that look as one of them did.

    ``o' = 1 - (1 - o)^(1/n)`` and
    ``s' = s o / Σ_{i=1..n} Σ_{k<i} C(i-1, k) (-1)^k o'^(k+1)/√(k+1)``: equation 9 of "3D Gaussian
    Splatting as Markov Chain Monte Carlo". Computed in float64, because the signs alternate.

    Args:
        opacities: ``[N]`` or ``[N, 1]`` in (0, 1).
        scales: ``[N, 3]``.
        ratios: ``[N]`` integers, n of each; clamped to 1 to n_max, in place as gsplat does.
        binoms: ``[n_max, n_max]``, ``binoms[i, k]`` = C(i, k).

    Returns:
        The new opacities, of their shape, and the new scales ``[N, 3]``.

    Raises:
        TypeError: no tensor.
        ValueError: a shape is not as above.
    """
    num = len(scales) if isinstance(scales, Tensor) and scales.dim() else 0
    shape("scales", scales, (num, 3))
    shape("opacities", opacities, (num,), (num, 1))
    shape("ratios", ratios, (num,))
    shape("binoms", binoms, (len(binoms), len(binoms)))
    most = len(binoms)
    ratios.clamp_(min=1, max=most)
    count = ratios.long()
    old = opacities.flatten().double()
    new = -torch.expm1(torch.log1p(-old) / count)
    power = torch.arange(1, most + 1, device=old.device)
    signs = torch.where(power % 2 == 1, 1.0, -1.0).double() / power.double().sqrt()
    weights = binoms.double().cumsum(0)[count - 1] * signs
    coefficients = old / (weights * new[:, None] ** power).sum(1)
    new_scales = (coefficients[:, None] * scales).to(scales.dtype)
    return new.to(opacities.dtype).view_as(opacities), new_scales


@contextmanager
def torch_strategies() -> Iterator[None]:
    """Inside, gsplat's MCMC strategy takes the functions here for two of its CUDA extension.

    They are ``compute_relocation`` and ``quat_scale_to_covar_preci`` in ``gsplat.strategy.ops``,
    and are put back at the end. The module is shared by all threads of the process.

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
