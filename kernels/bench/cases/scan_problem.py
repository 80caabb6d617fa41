"""A selective scan to be timed and checked: inputs like an initialised model's, and the oracle."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ...selective_scan import selective_scan
from ...selective_scan.reference import selective_scan_reference
from ..core.case import Error, Settings, Variant, compare
from ..core.measure import peak_bytes, saved_bytes

# The relative rms errors to float64 that are allowed. Those of half precision are explained by the
# rounding of inputs and output.
FORWARD_LIMIT, BACKWARD_LIMIT = 1e-6, 1e-5
CUDA_LIMIT = 1e-5  # of both directions: ex2.approx is off by 2^-22 at every token
HALF_LIMITS = {torch.bfloat16: 3e-2, torch.float16: 5e-3}
TRADE_LIMIT = 1.0  # where accuracy is the knob
BOTH = "forward+backward"
# Tokens, channels, and tokens that the oracle looks at.
SIZES = {"quick": (1024, 256, 128), "normal": (16961, 1024, 2048), "full": (16961, 1024, 16961)}


def make_inputs(
    batch: int, length: int, channels: int, states: int = 16, groups: int = 1, seed: int = 0
) -> dict[str, Tensor]:
    """Arguments of ``selective_scan``, float32 on the CPU, as in a model at its start.

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


