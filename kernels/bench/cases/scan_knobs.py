"""Cases of the scan's inner choices, which no caller makes: each is a point on the charts."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from ...selective_scan.cpu import tuning as cpu_tuning
from ...selective_scan.cuda import tuning as cuda_tuning
from ..core.case import Settings, Variant, on_kernels
from .scan_problem import ScanProblem
from .scan_variants import BOTH, TRADE_LIMIT, count_memory, make_pair, make_problem, make_variant


def _shorter(settings: Settings) -> ScanProblem:
    """Long enough for rates and errors: a quarter of the tokens."""
    return make_problem(settings, length=1024 if settings.level == "quick" else 4096)


def exponential(settings: Settings) -> list[Variant]:
    """Degree of the polynomial that makes the decays e^(δA) of the CPU's kernels. Degree 5 errs by
    float32's own rounding; each degree less saves a few percent and errs 10 to 50 times as much.
    With AVX-512 the default is a table of 16 and a cubic; elsewhere it is degree 5.
    """
    problem, default, made = _shorter(settings), cpu_tuning.Tuning(), []
    for degree in (3, 5) if settings.level == "quick" else (2, 3, 4, 5, 6):
        choice = replace(default, degree=degree, table=False)
        pair = make_pair(problem, f"degree {degree}")
        for variant in pair:
            variant.limit = TRADE_LIMIT
        made += on_kernels(cpu_tuning.use_tuning, choice, pair)
    return made + make_pair(problem, "default", default=True)


def spacings(settings: Settings) -> list[Variant]:
    """Tokens between the states that the forward keeps and from which the gradient begins anew.
    Saved: what the forward keeps beside its inputs.
    """
    problem, default, made = _shorter(settings), cpu_tuning.Tuning(), []
    for chunk in (32, 64) if settings.level == "quick" else (16, 32, 64, 128, 256):
        choice = replace(default, chunk=chunk, strip=min(chunk, default.strip))
        (both,) = [make_variant(problem, f"every {chunk}", BOTH, default=choice == default)]
        both.work = partial(count_memory, problem, BOTH)
        both.parameters["spacing"] = chunk
        made += on_kernels(cpu_tuning.use_tuning, choice, [both])
    return made


def chunks(settings: Settings) -> list[Variant]:
    """Tokens that the CPU's forward walks at once for one state. The gradient walks those between
    two kept states, see "boundary spacing".
    """
    problem, default, made = _shorter(settings), cpu_tuning.Tuning(), []
    for strip in (32, 64) if settings.level == "quick" else (8, 16, 32, 64, 128, 256):
        choice = replace(default, strip=strip, chunk=max(strip, default.chunk))
        pair = [make_variant(problem, f"{strip} tokens", default=choice == default)]
        made += on_kernels(cpu_tuning.use_tuning, choice, pair)
    return made


def cuda_tunings(settings: Settings) -> list[Variant]:
    """Into how many segments the sequence is cut that run at once, and channels and states of a
    thread, each against what is chosen by itself.
    """
    problem = make_problem(settings)
    (batch, length, width), states = problem.inputs["u"].shape, problem.inputs["A"].shape[1]
    chosen = cuda_tuning.scan_tuning((batch, length, width), states, 1, problem.device)
    made = make_pair(problem, "chosen by itself", default=True)
    changes = [{"segments": n, "back_segments": n} for n in (1, 4, 16, 64)]
    changes += [
        {"channels": c, "states": s, "back_channels": c, "back_states": s}
        for c, s in ((1, 4), (1, 8), (2, 8), (4, 4))
    ]
    for change in changes:
        name = ", ".join(f"{k} {v}" for k, v in change.items() if not k.startswith("back_"))
        made += on_kernels(
            cuda_tuning.use_tuning, replace(chosen, **change), make_pair(problem, name)
        )
    return made
