"""Checks and benchmarks of a machine: ``gamba bench, stress, doctor``."""

from __future__ import annotations

import importlib
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Annotated

import tyro
from msgspec import Meta

from ..batch import progress_bar
from ..conventions import DeviceChoice
from ..devices import pick_device
from ..errors import UserError
from ..files import output_folder, write_json, write_text
from ..untrusted.ranges import Minutes, Seed, Threads, ranged
from ..versions import used_versions

What = tyro.conf.Positional[Annotated[tuple[str, ...], tyro.conf.arg(metavar="WHAT ...")]]
# Suite -> the module with its ``tables(settings)``, imported when needed.
BENCH = {
    "scan": "gamba_warp.kernels.bench.scan",
    "conv": "gamba_warp.kernels.bench.conv",
    "raster": "gamba_warp.kernels.bench.raster",
    "model": "gamba_warp.measure.models",
    "step": "gamba_warp.train.timing",
}
# Suite -> modules with an ``OP``, imported when needed.
STRESS = {
    "scan": ("gamba_warp.kernels.cases.scan", "gamba_warp.kernels.cases.conv"),
    "raster": ("gamba_warp.kernels.cases.raster",),
}


def choose(what: Sequence[str], known: Mapping[str, object]) -> list[str]:
    """Return the selected names of ``known``, in its order; "all" selects all.

    Raises:
        UserError: a name is not known.
    """
    if unknown := [name for name in what if name not in (*known, "all")]:
        raise UserError(f"unknown case '{unknown[0]}'; there are {', '.join(known)} and all")
    return [name for name in known if name in what or "all" in what]


@ranged
def bench_command(
    what: What = ("all",),
    *,
    device: DeviceChoice = "auto",
    quick: bool = False,
    full: bool = False,
    peers: bool = False,
    out: Path = Path("out/bench"),
    threads: Threads | None = None,
    only: tuple[str, ...] = (),
) -> int:
    """Measure run time and error, also of other installed packages.

    Every variant is compared with float64 before it is timed; a failed one is not timed. Writes
    bench.json, bench.md and bench-OP.svg, a chart of time over error. Ctrl-C keeps the results.

    Args:
        what: scan, conv, raster, model, step (of a training), or all.
        device: Device to measure; auto is the GPU if there is one.
        quick: Small sizes and a few rounds; all suites take about a minute.
        full: All sizes, many rounds, and the torch loop at full length.
        peers: Also measure mambapy, mamba-ssm, causal-conv1d and gsplat, if installed.
        out: Folder for the results.
        threads: Number of CPU threads; by default torch's.
        only: Measure only these cases, by full name, such as "one call".
    """
    import torch

    from ..kernels.bench.measure import Settings, measure
    from ..kernels.bench.peers import versions
    from ..kernels.bench.report import busy_line, charts, failures, markdown

    if quick and full:
        raise UserError("--quick and --full: choose one")
    chosen = choose(what, BENCH)
    level = "quick" if quick else "full" if full else "normal"
    settings = Settings(pick_device(device), level, peers, threads or torch.get_num_threads())
    cases = [case for op in chosen for case in load_suite(op).tables(settings)]
    if only:
        names = list(dict.fromkeys(case.name for case in cases))
        if unknown := [name for name in only if name not in names]:
            raise UserError(f"--only {unknown[0]}: no such case; there are {'; '.join(names)}")
        cases = [case for case in cases if case.name in only]
    folder = output_folder(out)
    with progress_bar(unit="variant", desc="bench") as bar:

        def say(case: str, variant: str) -> None:
            bar.set_postfix_str(f"{case}, {variant}")
            bar.update()

        document = measure(cases, settings, say)
    document["machine"]["peers"] = versions() if peers else {}
    write_json(folder / "bench.json", document)
    write_text(folder / "bench.md", markdown(document))
    for op, chart in charts(document).items():
        write_text(folder / f"bench-{op}.svg", chart)
    failed = failures(document)
    print(*(f"{line}\n" for line in failed), sep="", end="")
    measured = sum(r["status"] == "ok" for r in document["records"])
    print(f"{measured} measured; wrote {folder / 'bench.json'}, bench.md and charts")
    if line := busy_line(document):
        print(line, file=sys.stderr)
    if document["interrupted"]:
        print("interrupted; the results so far are kept")
        return 130
    return 1 if failed else 0


def load_suite(op: str) -> ModuleType:
    """Import the module with the cases of one of ``BENCH``."""
    return importlib.import_module(BENCH[op])


@ranged
def stress_command(
    what: What = ("all",),
    *,
    seed: Seed = 0,
    minutes: Minutes | None = None,
    cases: Annotated[int, Meta(ge=1)] | None = None,
    device: DeviceChoice = "auto",
    threads: Threads | None = None,
    out: Path = Path("out/stress"),
) -> int:
    """Compare kernels with float64 on random and hostile cases.

    Checks forward results and all gradients. A failing case is made smaller. Writes stress.json and
    stress.md. Ctrl-C keeps the results so far.

    Args:
        what: scan (with the convolution), raster, or all (of these).
        seed: The same seed gives the same cases in the same order.
        minutes: Time limit; by default 1, or none with --cases.
        cases: Number of cases of each operator; by default as many as fit in --minutes.
        device: Device of the kernels; auto is the GPU if there is one.
        threads: Number of CPU threads; by default torch's.
        out: Folder for the results.
    """
    import torch

    from ..kernels.stress.run import StressRun

    chosen = pick_device(device)
    if threads is not None:
        torch.set_num_threads(threads)
    names = choose(what, STRESS)
    ops = [importlib.import_module(module).OP for name in names for module in STRESS[name]]
    folder, run = output_folder(out), StressRun(ops, chosen, seed)
    seconds = math.inf if minutes is None and cases is not None else 60 * (minutes or 1.0)
    with progress_bar(unit="case", desc="stress") as bar:

        def say(text: str) -> None:
            bar.set_postfix_str(text)
            bar.update()

        run.run(cases, seconds, say)
    write_json(folder / "stress.json", run.document())
    write_text(folder / "stress.md", run.markdown())
    print(f"{run.summary()}; wrote {folder / 'stress.json'} and stress.md")
    if run.about["interrupted"]:
        print("interrupted; the results so far are kept")
        return 130
    return 1 if run.failures else 0


def doctor_command(warm_up: bool = False) -> int:
    """Print what this machine has and can run, and what is missing.

    Args:
        warm_up: Also compile the kernels for this machine's devices, and print the time.
    """
    from ..measure import health

    _print("Versions", used_versions().items())
    _print("Devices", health.devices())
    _print("Folders", health.folders())
    abilities = list(health.abilities())
    _print("Can run", ((name, value) for name, value, _ in abilities))
    if warm_up:
        print("Kernels")
        for device, first, again in health.warm_up_kernels():
            print(f"  {device:<18} {first:.1f} s to compile or load, then {1000 * again:.0f} ms")
    else:
        print("Kernels compile on first use; 'gamba doctor --warm-up' does it now")
    return 1 if any(fault for _, _, fault in abilities) else 0


def _print(title: str, lines: Iterable[tuple[str, str]]) -> None:
    print(title)
    for name, value in lines:
        print(f"  {name:<18} {value}")
