"""Random and hostile cases of the causal convolution."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ...causal_conv1d import causal_conv1d, causal_conv1d_fn
from ..core.case import (
    COTANGENTS,
    DTYPES,
    RANGES,
    Case,
    Op,
    Option,
    Outcome,
    Runs,
    fill,
    fitted,
    generator,
)
from ..core.rounding import Rounding, samples_of
from ..oracles import scan as scan_oracle
from .scan import LAYOUTS, laid

OPTIONS = {
    "api": Option("conv", ("conv", "causal-conv1d")),
    "batch": Option(1, (1, 2, 3)),
    "length": Option(1, (0, 1, 2, 3, 4, 15, 16, 17, 63, 64, 65, 129, 300)),
    "channels": Option(1, (1, 2, 5, 15, 16, 17, 31, 33, 65)),
    "width": Option(2, (2, 3, 4), span=(2, 4)),
    "dtype": Option("float32", ("float32", "float32", "bfloat16", "float16")),
    "layout": Option("dense", LAYOUTS),
    "silu": Option(False, 0.7),
    "use_bias": Option(False, 0.5),
    "use_state": Option(False, 0.5),
    "final": Option(False, 0.5),
    "weight": Option("normal", RANGES, 0.3),
    "cotangent": Option("normal", COTANGENTS, others=RANGES),
}


def build(case: Case, device: torch.device) -> dict[str, Tensor | None]:
    """The leaves by argument, channels last."""
    o, dtype = case.options, DTYPES[case.options["dtype"]]
    batch, length, channels, width = (o[k] for k in ("batch", "length", "channels", "width"))
    g = {name: generator(case, name) for name in ("x", "weight", "rest")}
    state = fill((batch, width - 1, channels), case.kind, g["rest"]) if o["use_state"] else None
    made = {
        "x": laid(fill((batch, length, channels), case.kind, g["x"]).to(dtype), o["layout"]),
        "weight": fill((channels, width), o["weight"], g["weight"]),
        "bias": torch.randn(channels, generator=g["rest"]) if o["use_bias"] else None,
        "initial_state": None if state is None else state.to(dtype),
    }
    return {
        k: None if x is None else x.to(device).detach().requires_grad_() for k, x in made.items()
    }


def _run(o: dict, x: dict) -> dict[str, Tensor]:
    """The results by name, channels last."""
    values = x["weight"], x["bias"]
    rest: dict[str, Any] = {"activation": "silu" if o["silu"] else None}
    state = x["initial_state"]
    if o["api"] == "conv":
        rest |= dict(initial_state=state, return_final_state=o["final"])
        result = causal_conv1d(x["x"], *values, **rest)
    else:
        state = None if state is None else state.mT
        rest |= dict(initial_states=state, return_final_states=o["final"])
        result = causal_conv1d_fn(x["x"].mT, *values, **rest)
    results = result if isinstance(result, tuple) else (result,)
    return {k: t if o["api"] == "conv" else t.mT for k, t in zip(("out", "final"), results)}


def evaluate(case: Case, device: torch.device, trial: int = 0) -> Outcome:
    """Runs the operator and compares output, final state and all gradients with float64."""
    o, x = case.options, build(case, device)
    samples: dict[str, Any] = {k: samples_of(t) for k, t in x.items()}
    r = Rounding(case.seed, trial)
    out, final = scan_oracle.conv(samples, o["silu"], DTYPES[o["dtype"]], r)
    leaves = {k: t for k, t in x.items() if t is not None}
    truths, true_leaves = {"out": out, "final": final}, {k: samples[k] for k in leaves}
    runs = Runs(case, lambda: _run(o, x), leaves, truths, true_leaves)
    return runs.outcome({"out": (1,), "x": (1,)})


def _fit(options: dict) -> dict:
    return fitted(options, ("batch", "length", "channels"), 60_000)  # more than draw can give


OP = Op("conv", dict.fromkeys(RANGES, {}), OPTIONS, _fit, evaluate)
