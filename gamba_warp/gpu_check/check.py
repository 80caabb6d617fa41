"""``gamba gpu-check``: checks that need a CUDA machine, in one run of a few minutes.

It needs only torch, numpy and warp-lang, and no installation: in a bare checkout
``python -m gamba_warp.gpu_check`` is the same command. Each step runs in its own process with a
time limit, and writes both files after every item. So a crash or a timeout loses only the current
item; the files list skipped items.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import torch
import warp as wp

from ..errors import UserError, first_line
from ..files import output_folder, write_json, write_text
from ..kernels.bench.cases import conv, raster, scan
from ..kernels.bench.core.case import Case, Settings, Variant, make_cases
from ..kernels.bench.core.measure import machine, measure
from ..kernels.bench.core.report import case_parts, work_text
from ..kernels.bench.peers import PACKAGES, versions
from ..kernels.runtime.tables import markdown
from ..measure import blocks, inference
from ..versions import installed
from . import MINUTES, STEPS, Step
from .checks import LeftOut, checks

FORMAT = "gamba_warp.gpu_check.2"
_GRACE = 15.0  # seconds that the last item of a step may take
_LEAST = 5.0  # seconds left to begin a step
_LATE = "its {:.0f} s were up"
_STEP = "import sys; from {} import run_step; run_step(*sys.argv[1:])"  # run in a child process
_Item = TypeVar("_Item")
# Timed first, because the time may not suffice for all cases.
_FIRST = [
    *(("scan", "operator"), ("raster", "scene"), ("conv", "operator"), ("block", "one block")),
    *(("block", "backbone"), ("raster", "32 views"), ("scan", "training batch")),
    ("model", "one picture"),
]
_ON_A_CPU = [("conv", "operator")]  # a quick run on a CPU only tests the command
# Cases with other packages, in their own steps so that a crash does not affect our timings.
_BESIDE = {
    "peers-conv": [("conv", "operator")],
    "peers-scan": [("scan", "reference loop")],
    "peers-raster": [("raster", "scene"), ("raster", "32 views")],
}


class Report:
    """Document of a run and its two files, which are rewritten with every item.

    Attributes:
        folder: of gpu-check.json and gpu-check.md.
        document: ``{format, verdict, machine, settings, steps, checks, failures, not_done,
            bench}``, ready for JSON; the last is one document as ``gamba bench`` writes it,
            inference included.
        until: time after which no item is begun, seconds since the epoch.
        settings: of the benchmark's cases, by the options of the command.
    """

    def __init__(self, folder: Path, document: dict, until: float = float("inf")) -> None:
        self.folder, self.document, self.until = folder, document, until
        asked = document["settings"]
        threads = torch.get_num_threads()
        self.settings = Settings(torch.device(asked["device"]), asked["level"], threads=threads)

    def write(self) -> None:
        """Replace both files."""
        write_json(self.folder / "gpu-check.json", self.document)
        write_text(self.folder / "gpu-check.md", page(self.document))

    def read(self) -> None:
        """Read the document written by a step."""
        self.document = json.loads((self.folder / "gpu-check.json").read_bytes())

    def leave_out(self, what: str, reason: str) -> None:
        """Record a skipped item with its reason."""
        self.document["not_done"].append({"what": what, "reason": reason})

    def in_time(self, items: Iterable[_Item], name: Callable[[_Item], str]) -> Iterator[_Item]:
        """Yield items while there is time, and write after each."""
        for item in items:
            if time.time() > self.until:
                self.leave_out(name(item), "time was up")
            else:
                yield item
                self.write()


def begin(device: str, quick: bool, folder: Path) -> Report:
    """Return the report of a new run."""
    settings = {"device": device, "level": "quick" if quick else "normal"}
    document = {"format": FORMAT, "verdict": "not finished", "machine": {}, "settings": settings}
    document |= {name: [] for name in ("steps", "checks", "failures", "not_done")}
    report = Report(folder, document | {"bench": {"records": []}})
    report.document["machine"] = machine_facts(report.settings)
    for package in sorted(set(PACKAGES) - versions().keys()):
        report.leave_out(f"comparison with {package}", "not installed")
    return report


def run_gpu_check(
    device: str = "cuda",
    quick: bool = False,
    out: Path = Path("out/gpu-check"),
    minutes: float = MINUTES,
    steps: Sequence[str] = (),
) -> int:
    """Run kernel checks, full-size inference and the benchmark on this machine.

    Args:
        device: "cuda"; or "cpu", which tests the command itself.
        quick: tiny sizes.
        out: folder for gpu-check.json and gpu-check.md.
        minutes: time limit of the whole run.
        steps: names of ``STEPS``, or none for all.

    Returns:
        The exit code: 0 all executed items passed, 1 something failed, 130 Ctrl-C.

    Raises:
        UserError: CUDA is unavailable, or an option is out of range.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise UserError("no CUDA device here; --device cpu --quick tries the command itself")
    if not 0 < minutes < float("inf"):
        raise UserError(f"--minutes is {minutes}, it must be positive")
    report, ends = begin(device, quick, output_folder(out)), time.time() + 60 * minutes
    try:
        for step in STEPS:
            if not steps or step.name in steps:
                do(report, step, min(step.seconds * minutes / MINUTES, ends - time.time() - 1))
        failures = len(report.document["failures"])
        verdict = f"{failures} failed" if failures else "all that could be run passed"
        code = 1 if failures else 0
    except KeyboardInterrupt:
        report.read()
        verdict, code = "interrupted; what was done is here", 130
    report.document["verdict"] = verdict
    report.write()
    rows = headline(report.document)
    width = min(60, max(len(name) for name, _ in rows))
    lines = [f"{name:<{width}}  {value}" for name, value in rows]
    lines += [f"failed: {text}" for text in report.document["failures"]]
    lines += [f"not done: {r['what']}: {r['reason']}" for r in report.document["not_done"]]
    print("\n".join(lines))
    print(f"{verdict}; wrote {report.folder / 'gpu-check.json'} and gpu-check.md")
    return code


