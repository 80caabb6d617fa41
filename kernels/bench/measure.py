"""The clock: variants of a table are called once, checked, and timed in turn."""

from __future__ import annotations

import datetime
import gc
import math
import os
import platform
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp

from gamba_warp.versions import __version__

from ..cases.case import DIRECTIONS, Case, Error, compare


class NotInstalled(Exception):
    """Raised for a peer that is not installed; ``str(error)`` names its package."""


class Level(NamedTuple):
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


class Settings(NamedTuple):
    """Options of a run.

    Attributes:
        device: device of all variants.
        level: key of ``LEVELS``; tables also choose their sizes by it.
        peers: True to measure other packages too, if they are installed.
        threads: number of torch's threads on the CPU.
    """

    device: torch.device
    level: str = "normal"
    peers: bool = False
    threads: int = 1


@dataclass
class Variant:
    """One thing that is timed.

    Attributes:
        name: name within its table, unique for a direction.
        run: function that is timed; its first call is timed apart.
        check: function that computes the error before the clock starts, or raises; None, or a
            function that returns None, if there is no oracle.
        limit: largest ``rel_rms`` of the check; above it no time is printed.
        oracle: the reference of the error, and the part of the input, in words.
        direction: "forward" or "forward+backward".
        dtype: dtype of the inputs and outputs.
        peer: True for another package's code; ours is compared with the fastest of these.
        default: True for the default of a caller.
        rounds: greatest number of rounds, for slow variants.
        parameters: sizes (numbers or text).
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
    rounds: int | None = None
    parameters: dict[str, Any] = field(default_factory=dict)
    work: Callable[[], Mapping[str, int | float]] | None = None


class Table(NamedTuple):
    """Variants that are timed in turn, so that their ratios come from one run.

    Attributes:
        op: name of the suite: scan, conv, raster, model or step.
        name: unique within the op.
        build: function that makes the inputs and the variants, which are freed after it; the
            first paragraph of its docstring describes the comparison.
    """

    op: str
    name: str
    build: Callable[[Settings], list[Variant]]


@dataclass
class _Timed:
    """A variant under way: its record, and the seconds by the clock and of the CPU so far."""

    variant: Variant
    record: dict
    seconds: list[tuple[float, float]] = field(default_factory=list)

    def done(self, level: Level, time_is_up: bool) -> bool:
        count = len(self.seconds)
        most = min(level.most, self.variant.rounds or level.most)
        return count >= most or (time_is_up and count >= level.fewest)


def synchronize(device: torch.device) -> None:
    """Wait until a GPU has done its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def measure(
    tables: Iterable[Table],
    settings: Settings,
    say: Callable[[str, str], None] = lambda table, variant: None,
) -> dict:
    """Measure tables and return the document: machine, settings and records.

    A variant that raises, and a check that fails, are recorded in ``status``; the rest continues.
    Ctrl-C ends the run: ``interrupted`` is set and the measurements are kept.

    Args:
        tables: in the order of their measuring.
        settings: settings of the run.
        say: function that gets the table's and the variant's name before each step.

    Returns:
        ``{machine, settings, interrupted, records}``, ready for JSON. A record has ``op, case,
        variant, device, dtype, direction, ms_p20, ms_p50, ms_p80`` (milliseconds, quantiles of
        ``rounds`` runs), ``cpu_ms`` (the median of the process's CPU time, of all threads),
        ``jit_ms`` (the first call, compilation or its cache included), ``rel_rms_error, max_error``
        (see ``Error``), ``peer, peer_ms`` (the fastest peer of the same case, direction and sizes),
        ``work`` (counts); and ``status`` ("ok" or the failure), ``is_peer, is_default, oracle,
        limit, parameters, rounds, text``. Times are None unless the status is "ok".
    """
    records: list[dict] = []
    document = {
        "machine": machine(settings),
        "settings": {"level": settings.level, "peers": settings.peers},
        "interrupted": False,
        "records": records,
    }
    before, load = torch.get_num_threads(), os.getloadavg()[0]
    torch.set_num_threads(settings.threads)
    try:
        for table in tables:
            _run_table(table, settings, records, say)
    except KeyboardInterrupt:
        document["interrupted"] = True
    finally:
        torch.set_num_threads(before)
        document["machine"]["load"] = [round(load, 2), round(os.getloadavg()[0], 2)]
    return document


