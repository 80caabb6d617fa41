"""Other ways to the same result: a plain torch loop written here, and packages if installed."""

from __future__ import annotations

import importlib
import importlib.metadata

import torch
import torch.nn.functional as F
from torch import Tensor

from .core.case import NotInstalled

PACKAGES = ("mambapy", "mamba-ssm", "causal-conv1d", "gsplat", "gswarp")


def load(module: str, package: str):
    """Imports a peer's module.

    Raises:
        NotInstalled: the package is not there; a package that is there but broken raises its own.
    """
    try:
        importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        raise NotInstalled(package) from None
    return importlib.import_module(module)


def versions() -> dict[str, str]:
    """Versions of the peers that are installed."""
    found = {}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def scan_loop(
    u: Tensor,
    delta: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor,
    z: Tensor,
    delta_bias: Tensor,
) -> Tensor:
    """The selective scan as its formula reads, in torch, with δ = softplus(delta + delta_bias).

    The way that Mamba's own reference goes: the factors exp(δA) and δBu of all tokens are made
    first, ``[B, D, L, N]`` each, then a Python loop over the tokens carries the state.

    Args:
        u: ``[B, D, L]``, like delta, z and the result.
        delta: see above.
        A: ``[D, N]``.
        B: ``[B, N, L]``, like C.
        C: see above.
        D: ``[D]``, like delta_bias.
        z: the gate.
        delta_bias: see above.
    """
    step = F.softplus(delta + delta_bias[:, None])
    decay = torch.exp(step[..., None] * A[:, None])
    drive = (step * u)[..., None] * B.mT[:, None]
    h = torch.zeros_like(decay[:, :, 0])
    rows = []
    for t in range(u.shape[2]):
        h = decay[:, :, t] * h + drive[:, :, t]
        rows.append(torch.einsum("bdn,bn->bd", h, C[:, :, t]))
    y = torch.stack(rows, dim=2)
    return (y + D[:, None] * u) * F.silu(z)


def mambapy_scan(
    u: Tensor,
    delta: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor,
    z: Tensor,
    delta_bias: Tensor,
) -> Tensor:
    """The parallel scan of mambapy inside the formula; layout ``[B, L, D]``, ``[B, L, N]``.

    Raises:
        NotInstalled: mambapy is not there.
    """
    pscan = load("mambapy.pscan", "mambapy").pscan
    step = F.softplus(delta + delta_bias)
    decay = torch.exp(step[..., None] * A)
    drive = (step * u)[..., None] * B[:, :, None]
    states = pscan(decay, drive)
    y = (states @ C[..., None])[..., 0] + D * u
    return y * F.silu(z)


def mamba_ssm_scan(
    u: Tensor,
    delta: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor,
    z: Tensor,
    delta_bias: Tensor,
) -> Tensor:
    """mamba-ssm's CUDA kernel; layout ``[B, D, L]``, ``[B, N, L]``.

    Raises:
        NotInstalled: mamba-ssm is not there.
    """
    module = load("mamba_ssm.ops.selective_scan_interface", "mamba-ssm")
    return module.selective_scan_fn(
        u, delta, A, B, C, D, z=z, delta_bias=delta_bias, delta_softplus=True
    )


def torch_conv(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Causal depthwise convolution and SiLU in torch; x ``[B, D, L]``, weight ``[D, W]``."""
    width = weight.shape[1]
    y = F.conv1d(x, weight[:, None], bias, padding=width - 1, groups=x.shape[1])
    return F.silu(y[..., : x.shape[2]])


def causal_conv1d(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """The causal-conv1d package's kernel; x ``[B, D, L]``, weight ``[D, W]``; CUDA only.

    Raises:
        NotInstalled: causal-conv1d is not there.
    """
    function = load("causal_conv1d", "causal-conv1d").causal_conv1d_fn
    return function(x, weight, bias, activation="silu")


def gsplat_rasterization(**arguments) -> tuple[Tensor, Tensor, dict]:
    """The whole operator of gsplat; CUDA only. Arguments as ``rasterization``.

    Raises:
        NotInstalled: gsplat is not there.
    """
    function = load("gsplat", "gsplat").rasterization
    return function(**arguments, packed=False)


def gsplat_projection(
    means: Tensor, quats: Tensor, scales: Tensor, viewmats: Tensor, Ks: Tensor, size: int
) -> Tensor:
    """The projection alone of gsplat's torch code, the one part of it that a CPU runs.

    Returns:
        Centres in the picture, ``[V, N, 2]``.

    Raises:
        NotInstalled: gsplat is not there.
    """
    torch_code = load("gsplat.cuda._torch_impl", "gsplat")
    covariances, _ = torch_code._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    projected = torch_code._fully_fused_projection(means, covariances, viewmats, Ks, size, size)
    return projected[1]


def gswarp_rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    **options,
) -> tuple[Tensor, Tensor, dict]:
    """The whole operator of gswarp, view after view as it takes them; CUDA only.

    Arguments as ``rasterization``, without leading dimensions; the principal point must be the
    centre. Alphas are those it returns beside the picture.

    Raises:
        NotInstalled: gswarp is not there.
        ValueError: an option that it does not have.
    """
    if options:
        raise ValueError(f"gswarp has no {', '.join(options)}")
    module = load("gswarp", "gswarp")
    pictures, alphas = [], []
    for view, K in zip(viewmats, Ks):
        tangents = width / (2 * K[0, 0].item()), height / (2 * K[1, 1].item())
        settings = module.GaussianRasterizationSettings(
            image_height=height,
            image_width=width,
            tanfovx=tangents[0],
            tanfovy=tangents[1],
            bg=means.new_zeros(3),
            scale_modifier=1.0,
            viewmatrix=view.T.contiguous(),
            projmatrix=(_perspective(*tangents).to(view) @ view).T.contiguous(),
            sh_degree=0,
            campos=torch.linalg.inv(view)[:3, 3],
            prefiltered=False,
            debug=False,
        )
        picture, _, meta = module.GaussianRasterizer(settings)(
            means3D=means,
            means2D=torch.zeros_like(means, requires_grad=True),
            opacities=opacities[:, None],
            colors_precomp=colors,
            scales=scales,
            rotations=quats,
        )
        pictures.append(picture.permute(1, 2, 0))
        alphas.append(meta.alpha.reshape(height, width, 1))
    return torch.stack(pictures), torch.stack(alphas), {}


def _perspective(tangent_x: float, tangent_y: float, near: float = 0.01, far: float = 100.0):
    """The projection that diff-gaussian-rasterization's callers make: z forward, w = z."""
    matrix = torch.zeros(4, 4)
    matrix[0, 0], matrix[1, 1] = 1 / tangent_x, 1 / tangent_y
    matrix[2, 2], matrix[2, 3], matrix[3, 2] = far / (far - near), -far * near / (far - near), 1
    return matrix