def do(report: Report, step: Step, seconds: float) -> None:
    """Run a step in a child process with a time limit."""
    started, failures = time.time(), len(report.document["failures"])
    row = {"name": step.name, "status": "not done", "reason": "", "seconds": 0.0}
    report.document["steps"].append(row)
    report.write()
    if step.packages and report.settings.device.type != "cuda":
        row["reason"] = "needs CUDA"
    elif step.packages and not versions().keys() & set(step.packages):
        row["reason"] = f"not installed: {', '.join(step.packages)}"
    elif seconds < _LEAST:
        row["reason"] = "time was up"
    else:
        until = started + max(seconds - _GRACE, seconds / 2)
        words = "-c", _STEP.format(__name__), str(report.folder), step.name, str(until)
        reason = in_a_process(words, seconds)
        report.read()
        row = report.document["steps"][-1]
        row.update(status="stopped" if reason == _LATE.format(seconds) else "passed", reason=reason)
        if reason and row["status"] != "stopped":
            report.document["failures"].append(f"step {step.name}: {reason}")
        if len(report.document["failures"]) > failures:
            row["status"] = "failed"
    row["seconds"] = time.time() - started
    if row["status"] in ("not done", "stopped"):
        rest = "the rest of " if row["status"] == "stopped" else ""
        report.leave_out(f"{rest}step {step.name}", row["reason"])
    report.write()
    reason = f" ({row['reason']})" if row["reason"] else ""
    print(f"{step.name:<10} {row['status']}{reason}, {row['seconds']:.0f} s", flush=True)