def _run_table(table: Table, settings: Settings, records: list[dict], say: Callable) -> None:
    title = f"{table.op}: {table.name}"
    say(title, "inputs")
    try:
        variants = table.build(settings)
    except Exception as error:
        record = _record(table, Variant("all", lambda: None, None), settings)
        records.append(record | {"status": _reason(error)})
        return
    timed = [_Timed(v, _record(table, v, settings)) for v in variants]
    try:
        for t in timed:
            say(title, t.variant.name)
            _prepare(t, settings)
        ready = [t for t in timed if t.record["status"] == "ok"]
        _clock(ready, settings, lambda t: say(title, t.variant.name))
        for t in ready:
            if t.variant.work is not None and t.record["status"] == "ok":
                t.record["work"] = t.variant.work()
    finally:  # an interrupt keeps the results so far
        _summarize(timed)
        records += [t.record for t in timed if t.record["status"] != "not measured"]


_TIMES = ("ms_p20", "ms_p50", "ms_p80", "cpu_ms", "jit_ms")


def _record(table: Table, variant: Variant, settings: Settings) -> dict:
    text = (getattr(table.build, "__doc__", "") or "").split("\n\n")[0]
    return {
        "op": table.op,
        "case": table.name,
        "variant": variant.name,
        "device": settings.device.type,
        "dtype": variant.dtype,
        "direction": variant.direction,
        **dict.fromkeys((*_TIMES, "rel_rms_error", "max_error", "peer", "peer_ms")),
        "work": {},
        "status": "not measured",
        "is_peer": variant.peer,
        "is_default": variant.default,
        "oracle": variant.oracle,
        "limit": variant.limit if variant.oracle else None,
        "parameters": variant.parameters,
        "rounds": 0,
        "text": " ".join(text.split()),
    }


def _prepare(t: _Timed, settings: Settings) -> None:
    """Make the first call and the check, and set the status."""
    try:
        started = time.perf_counter()
        t.variant.run()
        synchronize(settings.device)
        t.record["jit_ms"] = 1e3 * (time.perf_counter() - started)
        error = t.variant.check() if t.variant.check else None
        if error is not None:
            if math.isfinite(error.rel_rms):
                t.record.update(rel_rms_error=error.rel_rms, max_error=error.maximum)
            if not error.rel_rms <= t.variant.limit:
                t.record["status"] = (
                    f"check failed: {error.worst} has relative rms error {error.rel_rms:.2g}, "
                    f"allowed {t.variant.limit:.2g}"
                )
                return
        t.record["status"] = "ok"
    except Exception as error:
        t.record["status"] = _reason(error)


def _clock(ready: list[_Timed], settings: Settings, say: Callable) -> None:
    """Time the variants in turn until each has its rounds and the table its time."""
    level = LEVELS[settings.level]
    ends = time.perf_counter() + level.seconds * len(ready)
    gc.collect()
    gc.disable()
    try:
        while True:
            time_is_up = time.perf_counter() >= ends
            todo = [t for t in ready if not t.done(level, time_is_up)]
            if not todo:
                return
            for t in todo:
                say(t)
                try:
                    synchronize(settings.device)
                    started = time.perf_counter(), time.process_time()
                    result = t.variant.run()
                    synchronize(settings.device)
                    ended = time.perf_counter(), time.process_time()
                    t.seconds.append((ended[0] - started[0], ended[1] - started[1]))
                    del result  # freeing it is in no variant's time
                except Exception as error:
                    t.record["status"] = _reason(error)
                    ready.remove(t)
    finally:
        gc.enable()


