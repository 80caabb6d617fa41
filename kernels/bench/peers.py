"""Other ways to the same results: plain torch code written here, and packages if installed."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from gamba_warp.versions import installed

from .measure import NotInstalled

PACKAGES = ("mambapy", "mamba-ssm", "causal-conv1d", "gsplat")


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


def channels_last(function: Callable[..., Tensor], names: Sequence[str]) -> Callable[..., Tensor]:
    """Return the function with its result and the inputs of these names exchanged, without copies.

    So one of ``[B, D, L]`` takes and gives ``[B, L, D]``.
    """

    def call(**inputs: Tensor) -> Tensor:
        return function(**inputs | {name: inputs[name].mT for name in names}).mT

    return call


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
