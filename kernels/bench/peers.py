"""Other ways to the same results: plain torch code written here, and packages if installed."""

from __future__ import annotations

import importlib

import torch
import torch.nn.functional as F
from torch import Tensor

from gamba_warp.versions import installed

from .measure import NotInstalled

PACKAGES = ("mambapy", "mamba-ssm", "causal-conv1d", "gsplat", "gswarp")


def load(module: str, package: str):
    """Imports a peer's module.

    Raises:
        NotInstalled: the package is not installed. A package that is broken raises its own error.
    """
    if not installed(package):
        raise NotInstalled(package)
    return importlib.import_module(module)


def versions() -> dict[str, str]:
    """Versions of the peers that are installed."""
    return installed(*PACKAGES)


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
    """Runs the selective scan in torch as its formula reads, δ = softplus(delta + delta_bias).

    Mamba's own reference does it in this way: the factors exp(δA) and δBu of all tokens are
    computed first, ``[B, D, L, N]`` each, and then a Python loop over the tokens carries the state.

    Args:
        u: ``[B, D, L]``, as delta, z and the result.
        delta: ``[B, D, L]``.
        A: ``[D, N]``.
        B: ``[B, N, L]``.
        C: ``[B, N, L]``.
        D: ``[D]``.
        z: the gate, ``[B, D, L]``.
        delta_bias: ``[D]``.
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


def mambapy_scan(*, A: Tensor, D: Tensor, z: Tensor, **x: Tensor) -> Tensor:
    """Runs the formula with mambapy's parallel scan; layout ``[B, L, D]``, ``[B, L, N]``.

    Raises:
        NotInstalled: mambapy is not installed.
    """
    pscan = load("mambapy.pscan", "mambapy").pscan
    step = F.softplus(x["delta"] + x["delta_bias"])
    drive = (step * x["u"])[..., None] * x["B"][:, :, None]
    states = pscan(torch.exp(step[..., None] * A), drive)
    y = (states @ x["C"][..., None])[..., 0] + D * x["u"]
    return y * F.silu(z)


def mamba_ssm_scan(**inputs: Tensor) -> Tensor:
    """Runs mamba-ssm's CUDA kernel; arguments and layout of ``scan_loop``.

    Raises:
        NotInstalled: mamba-ssm is not installed.
    """
    module = load("mamba_ssm.ops.selective_scan_interface", "mamba-ssm")
    return module.selective_scan_fn(**inputs, delta_softplus=True)


def torch_conv(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Runs causal depthwise convolution and SiLU in torch; x ``[B, D, L]``, weight ``[D, W]``."""
    width = weight.shape[1]
    y = F.conv1d(x, weight[:, None], bias, padding=width - 1, groups=x.shape[1])
    return F.silu(y[..., : x.shape[2]])


def causal_conv1d(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Runs the causal-conv1d package's kernel; x ``[B, D, L]``, weight ``[D, W]``; CUDA only.

    Raises:
        NotInstalled: causal-conv1d is not installed.
    """
    function = load("causal_conv1d", "causal-conv1d").causal_conv1d_fn
    return function(x, weight, bias, activation="silu")


def gsplat_rasterization(**arguments) -> tuple[Tensor, Tensor, dict]:
    """Runs gsplat's whole operator, on CUDA only, with the arguments of ``rasterization``.

    Raises:
        NotInstalled: gsplat is not installed.
    """
    function = load("gsplat", "gsplat").rasterization
    return function(**arguments, packed=False)


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
    """Runs gswarp's whole operator, one view after the other, on CUDA only.

    The arguments are those of ``rasterization``, without leading dimensions; the principal point
    must be the centre. The alphas are those that gswarp returns beside the picture.

    Raises:
        NotInstalled: gswarp is not installed.
        ValueError: gswarp does not have an option.
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
    """Makes the projection matrix of diff-gaussian-rasterization's callers: z forward, w = z."""
    matrix = torch.zeros(4, 4)
    matrix[0, 0], matrix[1, 1] = 1 / tangent_x, 1 / tangent_y
    matrix[2, 2], matrix[2, 3], matrix[3, 2] = far / (far - near), -far * near / (far - near), 1
    return matrix


def gsplat_colors(degree: int, coefficients: Tensor, means: Tensor, centers: Tensor) -> Tensor:
    """Runs gsplat's torch function, with the half and the clamp that its rasterizer adds.

    The arguments are those of ``colors_seen_from``.

    Raises:
        NotInstalled: gsplat is not installed.
    """
    code = load("gsplat.cuda._torch_impl", "gsplat")
    directions = means[:, None] - centers[:, :, None]
    wide = coefficients[:, None].expand(*directions.shape[:3], *coefficients.shape[2:])
    return (code._spherical_harmonics(degree, directions, wide) + 0.5).clamp_min(0)
