"""A selective scan to be timed and checked: inputs like an initialised model's, and the oracle."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial

import torch
from torch import Tensor

from ...selective_scan import selective_scan
from ...selective_scan.reference import EXACT, Off, selective_scan_reference
from ..core.case import BOTH, Settings, compare
from ..core.measure import peak_bytes, saved_bytes
from ..core.problem import Operator

# The relative rms errors to float64 that are allowed. Those of half precision are explained by the
# rounding of inputs and output.
LIMITS = {"forward": 1e-6, BOTH: 1e-5}
# With the error of ex2.approx at 16,961 tokens (CUDA.md): 1.9e-6 of the output, 3.3e-5 of dA.
CUDA_LIMITS = {"forward": 3e-6, BOTH: 4.5e-5}
HALF_LIMITS = {torch.bfloat16: 3e-2, torch.float16: 5e-3}
# Tokens, channels, and tokens that the oracle looks at.
SIZES = {"quick": (1024, 256, 128), "normal": (16961, 1024, 2048), "full": (16961, 1024, 16961)}


EX2 = 2.0**-22  # the largest relative error of ex2.approx, CUDA's own figure for exp2f


def allowances(
    results: Callable[[Off], Mapping[str, Tensor]], exponential: float = EX2
) -> dict[str, float]:
    """Allowed error of results by an inexact exponential (CUDA.md, Exponential).

    Args:
        results: the formulas in float64, their results by name.
        exponential: its largest relative error.

    Returns:
        By name the relative rms difference that errors always to one side make: of the decays, and
        of the steps, where a reciprocal adds half as much.
    """
    exact = results(EXACT)
    found = dict.fromkeys(exact, 0.0)
    for off in (Off(decay=exponential), Off(step=1.5 * exponential)):
        for name, value in results(off).items():
            found[name] += compare({name: value}, {name: exact[name]}).rel_rms
    return found


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


def scan_problem(
    inputs: dict[str, Tensor],
    device: torch.device,
    tokens: int,
    channels: int = 32,
    initial_state: Tensor | None = None,
    softplus: bool = True,
) -> Operator:
    """One set of inputs, run and checked in several ways.

    The oracle sees the first tokens and a few channels spread over all. Tokens do not depend on
    later ones, nor channels on each other, so for these it is exact.

    Args:
        inputs: of ``make_inputs``.
        device: where the operator runs.
        tokens: that the oracle sees.
        channels: likewise.
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
            own = chosen // (width // B.shape[2])
            B, C = B[:, :, own], C[:, :, own]
        options = {"delta_softplus": softplus, "initial_state": state}
        return selective_scan_reference(B=B, C=C, **options, **rest)[0]

    function = partial(selective_scan, delta_softplus=softplus)
    if initial_state is not None:
        function = partial(function, initial_state=initial_state.to(device))
    limits = CUDA_LIMITS if device.type == "cuda" else LIMITS
    part = f", first {tokens} of {length} tokens" if tokens < length else ""
    per_channel = dict.fromkeys(("u", "delta", "z", "out"), (*first, chosen))
    return Operator(
        function,
        reference,
        inputs,
        inputs["u"],
        device,
        f"float64 loop, {len(chosen)} of {width} channels{part}",
        {"B": batch, "L": length, "D": width, "N": inputs["A"].shape[1]},
        limits,
        HALF_LIMITS,
        cast=("u", "delta", "z", "B", "C", "out"),
        corner=per_channel
        | dict.fromkeys("BC", first)
        | dict.fromkeys(("A", "D", "delta_bias"), chosen),
    )


def make_problem(settings: Settings, channels_seen: int = 32, **changes) -> Operator:
    """A problem of the level's size, but for ``changes`` of ``make_inputs``."""
    length, width, tokens = SIZES[settings.level]
    inputs = make_inputs(**({"batch": 1, "length": length, "channels": width} | changes))
    return scan_problem(inputs, settings.device, tokens, channels_seen)


def count_memory(problem: Operator, direction: str) -> dict[str, int]:
    """Bytes of all states, of those saved for the gradient, and at the peak."""
    run = problem.forward if direction == "forward" else problem.backward
    counts = {"state_history_bytes": 4 * math.prod(problem.sizes.values())}
    if direction == BOTH:
        leaves = problem.leaves()
        counts["saved_bytes"] = saved_bytes(lambda: problem.call(leaves), leaves.values())
    peak = peak_bytes(run, problem.device)
    return counts if peak is None else counts | {"peak_bytes": peak}
