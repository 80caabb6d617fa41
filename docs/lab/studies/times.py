"""Cost of a layer's scan by length, width and dtype: the table of docs/kernels-alone.md.

Widths are the inner ones of published models: 512 of this project's ``rays``, 1,536 of mamba-130m,
5,120 of mamba-2.8b.
"""

from __future__ import annotations

from functools import partial

import torch

from gamba_warp.kernels.bench import peers
from gamba_warp.kernels.bench.cases.scan import peer
from gamba_warp.kernels.bench.cases.scan_problem import make_inputs, scan_problem
from gamba_warp.kernels.bench.core.case import Case, Settings, Variant

LENGTHS, WIDTHS = (512, 2048, 8192), (512, 1536, 5120)
_SLOW = 2048 * 1536  # tokens times channels up to which others' code in torch is timed
_COMPARED = 512  # tokens compared with the oracle


def cases(settings: Settings) -> list[Case]:
    """A case for each length and width."""
    lengths, widths = ((256,), (64,)) if settings.level == "quick" else (LENGTHS, WIDTHS)
    text = " ".join((layer.__doc__ or "").split())
    return [
        Case("times", f"{n} tokens, {d} channels", text, partial(layer, settings, n, d))
        for n in lengths
        for d in widths
    ]


def layer(settings: Settings, length: int, width: int) -> list[Variant]:
    """One sequence, 16 states: both dtypes, and beside them others' code."""
    problem = scan_problem(make_inputs(1, length, width), settings.device, min(length, _COMPARED))
    made = problem.pair("float32", default=True)
    made += problem.pair("bfloat16", {"dtype": torch.bfloat16})
    if settings.device.type == "cuda":
        return made + peer(problem, peers.mamba_ssm_scan).pair("mamba-ssm", peer=True)
    if length * width <= _SLOW:
        # the loop's gradient takes minutes: each token's share fills a tensor of all tokens
        made.append(peer(problem, peers.scan_loop).variant("torch loop", peer=True, rounds=3))
        mambapy = peer(problem, peers.mambapy_scan, channels_first=False)
        made += mambapy.pair("mambapy", peer=True, rounds=3)
    return made
