"""Cases of the selective scan, and the targets on them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch

from .. import peers
from ..core.case import Case, Error, Key, Settings, Target, Variant, make_cases, over_threads
from .scan_problem import (
    BOTH,
    HALF_LIMITS,
    SIZES,
    ScanProblem,
    count_memory,
    make_inputs,
    make_pair,
    make_problem,
    make_variant,
)


def cases(settings: Settings) -> list[Case]:
    """All cases of the scan at the level's sizes."""
    cpu = settings.device.type == "cpu"
    builders = [
        ("operator", operator, None),
        ("reference loop", reference_loop, None),
        ("knobs", knobs, "error"),
        ("length", lengths, "L"),
        ("batch", batches, "B"),
        ("states", states, "N"),
        ("threads", by_threads, "threads") if cpu else ("training batch", training_batch, None),
    ]
    return make_cases("scan", settings, builders)


def operator(settings: Settings) -> list[Variant]:
    """The whole operator: softplus, bias, skip and gate."""
    return make_pair(make_problem(settings), "default", default=True)


def reference_loop(settings: Settings) -> list[Variant]:
    """The operator against the formula as a torch loop (as Mamba's reference does it), and against
    peers where they are installed, all on the same input.
    """
    length, width, tokens = SIZES[settings.level]
    if settings.level == "normal":
        length = 2048  # at 16961 tokens the loop takes seconds and its factors gigabytes
    problem = ScanProblem(make_inputs(1, length, width), settings.device, tokens)
    made = [
        make_variant(problem, "default", default=True),
        _peer(problem, "torch loop", peers.scan_loop, rounds=2),
    ]
    if settings.peers:
        made.append(_peer(problem, "mambapy", peers.mambapy_scan, channels_first=False, rounds=3))
        if settings.device.type == "cuda":
            made.append(_peer(problem, "mamba-ssm", peers.mamba_ssm_scan))
    return made


def _peer(
    problem: ScanProblem,
    name: str,
    function: Callable,
    dtype: torch.dtype = torch.float32,
    direction: str = "forward",
    channels_first: bool = True,
    **changes,
) -> Variant:
    """Another package's scan on the inputs of a problem, laid out as it wants them."""
    inputs = dict(problem.at(dtype))
    if channels_first:  # laid out as the peer wants it, before the clock
        inputs |= {k: inputs[k].mT.contiguous() for k in ("u", "delta", "B", "C", "z")}

    def forward() -> torch.Tensor:
        with torch.no_grad():
            return function(**inputs)

    def backward() -> tuple[torch.Tensor, ...]:
        leaves = {k: x.detach().requires_grad_() for k, x in inputs.items()}
        return torch.autograd.grad(function(**leaves), list(leaves.values()), inputs["u"])

    def check() -> Error:
        out = forward()
        return problem.check_output(out.mT if channels_first else out)

    return Variant(
        name,
        forward if direction == "forward" else backward,
        check,
        HALF_LIMITS.get(dtype, 1e-4),
        problem.oracle + ("" if direction == "forward" else ", output only"),
        direction,
        str(dtype).removeprefix("torch."),
        peer=True,
        parameters=problem.sizes,
        **changes,
    )


def knobs(settings: Settings) -> list[Variant]:
    """Every choice that a caller has. Half precision is compared with the truth of the float32
    inputs. The discretisations are different models, each compared with its own formula, so that
    the one of Mamba's weights is the default at any cost.
    """
    problem = make_problem(settings)
    made = make_pair(problem, "float32", default=True)
    for dtype in (torch.bfloat16, torch.float16):
        name = str(dtype).removeprefix("torch.") + " inputs and output"
        made += make_pair(problem, name, dtype=dtype)
    for discretization in ("bilinear", "zoh"):
        made += make_pair(problem, discretization, options={"discretization": discretization})
    start = ScanProblem(problem.inputs, problem.device, problem.tokens)
    batch, _, width = problem.inputs["u"].shape
    start.initial_state = torch.randn(batch, width, 16, generator=torch.Generator().manual_seed(2))
    made += make_pair(start, "with an initial state")
    made += make_pair(make_problem(settings, groups=4), "4 groups of B and C")
    return made