def in_a_process(words: Sequence[str], seconds: float) -> str:
    """Run Python with arguments, and kill its process group at the end.

    Returns:
        The reason of a failure, with the last line of output; empty on success.
    """
    # Output of kernels and compilers goes to a file.
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(
            [sys.executable, *words], stdout=output, stderr=output, start_new_session=True
        )
        try:
            code = process.wait(seconds)
        except subprocess.TimeoutExpired:
            return _LATE.format(seconds)
        finally:  # also after an interrupt
            with suppress(ProcessLookupError):  # it leads the group of its children
                os.killpg(process.pid, signal.SIGKILL)
            process.kill()
            process.wait()
        output.seek(0)
        lines = output.read().decode(errors="replace").strip().splitlines()
    if code == 0:
        return ""
    died = f"ended with code {code}"
    if code < 0:
        died = f"died of signal {-code} ({signal.Signals(-code).name})"
    return ": ".join([f"its process {died}", *lines[-1:]])


def run_step(folder: str | Path, name: str, until: str | float = "inf") -> None:
    """Run a step within its time limit, and write to a folder's report."""
    document = json.loads((Path(folder) / "gpu-check.json").read_bytes())
    report = Report(Path(folder), document, float(until))
    settings, quick = report.settings, report.settings.level == "quick"
    cpu = settings.device.type == "cpu"
    if name == "checks":
        _checks(report)
    elif name == "inference":
        ceilings = make_cases(inference.OP, settings, [("ceilings", _ceilings, None)])
        _measure(report, settings, [*ceilings, *inference.full_size(settings)])
        if cpu:
            report.leave_out("inference from a CUDA graph", "needs CUDA")
    else:
        beside = name in _BESIDE
        settings = replace(settings, peers=beside)
        first = _BESIDE[name] if beside else _ON_A_CPU if quick and cpu else _FIRST
        suites = raster, scan, conv, blocks, inference
        found = {(c.op, c.name): c for suite in suites for c in suite.cases(settings)}
        keys = dict.fromkeys(first if beside or quick else (*first, *found))
        _measure(report, settings, [found[key] for key in keys if key in found])
    report.write()


def _checks(report: Report) -> None:
    device = report.settings.device
    every = checks(report.settings.level == "quick")
    for check in report.in_time(every, lambda check: check.name):
        started = time.perf_counter()
        row: dict[str, Any] = {"name": check.name, "status": "passed"}
        try:
            if check.cuda and device.type != "cuda":
                raise LeftOut("needs CUDA")
            row["found"] = check.run(device)
        except LeftOut as reason:
            report.leave_out(check.name, str(reason))
            continue
        except Exception as error:  # a broken kernel may raise anything, which is a failure
            row |= {"status": "failed", "found": f"{type(error).__name__}: {first_line(error)}"}
            report.document["failures"].append(f"{check.name}: {row['found']}")
        report.document["checks"].append(row | {"seconds": time.perf_counter() - started})


def _ceilings(settings: Settings) -> list[Variant]:
    """Return reference variants: the peak rates of a copy and a matrix product."""
    count, side = (1 << 18, 256) if settings.level == "quick" else (1 << 28, 8192)
    source = torch.ones(count, device=settings.device)
    a = torch.randn(side, side, device=settings.device).bfloat16()
    target, product = torch.empty_like(source), torch.empty_like(a)
    runs = {
        "a copy": (lambda: target.copy_(source), {"traffic": 8 * count}),
        "a product": (lambda: torch.mm(a, a, out=product), {"flops": 2 * side**3}),
    }
    return [Variant(name, run, None, work=lambda n=n: n) for name, (run, n) in runs.items()]


def _measure(report: Report, settings: Settings, cases: list[Case]) -> None:
    """Measure case after case; our faults are failures, those of peers only notes."""
    before, document = report.document["bench"], measure([], settings)
    for case in report.in_time(cases, lambda case: f"{case.op}: {case.name}"):
        records = measure([case], settings)["records"]
        document["records"] += records
        report.document["bench"] = joined(before, document)
        for r in records:
            name = f"{r['op']}: {r['case']}: {r['variant']}, {r['direction']}"
            if r["status"] == "ok":
                continue
            if r["is_peer"] or r["status"].startswith("not"):
                report.leave_out(name, r["status"])
            else:
                report.document["failures"].append(f"{name}: {r['status']}")


