"""Benchmark cases, each of a few variants that are timed in turn."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor

BOTH = "forward+backward"
DIRECTIONS = ("forward", BOTH)


def dtype_name(dtype: torch.dtype) -> str:
    """As "float32"."""
    return str(dtype).removeprefix("torch.")


class NotInstalled(Exception):
    """Raised for a peer that is not installed; ``str(error)`` names its package."""


@dataclass(frozen=True)
class Level:
    """Length of a measurement.

    Attributes:
        seconds: time for a variant; it takes longer only to reach ``fewest``.
        fewest: least number of rounds.
        most: greatest number of rounds.
    """

    seconds: float
    fewest: int
    most: int


LEVELS = {"quick": Level(0.1, 3, 20), "normal": Level(1.0, 5, 50), "full": Level(3.0, 9, 100)}


@dataclass(frozen=True)
class Settings:
    """Options of a run.

    Attributes:
        device: device of all cases.
        level: key of ``LEVELS``; cases also choose their sizes by it.
        peers: True to measure other packages too, if they are installed.
        threads: number of torch's threads on the CPU; a variant may ask for another number.
    """

    device: torch.device
    level: str = "normal"
    peers: bool = False
    threads: int = 1


@dataclass(frozen=True)
class Error:
    """Distance of a result from the oracle.

    Attributes:
        rel_rms: rms of the difference over rms of the truth, of the worst tensor.
        maximum: largest difference over the largest value of the truth, of the worst tensor.
        worst: name of the tensor with that ``rel_rms``.
    """

    rel_rms: float
    maximum: float
    worst: str


def compare(got: Mapping[str, Tensor], want: Mapping[str, Tensor]) -> Error:
    """Computes the error of named results in float64; NaN or a wrong shape makes it infinite."""
    rel_rms, maximum, worst = 0.0, 0.0, ""
    for name, truth in want.items():
        value, truth = got[name].detach().double().cpu(), truth.detach().double().cpu()
        if value.shape != truth.shape or not value.isfinite().all():
            return Error(math.inf, math.inf, name)
        if not truth.numel():
            continue
        difference = value - truth
        # If the truth is all zeros, the difference is taken as it is.
        rms = truth.square().mean().sqrt().item() or 1.0
        relative = difference.square().mean().sqrt().item() / rms
        if relative >= rel_rms:
            rel_rms, worst = relative, name
        maximum = max(maximum, (difference.abs().max() / (truth.abs().max() or 1.0)).item())
    return Error(rel_rms, maximum, worst)


@dataclass
class Variant:
    """One thing that is timed.

    Attributes:
        name: name within its case, unique for a direction.
        run: function that is timed; its first call is timed apart.
        check: function that computes the error before the clock starts, or raises; None, or a
            function that returns None, if there is no oracle.
        limit: largest ``rel_rms`` of the check; above it no time is printed.
        oracle: the reference of the error, and the part of the input, in words.
        direction: "forward" or "forward+backward".
        dtype: dtype of the inputs and outputs.
        peer: True for another package's code; ours is compared with the fastest of these.
        default: True for the default of a caller.
        threads: number of torch's threads on the CPU, or None for the run's.
        rounds: greatest number of rounds, for slow variants.
        parameters: sizes (numbers or text), for the tables and charts.
        work: function that counts work after the clock has stopped.
    """

    name: str
    run: Callable[[], object]
    check: Callable[[], Error | None] | None
    limit: float = 1e-5
    oracle: str = ""
    direction: str = "forward"
    dtype: str = "float32"
    peer: bool = False
    default: bool = False
    threads: int | None = None
    rounds: int | None = None
    parameters: dict[str, Any] = field(default_factory=dict)
    work: Callable[[], Mapping[str, int | float]] | None = None


@dataclass
class Case:
    """Variants that are timed in turn, so that their ratios come from one run.

    Attributes:
        op: scan, conv, raster, block, model or step.
        name: unique within the op.
        text: one sentence on the comparison.
        build: function that makes the inputs and the variants; they are freed after the case.
        axis: parameter along which cost is drawn; "error" draws time against error, "skipped"
            skipped work against saved time, and None draws no chart.
    """

    op: str
    name: str
    text: str
    build: Callable[[], list[Variant]]
    axis: str | None = None


def make_cases(
    op: str,
    settings: Settings,
    builders: Iterable[tuple[str, Callable[[Settings], list[Variant]], str | None]],
) -> list[Case]:
    """The cases of an op from a table of names, builders and axes.

    A builder's docstring is the text of its case.
    """
    return [
        Case(op, name, " ".join((build.__doc__ or "").split()), partial(build, settings), axis)
        for name, build, axis in builders
    ]


def over_threads(make: Callable[..., list[Variant]]) -> list[Variant]:
    """``make(name, threads=)``'s variants for one thread, two, four and so on to all cores."""
    cores = os.cpu_count() or 1
    made = []
    for threads in sorted({1, cores, *(2**i for i in range(1, 10) if 2**i < cores)}):
        for variant in make(f"{threads} thread{'s' * (threads > 1)}", threads=threads):
            variant.parameters = variant.parameters | {"threads": threads}
            made.append(variant)
    return made
