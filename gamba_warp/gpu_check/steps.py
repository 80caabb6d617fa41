"""The steps of ``gamba gpu-check``, each run in a process of its own.

After every item a step writes its findings to a file. So whatever ends the step, a crash of another
package or the clock, loses no more than the item under way.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import torch
import warp as wp

from ..errors import first_line
from ..files import write_json
from ..kernels.bench import Case, Settings, Target, measure
from ..kernels.bench.cases import conv, raster, scan
from ..kernels.bench.core.report import judge
from ..kernels.bench.static.report import find_kernels
from ..measure import blocks, inference
from .kernels import LeftOut, checks

_Item = TypeVar("_Item")
_SUITES = (raster, scan, conv, blocks)
# These cases are timed first, since the time may end before the list does; all others follow.
_FIRST = [
    ("scan", "operator"), ("raster", "scene"), ("conv", "operator"), ("block", "one block"),
    ("block", "backbone"), ("raster", "32 views"), ("scan", "training batch"),
    ("model", "one picture"),
]  # fmt: skip
_ON_A_CPU = [("conv", "operator")]  # a quick run on a CPU only tries the command
# These cases run other people's packages, and a crash there must not end the timing of ours.
_BESIDE = {
    "peers-conv": [("conv", "operator")],
    "peers-scan": [("scan", "reference loop")],
    "peers-raster": [("raster", "scene"), ("raster", "32 views")],
}


@dataclass
class Part:
    """What a step has done so far.

    Attributes:
        path: file of the findings.
        until: time after which no item is begun, seconds since the epoch.
        parent: number of the process that asked; no item is begun once it is gone.
        result: findings, ready for JSON.
        not_done: ``{what, reason}`` of each item left out.
        failures: faults, in words.
        whole: whether the step came to its end.
    """

    path: Path
    until: float
    parent: int = field(default_factory=os.getppid)
    result: dict = field(default_factory=dict)
    not_done: list[dict] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    whole: bool = False

    def write(self) -> None:
        """Replaces the file by the present state."""
        names = ("result", "not_done", "failures", "whole")
        write_json(self.path, {name: getattr(self, name) for name in names})

    def leave_out(self, what: str, reason: str) -> None:
        """Records that something is not done, and why."""
        self.not_done.append({"what": what, "reason": reason})

    def in_time(self, items: Iterable[_Item], name: Callable[[_Item], str]) -> Iterator[_Item]:
        """Yields items while there is time and somebody waits, and writes after each."""
        for item in items:
            if time.time() > self.until or os.getppid() != self.parent:
                self.leave_out(name(item), "time was up")
            else:
                yield item
                self.write()


def run_step(name: str, part: Part, settings: Settings) -> None:
    """Runs the step of that name to its end, or until its time is up."""
    torch.set_num_threads(settings.threads)
    part.write()
    if name in _BESIDE:
        _bench(part, replace(settings, peers=True), _BESIDE[name])
    elif name == "bench":
        quick, cpu = settings.level == "quick", settings.device.type == "cpu"
        _bench(part, settings, _ON_A_CPU if quick and cpu else _FIRST, alone=quick)
    else:
        {"compile": _compile, "checks": _checks, "inference": _inference}[name](part, settings)
    part.whole = True
    part.write()


def _compile(part: Part, settings: Settings) -> None:
    """Compiles every kernel of ``gamba bench --static`` for this device, into Warp's cache."""
    device = wp.device_from_torch(settings.device)
    entries = find_kernels()
    part.result = {"kernels": 0, "of": len(entries), "seconds": 0.0}
    for entry in part.in_time(entries, lambda e: f"compile {e.name}, {e.case}"):
        started = time.perf_counter()
        kernel, block = entry.launch.kernel, entry.launch.block
        if not kernel.module.load(device, block):
            part.failures.append(f"{entry.name}, {entry.case}: does not load on {device}")
        part.result["kernels"] += 1
        part.result["seconds"] += time.perf_counter() - started


def _checks(part: Part, settings: Settings) -> None:
    found = part.result["checks"] = []
    for check in part.in_time(checks(settings.level == "quick"), lambda check: check.name):
        started = time.perf_counter()
        row: dict[str, Any] = {"name": check.name, "status": "passed"}
        try:
            if check.cuda and settings.device.type != "cuda":
                raise LeftOut("needs CUDA")
            row["found"] = check.run(settings.device)
        except LeftOut as reason:
            part.leave_out(check.name, str(reason))
            continue
        except Exception as error:  # a broken kernel may raise anything, and that is a finding
            row |= {"status": "failed", "found": f"{type(error).__name__}: {first_line(error)}"}
            part.failures.append(f"{check.name}: {row['found']}")
        found.append(row | {"seconds": time.perf_counter() - started})


def _inference(part: Part, settings: Settings) -> None:
    part.result["ceilings"] = _ceilings(settings)
    _measure(part, settings, inference.cases(settings), inference.targets(settings))
    if settings.device.type != "cuda":
        part.leave_out("inference from a CUDA graph", "needs CUDA")
    else:
        part.result["reserved_gib"] = torch.cuda.memory_reserved(settings.device) / 2**30


def _ceilings(settings: Settings) -> dict[str, float]:
    """Measures what the device does at best, to judge times by: a copy and a matrix product."""
    count, side = (1 << 20, 256) if settings.level == "quick" else (1 << 30, 8192)
    source = torch.ones(count // 4, device=settings.device)
    a = torch.randn(side, side, device=settings.device).bfloat16()
    target = torch.empty_like(source)

    def seconds(run: Callable[[], object]) -> float:
        spans = []
        for _ in range(5):
            started = time.perf_counter()
            run()
            if settings.device.type == "cuda":
                torch.cuda.synchronize(settings.device)
            spans.append(time.perf_counter() - started)
        return min(spans)

    return {
        "copy_gb_per_s": 2 * count / seconds(lambda: target.copy_(source)) / 1e9,
        "bfloat16_tflop_per_s": 2 * side**3 / seconds(lambda: a @ a) / 1e12,
    }


def _bench(
    part: Part, settings: Settings, first: list[tuple[str, str]], *, alone: bool = True
) -> None:
    """Measures the cases of ``gamba bench`` named in ``first``; unless ``alone``, then all others.

    A name of ``first`` that has no case at this level is passed over.
    """
    found: dict[tuple[str, str], Case] = {}
    targets: list[Target] = []
    for suite in _SUITES:
        found |= {(case.op, case.name): case for case in suite.cases(settings)}
        targets += suite.targets(settings)
    keys = [key for key in first if key in found]
    if not alone:
        keys += [key for key in found if key not in keys]
    _measure(part, settings, [found[key] for key in keys], targets)


def _measure(part: Part, settings: Settings, cases: list[Case], targets: list[Target]) -> None:
    """Measures case after case; a fault of ours is a failure, a fault of a peer only a note."""
    document = part.result["bench"] = measure([], settings)
    for case in part.in_time(cases, lambda case: f"{case.op}: {case.name}"):
        records = measure([case], settings)["records"]
        document["records"] += records
        document["targets"] = judge(targets, document["records"])
        for r in records:
            name = f"{r['op']}: {r['case']}: {r['variant']}, {r['direction']}"
            if r["status"] == "ok":
                continue
            if r["is_peer"] or r["status"].startswith("not"):
                part.leave_out(name, r["status"])
            else:
                part.failures.append(f"{name}: {r['status']}")