@dataclass(eq=False)
class ScanProblem:
    """One set of inputs, run and checked in several ways.

    The oracle sees a corner of the problem: the first tokens and a few channels spread over all.
    Tokens do not depend on later ones, nor channels on each other, so for these it is exact; for
    gradients the cotangent is 0 outside the corner, so that of B and C, which sum over channels,
    are exact as well.

    Attributes:
        inputs: of ``make_inputs``, the truth that every dtype is compared with.
        device: where the operator runs.
        tokens: of the corner.
        channels: of the corner.
        initial_state: ``[B, D, N]``, or None.
        softplus: whether δ is one.
    """

    inputs: dict[str, Tensor]
    device: torch.device
    tokens: int
    channels: int = 32
    initial_state: Tensor | None = None
    softplus: bool = True
    _truths: dict = field(default_factory=dict)
    _cast: dict = field(default_factory=dict)

    def __post_init__(self) -> None:
        _, length, width = self.inputs["u"].shape
        self.tokens = min(self.tokens, length)
        self.chosen = torch.arange(0, width, max(1, width // self.channels))[: self.channels]
        self.chosen = self.chosen + torch.arange(len(self.chosen)) % max(1, width // self.channels)

    @property
    def oracle(self) -> str:
        """What the check compares with, in words."""
        _, length, width = self.inputs["u"].shape
        part = f"{len(self.chosen)} of {width} channels"
        if self.tokens < length:
            part += f", first {self.tokens} of {length} tokens"
        return f"float64 loop, {part}"

    @property
    def sizes(self) -> dict[str, int]:
        """For tables and charts."""
        batch, length, width = self.inputs["u"].shape
        return {"B": batch, "L": length, "D": width, "N": self.inputs["A"].shape[1]}

    def bare(self) -> ScanProblem:
        """The same with the steps given, and no gate, skip or bias."""
        x = self.inputs
        step = torch.nn.functional.softplus(x["delta"] + x["delta_bias"])
        inputs = {"u": x["u"], "delta": step, "A": x["A"], "B": x["B"], "C": x["C"]}
        return ScanProblem(inputs, self.device, self.tokens, self.channels, softplus=False)

    def at(self, dtype: torch.dtype) -> dict[str, Tensor]:
        """The inputs on the device, with u, delta, z, B and C in a dtype; kept."""
        if dtype not in self._cast:
            cast = ("u", "delta", "z", "B", "C")
            self._cast[dtype] = {
                k: x.to(self.device, dtype if k in cast else None) for k, x in self.inputs.items()
            }
        return self._cast[dtype]

    def call(self, inputs: dict[str, Tensor], **options) -> Tensor:
        """The operator as a model calls it."""
        state = self.initial_state
        if state is not None:
            options["initial_state"] = state.to(self.device)
        given: dict[str, Any] = {**inputs, **options}
        return selective_scan(**given, delta_softplus=self.softplus)

    def forward(self, dtype: torch.dtype = torch.float32, **options) -> Tensor:
        """What is timed: the output, without a gradient."""
        with torch.no_grad():
            return self.call(self.at(dtype), **options)

    def leaves(self, dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
        """The inputs, asking for gradients."""
        return {k: x.detach().requires_grad_() for k, x in self.at(dtype).items()}

    def backward(self, dtype: torch.dtype = torch.float32, **options) -> tuple[Tensor, ...]:
        """What is timed: forward and all gradients, with u as the cotangent."""
        leaves = self.leaves(dtype)
        out = self.call(leaves, **options)
        return torch.autograd.grad(out, list(leaves.values()), self.at(dtype)["u"])

    def check_output(self, out: Tensor, discretization: str = "mamba") -> Error:
        """Error of an output ``[B, L, D]``."""
        want = self._truth(discretization)["out"]
        return compare({"out": out[:, : self.tokens].cpu()[..., self.chosen]}, {"out": want})

    def check_forward(self, dtype: torch.dtype = torch.float32, **options) -> Error:
        """Error of ``forward``."""
        out = self.forward(dtype, **options)
        return self.check_output(out, options.get("discretization", "mamba"))

    def check_backward(self, dtype: torch.dtype = torch.float32, **options) -> Error:
        """Error of the output and of every gradient."""
        leaves = self.leaves(dtype)
        out = self.call(leaves, **options)
        cotangent = torch.zeros(out.shape, dtype=out.dtype)
        corner = self._cotangent()
        cotangent[:, : self.tokens, self.chosen] = corner.to(out.dtype)
        grads = torch.autograd.grad(out, list(leaves.values()), cotangent.to(self.device))
        got = {name: self._corner(name, g.cpu()) for name, g in zip(leaves, grads)}
        want = self._truth(options.get("discretization", "mamba"), gradients=True)
        got["out"] = out.detach()[:, : self.tokens].cpu()[..., self.chosen]
        return compare(got, want)

    def _corner(self, name: str, x: Tensor) -> Tensor:
        if name in ("u", "delta", "z"):
            return x[:, : self.tokens, self.chosen]
        if name in ("B", "C"):
            return x[:, : self.tokens]
        return x[self.chosen]

    def _cotangent(self) -> Tensor:
        g = torch.Generator().manual_seed(1)
        return torch.randn(len(self.inputs["u"]), self.tokens, len(self.chosen), generator=g)

    def _truth(self, discretization: str, gradients: bool = False) -> dict[str, Tensor]:
        """Output, and if asked for the gradients, of the corner in float64; kept."""
        key = discretization, gradients
        if key in self._truths:
            return self._truths[key]
        leaves = {k: self._corner(k, x).double() for k, x in self.inputs.items()}
        groups = self.inputs["B"].shape[2] if self.inputs["B"].dim() == 4 else 1
        full = {k: x.requires_grad_(gradients) for k, x in leaves.items()}
        arguments = dict(full)
        if groups > 1:  # a channel's own group; every chosen channel becomes a group of one
            own = self.chosen // (self.inputs["u"].shape[2] // groups)
            arguments |= {k: full[k][:, :, own] for k in ("B", "C")}
        state = self.initial_state
        with torch.set_grad_enabled(gradients):
            out, _ = selective_scan_reference(
                **arguments,
                delta_softplus=self.softplus,
                initial_state=None if state is None else state[:, self.chosen].double(),
                discretization=discretization,
            )
        truth = {"out": out.detach()}
        if gradients:
            grads = torch.autograd.grad(out, list(full.values()), self._cotangent().double())
            truth |= dict(zip(full, grads))
        self._truths[key] = truth
        return truth


def make_problem(settings: Settings, **changes) -> ScanProblem:
    """A problem of the level's size, but for ``changes`` of ``make_inputs``."""
    length, width, tokens = SIZES[settings.level]
    inputs = make_inputs(**({"batch": 1, "length": length, "channels": width} | changes))
    return ScanProblem(inputs, settings.device, tokens)


def make_variant(
    problem: ScanProblem,
    name: str,
    direction: str = "forward",
    dtype: torch.dtype = torch.float32,
    options: dict | None = None,
    **changes,
) -> Variant:
    """A variant that calls the operator with ``options``."""
    forward, options = direction == "forward", options or {}
    limit = FORWARD_LIMIT if forward else BACKWARD_LIMIT
    if problem.device.type == "cuda":
        limit = CUDA_LIMIT
    return Variant(
        name,
        partial(problem.forward if forward else problem.backward, dtype, **options),
        partial(problem.check_forward if forward else problem.check_backward, dtype, **options),
        HALF_LIMITS.get(dtype, limit),
        problem.oracle,
        direction,
        str(dtype).removeprefix("torch."),
        parameters=problem.sizes,
        **changes,
    )


def make_pair(problem: ScanProblem, name: str, **changes) -> list[Variant]:
    """Forward, and forward with all gradients."""
    return [make_variant(problem, name, direction, **changes) for direction in ("forward", BOTH)]


def count_memory(problem: ScanProblem, direction: str) -> dict[str, int]:
    """Bytes: of all states, of what is kept for the gradient, and the peak."""
    run = problem.forward if direction == "forward" else problem.backward
    counts = {"state_history_bytes": 4 * math.prod(problem.sizes.values())}
    if direction == BOTH:
        leaves = problem.leaves()
        counts["saved_bytes"] = saved_bytes(lambda: problem.call(leaves), leaves.values())
    peak = peak_bytes(run, problem.device)
    return counts if peak is None else counts | {"peak_bytes": peak}
