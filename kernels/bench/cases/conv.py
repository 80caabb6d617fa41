"""Cases of the causal convolution."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from ...causal_conv1d import causal_conv1d
from ...causal_conv1d.reference import causal_conv1d_reference
from .. import peers
from ..core.case import (
    BOTH,
    Case,
    Settings,
    Variant,
    dtype_name,
    make_cases,
)
from ..core.problem import Operator

LIMITS = {"forward": 1e-6, BOTH: 1e-5}
HALF_LIMITS = {torch.bfloat16: 1e-2, torch.float16: 2e-3}
_FULL = (1, 16961, 1024, 4)
_SIZES = {"quick": (1, 1024, 256, 4), "normal": _FULL, "full": _FULL}  # of ``conv_problem``
_TOKENS = 2048  # that the oracle looks at


def cases(settings: Settings) -> list[Case]:
    """All cases of the convolution at the level's sizes."""
    builders = [("operator", operator, None), ("knobs", knobs, "error")]
    return make_cases("conv", settings, builders)


def _reference(**inputs: Tensor) -> Tensor:
    return causal_conv1d_reference(**inputs, activation="silu")[0]


_silu = partial(causal_conv1d, activation="silu")


def conv_problem(
    device: torch.device,
    sizes: tuple[int, int, int, int],
    function: Callable[..., Tensor] = _silu,
    turned: bool = False,
    state: bool = False,
) -> Operator:
    """``function(x, weight, bias)``; the oracle sees all channels of the first tokens.

    Args:
        device: where the operator runs.
        sizes: batch, tokens, channels and taps.
        function: the operator, or another package's.
        turned: True if it takes ``x [B, D, L]``.
        state: True if ``initial_state`` is an input too.
    """
    batch, length, width, taps = sizes
    tokens = min(length, _TOKENS)
    g = torch.Generator().manual_seed(0)
    inputs = {
        "x": torch.randn(batch, length, width, generator=g),
        "weight": torch.rand(width, taps, generator=g) - 0.5,
        "bias": torch.rand(width, generator=g) - 0.5,
    }
    cotangent = torch.randn(batch, length, width, generator=g)
    if state:
        inputs["initial_state"] = torch.randn(batch, taps - 1, width, generator=g)
    return Operator(
        function,
        _reference,
        inputs,
        cotangent,
        device,
        "float64 sum" + (f", first {tokens} tokens" if tokens < length else ""),
        {"B": batch, "L": length, "D": width, "taps": taps},
        LIMITS,
        HALF_LIMITS,
        cast=("x", "out"),
        corner=dict.fromkeys(("x", "out"), (slice(None), slice(tokens))),
        turned=("x", "out") if turned else (),
    )


def operator(settings: Settings) -> list[Variant]:
    """Convolution and SiLU beside torch's grouped convolution in its own layout."""
    problem = partial(conv_problem, settings.device, _SIZES[settings.level])
    made = problem().pair("default", default=True)
    made += problem(peers.torch_conv, True).pair("torch conv1d", peer=True, rounds=10)
    if settings.peers and settings.device.type == "cuda":
        made += problem(peers.causal_conv1d, True).pair("causal-conv1d", peer=True)
    return made


def knobs(settings: Settings) -> list[Variant]:
    """Half precision is compared with the truth of the float32 inputs."""
    problem, made = conv_problem(settings.device, _SIZES[settings.level]), []
    for dtype in (torch.float32, torch.bfloat16, torch.float16):
        default = dtype == torch.float32
        made += problem.pair(dtype_name(dtype), {"dtype": dtype}, default=default)
    return made
