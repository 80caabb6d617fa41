"""``gamba bench``: run time against error, on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro
from tqdm import tqdm

from ..devices import pick_device
from ..errors import UserError
from ..files import atomic_path, output_folder, write_json
from ..kernels.bench import Case, Settings, Target, measure
from ..kernels.bench.core.page import page
from ..kernels.bench.core.report import judge, markdown, ratio_table
from ..kernels.bench.peers import versions
from ..kernels.bench.static.report import NoCompiler, static_markdown, static_report
from ..measure.suites import SUITES, load_suite, read_document


def bench_command(
    what: tyro.conf.Positional[Annotated[tuple[str, ...], tyro.conf.arg(metavar="WHAT ...")]] = (
        "all",
    ),
    *,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    quick: bool = False,
    full: bool = False,
    peers: bool = False,
    out: Path = Path("out/bench"),
    threads: int | None = None,
    compare: Path | None = None,
    render: tuple[Path, ...] = (),
    static: bool = False,
) -> int:
    """Measures run time against error, with what is installed beside us.

    Every variant is compared with float64 before it is timed; what fails gets no time. Writes
    bench.json, bench.md and bench.html. Ctrl-C keeps what was measured.

    Args:
        what: scan, conv, raster, block, model, train-step, or all.
        device: Where; auto is the GPU if there is one.
        quick: Small sizes, a few rounds: seconds.
        full: All sizes, many rounds, the torch loop at full length.
        peers: Also measure mambapy, mamba-ssm, causal-conv1d, gsplat and gswarp, where installed.
        out: Folder for the results. With --render it may be a .md or .html file.
        threads: CPU threads; default: torch's.
        compare: An older bench.json; prints the ratios of the times.
        render: Measure nothing; make the tables and the page of these JSON files.
        static: Measure nothing; compile the CUDA kernels, no GPU needed, and write what they take
            (registers, stack, shared memory, occupancy) to static.json and static.md.
    """
    if static:
        return _static(out)
    if render:
        return _render(render, out)
    settings, modules = _settings(what, device, quick, full, peers, threads)
    old = read_document(compare) if compare is not None else None
    folder = output_folder(out)
    cases: list[Case] = []
    targets: list[Target] = []
    for op, module in modules.items():
        cases += [case for case in module.cases(settings) if case.op == op]
        targets += [t for t in module.targets(settings) if t.times[0].op == op]
    with tqdm(total=len(cases), unit="case", desc="bench", disable=None) as bar:
        document = measure(cases, settings, _progress(bar))
    document["machine"]["peers"] = versions() if peers else {}
    document["targets"] = judge(targets, document["records"])
    write_json(folder / "bench.json", document)
    _write(folder / "bench.md", markdown([document]))
    _write(folder / "bench.html", page([document]))
    return _report(document, old, folder)


def _settings(what, device, quick, full, peers, threads) -> tuple[Settings, dict]:
    unknown = [name for name in what if name not in (*SUITES, "all")]
    if unknown:
        raise UserError(f"unknown case '{unknown[0]}'; there are {', '.join(SUITES)} and all")
    if quick and full:
        raise UserError("--quick and --full: choose one")
    if threads is not None and threads < 1:
        raise UserError(f"--threads is {threads}, it must be positive")
    settings = Settings(
        device=pick_device(device),
        level="quick" if quick else "full" if full else "normal",
        peers=peers,
        threads=threads or torch.get_num_threads(),
    )
    ops = [name for name in SUITES if name in what or "all" in what]
    return settings, {op: load_suite(op) for op in ops}


def _progress(bar: tqdm):
    """Shows what is under way; the bar moves on when the case changes."""
    current = [None]

    def say(case: str, variant: str) -> None:
        if current[0] not in (None, case):
            bar.update()
        current[0] = case
        bar.set_postfix_str(f"{case}, {variant}")

    return say


def _render(paths: tuple[Path, ...], out: Path) -> int:
    documents = [read_document(path) for path in paths]
    if out.suffix in (".md", ".html"):
        _write(out, markdown(documents) if out.suffix == ".md" else page(documents))
        print(f"wrote {out}")
        return 0
    folder = output_folder(out)
    _write(folder / "bench.md", markdown(documents))
    _write(folder / "bench.html", page(documents))
    print(f"wrote {folder / 'bench.md'} and bench.html")
    return 0


def _static(out: Path) -> int:
    folder = output_folder(out)
    with tqdm(unit="kernel", desc="static", disable=None) as bar:
        try:
            document = static_report(lambda kernel: bar.set_postfix_str(kernel) or bar.update())
        except NoCompiler as error:
            raise UserError(f"--static: {error}") from error
    write_json(folder / "static.json", document)
    _write(folder / "static.md", static_markdown(document))
    print(f"{len(document['kernels'])} rows; wrote {folder / 'static.json'} and static.md")
    return 0


def _write(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _report(document: dict, old: dict | None, folder: Path) -> int:
    """Prints targets, failures and ratios; returns the exit code."""
    for t in document["targets"]:
        word = {True: "reached", False: "missed", None: "not measured"}[t["reached"]]
        value = "" if t["value"] is None else f"{t['value']:.3g}"
        print(f"{word:<12} {value:>8}  ({t['wanted']})  {t['op']}: {t['text']}")
    if old is not None:
        print(ratio_table(old, document))
    faults = [r for r in document["records"] if r["status"].startswith(("failed", "check"))]
    for r in faults:
        print(f"{r['op']}: {r['case']}: {r['variant']}, {r['direction']}: {r['status']}")
    measured = sum(r["status"] == "ok" for r in document["records"])
    print(f"{measured} measured; wrote {folder / 'bench.json'}, bench.md and bench.html")
    if document["interrupted"]:
        print("interrupted; what was measured is kept")
        return 130
    return 1 if faults else 0
