"""Cases of the selective scan, and the targets on them."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial

import torch

from .. import peers
from ..core.case import Case, Error, Key, Settings, Target, Variant
from ..probe import probe_rate, probe_scan
from . import scan_knobs
from .scan_problem import ScanProblem, make_inputs
from .scan_variants import (
    BOTH,
    HALF_LIMITS,
    SIZES,
    count_memory,
    make_pair,
    make_problem,
    make_variant,
)


def cases(settings: Settings) -> list[Case]:
    """All cases of the scan at the level's sizes."""
    cpu = settings.device.type == "cpu"
    builders = [
        ("operator", _operator, None),
        ("reference loop", _reference_loop, None),
        ("knobs", _knobs, "error"),
        *([("exponential", scan_knobs.exponential, "error")] if cpu else []),
        *([("boundary spacing", scan_knobs.spacings, "error,memory,spacing")] if cpu else []),
        ("chunk size", scan_knobs.chunks if cpu else scan_knobs.cuda_tunings, "error"),
        ("length", _lengths, "L"),
        ("batch", _batches, "B"),
        ("states", _states, "N"),
    ]
    if cpu:
        builders.append(("threads", _threads, "threads"))
    else:
        builders.append(("training batch", _training_batch, None))
    return [
        Case("scan", name, " ".join(build.__doc__.split()), partial(build, settings), axis)
        for name, build, axis in builders
    ]


def _operator(settings: Settings) -> list[Variant]:
    """The whole operator (softplus, bias, skip and gate) beside a bare probe: a native loop over
    given steps, without gate, skip or gradient, into a given output.
    """
    problem = make_problem(settings)
    made = make_pair(problem, "default", default=True)
    bare = problem.bare()
    made.append(make_variant(bare, "given steps, no gate or skip"))
    if settings.device.type == "cpu":
        made += [_probe(bare, threads) for threads in sorted({1, settings.threads})]
    return made


def _probe(bare: ScanProblem, threads: int) -> Variant:
    x = bare.inputs
    out = torch.empty_like(x["u"][0])
    run = partial(
        probe_scan, *(x["u"][0], x["delta"][0], probe_rate(x["A"]), x["B"][0], x["C"][0], out)
    )
    _, length, width = x["u"].shape
    return Variant(
        f"probe, {threads} thread{'s' * (threads > 1)}",
        run,
        lambda: bare.check_output(run()[None]),
        1e-5,
        bare.oracle,
        peer=True,
        threads=threads,
        parameters={"B": 1, "L": length, "D": width, "N": 16},
    )


def _loop_length(settings: Settings) -> int:
    """At 16961 tokens the loop takes seconds and its factors gigabytes."""
    return 2048 if settings.level == "normal" else SIZES[settings.level][0]


def _reference_loop(settings: Settings) -> list[Variant]:
    """The operator against the formula as a torch loop (as Mamba's reference does it), and against
    peers where they are installed, all on the same input. No target is set on the loop: it too
    works on all channels at once, so that the bare probe is the limit and the loop is not.
    """
    length, tokens = _loop_length(settings), SIZES[settings.level][2]
    width = SIZES[settings.level][1]
    inputs = make_inputs(1, length, width)
    problem = ScanProblem(inputs, settings.device, tokens)
    made = [
        make_variant(problem, "default", default=True),
        _peer(problem, "torch loop", peers.scan_loop, channels_first=True, rounds=2),
    ]
    if settings.peers:
        made.append(_peer(problem, "mambapy", peers.mambapy_scan, channels_first=False, rounds=3))
        if settings.device.type == "cuda":
            made.append(_peer(problem, "mamba-ssm", peers.mamba_ssm_scan, channels_first=True))
    return made


def _peer(
    problem: ScanProblem,
    name: str,
    function: Callable,
    channels_first: bool,
    rounds: int | None = None,
    dtype: torch.dtype = torch.float32,
    direction: str = "forward",
) -> Variant:
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

    batch, length, width = problem.inputs["u"].shape
    return Variant(
        name,
        forward if direction == "forward" else backward,
        check,
        HALF_LIMITS.get(dtype, 1e-4),
        problem.oracle + ("" if direction == "forward" else ", output only"),
        direction,
        str(dtype).removeprefix("torch."),
        peer=True,
        rounds=rounds,
        parameters={"B": batch, "L": length, "D": width, "N": 16},
    )


def _knobs(settings: Settings) -> list[Variant]:
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


def _lengths(settings: Settings) -> list[Variant]:
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


