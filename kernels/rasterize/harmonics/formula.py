"""Real spherical harmonics up to degree 4, in torch (autograd gives the gradients).

The operator of ``autograd.py`` takes this where it has no kernel: for other dtypes than float32,
other devices, very many channels. In float64 it is the oracle of the kernels.
"""

import torch
from torch import Tensor


def harmonics_basis(degree: int, directions: Tensor) -> Tensor:
    """Values of the harmonics, in the order and signs of 3DGS.

    Args:
        degree: 0 to 4.
        directions: ``[.., 3]``, unit.

    Returns:
        ``[.., (degree + 1)²]``.
    """
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    basis = [torch.full_like(x, 0.28209479177387814)]
    if degree > 0:
        c = 0.4886025119029199
        basis += [-c * y, c * z, -c * x]
    if degree > 1:
        c = 1.0925484305920792
        basis += [
            c * x * y,
            -c * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -c * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if degree > 2:
        basis += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    if degree > 3:
        basis += [
            2.5033429417967046 * x * y * (xx - yy),
            -1.7701307697799304 * y * z * (3 * xx - yy),
            0.9461746957575601 * x * y * (7 * zz - 1),
            -0.6690465435572892 * y * z * (7 * zz - 3),
            0.10578554691520431 * (35 * zz * zz - 30 * zz + 3),
            -0.6690465435572892 * x * z * (7 * zz - 3),
            0.47308734787878004 * (xx - yy) * (7 * zz - 1),
            -1.7701307697799304 * x * z * (xx - 3 * yy),
            0.6258357354491761 * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
        ]
    return torch.stack(basis, -1)


def colors_by_formula(degree: int, coefficients: Tensor, means: Tensor, centers: Tensor) -> Tensor:
    """The colours of ``colors_seen_from``, in any floating dtype, with gradients of any order.

    Args:
        degree: as for ``colors_seen_from``, like the rest.
        coefficients: ``[B, N, K, D]`` or ``[B, V, N, K, D]``.
        means: ``[B, N, 3]``.
        centers: ``[B, V, 3]``.

    Returns:
        ``[B, V, N, D]``, as ``colors_seen_from``.
    """
    sums = sums_by_formula(degree, coefficients, means, centers)
    return torch.where(sums.isnan(), sums, (sums + 0.5).clamp_min(0))


def sums_by_formula(degree: int, coefficients: Tensor, means: Tensor, centers: Tensor) -> Tensor:
    """The sums of ``sums_seen_from``, computed as in ``colors_by_formula``."""
    used = coefficients[..., : (degree + 1) ** 2, :]
    used = used if used.dim() == 5 else used[:, None]
    # no NaN or infinity may meet a zero gradient: 0 * NaN would spread to the whole view
    finite = means.isfinite().all(-1)[:, None] & used.isfinite().flatten(-2).all(-1)
    means = torch.where(means.isfinite().all(-1, keepdim=True), means, 0.0)
    used = torch.where(finite[..., None, None], used, 0.0)
    directions = torch.nn.functional.normalize(means[:, None] - centers[:, :, None], dim=-1)
    basis = harmonics_basis(degree, directions)
    if used.shape[1] == 1:  # without this, the coefficients of all views would be written out
        sums = torch.einsum("bvnk,bnkd->bvnd", basis, used[:, 0])
    else:
        sums = torch.einsum("bvnk,bvnkd->bvnd", basis, used)
    return torch.where(finite[..., None], sums, torch.nan)
