"""Studies of the scan: its internal choices."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from unittest.mock import patch

from gamba_warp.kernels.bench.cases.scan_problem import count_memory, make_problem
from gamba_warp.kernels.bench.core.case import BOTH, Case, Settings, Variant, make_cases
from gamba_warp.kernels.bench.core.problem import Operator
from gamba_warp.kernels.selective_scan.cpu import launch as cpu
from gamba_warp.kernels.selective_scan.cuda import launch as cuda

on_cpu, on_cuda = partial(patch.object, cpu, "TUNING"), partial(patch.object, cuda, "FORCED")
_TRADE_LIMIT = 1.0  # where accuracy is the knob


def cases(settings: Settings) -> list[Case]:
    """All studies of the scan at the level's sizes."""
    if settings.device.type != "cpu":
        return make_cases("scan", settings, [("chunk size", cuda_tunings, "error")])
    builders = [
        ("exponential", exponential, "error"),
        ("boundary spacing", spacings, "spacing"),
        ("chunk size", chunks, "error"),
    ]
    return make_cases("scan", settings, builders)


def on_kernels(use: Callable, choice: object, made: list[Variant]) -> list[Variant]:
    """Make variants run, check and count inside ``use(choice)``, which selects kernels."""

    def inside(function: Callable) -> Callable:
        def run():
            with use(choice):
                return function()

        return run

    for variant in made:
        variant.run = inside(variant.run)
        if variant.check is not None:
            variant.check = inside(variant.check)
        if variant.work is not None:
            variant.work = inside(variant.work)
    return made


def _shorter(settings: Settings) -> Operator:
    """Long enough for rates and errors: a quarter of the tokens."""
    return make_problem(settings, length=1024 if settings.level == "quick" else 4096)


def exponential(settings: Settings) -> list[Variant]:
    """Degree of the polynomial that makes the decays e^(δA) of the CPU's kernels. Degree 5 errs by
    float32's own rounding; each degree less saves a few percent and errs 10 to 50 times as much.
    With AVX-512 the default is a table of 16 and a cubic; elsewhere it is degree 5.
    """
    problem, default, made = _shorter(settings), cpu.Tuning(), []
    for degree in (3, 5) if settings.level == "quick" else (2, 3, 4, 5, 6):
        choice = default._replace(degree=degree, table=False)
        pair = problem.pair(f"degree {degree}", limit=_TRADE_LIMIT)
        made += on_kernels(on_cpu, choice, pair)
    return made + problem.pair("default", default=True)


def spacings(settings: Settings) -> list[Variant]:
    """Tokens between the states that the forward keeps and from which the gradient begins anew.
    Saved: what the forward keeps beside its inputs.
    """
    problem, default, made = _shorter(settings), cpu.Tuning(), []
    for chunk in (32, 64) if settings.level == "quick" else (16, 32, 64, 128, 256):
        choice = default._replace(chunk=chunk, strip=min(chunk, default.strip))
        (both,) = [problem.variant(f"every {chunk}", BOTH, default=choice == default)]
        both.work = partial(count_memory, problem, BOTH)
        both.parameters["spacing"] = chunk
        made += on_kernels(on_cpu, choice, [both])
    return made


def chunks(settings: Settings) -> list[Variant]:
    """Tokens that the CPU's forward walks at once for one state. The gradient walks those between
    two kept states, see "boundary spacing".
    """
    problem, default, made = _shorter(settings), cpu.Tuning(), []
    for strip in (32, 64) if settings.level == "quick" else (8, 16, 32, 64, 128, 256):
        choice = default._replace(strip=strip, chunk=max(strip, default.chunk))
        pair = [problem.variant(f"{strip} tokens", default=choice == default)]
        made += on_kernels(on_cpu, choice, pair)
    return made


def cuda_tunings(settings: Settings) -> list[Variant]:
    """Into how many segments the sequence is cut that run at once, and channels and states of a
    thread, each against what is chosen by itself.
    """
    problem = make_problem(settings)
    (batch, length, width), states = problem.inputs["u"].shape, problem.inputs["A"].shape[1]
    chosen = cuda.scan_tuning((batch, length, width), states, 1, problem.device)
    made = problem.pair("chosen by itself", default=True)
    changes = [{"segments": n, "back_segments": n} for n in (1, 4, 16, 64)]
    changes += [
        {"channels": c, "states": s, "back_channels": c, "back_states": s}
        for c, s in ((1, 4), (1, 8), (2, 8), (4, 4))
    ]
    for change in changes:
        name = ", ".join(f"{k} {v}" for k, v in change.items() if not k.startswith("back_"))
        made += on_kernels(on_cuda, chosen._replace(**change), problem.pair(name))
    return made
