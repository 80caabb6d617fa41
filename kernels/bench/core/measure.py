"""Runs cases: first call, check, clock, counts. Results that fail their check get no time."""

from __future__ import annotations

import contextlib
import ctypes
import datetime
import gc
import math
import os
import platform
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
import warp as wp

from gamba_warp.versions import __version__

from ...runtime import memory
from .case import LEVELS, Case, NotInstalled, Settings, Variant

FORMAT = "gamba_warp.bench.1"
TIMES = ("ms_p20", "ms_p50", "ms_p80", "jit_ms")
# Options of Linux's prctl, and its further arguments, which must be zeros.
_SET_THP_DISABLE, _GET_THP_DISABLE = 41, 42
_NO_MORE = (ctypes.c_ulong(0),) * 4


@dataclass
class _Timed:
    """A variant under way: its record and the seconds measured so far."""

    variant: Variant
    record: dict
    seconds: list[float] = field(default_factory=list)

    def done(self, fewest: int, time_is_up: bool, most: int) -> bool:
        count = len(self.seconds)
        most = min(most, self.variant.rounds or most)
        return count >= most or (time_is_up and count >= fewest)


def synchronize(device: torch.device) -> None:
    """Waits until a GPU has done its work; a CPU needs no waiting."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def measure(
    cases: Iterable[Case],
    settings: Settings,
    say: Callable[[str, str], None] = lambda case, variant: None,
) -> dict:
    """Measures cases and returns the document: machine, settings and records.

    A variant that raises, and a check that fails, are recorded in ``status``; the rest goes on.
    Ctrl-C ends the run: ``interrupted`` is set and the measurements are kept.

    Args:
        cases: cases in the order of their measuring.
        settings: settings of the run.
        say: function that gets the case's and the variant's name before each step.

    Returns:
        ``{format, machine, settings, interrupted, records}``, ready for JSON. A record has ``op,
        case, variant, device, dtype, direction, ms_p20, ms_p50, ms_p80`` (milliseconds, quantiles
        of ``rounds`` runs), ``jit_ms`` (the first call, compilation or its cache included),
        ``rel_rms_error, max_error`` (see ``Error``), ``peer, peer_ms`` (the fastest peer of the
        same case, direction and sizes), ``work`` (counts); and ``status`` ("ok" or the failure),
        ``is_peer, is_default, oracle, limit, parameters, threads, rounds, axis``. Times are None
        unless the status is "ok".
    """
    records: list[dict] = []
    document = {
        "format": FORMAT,
        "machine": machine(settings),
        "settings": {"level": settings.level, "peers": settings.peers},
        "interrupted": False,
        "records": records,
    }
    try:
        for case in cases:
            _run_case(case, settings, records, say)
    except KeyboardInterrupt:
        document["interrupted"] = True
    finally:
        torch.set_num_threads(settings.threads)
    return document


def _run_case(case: Case, settings: Settings, records: list[dict], say: Callable) -> None:
    torch.set_num_threads(settings.threads)
    say(f"{case.op}: {case.name}", "inputs")
    try:
        variants = case.build()
    except Exception as error:
        variants = [Variant("all", lambda: None, None)]
        records.append(_record(case, variants[0], settings) | {"status": _reason(error)})
        return
    timed = [_Timed(v, _record(case, v, settings)) for v in variants]
    try:
        for t in timed:
            say(f"{case.op}: {case.name}", t.variant.name)
            _prepare(t, settings)
        ready = [t for t in timed if t.record["status"] == "ok"]
        _clock(ready, settings, lambda t: say(f"{case.op}: {case.name}", t.variant.name))
        for t in ready:
            if t.variant.work is not None and t.record["status"] == "ok":
                torch.set_num_threads(t.variant.threads or settings.threads)
                t.record["work"] = t.variant.work()
    finally:  # an interrupt keeps the results so far
        _summarize(timed)
        records += [t.record for t in timed if t.record["status"] != "not measured"]


def _record(case: Case, variant: Variant, settings: Settings) -> dict:
    return {
        "op": case.op,
        "case": case.name,
        "variant": variant.name,
        "device": settings.device.type,
        "dtype": variant.dtype,
        "direction": variant.direction,
        **dict.fromkeys(TIMES),
        "rel_rms_error": None,
        "max_error": None,
        "peer": None,
        "peer_ms": None,
        "work": {},
        "status": "not measured",
        "is_peer": variant.peer,
        "is_default": variant.default,
        "oracle": variant.oracle,
        "limit": variant.limit if variant.oracle else None,
        "parameters": variant.parameters,
        "threads": variant.threads or settings.threads,
        "rounds": 0,
        "axis": case.axis,
        "text": case.text,
    }


def _prepare(t: _Timed, settings: Settings) -> None:
    """Makes the first call and the check, and sets the status."""
    torch.set_num_threads(t.variant.threads or settings.threads)
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
    """Times the variants in turn until each has its rounds and the case its time."""
    level = LEVELS[settings.level]
    ends = time.perf_counter() + level.seconds * len(ready)
    gc.collect()
    gc.disable()
    try:
        while True:
            time_is_up = time.perf_counter() >= ends
            todo = [t for t in ready if not t.done(level.fewest, time_is_up, level.most)]
            if not todo:
                return
            for t in todo:
                say(t)
                torch.set_num_threads(t.variant.threads or settings.threads)
                try:
                    synchronize(settings.device)
                    started = time.perf_counter()
                    result = t.variant.run()
                    synchronize(settings.device)
                    t.seconds.append(time.perf_counter() - started)
                    del result  # freeing it is in no variant's time
                except Exception as error:
                    t.record["status"] = _reason(error)
                    ready.remove(t)
    finally:
        gc.enable()


def _summarize(timed: list[_Timed]) -> None:
    """Writes the times into the records, and in each the fastest peer of the same sizes."""
    for t in timed:
        if t.record["status"] == "ok" and not t.seconds:
            t.record["status"] = "not measured"
        if t.record["status"] != "ok":
            t.record.update(dict.fromkeys(TIMES))
            continue
        quantiles = np.quantile(t.seconds, [0.2, 0.5, 0.8]) * 1e3
        t.record.update(zip(TIMES, map(float, quantiles)), rounds=len(t.seconds))
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


def peak_bytes(run: Callable[[], object], device: torch.device) -> int | None:
    """Measures the growth of memory while ``run`` runs, in bytes, its result included.

    On CUDA this is torch's own count. On Linux it is the process's resident memory, whose
    high-water mark the kernel lets us reset; on other systems it is None.
    """
    if device.type == "cuda":
        synchronize(device)
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        result = run()
        synchronize(device)
        del result
        return torch.cuda.max_memory_allocated(device) - before
    try:
        with _small_pages():
            # memory that is free but kept would be reused unseen
            ctypes.CDLL(None).malloc_trim(0)
            memory.release()
            Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")
            before = _resident("VmRSS")
            result = run()
            after = _resident("VmHWM")
    except (OSError, AttributeError, StopIteration):
        return None
    del result
    memory.release()  # it has small pages
    return after - before


@contextlib.contextmanager
def _small_pages() -> Iterator[None]:
    """Keeps Linux from using huge pages for this process.

    numpy asks for huge pages under each array of 4 MiB or more, and the heap keeps this mark after
    the array is freed. Later allocations there would be counted in steps of 2 MiB.

    Raises:
        AttributeError: the system is not Linux.
    """
    prctl = ctypes.CDLL(None).prctl
    disabled = prctl(_GET_THP_DISABLE, *_NO_MORE)
    prctl(_SET_THP_DISABLE, ctypes.c_ulong(1), *_NO_MORE[1:])
    try:
        yield
    finally:
        prctl(_SET_THP_DISABLE, ctypes.c_ulong(max(disabled, 0)), *_NO_MORE[1:])


def _resident(name: str) -> int:
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return 1024 * int(next(line for line in lines if line.startswith(name)).split()[1])


def saved_bytes(forward: Callable[[], object], inputs: Iterable[torch.Tensor]) -> int:
    """Counts the bytes that a forward pass keeps for its backward, without the inputs."""
    own = {x.untyped_storage().data_ptr() for x in inputs}
    seen: dict[int, int] = {}

    def pack(x: torch.Tensor) -> torch.Tensor:
        seen[x.untyped_storage().data_ptr()] = x.untyped_storage().nbytes()
        return x

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda x: x):
        result = forward()
    del result
    return sum(size for pointer, size in seen.items() if pointer not in own)
