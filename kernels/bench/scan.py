"""Benchmark of the selective scan."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch

from ..cases.case import BOTH, DIRECTIONS, Case
from ..cases.scan import make_inputs, scan_case
from ..selective_scan import selective_scan_fn
from . import peers
from .measure import Settings, Table, Variant, pair, saved_bytes, variant

# Tokens, channels, and tokens that the oracle computes.
SIZES = {"quick": (1024, 256, 128), "normal": (16961, 1024, 2048), "full": (16961, 1024, 16961)}
_HALF = {"dtype": torch.bfloat16}


def tables(settings: Settings) -> list[Table]:
    """Return the tables of the scan."""
    builders = {
        "operator": operator,
        "knobs": knobs,
        "length": lengths,
        "layers": layers,
        "packed": packed,
    }
    if settings.device.type == "cuda":
        builders["training batch"] = training_batch
    return [Table("scan", name, build) for name, build in builders.items()]


def make_case(settings: Settings, channels_seen: int = 32, **changes: int) -> Case:
    """Return a case of the level's size, but for ``changes`` of ``make_inputs``."""
    length, width, tokens = SIZES[settings.level]
    inputs = make_inputs(**({"batch": 1, "length": length, "channels": width} | changes))
    return scan_case(inputs, settings.device, tokens, channels_seen)


def operator(settings: Settings) -> list[Variant]:
    """The whole operator: softplus, bias, skip and gate; in both layouts."""
    case = make_case(settings)
    return pair(case, "default", default=True) + pair(_turned(case), "[B, D, L]")


_TRANSPOSED = ("u", "delta", "B", "C", "z", "out")


def _turned(case: Case) -> Case:
    """Return the same operator in mamba-ssm's layout."""
    function = partial(selective_scan_fn, delta_softplus=True)
    return replace(case, function=function, transposed=_TRANSPOSED)


def _peer(case: Case, function: Callable, channels_first: bool = True) -> Case:
    """Return another package's scan on the same inputs, laid out for it; its output is checked."""
    return replace(
        case,
        function=function,
        limits=dict.fromkeys(case.limits, 1e-4),
        transposed=_TRANSPOSED if channels_first else (),
        compared=False,
    )


def knobs(settings: Settings) -> list[Variant]:
    """Every choice that a caller has. Half precision is compared with the exact values of
    the float32 inputs. The discretisations are different models, each with a formula of its own.
    """
    case = make_case(settings)
    variants = pair(case, "float32", default=True)
    for dtype in (torch.bfloat16, torch.float16):
        name = f"{str(dtype).removeprefix('torch.')} inputs and output"
        variants += pair(case, name, options={"dtype": dtype})
    for discretization in ("bilinear", "zoh"):
        variants += pair(case, discretization, options={"discretization": discretization})
    batch, _, width = case.inputs["u"].shape
    state = torch.randn(batch, width, 16, generator=torch.Generator().manual_seed(2))
    tokens = SIZES[settings.level][2]
    start = scan_case(case.inputs, case.device, tokens, initial_state=state)
    variants += pair(start, "with an initial state")
    return variants + pair(make_case(settings, groups=4), "4 groups of B and C")


def lengths(settings: Settings) -> list[Variant]:
    """Cost against the number of tokens. Saved: tensors of the forward pass besides its inputs;
    history: the states of all tokens.
    """
    variants = []
    for length in (256, 1024) if settings.level == "quick" else (4096, 16384, 65536):
        case = make_case(settings, 8 if length > 16961 else 32, length=length)
        for direction in DIRECTIONS:
            work = partial(count_memory, case, direction)
            variants.append(variant(case, f"L {length}", direction, rounds=20, work=work))
    return variants


def count_memory(case: Case, direction: str) -> dict[str, int]:
    """Return the bytes of all states, and of the tensors saved for the gradient."""
    counts = {"state_history_bytes": 4 * math.prod(case.sizes.values())}
    if direction == BOTH:
        leaves = case.leaves()
        counts["saved_bytes"] = saved_bytes(lambda: case.call(leaves), leaves.values())
    return counts


def layers(settings: Settings) -> list[Variant]:
    """Scans of layers, by tokens and channels: 512 channels of this project's preset rays, 1,536 of
    mamba-130m, 5,120 of mamba-2.8b; in both layouts. Beside them the formula as a torch loop
    (Mamba's reference does it so), and peers where they are installed, on the same inputs.
    """
    quick, variants = settings.level == "quick", []
    for length in (256,) if quick else (512, 2048, 8192):
        for width in (64,) if quick else (512, 1536, 5120):
            case = scan_case(make_inputs(1, length, width), settings.device, 512)
            name = f"{length} x {width}"
            variants += pair(case, name) + pair(_turned(case), f"{name}, [B, D, L]")
            variants += pair(case, f"{name}, bfloat16", options=_HALF)
            if settings.peers and settings.device.type == "cuda":
                theirs, label = peers.mamba_ssm_scan, f"mamba-ssm, {name}"
                variants += pair(_peer(case, theirs), label, peer=True)
                last = _peer(
                    case, peers.channels_last(theirs, _TRANSPOSED[:-1]), channels_first=False
                )
                variants += pair(last, f"{label}, channels last", peer=True)
            if length * width <= 2048 * 1536:  # others' code in torch takes seconds
                loop, slow = _peer(case, peers.scan_loop), {"peer": True, "rounds": 3}
                variants.append(variant(loop, f"torch loop, {name}", **slow))
                if settings.peers:
                    mambapy = _peer(case, peers.mambapy_scan, channels_first=False)
                    variants += pair(mambapy, f"mambapy, {name}", **slow)
    return variants


def packed(settings: Settings) -> list[Variant]:
    """Sequences of many lengths in one packed row, one sequence as long, and a few of the sequences
    in rows that are padded to the longest. The oracle sees the first of them.
    """
    length, width, _ = SIZES[settings.level]
    first = length // 8
    case = scan_case(make_inputs(1, length, width), settings.device, first)
    variants = pair(case, "one sequence", default=True)
    for count in (8, 64):
        g = torch.Generator().manual_seed(count)
        cuts = first + torch.randperm(length - first, generator=g)[: count - 1].sort().values
        cuts[0] = first
        cuts = torch.tensor([0, *cuts.tolist(), length], dtype=torch.int32, device=settings.device)
        cut = replace(case, function=partial(case.function, cu_seqlens=cuts))
        variants += pair(cut, f"{count} sequences")
        if count == 8:
            rows = make_inputs(count, int(cuts.diff().max()), width)
            variants += pair(scan_case(rows, settings.device, first), f"{count} sequences, padded")
    return variants


def training_batch(settings: Settings) -> list[Variant]:
    """A layer of the paper's training: 16 sequences in bfloat16, compared with mamba-ssm."""
    length, width, tokens = SIZES[settings.level]
    inputs = make_inputs(2 if settings.level == "quick" else 16, length, width)
    case = scan_case(inputs, settings.device, min(tokens, 2048))
    variants = pair(case, "default", options=_HALF, default=True)
    variants.append(variant(make_case(settings), "one sequence", options=_HALF))
    if settings.peers:
        variants += pair(_peer(case, peers.mamba_ssm_scan), "mamba-ssm", options=_HALF, peer=True)
    return variants
