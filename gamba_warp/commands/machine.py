"""Checks and benchmarks of a machine: ``gamba bench, stress, doctor``."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Annotated

import tyro
from msgspec import Meta

from ..batch import progress_bar
from ..conventions import DeviceChoice
from ..devices import pick_device
from ..files import output_folder, write_json, write_text
from ..untrusted.ranges import Minutes, Seed, Threads, ranged
from ..versions import used_versions

# Suite -> the module with its ``cases(settings)``, imported when needed.
SUITES = {
    "scan": "gamba_warp.kernels.bench.cases.scan",
    "conv": "gamba_warp.kernels.bench.cases.conv",
    "raster": "gamba_warp.kernels.bench.cases.raster",
    "block": "gamba_warp.measure.blocks",
    "model": "gamba_warp.measure.inference",
}

# Suite -> modules with an ``OP``, imported when needed.
STRESS = {
    "scan": ("gamba_warp.kernels.cases.scan", "gamba_warp.kernels.cases.conv"),
    "raster": ("gamba_warp.kernels.cases.raster",),
    "model": ("gamba_warp.measure.stress",),
}


@ranged
def bench_command(
    what: tyro.conf.Positional[Annotated[tuple[str, ...], tyro.conf.arg(metavar="WHAT ...")]] = (
        "all",
    ),
    *,
    device: DeviceChoice = "auto",
    quick: bool = False,
    full: bool = False,
    peers: bool = False,
    out: Path = Path("out/bench"),
    threads: Threads | None = None,
    compare: Path | None = None,
    render: tuple[Path, ...] = (),
    only: tuple[str, ...] = (),
) -> int:
    """Measure run time and error, also of other installed packages.

    Every variant is compared with float64 before it is timed; a failed one is not timed. Writes
    bench.json, bench.md and bench.html. Ctrl-C keeps the results so far.

    Args:
        what: scan, conv, raster, block, model, or all.
        device: Device to measure; auto is the GPU if there is one.
        quick: Small sizes and a few rounds, in seconds.
        full: All sizes, many rounds, and the torch loop at full length.
        peers: Also measure mambapy, mamba-ssm, causal-conv1d, gsplat and gswarp, if installed.
        out: Folder for the results. With --render it may be a .md or .html file.
        threads: Number of CPU threads; by default torch's.
        compare: An older bench.json; prints the ratios of the times.
        render: Measure nothing; make the tables and the page of these JSON files.
        only: Measure only these cases, by full name, such as "one call".
    """
    from ..measure import suites

    if render:
        first, *others = suites.write_pages([suites.read_document(path) for path in render], out)
        print(" and ".join([f"wrote {first}", *(path.name for path in others)]))
        return 0
    chosen = suites.choose(what, SUITES, {"all": tuple(SUITES)})
    settings = suites.make_settings(pick_device(device), quick, full, peers, threads)
    old = suites.read_document(compare) if compare is not None else None
    folder = output_folder(out)
    document = suites.run_suites({op: load_suite(op) for op in chosen}, settings, only)
    suites.write_document(document, folder)
    written = f"wrote {folder / 'bench.json'}, bench.md and bench.html"
    print(f"{suites.summary(document, old)}; {written}")
    if document["interrupted"]:
        print("interrupted; the results so far are kept")
        return 130
    return 1 if suites.failed_records(document) else 0


def load_suite(op: str) -> ModuleType:
    """Import the module with the cases of one of ``SUITES``."""
    return importlib.import_module(SUITES[op])


@ranged
def stress_command(
    what: tyro.conf.Positional[Annotated[tuple[str, ...], tyro.conf.arg(metavar="WHAT ...")]] = (
        "all",
    ),
    *,
    seed: Seed = 0,
    minutes: Minutes | None = None,
    cases: Annotated[int, Meta(ge=1)] | None = None,
    device: DeviceChoice = "auto",
    threads: Threads | None = None,
    out: Path = Path("out/stress"),
) -> int:
    """Compare kernels and model with float64 on random and hostile cases.

    Checks forward results and all gradients. A failing case is made smaller. Writes stress.json and
    stress.md. Ctrl-C keeps the results so far.

    Args:
        what: scan (with the convolution), raster, model, or all (of these).
        seed: The same seed gives the same cases in the same order.
        minutes: Time limit; by default 1, or none with --cases.
        cases: Number of cases of each operator; by default as many as fit in --minutes.
        device: Device of the kernels; auto is the GPU if there is one.
        threads: Number of CPU threads; by default torch's.
        out: Folder for the results.
    """
    import torch

    from ..kernels.stress.run import StressRun
    from ..measure import suites

    chosen = pick_device(device)
    if threads is not None:
        torch.set_num_threads(threads)
    names = suites.choose(what, STRESS, {"all": tuple(STRESS)})
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
