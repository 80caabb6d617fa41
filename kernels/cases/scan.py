"""Cases of the selective scan: like an initialised model's, and random and hostile ones."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ..selective_scan import selective_scan, selective_scan_fn, selective_scan_state
from ..selective_scan.reference import selective_scan_reference
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

# The relative rms errors to float64 that are allowed. Those of half precision are explained by the
# rounding of inputs and output.
LIMITS = {"forward": 1e-6, BOTH: 1e-5}
# With the error of ex2.approx at 16,961 tokens (CUDA.md): 1.9e-6 of the output, 3.3e-5 of dA.
CUDA_LIMITS = {"forward": 3e-6, BOTH: 4.5e-5}
HALF_LIMITS = {torch.bfloat16: 3e-2, torch.float16: 5e-3}


def make_inputs(
    batch: int, length: int, channels: int, states: int = 16, groups: int = 1, seed: int = 0
) -> dict[str, Tensor]:
    """Return arguments of ``selective_scan``, float32 on the CPU, as in a model at its start.

    u, z, B and C are standard normal, D is 1; delta is 0.5·normal before a bias whose softplus is
    log-uniform in 1e-3..1e-1; A = -(1..N) with 10 % of relative noise.
    """
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g)

    grouped = (batch, length, states) if groups == 1 else (batch, length, groups, states)
    low, high = math.log(1e-3), math.log(1e-1)
    step = torch.exp(low + (high - low) * torch.rand(channels, generator=g))
    rates = torch.arange(1, states + 1) * (1 + 0.1 * normal(channels, states)).clamp_min(0.1)
    return {
        "u": normal(batch, length, channels),
        "delta": normal(batch, length, channels).mul_(0.5),
        "A": -rates,
        "B": normal(*grouped),
        "C": normal(*grouped),
        "D": torch.ones(channels),
        "z": normal(batch, length, channels),
        "delta_bias": step + torch.log(-torch.expm1(-step)),
    }


def scan_case(
    inputs: Mapping[str, Tensor],
    device: torch.device,
    tokens: int,
    channels: int = 32,
    initial_state: Tensor | None = None,
    softplus: bool = True,
) -> Case:
    """Return the scan of one set of inputs.

    The oracle sees the first tokens and a few channels spread over all. Tokens do not depend on
    later ones, nor channels on each other, so for these it is exact.

    Args:
        inputs: of ``make_inputs``.
        device: of the operator.
        tokens: number that the oracle sees.
        channels: number that the oracle sees.
        initial_state: ``[B, D, N]``, or None.
        softplus: True to apply softplus to delta.
    """
    batch, length, width = inputs["u"].shape
    tokens, step = min(tokens, length), max(1, width // channels)
    chosen = torch.arange(0, width, step)[:channels]
    chosen = chosen + torch.arange(len(chosen)) % step
    first = slice(None), slice(tokens)
    state = None if initial_state is None else initial_state[:, chosen].double()

    def reference(*, B: Tensor, C: Tensor, **rest) -> Tensor:
        if B.dim() == 4:  # a channel's own group; every chosen channel becomes a group of one
            group = chosen // (width // B.shape[2])
            B, C = B[:, :, group], C[:, :, group]
        options = {"delta_softplus": softplus, "initial_state": state}
        return selective_scan_reference(B=B, C=C, **options, **rest)[0]

    function = partial(selective_scan, delta_softplus=softplus)
    if initial_state is not None:
        function = partial(function, initial_state=initial_state.to(device))
    limits = CUDA_LIMITS if device.type == "cuda" else LIMITS
    text = f", first {tokens} of {length} tokens" if tokens < length else ""
    part = dict.fromkeys(("u", "delta", "z", "out"), (*first, chosen))
    part |= dict.fromkeys("BC", first) | dict.fromkeys(("A", "D", "delta_bias"), chosen)
    return Case(
        function,
        reference,
        inputs,
        inputs["u"],
        device,
        f"float64 loop, {len(chosen)} of {width} channels{text}",
        {"B": batch, "L": length, "D": width, "N": inputs["A"].shape[1]},
        limits,
        HALF_LIMITS,
        cast=("u", "delta", "z", "B", "C"),
        part=dict.fromkeys(DIRECTIONS, part),
    )


# Random and hostile cases.

DISCRETIZATIONS = ("mamba", "bilinear", "zoh")
APIS = ("scan", "state", "prefix", "mamba-ssm")
LAYOUTS = ("dense", "expanded", "channels first", "part")
SEQUENCES = (1, 1, 1, 2, 3, 7, 20)  # packed in one row
_LARGEST = 60_000  # B L D N: the oracle holds some dozen of these eight times

# kind -> options that it fixes or draws; the ranges of delta and A: see _steps, _rates
KINDS: dict[str, dict] = {
    "uniform": {},
    "tiny": {"u": "tiny", "B": "tiny"},
    "huge": {"u": "huge", "B": "huge"},
    "denormal": {"u": "denormal"},
    "constant": {"u": "ones", "B": "ones", "delta": "constant"},
    "zeros": {"u": "zeros"},
    "alternating": {"u": "alternating", "B": "ones", "delta": "constant"},
    "spread": {"u": "spread", "B": "spread", "C": "spread", "A": "wide", "delta": "wide"},
    "spikes": {"u": "spikes", "delta": "wide"},
    "slow": {"A": "slow"},
    "no decay": {"A": "zero"},
    "fast": {"A": "fast"},
    "all rates": {"A": "wide"},
    "steps off": {"delta": "off"},
    "steps at 20": {"delta": "at 20", "softplus": True},
    "steps on": {"delta": "on"},
    "signed steps": {"delta": "signed", "A": "model", "softplus": False},
    "long": {
        "length": (2049, 5000, 16961, 20000), "states": 1, "channels": (1, 2, 3),
        "A": ("model", "slow", "zero"), "delta": ("steps", "constant"),
        "batch": 1, "groups": 1, "layout": "dense",
    },
}  # fmt: skip
OPTIONS = {
    "dtype": ("float32", "float32", "bfloat16", "float16"),
    "api": APIS,
    "batch": (1, 1, 2, 3),
    "length": (1, 0, 2, 3, 4, 15, 16, 17, 63, 64, 65, 100, 127, 129, 200, 300, 577),
    "channels": (1, 2, 3, 5, 8, 15, 16, 17, 31, 32, 33, 48, 65, 130),
    "states": (1, 2, 3, 4, 5, 8, 16, 16, 17, 32, 33, 64, 128, 255, 256),
    "groups": (1, 1, 2, 3),
    "delta_dtype": ("float32", *["as dtype"] * 4),
    "layout": LAYOUTS,
    "discretization": ("mamba", *DISCRETIZATIONS),
    "softplus": (False, False, True, True, True),
    "use_D": (False, True),
    "use_z": (False, True),
    "use_bias": (False, True),
    "use_state": (False, True),
    "last": (False, True),
    "split": range(577),
    "constant_B": (*[False] * 4, True),
    "u": mostly("normal", RANGES),
    "delta": ("steps", "steps", "wide", "constant"),
    "A": ("model", "model", "wide", "slow"),
    "B": ("normal",),
    "C": mostly("normal", RANGES),
    "cotangent": COTANGENTS,
    "sequences": SEQUENCES,
}


def _fit(options: dict) -> dict:
    """Return sizes that fit each other and the oracle, and options that the API takes."""
    o = dict(options)
    if o["delta_dtype"] == "as dtype":
        o["delta_dtype"] = o["dtype"]
    if o["api"] in ("prefix", "mamba-ssm"):
        o["sequences"] = 1
    if o["sequences"] > 1:
        o["batch"] = 1
    while math.prod(o[k] for k in ("batch", "length", "channels", "states")) > _LARGEST:
        if o["states"] > 1 and (o["length"] < 1000 or o["channels"] == 1):
            o["states"] = (o["states"] + 1) // 2
        else:
            o["channels"] = max(1, o["channels"] // 2)
            if o["channels"] == 1 and o["states"] == 1:
                o["batch"] = 1
                break
    o["groups"] = math.gcd(o["groups"], o["channels"])
    if o["api"] != "prefix":
        o["split"] = 0
    o["split"] = min(o["split"], o["length"])
    if o["api"] == "mamba-ssm":
        o |= {"use_state": False, "discretization": "mamba"}
    else:
        o["constant_B"] = False
    if o["api"] == "state":
        o |= {"last": True, "use_D": False, "use_z": False}
    if o["api"] == "prefix":
        o["last"] = True
    if o["delta"] == "signed":  # e^|δA| grows: keep within range
        o["length"], o["A"] = min(o["length"], 300), "model"
        o["states"] = min(o["states"], 8)
    if o["delta"] in ("at 20", "off") and not o["softplus"]:
        o["delta"] = "steps"
    return o


def _steps_and_rates(o: dict, shape: tuple[int, ...], g: dict) -> tuple[Tensor, Tensor]:
    """Return the steps, before a softplus or as used, and ``A [D, N]``, by their ranges."""
    uniform = torch.rand(shape, generator=g["delta"])
    normal = torch.randn(shape, generator=g["delta"])
    if o["softplus"]:
        steps = {
            "steps": -4 + 1.5 * normal, "wide": 30 * normal, "constant": 0 * normal - 3.3,
            "off": -100 + normal, "on": 100 + normal, "at 20": 20 + 1e-3 * normal,
        }  # fmt: skip
    else:
        steps = {
            "steps": 10 ** (2 * uniform - 3), "wide": 10 ** (8 * uniform - 6),
            "constant": 0 * uniform + 0.037, "on": 30 + 70 * uniform,
        }  # fmt: skip
    noise = torch.rand(o["channels"], o["states"], generator=g["A"])
    rates = {
        "model": torch.arange(1.0, o["states"] + 1) * (0.9 + 0.2 * noise), "slow": 0 * noise + 1e-6,
        "zero": 0 * noise, "fast": 1e3 * (1 + noise), "wide": 10 ** (9 * noise - 6),
    }  # fmt: skip
    steps["signed"] = 0.02 * normal
    return steps[o["delta"]], -rates[o["A"]]


def laid(x: Tensor, layout: str) -> Tensor:
    """Return the same values with another layout; "expanded" repeats batch element 0."""
    if layout == "expanded":
        return x[:1].expand_as(x)
    if layout == "channels first":
        return x.transpose(1, -1).contiguous().transpose(1, -1)
    if layout == "part":
        return torch.cat([x, x, x], -1)[..., x.shape[-1] : 2 * x.shape[-1]]
    return x


def borders(case: RandomCase, device: torch.device) -> Tensor | None:
    """Return ``cu_seqlens`` of the packed sequences, some without tokens; None for a single one."""
    length, count = case.options["length"], case.options["sequences"]
    if count == 1:
        return None
    cuts = torch.randint(length + 1, (count - 1,), generator=generator(case, "cuts"))
    return torch.tensor([0, *cuts.sort().values.tolist(), length], device=device)


def build(case: RandomCase, device: torch.device) -> dict[str, Tensor | None]:
    """Return the leaves by argument, channels last; a constant B is ``[D, N]``."""
    o = case.options
    batch, length, channels, n = (o[k] for k in ("batch", "length", "channels", "states"))
    token, grouped = (batch, length, channels), (batch, length, o["groups"], n)
    g = {name: generator(case, name) for name in ("u", "delta", "A", "B", "C", "z", "rest")}
    rest = partial(torch.randn, generator=g["rest"])
    steps, rates = _steps_and_rates(o, token, g)
    B_shape = (channels, n) if o["constant_B"] else grouped
    leaves = {
        "u": fill(token, o["u"], g["u"]),
        "delta": steps,
        "A": rates,
        "B": fill(B_shape, o["B"], g["B"]),
        "C": fill(grouped, o["C"], g["C"]),
        "D": rest(channels) if o["use_D"] else None,
        "z": 3 * torch.randn(token, generator=g["z"]) if o["use_z"] else None,
        "delta_bias": rest(channels) if o["use_bias"] and o["softplus"] else None,
        "initial_state": rest(max(batch, o["sequences"]), channels, n) if o["use_state"] else None,
    }
    if o["use_bias"] and not o["softplus"]:
        leaves["delta_bias"] = 0.01 * rest(channels).abs()
    dtypes = {"u": "dtype", "z": "dtype", "B": "dtype", "C": "dtype", "delta": "delta_dtype"}
    for name, option in dtypes.items():
        if leaves[name] is not None:
            limit = torch.finfo(DTYPES[o[option]]).max
            leaves[name] = leaves[name].clamp(-limit, limit).to(DTYPES[o[option]])
            if name != "B" or not o["constant_B"]:
                leaves[name] = laid(leaves[name].to(device), o["layout"])
    return {
        k: None if x is None else x.to(device).detach().requires_grad_() for k, x in leaves.items()
    }


def _run(o: dict, x: dict, cu_seqlens: Tensor | None) -> dict[str, Tensor]:
    """Return the results by name, channels last."""
    common: dict[str, Any] = dict(delta_softplus=o["softplus"])
    if o["api"] == "mamba-ssm":
        u, delta = x["u"].mT, x["delta"].mT
        z = None if x["z"] is None else x["z"].mT
        B, C = (t if t.dim() == 2 else t.permute(0, 2, 3, 1).squeeze(1) for t in (x["B"], x["C"]))
        more = dict(return_last_state=o["last"], **common)
        result = selective_scan_fn(u, delta, x["A"], B, C, x["D"], z, x["delta_bias"], **more)
        out, *last = result if isinstance(result, tuple) else (result,)
        return {"out": out.mT} | dict(zip(["last"], last))
    common |= dict(discretization=o["discretization"], cu_seqlens=cu_seqlens)
    state = x["initial_state"]
    k = o["length"] if o["api"] == "state" else o["split"]
    if o["api"] in ("state", "prefix"):
        u, delta = (x[name][:, :k] for name in ("u", "delta"))
        steps = dict(delta_bias=x["delta_bias"], initial_state=state, **common)
        state = selective_scan_state(u, delta, x["A"], x["B"][:, :k], **steps)
    if o["api"] == "state":
        return {"last": state}
    u, delta, B, C = (x[name][:, k:] for name in ("u", "delta", "B", "C"))
    z = None if x["z"] is None else x["z"][:, k:]
    common |= dict(initial_state=state, return_last_state=o["last"])
    result = selective_scan(u, delta, x["A"], B, C, x["D"], z, x["delta_bias"], **common)
    return dict(zip(("out", "last"), result if isinstance(result, tuple) else (result,)))


def evaluate(case: RandomCase, device: torch.device, trial: int = 0) -> Outcome:
    """Run the operator and compare outputs and all gradients with float64."""
    o, r, x = case.options, Rounding(case.seed, trial), build(case, device)
    samples: dict[str, Any] = {name: samples_of(t) for name, t in x.items()}
    used = dict(samples)
    if o["constant_B"]:  # every channel is its own group
        used["B"] = scan_oracle.over_tokens(r(samples["B"]), samples["u"], r)
    exact = partial(
        scan_oracle.scan, softplus=o["softplus"], discretization=o["discretization"], r=r
    )
    cuts = borders(case, device)
    out, last = scan_oracle.of_sequences(exact, used, cuts)
    leaves = {k: t for k, t in x.items() if t is not None}
    expected = {"out": out[:, :, o["split"] :], "last": last}
    runs = Runs(case, lambda: _run(o, x, cuts), leaves, expected, {k: samples[k] for k in leaves})
    # the tokens of a channel are taken together
    parts: dict[str, tuple[int, ...]] = dict.fromkeys(("out", "u", "delta", "z", "C"), (1,))
    return runs.outcome(parts if o["constant_B"] else parts | {"B": (1,)})


OP = Op("scan", KINDS, OPTIONS, _fit, evaluate)
