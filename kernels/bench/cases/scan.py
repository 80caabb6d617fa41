"""Cases of the selective scan."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch

from .. import peers
from ..core.case import (
    DIRECTIONS,
    Case,
    Settings,
    Variant,
    dtype_name,
    make_cases,
    over_threads,
)
from ..core.problem import Operator
from .scan_problem import SIZES, count_memory, make_inputs, make_problem, scan_problem


def cases(settings: Settings) -> list[Case]:
    """All cases of the scan at the level's sizes."""
    cpu = settings.device.type == "cpu"
    builders = [
        ("operator", operator, None),
        ("reference loop", reference_loop, None),
        ("knobs", knobs, "error"),
        ("length", lengths, "L"),
        ("batch", batches, "B"),
        ("packed", packed, None),
        ("states", states, "N"),
        ("threads", by_threads, "threads") if cpu else ("training batch", training_batch, None),
    ]
    return make_cases("scan", settings, builders)


def operator(settings: Settings) -> list[Variant]:
    """The whole operator: softplus, bias, skip and gate."""
    return make_problem(settings).pair("default", default=True)


def reference_loop(settings: Settings) -> list[Variant]:
    """The operator against the formula as a torch loop (as Mamba's reference does it), and against
    peers where they are installed, all on the same input.
    """
    length, width, tokens = SIZES[settings.level]
    if settings.level == "normal":
        length = 2048  # at 16961 tokens the loop takes seconds and its factors gigabytes
    problem = scan_problem(make_inputs(1, length, width), settings.device, tokens)
    loop = peer(problem, peers.scan_loop).variant("torch loop", peer=True, rounds=2)
    made = [problem.variant("default", default=True), loop]
    if settings.peers:
        mambapy = peer(problem, peers.mambapy_scan, channels_first=False)
        made.append(mambapy.variant("mambapy", peer=True, rounds=3))
        if settings.device.type == "cuda":
            made.append(peer(problem, peers.mamba_ssm_scan).variant("mamba-ssm", peer=True))
    return made


def peer(problem: Operator, function: Callable, channels_first: bool = True) -> Operator:
    """Another package's scan on the same inputs, laid out for it; its output is checked."""
    return replace(
        problem,
        function=function,
        limits=dict.fromkeys(problem.limits, 1e-4),
        turned=("u", "delta", "B", "C", "z", "out") if channels_first else (),
        compared=False,
    )


def knobs(settings: Settings) -> list[Variant]:
    """Every choice that a caller has. Half precision is compared with the truth of the float32
    inputs. The discretisations are different models, each compared with its own formula, so that
    the one of Mamba's weights is the default at any cost.
    """
    problem = make_problem(settings)
    made = problem.pair("float32", default=True)
    for dtype in (torch.bfloat16, torch.float16):
        made += problem.pair(f"{dtype_name(dtype)} inputs and output", {"dtype": dtype})
    for discretization in ("bilinear", "zoh"):
        made += problem.pair(discretization, {"discretization": discretization})
    batch, _, width = problem.inputs["u"].shape
    state = torch.randn(batch, width, 16, generator=torch.Generator().manual_seed(2))
    tokens = SIZES[settings.level][2]
    start = scan_problem(problem.inputs, problem.device, tokens, initial_state=state)
    made += start.pair("with an initial state")
    return made + make_problem(settings, groups=4).pair("4 groups of B and C")


def lengths(settings: Settings) -> list[Variant]:
    """Cost and memory against the number of tokens. Saved: tensors of the forward pass beside its
    inputs; history: the states of all tokens; peak: growth of memory in forward and backward.
    """
    lengths = {"quick": (256, 1024)}.get(settings.level, (4096, 16384, 65536))
    made = []
    for length in lengths:
        problem = make_problem(settings, 8 if length > 16961 else 32, length=length)
        for direction in DIRECTIONS:
            work = partial(count_memory, problem, direction)
            made.append(problem.variant(f"L {length}", direction, rounds=20, work=work))
    return made


def batches(settings: Settings) -> list[Variant]:
    """Cost against the number of sequences, of a small model's width."""
    quick = settings.level == "quick"
    length = 512 if quick else 4096
    made = []
    for batch in (1, 4) if quick else (1, 2, 4, 8):
        problem = make_problem(settings, batch=batch, length=length, channels=256)
        made += problem.pair(f"B {batch}")
    return made


def packed(settings: Settings) -> list[Variant]:
    """Sequences of many lengths in one packed row beside one sequence as long. The oracle sees the
    first of them.
    """
    length, width, _ = SIZES[settings.level]
    first = length // 8
    problem = scan_problem(make_inputs(1, length, width), settings.device, first)
    made = problem.pair("one sequence", default=True)
    for count in (8, 64):
        g = torch.Generator().manual_seed(count)
        cuts = first + torch.randperm(length - first, generator=g)[: count - 1].sort().values
        cuts[0] = first
        cuts = torch.tensor([0, *cuts.tolist(), length], dtype=torch.int32, device=settings.device)
        cut = replace(problem, function=partial(problem.function, cu_seqlens=cuts))
        made += cut.pair(f"{count} sequences")
    return made


def states(settings: Settings) -> list[Variant]:
    """Cost against the number of states per channel; 16 is the tuned one."""
    counts = (4, 16) if settings.level == "quick" else (4, 8, 16, 32, 64)
    length = 512 if settings.level == "quick" else 4096
    made = []
    for states in counts:
        made += make_problem(settings, length=length, states=states).pair(f"N {states}")
    return made


def by_threads(settings: Settings) -> list[Variant]:
    """Cost against torch's number of threads, from one to the machine's cores."""
    return over_threads(make_problem(settings).pair)


def training_batch(settings: Settings) -> list[Variant]:
    """A layer of the paper's training: 16 sequences in bfloat16, beside mamba-ssm."""
    batch = 2 if settings.level == "quick" else 16
    length, width, tokens = SIZES[settings.level]
    problem = scan_problem(make_inputs(batch, length, width), settings.device, min(tokens, 2048))
    half = {"dtype": torch.bfloat16}
    made = problem.pair("default", half, default=True)
    made.append(make_problem(settings).variant("one sequence", options=half))
    if settings.peers:
        made += peer(problem, peers.mamba_ssm_scan).pair("mamba-ssm", half, peer=True)
    return made
