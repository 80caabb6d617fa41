"""Random and hostile cases of the causal convolution."""

from __future__ import annotations

from random import Random

import torch
from torch import Tensor

from ...causal_conv1d import causal_conv1d, causal_conv1d_fn
from ..core.case import DTYPES, Case, Op, Outcome, fitted, generator
from ..core.ranges import RANGES, fill
from ..core.rounding import Rounding, samples_of
from ..oracles import scan as scan_oracle
from .scan import LAYOUTS, compared, gradients_of, laid, repeated

_LENGTHS = (0, 1, 2, 3, 4, 15, 16, 17, 63, 64, 65, 129, 300)
_CHANNELS = (1, 2, 5, 15, 16, 17, 31, 33, 65)
_PLAIN = {
    "api": "conv", "batch": 1, "length": 1, "channels": 1, "width": 2, "dtype": "float32",
    "layout": "dense", "silu": False, "use_bias": False, "use_state": False, "final": False,
    "weight": "normal", "cotangent": "normal",
}  # fmt: skip


def draw(rng: Random, kind: str) -> dict:
    """Random options."""
    flag = lambda chance=0.5: rng.random() < chance  # noqa: E731
    return dict(
        api=rng.choice(("conv", "causal-conv1d")), batch=rng.choice((1, 2, 3)),
        length=rng.choice(_LENGTHS), channels=rng.choice(_CHANNELS), width=rng.choice((2, 3, 4)),
        dtype=rng.choice(("float32", "float32", "bfloat16", "float16")),
        layout=rng.choice(LAYOUTS), silu=flag(0.7), use_bias=flag(), use_state=flag(),
        final=flag(), weight=rng.choice(RANGES) if flag(0.3) else "normal",
        cotangent=rng.choice(("normal", "normal", "ones", "spikes", "zeros")),
    )  # fmt: skip


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
    activation = "silu" if o["silu"] else None
    if o["api"] == "conv":
        result = causal_conv1d(
            x["x"], x["weight"], x["bias"], activation=activation,
            initial_state=x["initial_state"], return_final_state=o["final"],
        )  # fmt: skip
        if isinstance(result, tuple):
            return {"out": result[0], "final": result[1]}
        return {"out": result}
    state = x["initial_state"]
    result = causal_conv1d_fn(
        x["x"].transpose(1, 2), x["weight"], x["bias"], activation=activation,
        initial_states=None if state is None else state.transpose(1, 2),
        return_final_states=o["final"],
    )  # fmt: skip
    if isinstance(result, tuple):
        return {"out": result[0].transpose(1, 2), "final": result[1].transpose(1, 2)}
    return {"out": result.transpose(1, 2)}


def evaluate(case: Case, device: torch.device, trial: int = 0) -> Outcome:
    """Runs the operator and compares output, final state and all gradients with float64."""
    o = case.options
    x = build(case, device)
    leaves = {k: t for k, t in x.items() if t is not None}
    samples = {k: samples_of(t) for k, t in x.items()}
    r = Rounding(case.seed, trial)
    out, final = scan_oracle.conv(samples, o["silu"], DTYPES[o["dtype"]], r)
    truths = {"out": out, "final": final}
    cotangents = {
        n: fill(t.shape[1:], o["cotangent"], generator(case, f"v_{n}")).to(DTYPES[o["dtype"]])
        for n, t in truths.items()
    }
    results, grads, faults = repeated(lambda: _run(o, x), cotangents, leaves)
    named = {n: truths[n] for n in results}
    true_leaves = {k: t for k, t in samples.items() if t is not None}
    true_grads = gradients_of(named, true_leaves, cotangents)
    parts = {"out": (1,), "x": (1,), "final": (), "initial_state": ()}
    return Outcome(compared(results, grads, named, true_grads, parts), faults)


def _valid(options: dict) -> dict:
    o = options | {"width": min(4, max(2, options["width"]))}
    return fitted(o, ("batch", "length", "channels"), 60_000)  # more than draw can give


_CHOICES = {
    "api": ("conv", "causal-conv1d"), "dtype": tuple(DTYPES), "layout": LAYOUTS,
    "weight": RANGES, "cotangent": RANGES,
}  # fmt: skip
OP = Op("conv", RANGES, _PLAIN, _CHOICES, draw, _valid, evaluate)
