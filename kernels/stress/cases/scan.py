"""Random and hostile cases of the selective scan."""

from __future__ import annotations

import math
from random import Random
from typing import Any

import torch
from torch import Tensor

from ...selective_scan import selective_scan, selective_scan_fn, selective_scan_state
from ..core.case import DTYPES, Case, Comparison, Op, Outcome, fitted, generator, judge
from ..core.ranges import RANGES, fill
from ..core.rounding import Rounding, samples_of
from ..oracles import scan as scan_oracle

DISCRETIZATIONS = ("mamba", "bilinear", "zoh")
APIS = ("scan", "state", "prefix", "mamba-ssm")
LAYOUTS = ("dense", "expanded", "channels first", "part")
_LENGTHS = (0, 1, 2, 3, 4, 15, 16, 17, 63, 64, 65, 100, 127, 129, 200, 300, 577)
_CHANNELS = (1, 2, 3, 5, 8, 15, 16, 17, 31, 32, 33, 48, 65, 130)
_STATES = (1, 2, 3, 4, 5, 8, 16, 16, 17, 32, 33, 64, 128, 255, 256)
_LARGEST = 60_000  # B L D N: the oracle holds some dozen of these eight times

# kind -> options that it fixes; ranges of u, B, C: of ranges.py; of delta and A: see _steps, _rates
_KINDS: dict[str, dict] = {
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
    "long": {"batch": 1, "groups": 1, "layout": "dense"},
}
_PLAIN = {
    "api": "scan", "batch": 1, "length": 1, "channels": 1, "states": 1, "groups": 1,
    "dtype": "float32", "delta_dtype": "float32", "layout": "dense", "discretization": "mamba",
    "softplus": False, "use_D": False, "use_z": False, "use_bias": False, "use_state": False,
    "last": False, "split": 0, "constant_B": False, "u": "normal", "delta": "steps", "A": "model",
    "B": "normal", "C": "normal", "cotangent": "normal",
}  # fmt: skip


def draw(rng: Random, kind: str) -> dict:
    """Random options."""
    flag = lambda chance=0.5: rng.random() < chance  # noqa: E731
    dtype = rng.choice(("float32", "float32", "bfloat16", "float16"))
    options = dict(
        api=rng.choice(APIS), batch=rng.choice((1, 1, 2, 3)), length=rng.choice(_LENGTHS),
        channels=rng.choice(_CHANNELS), states=rng.choice(_STATES), groups=rng.choice((1, 1, 2, 3)),
        dtype=dtype, delta_dtype="float32" if flag(0.2) else dtype, layout=rng.choice(LAYOUTS),
        discretization=rng.choice(("mamba", *DISCRETIZATIONS)), softplus=flag(0.6), use_D=flag(),
        use_z=flag(), use_bias=flag(), use_state=flag(), last=flag(),
        split=rng.randrange(_LENGTHS[-1]), constant_B=flag(0.2),
        u=rng.choice(RANGES) if flag(0.3) else "normal",
        delta=rng.choice(("steps", "steps", "wide", "constant")),
        A=rng.choice(("model", "model", "wide", "slow")),
        B="normal", C=rng.choice(RANGES) if flag(0.2) else "normal",
        cotangent=rng.choice(("normal", "normal", "ones", "spikes", "zeros")),
    )  # fmt: skip
    if kind == "long":
        options |= dict(
            length=rng.choice((2049, 5000, 16961, 20000)), states=1, channels=rng.choice((1, 2, 3)),
            A=rng.choice(("model", "slow", "zero")), delta=rng.choice(("steps", "constant")),
        )  # fmt: skip
    return valid(options | _KINDS[kind])


