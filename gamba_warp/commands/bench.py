"""``gamba bench``: run time against error, on this machine."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType
from typing import Annotated

import tyro

from ..conventions import DeviceChoice
from ..devices import pick_device
from ..files import output_folder
from ..untrusted.ranges import Threads, ranged

# What is measured -> the module with ``cases(settings)`` and ``targets(settings)``. It is imported
# when it is asked for.
SUITES = {
    "scan": "gamba_warp.kernels.bench.cases.scan",
    "conv": "gamba_warp.kernels.bench.cases.conv",
    "raster": "gamba_warp.kernels.bench.cases.raster",
    "block": "gamba_warp.measure.blocks",
    "model": "gamba_warp.measure.blocks",
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
    static: bool = False,
    only: tuple[str, ...] = (),
) -> int:
    """Measures run time against error, with what is installed beside us.

    Every variant is compared with float64 before it is timed; what fails gets no time. Writes
    bench.json, bench.md and bench.html. Ctrl-C keeps what was measured.

    Args:
        what: scan, conv, raster, block, model, or all.
        device: Device to measure; auto is the GPU if there is one.
        quick: Small sizes and a few rounds, which take seconds.
        full: All sizes, many rounds, and the torch loop at full length.
        peers: Also measure mambapy, mamba-ssm, causal-conv1d, gsplat and gswarp, where installed.
        out: Folder for the results. With --render it may be a .md or .html file.
        threads: Number of CPU threads; torch's own number if not given.
        compare: An older bench.json; prints the ratios of the times.
        render: Measure nothing; make the tables and the page of these JSON files.
        static: Measure nothing; compile the CUDA kernels, no GPU needed, and write what they take
            (registers, stack, shared memory, occupancy) to static.json and static.md.
        only: Measure only these cases, by their full names, as "one call".
    """
    from ..measure import suites

    if static:
        folder = output_folder(out)
        rows = suites.write_static(folder)
        print(f"{rows} rows; wrote {folder / 'static.json'} and static.md")
        return 0
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
        print("interrupted; what was measured is kept")
        return 130
    return 1 if suites.failed_records(document) else 0


def load_suite(op: str) -> ModuleType:
    """The module with the cases and targets of one of ``SUITES``."""
    return importlib.import_module(SUITES[op])
