"""``make study WHAT="..."``, or ``python -m lab.studies`` with docs/ on the path of modules."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Annotated

import tyro

from gamba_warp.conventions import DeviceChoice
from gamba_warp.devices import pick_device
from gamba_warp.errors import UserError
from gamba_warp.files import output_folder
from gamba_warp.measure import suites
from gamba_warp.untrusted.ranges import Threads, ranged

from . import StudySettings, show, targets

# Name of a study -> the module with ``cases(settings)`` and optionally ``targets(settings)``.
STUDIES = {name: f".{name}" for name in ("scan", "times", "raster", "step", "loader")}


def load_study(op: str):
    """The module with the cases and targets of one of ``STUDIES``."""
    return importlib.import_module(STUDIES[op], __package__)


@ranged
def study(
    what: tyro.conf.Positional[Annotated[tuple[str, ...], tyro.conf.arg(metavar="WHAT ...")]] = (),
    *,
    device: DeviceChoice = "auto",
    quick: bool = False,
    full: bool = False,
    out: Path = Path("out/study"),
    threads: Threads | None = None,
    render: tuple[Path, ...] = (),
    data: Path | None = None,
    only: tuple[str, ...] = (),
) -> int:
    """Measure the studies of the project, with the timing of gamba bench.

    Writes bench.json, bench.md and bench.html. Ctrl-C keeps the results so far.

    Args:
        what: scan and raster (choices inside the kernels, large scenes), times (of a layer's scan,
            by length, width and dtype), step (of training, by parts), loader.
        device: Device to measure; auto is the GPU if there is one.
        quick: Small sizes and a few rounds, which take seconds.
        full: All sizes and many rounds.
        out: Folder for the results. With --render it may be a .md or .html file.
        threads: Number of CPU threads; torch's own number if not given.
        render: Measure nothing; make the tables and the page of these JSON files, of gamba bench
            too.
        data: Folder of posed views for step and loader; made-up views if not given.
        only: Measure only these cases, by their full names, as L or "random, float32".
    """
    if render:
        documents = [suites.read_document(path) for path in render]
        paths = suites.write_pages(documents, out, show.markdown, show.page)
        print(f"wrote {', '.join(map(str, paths))}")
        return 0
    chosen = suites.choose(what, STUDIES, {})
    if not chosen:
        raise UserError(f"name what to study: {', '.join(STUDIES)}")
    if data is not None and not data.is_dir():
        raise UserError(f"--data {data}: no such folder")
    given = suites.make_settings(pick_device(device), quick, full, False, threads)
    settings = StudySettings(**vars(given), data=data)
    folder = output_folder(out)
    modules = {op: load_study(op) for op in chosen}
    document = suites.run_suites(modules, settings, only)
    wanted = [t for m in modules.values() if hasattr(m, "targets") for t in m.targets(settings)]
    document["targets"] = targets.judge(dict.fromkeys(wanted), document["records"])
    suites.write_document(document, folder, show.markdown, show.page)
    print(f"{show.summary(document)}; wrote {folder / 'bench.json'}, bench.md and bench.html")
    return 130 if document["interrupted"] else int(bool(suites.failed_records(document)))


if __name__ == "__main__":
    try:
        sys.exit(tyro.cli(study, prog="make study"))
    except UserError as error:
        sys.exit(f"study: {error}")