def _batches(settings: Settings) -> list[Variant]:
    """Cost against the number of sequences, of a small model's width."""
    quick = settings.level == "quick"
    length = 512 if quick else 4096
    made = []
    for batch in (1, 4) if quick else (1, 2, 4, 8):
        made += make_pair(
            make_problem(settings, batch=batch, length=length, channels=256), f"B {batch}"
        )
    return made


def _states(settings: Settings) -> list[Variant]:
    """Cost against the number of states per channel; 16 is the tuned one."""
    counts = (4, 16) if settings.level == "quick" else (4, 8, 16, 32, 64)
    length = 512 if settings.level == "quick" else 4096
    made = []
    for states in counts:
        made += make_pair(make_problem(settings, length=length, states=states), f"N {states}")
    return made


def _threads(settings: Settings) -> list[Variant]:
    """Cost against torch's number of threads, from one to the machine's cores."""
    problem = make_problem(settings)
    cores = os.cpu_count() or 1
    counts = sorted({1, cores, *(2**i for i in range(1, 10) if 2**i < cores)})
    made = []
    for threads in counts:
        variants = make_pair(problem, f"{threads} thread{'s' * (threads > 1)}", threads=threads)
        for variant in variants:
            variant.parameters["threads"] = threads
        made += variants
    return made


def _training_batch(settings: Settings) -> list[Variant]:
    """A layer of the paper's training: 16 sequences in bfloat16, beside mamba-ssm."""
    batch = 2 if settings.level == "quick" else 16
    problem = make_problem(settings, batch=batch)
    problem.tokens = min(problem.tokens, 2048)
    made = make_pair(problem, "default", dtype=torch.bfloat16, default=True)
    single = make_problem(settings)
    made.append(make_variant(single, "one sequence", dtype=torch.bfloat16))
    if settings.peers:
        made += [
            _peer(
                *(problem, "mamba-ssm", peers.mamba_ssm_scan, True),
                dtype=torch.bfloat16,
                direction=direction,
            )
            for direction in ("forward", BOTH)
        ]
    return made


def _scan(case: str, variant: str, direction: str = "forward", field: str = "ms_p50") -> Key:
    return Key("scan", case, variant, direction, field)


def targets(settings: Settings) -> list[Target]:
    """What should be reached; nothing at a quick run's sizes."""
    if settings.level == "quick":
        return []
    ours = _scan("operator", "default")
    made = [
        Target(
            "forward + backward over forward",
            (_scan("operator", "default", BOTH),),
            (ours,),
            at_most=5,
        ),
    ]
    long, short = (partial(_scan, "length", f"L {length}") for length in (65536, 4096))
    for name, field in (("time", "ms_p50"), ("memory", "peak_bytes")):
        for direction in ("forward", BOTH):
            made.append(
                Target(
                    f"{direction}, {name} per token at L 65536 over L 4096",
                    (long(direction, field),),
                    (short(direction, field),),
                    scale=4096 / 65536,
                    at_most=1.2 if (name, direction) == ("time", BOTH) else 1.1,
                )
            )
    made.append(
        Target(
            "saved for the backward over the state history",
            (long(BOTH, "saved_bytes"),),
            (long(BOTH, "state_history_bytes"),),
            at_most=1 / 64,
        )
    )
    return made + (_cpu_targets(ours) if settings.device.type == "cpu" else _cuda_targets())


def _cpu_targets(ours: Key) -> list[Target]:
    probe = _scan("operator", "probe, 2 threads")
    made = [Target("forward over the bare probe, 2 threads", (ours,), (probe,), at_most=1.3)]
    for direction in ("forward", BOTH):
        one, two = (_scan("threads", name, direction) for name in ("1 thread", "2 threads"))
        made.append(Target(f"{direction}, 1 thread over 2", (one,), (two,), at_least=1.8))
    return made


def _cuda_targets() -> list[Target]:
    layer = partial(_scan, "training batch")
    ours, both, single = layer("default"), layer("default", BOTH), layer("one sequence")
    peer = layer("mamba-ssm")
    return [
        Target("forward of a layer, B 16, bfloat16, ms", (ours,), at_most=2.2),
        Target("forward + backward of a layer, B 16, bfloat16, ms", (both,), at_most=6),
        Target("forward of a layer, B 1, bfloat16, ms", (single,), at_most=0.25),
        Target("forward, mamba-ssm's time over ours", (peer,), (ours,), at_least=1.5),
    ]
