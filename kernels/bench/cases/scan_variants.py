"""What the cases of the selective scan share: problems, variants, limits and memory."""

from __future__ import annotations

from functools import partial

import torch

from ..core.case import Settings, Variant
from ..core.measure import peak_bytes, saved_bytes
from .scan_problem import ScanProblem, make_inputs

# The relative rms errors to float64 that are allowed. Those of half precision are explained by the
# rounding of inputs and output.
FORWARD_LIMIT, BACKWARD_LIMIT = 1e-6, 1e-5
CUDA_LIMIT = 1e-5  # of both directions: ex2.approx is off by 2^-22 at every token
HALF_LIMITS = {torch.bfloat16: 3e-2, torch.float16: 5e-3}
TRADE_LIMIT = 1.0  # where accuracy is the knob
BOTH = "forward+backward"
# Tokens, channels, and tokens that the oracle looks at.
SIZES = {"quick": (1024, 256, 128), "normal": (16961, 1024, 2048), "full": (16961, 1024, 16961)}


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
    batch, length, width = problem.inputs["u"].shape
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
        parameters={"B": batch, "L": length, "D": width, "N": problem.inputs["A"].shape[1]},
        **changes,
    )


def make_pair(problem: ScanProblem, name: str, **changes) -> list[Variant]:
    """Forward, and forward with all gradients."""
    return [make_variant(problem, name, direction, **changes) for direction in ("forward", BOTH)]


def count_memory(problem: ScanProblem, direction: str) -> dict[str, int]:
    """Bytes: of all states, of what is kept for the gradient, and the peak."""
    batch, length, width = problem.inputs["u"].shape
    history = 4 * batch * length * width * problem.inputs["A"].shape[1]
    run = problem.forward if direction == "forward" else problem.backward
    counts = {"state_history_bytes": history}
    if direction == BOTH:
        leaves = problem.leaves()
        counts["saved_bytes"] = saved_bytes(lambda: problem.call(leaves), leaves.values())
    peak = peak_bytes(run, problem.device)
    return counts if peak is None else counts | {"peak_bytes": peak}
