"""Time of a run by parts, from the events of torch's profiler.

A part is a region named with ``record_function``, or operators of one kind inside a region. An
operator's gradient belongs to the region of the operator: the profiler gives both the same sequence
number. Times are self times on the calling thread, so every moment is counted once.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from torch.profiler import ProfilerActivity, profile, record_function

from gamba_warp.kernels.bench.core.report import number

_WHOLE = "the whole run"
_BACKWARD = "autograd::engine::evaluate_function"
PREFIXES = FORWARD, BACKWARD = "forward: ", "backward: "
REST, WHOLE = "not attributed", "under the profiler"


def measure_parts(
    run: Callable[[], object],
    regions: Sequence[str],
    kinds: Mapping[str, Mapping[str, str]],
    rounds: int,
) -> dict[str, float]:
    """Profile a run on the CPU, a few times.

    Args:
        run: the function to measure, with regions by ``torch.profiler.record_function``.
        regions: names of the regions; of two that enclose an operator the inner one counts.
        kinds: separate parts by region: text in an operator's name -> part. Operators inside such
            an operator belong to it, too.
        rounds: number of runs, >= 1.

    Returns:
        Milliseconds, medians over the rounds: "forward: PART" and "backward: PART" for each part
        that took any time; "not attributed", outside all regions; and "under the profiler", the
        time of the whole profiled run.
    """
    # Read at the first use; below this level the profiler writes to stderr.
    os.environ.setdefault("KINETO_LOG_LEVEL", "6")
    found: list[dict[str, float]] = []
    for _ in range(rounds):
        with profile(activities=[ProfilerActivity.CPU]) as profiler, record_function(_WHOLE):
            run()
        found.append(_sums(profiler.events() or [], set(regions), kinds))
    names = dict.fromkeys(name for sums in found for name in sums)
    return {n: float(np.median([sums.get(n, 0.0) for sums in found])) for n in names}


def _sums(
    events: Iterable[Any], regions: set[str], kinds: Mapping[str, Mapping[str, str]]
) -> dict[str, float]:
    """Milliseconds of one profiled run, as ``measure_parts`` names them."""
    events = sorted(events, key=lambda event: event.time_range.start)
    whole = next(event for event in events if event.name == _WHOLE)
    places = [_place(event, regions) for event in events]
    # An operator without a gradient has the number of the next one that has it: the last one holds.
    numbers = {e.sequence_nr: p.name for e, p in zip(events, places) if p and p.name in regions}
    sums: Counter[str] = Counter()
    for event, place in zip(events, places):
        if place is None:
            continue
        backward = place.name not in regions
        region = numbers.get(place.sequence_nr) if backward else place.name
        if region is not None:
            part = _kind(event, place, kinds.get(region, {})) or region
            sums[(BACKWARD if backward else FORWARD) + part] += event.self_cpu_time_total / 1e3
    total = whole.time_range.elapsed_us() / 1e3
    return {**sums, REST: total - sum(sums.values()), WHOLE: total}


def _place(event: Any, regions: set[str]) -> Any | None:
    """Find the innermost region, or function of the gradient, around an event."""
    while event is not None:
        if event.name in regions or event.name.startswith(_BACKWARD):
            return event
        event = event.cpu_parent
    return None


def _kind(event: Any, place: Any, kinds: Mapping[str, str]) -> str | None:
    """The part of the first operator, from the event up to its place, whose name is of a kind."""
    while event is not None:
        for text, part in kinds.items():
            if text in event.name:
                return part
        if event is place:
            return None
        event = event.cpu_parent
    return None


def parts_of(record: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """Forward and backward milliseconds of a record's parts, the largest first; empty if none."""
    work, parts = record["work"], {}
    for name in work:
        if name.startswith(PREFIXES):
            part = name.split(": ", 1)[1]
            parts[part] = (work.get(FORWARD + part, 0.0), work.get(BACKWARD + part, 0.0))
    parts = dict(sorted(parts.items(), key=lambda item: -sum(item[1])))
    return parts | ({REST: (work[REST], 0.0)} if REST in work else {})


def parts_table(records: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[str]]] | None:
    """Header and rows of the parts of a case's variants, or None if it has none."""
    split = [(record, parts_of(record)) for record in records]
    split = [(record, parts) for record, parts in split if parts]
    if not split:
        return None
    rows = []
    for record, parts in split:
        whole = record["work"].get(WHOLE) or sum(map(sum, parts.values()))
        for part, (forward, backward) in parts.items():
            share = f"{(forward + backward) / whole:.1%}"
            times = [number(forward), number(backward) if backward else ""]
            rows.append([record["variant"], part, *times, share])
        rows.append([record["variant"], f"whole, {WHOLE}", number(whole), "", ""])
    return ["variant", "part", "ms forward", "ms backward", "share"], rows