def joined(before: dict, later: dict) -> dict:
    """Join two documents; a case of the later one replaces an earlier."""
    new = {(r["op"], r["case"]) for r in later["records"]}
    old = [r for r in before["records"] if (r["op"], r["case"]) not in new]
    return later | before | {"records": old + later["records"]}


def machine_facts(settings: Settings) -> dict:
    """Return the facts of ``gamba bench``, with more on the GPU and on other packages."""
    facts = machine(settings)
    if settings.device.type == "cuda":
        gpu = torch.cuda.get_device_properties(settings.device)
        free, total = torch.cuda.mem_get_info(settings.device)
        facts |= {
            "architecture": f"sm_{gpu.major}{gpu.minor}",
            "multiprocessors": gpu.multi_processor_count,
            "memory_gib": round(total / 2**30, 1),
            "free_gib": round(free / 2**30, 1),
            "driver": ".".join(map(str, wp.get_cuda_driver_version() or ())),
        }
    others = installed("timm", "pytest", "triton", "tyro", "safetensors")
    return facts | {"packages": others | versions()}


def headline(document: dict) -> list[tuple[str, str]]:
    """Return the results in rows of a name and a value."""
    packages = ", ".join(f"{k} {v}" for k, v in document["machine"]["packages"].items())
    facts = document["machine"] | {"packages": packages}
    rows = [(name.replace("_", " "), str(value)) for name, value in facts.items() if value]
    for step in document["steps"]:
        reason = f": {step['reason']}" if step["reason"] else ""
        rows.append((f"step {step['name']}", f"{step['status']}, {step['seconds']:.0f} s{reason}"))
    if words := [check["status"] for check in document["checks"]]:
        counts = (f"{words.count(word)} {word}" for word in dict.fromkeys(words))
        rows.append(("checks of the kernels", ", ".join(counts)))
    for r in document["bench"]["records"]:
        if r["op"] == "inference":
            value = r["status"]
            if value == "ok":
                value = f"{r['ms_p50']:.3g} ms ({r['ms_p20']:.3g} to {r['ms_p80']:.3g})"
                value = ", ".join(filter(None, (value, work_text(r))))
            if r["rel_rms_error"] is not None:
                value += f", error {r['rel_rms_error']:.2g} to {r['oracle']}"
            rows.append((f"inference, {r['variant']}", value))
    return rows


def page(document: dict) -> str:
    """Return the document as a Markdown page."""
    title = document["verdict"]
    lines = ["# gamba gpu-check", "", f"Written by `gamba gpu-check`, not by hand. **{title}**", ""]
    lines.append(markdown(("what", "found"), headline(document)))
    not_done = [f"{row['what']}: {row['reason']}" for row in document["not_done"]]
    for name, rows in (("Failed", document["failures"]), ("Not done", not_done)):
        if rows:
            lines += ["", f"## {name}", "", *(f"- {row}" for row in rows)]
    for part in case_parts(document["bench"]):
        lines += ["", f"## {part.title}", "", *part.texts, ""]
        lines += [markdown(*rows) for rows in part.tables]
    return "\n".join([*lines, ""])


def main(arguments: list[str] | None = None) -> int:
    """Run ``python -m gamba_warp.gpu_check``: the command without tyro."""
    parser = argparse.ArgumentParser(
        prog="gamba gpu-check", description=(run_gpu_check.__doc__ or "").split("\n\n")[0]
    )
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--quick", action="store_true", help="tiny sizes")
    parser.add_argument("--out", type=Path, default=Path("out/gpu-check"), help="folder")
    parser.add_argument("--minutes", type=float, default=MINUTES, help="the run takes no longer")
    names = [step.name for step in STEPS]
    parser.add_argument("--steps", nargs="+", choices=names, default=(), help="only these")
    o = parser.parse_args(arguments)
    try:
        return run_gpu_check(**vars(o))
    except UserError as error:
        print(f"gamba: {error}", file=sys.stderr)
        return 2