def _summarize(timed: list[_Timed]) -> None:
    """Write the times into the records, and into each the fastest peer of the same sizes."""
    for t in timed:
        if t.record["status"] == "ok" and not t.seconds:
            t.record["status"] = "not measured"
        if t.record["status"] != "ok":
            t.record.update(dict.fromkeys(_TIMES))
            continue
        wall, cpu = zip(*t.seconds)
        times = *np.quantile(wall, [0.2, 0.5, 0.8]), np.median(cpu)
        t.record.update(zip(_TIMES, (1e3 * float(x) for x in times)), rounds=len(wall))
    peers = [t.record for t in timed if t.record["is_peer"] and t.record["ms_p50"]]
    for record in (t.record for t in timed if not t.variant.peer):
        same = [r for r in peers if all(r[k] == record[k] for k in ("direction", "parameters"))]
        if same:
            fastest = min(same, key=lambda r: r["ms_p50"])
            record.update(peer=fastest["variant"], peer_ms=fastest["ms_p50"])


def _reason(error: Exception) -> str:
    if isinstance(error, NotInstalled):
        return f"not installed: {error}"
    lines = str(error).strip().splitlines()
    return f"failed: {type(error).__name__}: {lines[0] if lines else ''}"


def machine(settings: Settings) -> dict:
    """Return the conditions of the figures: processor, threads, versions and day, but no names."""
    gpu = torch.cuda.get_device_name(settings.device) if settings.device.type == "cuda" else None
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return {
        "cpu": names[0] if names else platform.processor() or platform.machine(),
        "simd": torch.backends.cpu.get_cpu_capability(),
        "cores": os.cpu_count(),
        "threads": settings.threads,
        "gpu": gpu,
        "cuda": torch.version.cuda if gpu else None,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": torch.__version__,
        "warp": wp.__version__,
        "gamba_warp": __version__,
        "date": datetime.datetime.now(datetime.timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
    }


def saved_bytes(forward: Callable[[], object], inputs: Iterable[torch.Tensor]) -> int:
    """Count the bytes that a forward pass keeps for its backward, without the inputs."""
    input_pointers = {x.untyped_storage().data_ptr() for x in inputs}
    seen: dict[int, int] = {}

    def pack(x: torch.Tensor) -> torch.Tensor:
        seen[x.untyped_storage().data_ptr()] = x.untyped_storage().nbytes()
        return x

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda x: x):
        result = forward()
    del result
    return sum(size for pointer, size in seen.items() if pointer not in input_pointers)


def variant(case: Case, name: str, direction: str = "forward", **changes: Any) -> Variant:
    """Return a variant that runs and checks a case.

    Args:
        case: what it runs.
        name: of the variant.
        direction: of the variant.
        changes: attributes of the variant; and ``options`` of the case's runs.
    """
    options = changes.pop("options", {})
    dtype = options.get("dtype")
    defaults: dict[str, Any] = {
        "run": partial(case.forward if direction == "forward" else case.backward, **options),
        "check": partial(case.check, direction, **options),
        "limit": case.limit(direction, dtype or torch.float32),
        "oracle": case.oracle(direction),
        "dtype": str(dtype or torch.float32).removeprefix("torch."),
        "parameters": dict(case.sizes),
    }
    return Variant(name, direction=direction, **(defaults | changes))


def pair(case: Case, name: str, **changes: Any) -> list[Variant]:
    """Return the variants of both directions: forward, and forward with all gradients."""
    return [variant(case, name, direction, **changes) for direction in DIRECTIONS]


def difference(case: Case, other: Case, direction: str) -> Error:
    """Return the difference of two cases' results, or of their gradients."""
    run = "forward" if direction == "forward" else "backward"
    results = (getattr(x, run)() for x in (case, other))
    tensors = (r if isinstance(r, tuple) else (r,) for r in results)
    return compare(*({str(i): x for i, x in enumerate(r) if torch.is_tensor(x)} for r in tensors))