def valid(options: dict) -> dict:
    """Sizes that fit each other and the oracle; options that the API takes."""
    o = dict(options)
    while math.prod(o[k] for k in ("batch", "length", "channels", "states")) > _LARGEST:
        if o["states"] > 1 and (o["length"] < 1000 or o["channels"] == 1):
            o["states"] = (o["states"] + 1) // 2
        else:
            o["channels"] = max(1, o["channels"] // 2)
            if o["channels"] == 1 and o["states"] == 1:
                o["batch"] = 1
                break
    o = fitted(o, ("batch", "length", "channels", "states"), 4 * _LARGEST)
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


def _steps(o: dict, shape: tuple[int, ...], g: torch.Generator) -> Tensor:
    """The steps by the name of its range, before a softplus or as it is used."""
    uniform = torch.rand(shape, generator=g)
    normal = torch.randn(shape, generator=g)
    if o["delta"] == "signed":
        return 0.02 * normal
    if o["softplus"]:
        named = {
            "steps": -4 + 1.5 * normal, "wide": 30 * normal, "constant": 0 * normal - 3.3,
            "off": -100 + normal, "on": 100 + normal, "at 20": 20 + 1e-3 * normal,
        }  # fmt: skip
    else:
        named = {
            "steps": 10 ** (2 * uniform - 3), "wide": 10 ** (8 * uniform - 6),
            "constant": 0 * uniform + 0.037, "on": 30 + 70 * uniform,
        }  # fmt: skip
    return named[o["delta"]]


def _rates(o: dict, g: torch.Generator) -> Tensor:
    """``A [D, N]`` by the name of its range."""
    shape = o["channels"], o["states"]
    noise = torch.rand(shape, generator=g)
    if o["A"] == "model":
        return -torch.arange(1.0, shape[1] + 1) * (0.9 + 0.2 * noise)
    named = {"slow": 0 * noise + 1e-6, "zero": 0 * noise, "fast": 1e3 * (1 + noise)}
    return -named.get(o["A"], 10 ** (9 * noise - 6))


def laid(x: Tensor, layout: str) -> Tensor:
    """The same shape with another layout; "expanded" repeats batch element 0."""
    if layout == "expanded":
        return x[:1].expand_as(x)
    if layout == "channels first":
        return x.transpose(1, -1).contiguous().transpose(1, -1)
    if layout == "part":
        return torch.cat([x, x, x], -1)[..., x.shape[-1] : 2 * x.shape[-1]]
    return x


def build(case: Case, device: torch.device) -> dict[str, Tensor | None]:
    """The leaves by argument, channels last; a constant B is ``[D, N]``."""
    o = case.options
    batch, length, channels, n = (o[k] for k in ("batch", "length", "channels", "states"))
    token, grouped = (batch, length, channels), (batch, length, o["groups"], n)
    g = {name: generator(case, name) for name in ("u", "delta", "A", "B", "C", "z", "rest")}
    rest = lambda *shape: torch.randn(*shape, generator=g["rest"])  # noqa: E731
    B_shape = (channels, n) if o["constant_B"] else grouped
    made = {
        "u": fill(token, o["u"], g["u"]),
        "delta": _steps(o, token, g["delta"]),
        "A": _rates(o, g["A"]),
        "B": fill(B_shape, o["B"], g["B"]),
        "C": fill(grouped, o["C"], g["C"]),
        "D": rest(channels) if o["use_D"] else None,
        "z": 3 * torch.randn(token, generator=g["z"]) if o["use_z"] else None,
        "delta_bias": rest(channels) if o["use_bias"] and o["softplus"] else None,
        "initial_state": rest(batch, channels, n) if o["use_state"] else None,
    }
    if o["use_bias"] and not o["softplus"]:
        made["delta_bias"] = 0.01 * rest(channels).abs()
    dtypes = {"u": "dtype", "z": "dtype", "B": "dtype", "C": "dtype", "delta": "delta_dtype"}
    for name, option in dtypes.items():
        if made[name] is not None:
            limit = torch.finfo(DTYPES[o[option]]).max
            made[name] = made[name].clamp(-limit, limit).to(DTYPES[o[option]])
            if name != "B" or not o["constant_B"]:
                made[name] = laid(made[name].to(device), o["layout"])
    return {
        k: None if x is None else x.to(device).detach().requires_grad_() for k, x in made.items()
    }


def _run(o: dict, x: dict) -> dict[str, Tensor]:
    """The results by name, channels last."""
    common: dict[str, Any] = dict(delta_softplus=o["softplus"])
    if o["api"] == "mamba-ssm":
        u, delta = (x[name].transpose(1, 2) for name in ("u", "delta"))
        z = None if x["z"] is None else x["z"].transpose(1, 2)
        B, C = (t if t.dim() == 2 else t.permute(0, 2, 3, 1) for t in (x["B"], x["C"]))
        if o["groups"] == 1:
            B, C = (t if t.dim() == 2 else t[:, 0] for t in (B, C))
        result = selective_scan_fn(
            u, delta, x["A"], B, C, x["D"], z, x["delta_bias"],
            return_last_state=o["last"], **common,
        )  # fmt: skip
        if isinstance(result, tuple):
            return {"out": result[0].transpose(1, 2), "last": result[1]}
        return {"out": result.transpose(1, 2)}
    common["discretization"] = o["discretization"]
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
    result = selective_scan(
        u, delta, x["A"], B, C, x["D"], z, x["delta_bias"], initial_state=state,
        return_last_state=o["last"], **common,
    )  # fmt: skip
    if isinstance(result, tuple):
        return {"out": result[0], "last": result[1]}
    return {"out": result}


def _oracle(case: Case, x: dict, trial: int) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Results and leaves, ``[SAMPLES, ..]``."""
    o, leaves = case.options, {name: samples_of(t) for name, t in x.items()}
    used, r = dict(leaves), Rounding(case.seed, trial)
    if o["constant_B"]:  # every channel is a group of its own
        used["B"] = scan_oracle.over_tokens(r(leaves["B"]), leaves["u"], r)
    out, last = scan_oracle.scan(used, o["softplus"], o["discretization"], r)
    results = {"out": out[:, :, o["split"] :], "last": last}
    return results, {k: t for k, t in leaves.items() if t is not None}


# which dimensions of a result are taken together: tokens
_PARTS = {"out": (1,), "u": (1,), "delta": (1,), "z": (1,), "B": (1,), "C": (1,)}


def gradients_of(results: dict, leaves: dict, cotangents: dict) -> dict[str, Tensor]:
    """Gradients by leaf; zeros where a result does not depend on it."""
    names = [n for n in results if results[n].requires_grad and results[n].numel()]
    if not names:
        return {k: torch.zeros_like(x) for k, x in leaves.items()}
    grads = torch.autograd.grad(
        [results[n] for n in names], list(leaves.values()),
        [cotangents[n].to(results[n]).expand_as(results[n]) for n in names], allow_unused=True,
    )  # fmt: skip
    return {k: torch.zeros_like(x) if g is None else g for (k, x), g in zip(leaves.items(), grads)}


def repeated(run, cotangents: dict, leaves: dict) -> tuple[dict, dict, list[str]]:
    """Results and gradients of ``run()``, and what differs between two runs."""
    (first, grads), (again, others) = (
        (results := run(), gradients_of(results, leaves, cotangents)) for _ in range(2)
    )
    pairs = [(n, first[n], again[n]) for n in first]
    pairs += [(f"gradient of {n}", grads[n], others[n]) for n in grads]
    faults = [
        f"two runs differ in {name}"
        for name, a, b in pairs
        if not torch.equal(a.nan_to_num(1.5), b.nan_to_num(1.5))
    ]
    return first, grads, faults


def compared(results, grads, truths, true_grads, parts) -> list[Comparison]:
    """All results, then all gradients."""
    together = {name: parts.get(name, ()) for name in (*results, *grads)}
    made = [judge(n, x, truths[n], together[n]) for n, x in results.items()]
    return made + [
        judge(f"gradient of {n}", x, true_grads[n], together[n]) for n, x in grads.items()
    ]


def evaluate(case: Case, device: torch.device, trial: int = 0) -> Outcome:
    """Runs the operator and compares outputs and all gradients with float64."""
    o = case.options
    x = build(case, device)
    leaves = {k: t for k, t in x.items() if t is not None}
    truths, true_leaves = _oracle(case, x, trial)
    dtypes = {"out": DTYPES[o["dtype"]], "last": torch.float32}
    cotangents = {
        n: fill(t.shape[1:], o["cotangent"], generator(case, f"v_{n}")).to(dtypes[n])
        for n, t in truths.items()
    }
    results, grads, faults = repeated(lambda: _run(o, x), cotangents, leaves)
    named = {n: truths[n] for n in results}
    true_grads = gradients_of(named, true_leaves, cotangents)
    parts = dict(_PARTS, B=()) if o["constant_B"] else _PARTS
    return Outcome(compared(results, grads, named, true_grads, parts), faults)


_CHOICES = {
    "api": APIS, "dtype": tuple(DTYPES), "delta_dtype": tuple(DTYPES), "layout": LAYOUTS,
    "discretization": DISCRETIZATIONS, "u": RANGES, "B": RANGES, "C": RANGES, "cotangent": RANGES,
    "delta": ("steps", "wide", "constant", "off", "on", "at 20", "signed"),
    "A": ("model", "slow", "zero", "fast", "wide"),
}  # fmt: skip
OP = Op("scan", tuple(_KINDS), _PLAIN, _CHOICES, draw, valid, evaluate)