def lengths(settings: Settings) -> list[Variant]:
    """Cost and memory against the number of tokens. Saved: what the forward pass keeps beside its
    inputs; history: the states of all tokens; peak: growth of memory in forward and backward.
    """
    lengths = {"quick": (256, 1024)}.get(settings.level, (4096, 16384, 65536))
    made = []
    for length in lengths:
        problem = make_problem(settings, length=length)
        problem.channels = 8 if length > 16961 else 32
        for direction in ("forward", BOTH):
            made.append(make_variant(problem, f"L {length}", direction, rounds=20))
            made[-1].work = partial(count_memory, problem, direction)
    return made


def batches(settings: Settings) -> list[Variant]:
    """Cost against the number of sequences, of a small model's width."""
    quick = settings.level == "quick"
    length = 512 if quick else 4096
    made = []
    for batch in (1, 4) if quick else (1, 2, 4, 8):
        made += make_pair(
            make_problem(settings, batch=batch, length=length, channels=256), f"B {batch}"
        )
    return made


def states(settings: Settings) -> list[Variant]:
    """Cost against the number of states per channel; 16 is the tuned one."""
    counts = (4, 16) if settings.level == "quick" else (4, 8, 16, 32, 64)
    length = 512 if settings.level == "quick" else 4096
    made = []
    for states in counts:
        made += make_pair(make_problem(settings, length=length, states=states), f"N {states}")
    return made


def by_threads(settings: Settings) -> list[Variant]:
    """Cost against torch's number of threads, from one to the machine's cores."""
    return over_threads(partial(make_pair, make_problem(settings)))


def training_batch(settings: Settings) -> list[Variant]:
    """A layer of the paper's training: 16 sequences in bfloat16, beside mamba-ssm."""
    batch = 2 if settings.level == "quick" else 16
    problem = make_problem(settings, batch=batch)
    problem.tokens = min(problem.tokens, 2048)
    made = make_pair(problem, "default", dtype=torch.bfloat16, default=True)
    single = make_problem(settings)
    made.append(make_variant(single, "one sequence", dtype=torch.bfloat16))
    if settings.peers:
        peer = partial(_peer, problem, "mamba-ssm", peers.mamba_ssm_scan, torch.bfloat16)
        made += [peer(direction) for direction in ("forward", BOTH)]
    return made


def targets(settings: Settings) -> list[Target]:
    """What should be reached; nothing at a quick run's sizes."""
    if settings.level == "quick":
        return []
    key = partial(Key, "scan")
    ours, both = key("operator", "default"), key("operator", "default", BOTH)
    made = [Target("forward + backward over forward", (both,), (ours,), at_most=5)]
    long, short = (partial(key, "length", f"L {length}") for length in (65536, 4096))
    for name, field in (("time", "ms_p50"), ("memory", "peak_bytes")):
        for direction in ("forward", BOTH):
            text = f"{direction}, {name} per token at L 65536 over L 4096"
            times, over = (long(direction, field),), (short(direction, field),)
            most = 1.2 if (name, direction) == ("time", BOTH) else 1.1
            made.append(Target(text, times, over, scale=4096 / 65536, at_most=most))
    saved, history = (long(BOTH, field) for field in ("saved_bytes", "state_history_bytes"))
    text = "saved for the backward over the state history"
    made.append(Target(text, (saved,), (history,), at_most=1 / 64))
    if settings.device.type == "cpu":
        for direction in ("forward", BOTH):
            one, two = (key("threads", name, direction) for name in ("1 thread", "2 threads"))
            made.append(Target(f"{direction}, 1 thread over 2", (one,), (two,), at_least=1.8))
        return made
    layer = partial(key, "training batch")
    ours, both, single = layer("default"), layer("default", BOTH), layer("one sequence")
    return [
        *made,
        Target("forward of a layer, B 16, bfloat16, ms", (ours,), at_most=2.2),
        Target("forward + backward of a layer, B 16, bfloat16, ms", (both,), at_most=6),
        Target("forward of a layer, B 1, bfloat16, ms", (single,), at_most=0.25),
        Target("forward, mamba-ssm's time over ours", (layer("mamba-ssm"),), (ours,), at_least=1.5),
    ]
