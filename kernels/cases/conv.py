"""Cases of the causal convolution: at realistic sizes, and random and hostile ones."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ..causal_conv1d import causal_conv1d, causal_conv1d_fn
from ..causal_conv1d.reference import causal_conv1d_reference
from . import scan_oracle
from .case import BOTH, DIRECTIONS, Case
from .random_case import (
    COTANGENTS,
    DTYPES,
    RANGES,
    Op,
    Outcome,
    RandomCase,
    Runs,
    fill,
    generator,
    mostly,
)
from .rounding import Rounding, samples_of
from .scan import LAYOUTS, SEQUENCES, borders, laid

LIMITS = {"forward": 1e-6, BOTH: 1e-5}
HALF_LIMITS = {torch.bfloat16: 1e-2, torch.float16: 2e-3}
TOKENS = 2048  # that the oracle computes


def _reference(**inputs: Tensor) -> Tensor:
    return causal_conv1d_reference(**inputs, activation="silu")[0]


silu = partial(causal_conv1d, activation="silu")


def conv_case(
    device: torch.device,
    sizes: tuple[int, int, int, int],
    function: Callable[..., Tensor] = silu,
    transposed: bool = False,
    state: bool = False,
) -> Case:
    """Return ``function(x, weight, bias)``; the oracle sees all channels of the first tokens.

    Args:
        device: of the operator.
        sizes: batch, tokens, channels and taps.
        function: the operator, or another package's.
        transposed: True if it takes ``x [B, D, L]``.
        state: True if ``initial_state`` is an input too.
    """
    batch, length, width, taps = sizes
    tokens = min(length, TOKENS)
    g = torch.Generator().manual_seed(0)
    inputs = {
        "x": torch.randn(batch, length, width, generator=g),
        "weight": torch.rand(width, taps, generator=g) - 0.5,
        "bias": torch.rand(width, generator=g) - 0.5,
    }
    cotangent = torch.randn(batch, length, width, generator=g)
    if state:
        inputs["initial_state"] = torch.randn(batch, taps - 1, width, generator=g)
    return Case(
        function,
        _reference,
        inputs,
        cotangent,
        device,
        "float64 sum" + (f", first {tokens} tokens" if tokens < length else ""),
        {"B": batch, "L": length, "D": width, "taps": taps},
        LIMITS,
        HALF_LIMITS,
        cast=("x",),
        part=dict.fromkeys(DIRECTIONS, dict.fromkeys(("x", "out"), (slice(None), slice(tokens)))),
        transposed=("x", "out") if transposed else (),
    )


# Random and hostile cases.

OPTIONS = {
    "api": ("conv", "causal-conv1d"),
    "batch": (1, 2, 3),
    "length": (1, 0, 2, 3, 4, 15, 16, 17, 63, 64, 65, 129, 300),
    "channels": (1, 2, 5, 15, 16, 17, 31, 33, 65),
    "width": (2, 3, 4),
    "dtype": ("float32", "float32", "bfloat16", "float16"),
    "layout": LAYOUTS,
    "silu": (False, True, True),
    "use_bias": (False, True),
    "use_state": (False, True),
    "final": (False, True),
    "weight": mostly("normal", RANGES),
    "cotangent": COTANGENTS,
    "sequences": SEQUENCES,
}


def build(case: RandomCase, device: torch.device) -> dict[str, Tensor | None]:
    """Return the leaves by argument, channels last."""
    o, dtype = case.options, DTYPES[case.options["dtype"]]
    batch, length, channels, width = (o[k] for k in ("batch", "length", "channels", "width"))
    g = {name: generator(case, name) for name in ("x", "weight", "rest")}
    before = max(batch, o["sequences"]), width - 1, channels
    state = fill(before, case.kind, g["rest"]) if o["use_state"] else None
    leaves = {
        "x": laid(fill((batch, length, channels), case.kind, g["x"]).to(dtype), o["layout"]),
        "weight": fill((channels, width), o["weight"], g["weight"]),
        "bias": torch.randn(channels, generator=g["rest"]) if o["use_bias"] else None,
        "initial_state": None if state is None else state.to(dtype),
    }
    return {
        k: None if x is None else x.to(device).detach().requires_grad_() for k, x in leaves.items()
    }


def _run(o: dict, x: dict, cu_seqlens: Tensor | None) -> dict[str, Tensor]:
    """Return the results by name, channels last."""
    values = x["weight"], x["bias"]
    rest: dict[str, Any] = {"activation": "silu" if o["silu"] else None}
    state = x["initial_state"]
    if o["api"] == "conv":
        rest |= dict(initial_state=state, return_final_state=o["final"], cu_seqlens=cu_seqlens)
        result = causal_conv1d(x["x"], *values, **rest)
    else:
        state = None if state is None else state.mT
        rest |= dict(initial_states=state, return_final_states=o["final"])
        result = causal_conv1d_fn(x["x"].mT, *values, **rest)
    results = result if isinstance(result, tuple) else (result,)
    return {k: t if o["api"] == "conv" else t.mT for k, t in zip(("out", "final"), results)}


def evaluate(case: RandomCase, device: torch.device, trial: int = 0) -> Outcome:
    """Run the operator and compare output, final state and all gradients with float64."""
    o, x = case.options, build(case, device)
    samples: dict[str, Any] = {k: samples_of(t) for k, t in x.items()}
    r = Rounding(case.seed, trial)
    exact = partial(scan_oracle.conv, silu=o["silu"], dtype=DTYPES[o["dtype"]], r=r)
    cuts = borders(case, device)
    out, final = scan_oracle.of_sequences(exact, samples, cuts)
    leaves = {k: t for k, t in x.items() if t is not None}
    expected, sample_leaves = {"out": out, "final": final}, {k: samples[k] for k in leaves}
    runs = Runs(case, lambda: _run(o, x, cuts), leaves, expected, sample_leaves)
    return runs.outcome({"out": (1,), "x": (1,)})


def _fit(options: dict) -> dict:
    if options["api"] != "conv":
        return options | {"sequences": 1}
    return options | {"batch": 1} if options["sequences"] > 1 else options


OP = Op("conv", dict.fromkeys(RANGES, {}), OPTIONS, _fit, evaluate)
