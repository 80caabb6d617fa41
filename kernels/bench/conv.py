"""Benchmark of the causal convolution."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch

from ..cases.conv import conv_case
from ..causal_conv1d import causal_conv1d_fn
from . import peers
from .measure import Settings, Table, Variant, pair

_SIZES = {"quick": (1, 1024, 256, 4)}  # of ``conv_case``
_FULL = (1, 16961, 1024, 4)


def tables(settings: Settings) -> list[Table]:
    """Return the tables of the convolution."""
    return [Table("conv", "operator", operator), Table("conv", "knobs", knobs)]


def operator(settings: Settings) -> list[Variant]:
    """Convolution and SiLU, compared with torch's grouped convolution, in both layouts."""
    case = partial(conv_case, settings.device, _SIZES.get(settings.level, _FULL))
    variants = pair(case(), "default", default=True)
    drop_in: Any = partial(causal_conv1d_fn, activation="silu")
    variants += pair(case(drop_in, True), "[B, D, L]")
    others = {"torch conv1d": (peers.torch_conv, {"rounds": 10})}
    if settings.peers and settings.device.type == "cuda":
        others["causal-conv1d"] = peers.causal_conv1d, {}
    for name, (function, options) in others.items():
        variants += pair(case(function, True), name, peer=True, **options)
        last = case(peers.channels_last(function, ("x",)))
        variants += pair(last, f"{name}, channels last", peer=True, **options)
    return variants


def knobs(settings: Settings) -> list[Variant]:
    """Half precision, compared with the exact values of the float32 inputs."""
    case = conv_case(settings.device, _SIZES.get(settings.level, _FULL))
    variants = pair(case, "float32", default=True)
    for dtype in (torch.bfloat16, torch.float16):
        variants += pair(case, str(dtype).removeprefix("torch."), options={"dtype": dtype})
    return variants
