"""Cases of the selective scan, and the targets on them."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial

import torch

from . import peers
from .case import Case, Error, Key, Settings, Target, Variant
from .measure import peak_bytes, saved_bytes
from .probe import probe_rate, probe_scan
from .scan_problem import ScanProblem, make_inputs

# Allowed relative rms error to float64. Half precision: what rounding inputs and output explains.
FORWARD_LIMIT, BACKWARD_LIMIT = 1e-6, 1e-5
HALF_LIMITS = {torch.bfloat16: 3e-2, torch.float16: 5e-3}
BOTH = "forward+backward"
# Tokens, channels, and tokens that the oracle looks at.
_SIZES = {"quick": (1024, 256, 128), "normal": (16961, 1024, 2048), "full": (16961, 1024, 16961)}


def cases(settings: Settings) -> list[Case]:
    """All cases of the scan at the level's sizes."""
    builders = [
        ("operator", _operator, None),
        ("reference loop", _reference_loop, None),
        ("knobs", _knobs, "error"),
        ("length", _lengths, "L"),
        ("batch", _batches, "B"),
        ("states", _states, "N"),
    ]
    if settings.device.type == "cpu":
        builders.append(("threads", _threads, "threads"))
    else:
        builders.append(("training batch", _training_batch, None))
    return [
        Case("scan", name, " ".join(build.__doc__.split()), partial(build, settings), axis)
        for name, build, axis in builders
    ]


def _problem(settings: Settings, **changes) -> ScanProblem:
    length, width, tokens = _SIZES[settings.level]
    inputs = make_inputs(**({"batch": 1, "length": length, "channels": width} | changes))
    return ScanProblem(inputs, settings.device, tokens)


def _variant(
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
    return Variant(
        name,
        partial(problem.forward if forward else problem.backward, dtype, **options),
        partial(problem.check_forward if forward else problem.check_backward, dtype, **options),
        HALF_LIMITS.get(dtype, FORWARD_LIMIT if forward else BACKWARD_LIMIT),
        problem.oracle,
        direction,
        str(dtype).removeprefix("torch."),
        parameters={"B": batch, "L": length, "D": width, "N": problem.inputs["A"].shape[1]},
        **changes,
    )


def _pair(problem: ScanProblem, name: str, **changes) -> list[Variant]:
    return [_variant(problem, name, direction, **changes) for direction in ("forward", BOTH)]


def _operator(settings: Settings) -> list[Variant]:
    """The whole operator (softplus, bias, skip and gate) beside a bare probe: a native loop over
    given steps, without gate, skip or gradient, into a given output.
    """
    problem = _problem(settings)
    made = _pair(problem, "default", default=True)
    bare = problem.bare()
    made.append(_variant(bare, "given steps, no gate or skip"))
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
    return 2048 if settings.level == "normal" else _SIZES[settings.level][0]


def _reference_loop(settings: Settings) -> list[Variant]:
    """The operator against the formula as a torch loop (as Mamba's reference does it), and against
    peers where they are installed, all on the same input.
    """
    length, tokens = _loop_length(settings), _SIZES[settings.level][2]
    width = _SIZES[settings.level][1]
    inputs = make_inputs(1, length, width)
    problem = ScanProblem(inputs, settings.device, tokens)
    made = [
        _variant(problem, "default", default=True),
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
    problem = _problem(settings)
    made = _pair(problem, "float32", default=True)
    for dtype in (torch.bfloat16, torch.float16):
        name = str(dtype).removeprefix("torch.") + " inputs and output"
        made += _pair(problem, name, dtype=dtype)
    for discretization in ("bilinear", "zoh"):
        made += _pair(problem, discretization, options={"discretization": discretization})
    start = ScanProblem(problem.inputs, problem.device, problem.tokens)
    batch, _, width = problem.inputs["u"].shape
    start.initial_state = torch.randn(batch, width, 16, generator=torch.Generator().manual_seed(2))
    made += _pair(start, "with an initial state")
    made += _pair(_problem(settings, groups=4), "4 groups of B and C")
    return made


def _lengths(settings: Settings) -> list[Variant]:
    """Cost and memory against the number of tokens. Saved: what the forward pass keeps beside its
    inputs; history: the states of all tokens; peak: growth of memory in forward and backward.
    """
    lengths = {"quick": (256, 1024)}.get(settings.level, (4096, 16384, 65536))
    made = []
    for length in lengths:
        problem = _problem(settings, length=length)
        problem.channels = 8 if length > 16961 else 32
        for direction in ("forward", BOTH):
            made.append(_variant(problem, f"L {length}", direction, rounds=20))
            made[-1].work = partial(_memory, problem, direction)
    return made


def _memory(problem: ScanProblem, direction: str) -> dict[str, int]:
    batch, length, width = problem.inputs["u"].shape
    history = 4 * batch * length * width * problem.inputs["A"].shape[1]
    run = problem.forward if direction == "forward" else problem.backward
    counts = {"state_history_bytes": history}
    if direction == BOTH:
        leaves = problem.leaves()
        counts["saved_bytes"] = saved_bytes(lambda: problem.call(leaves), leaves.values())
    peak = peak_bytes(run, problem.device)
    return counts if peak is None else counts | {"peak_bytes": peak}


def _batches(settings: Settings) -> list[Variant]:
    """Cost against the number of sequences, of a small model's width."""
    quick = settings.level == "quick"
    length = 512 if quick else 4096
    made = []
    for batch in (1, 4) if quick else (1, 2, 4, 8):
        made += _pair(_problem(settings, batch=batch, length=length, channels=256), f"B {batch}")
    return made


def _states(settings: Settings) -> list[Variant]:
    """Cost against the number of states per channel; 16 is the tuned one."""
    counts = (4, 16) if settings.level == "quick" else (4, 8, 16, 32, 64)
    length = 512 if settings.level == "quick" else 4096
    made = []
    for states in counts:
        made += _pair(_problem(settings, length=length, states=states), f"N {states}")
    return made


def _threads(settings: Settings) -> list[Variant]:
    """Cost against torch's number of threads, from one to the machine's cores."""
    problem = _problem(settings)
    cores = os.cpu_count() or 1
    counts = sorted({1, cores, *(2**i for i in range(1, 10) if 2**i < cores)})
    made = []
    for threads in counts:
        variants = _pair(problem, f"{threads} thread{'s' * (threads > 1)}", threads=threads)
        for variant in variants:
            variant.parameters["threads"] = threads
        made += variants
    return made


def _training_batch(settings: Settings) -> list[Variant]:
    """A layer of the paper's training: 16 sequences in bfloat16, beside mamba-ssm."""
    batch = 2 if settings.level == "quick" else 16
    problem = _problem(settings, batch=batch)
    problem.tokens = min(problem.tokens, 2048)
    made = _pair(problem, "default", dtype=torch.bfloat16, default=True)
    single = _problem(settings)
    made.append(_variant(single, "one sequence", dtype=torch.bfloat16))
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
            f"forward at L {_loop_length(settings)}, torch loop's time over ours",
            (_scan("reference loop", "torch loop"),),
            (_scan("reference loop", "default"),),
            at_least=300,
        ),
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
                    at_most=1.1,
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
    made = [Target("forward over the bare probe, 2 threads", (ours,), (probe,), at_most=1.6)]
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
