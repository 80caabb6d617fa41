"""A run of ``gamba bench``, and its result files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import msgspec
import torch
from msgspec import Meta

from ..batch import progress_bar
from ..errors import UserError
from ..files import output_folder, write_json, write_text
from ..kernels.bench.core.case import Case, Settings
from ..kernels.bench.core.measure import FORMAT, TIMES, measure
from ..kernels.bench.core.report import markdown, ratio_table
from ..kernels.bench.peers import versions
from ..untrusted import documents
from .page import page

Maker = Callable[[Sequence[dict]], str]  # documents to a page


def make_settings(
    device: torch.device, quick: bool, full: bool, peers: bool, threads: int | None
) -> Settings:
    """Return the settings of the cases from the options of the command.

    Raises:
        UserError: options contradict each other.
    """
    if quick and full:
        raise UserError("--quick and --full: choose one")
    return Settings(
        device=device,
        level="quick" if quick else "full" if full else "normal",
        peers=peers,
        threads=threads or torch.get_num_threads(),
    )


def choose(
    what: Sequence[str], known: Iterable[str], groups: Mapping[str, Sequence[str]]
) -> list[str]:
    """Return the ``known`` names that are selected, directly or by a group, in their order.

    Raises:
        UserError: a name is not known.
    """
    names = [*known, *groups]
    if unknown := [name for name in what if name not in names]:
        listed = f"{', '.join(names[:-1])} and {names[-1]}"
        raise UserError(f"unknown case '{unknown[0]}'; there are {listed}")
    named = {part for name in what for part in groups.get(name, (name,))}
    return [name for name in names if name in named]


def run_suites(
    suites: Mapping[str, ModuleType], settings: Settings, only: Sequence[str] = ()
) -> dict:
    """Measure the cases of suites, with a progress bar.

    Args:
        suites: by operator, the module with its ``cases(settings)``.
        settings: of the cases.
        only: names of the cases to measure; all by default.

    Returns:
        The document of the records and peers; after Ctrl-C with the results so far.

    Raises:
        UserError: a name is not a case of the suites.
    """
    cases: list[Case] = []
    for op, module in suites.items():
        cases += [case for case in module.cases(settings) if case.op == op]
    if only:
        names = list(dict.fromkeys(case.name for case in cases))
        if unknown := [name for name in only if name not in names]:
            raise UserError(f"--only {unknown[0]}: no such case; there are {'; '.join(names)}")
        cases = [case for case in cases if case.name in only]
    with progress_bar(total=len(cases), unit="case", desc="bench") as bar:
        seen: list[str] = []

        def say(case: str, variant: str) -> None:
            if seen[-1:] not in ([], [case]):
                bar.update()
            seen.append(case)
            bar.set_postfix_str(f"{case}, {variant}")

        document = measure(cases, settings, say)
    document["machine"]["peers"] = versions() if settings.peers else {}
    return document


def read_document(path: Path) -> dict:
    """Read a bench.json, and check that it has all fields of reports.

    Raises:
        UserError: no such file, not JSON, another format, or a value is missing, of another type
            or out of range; the message names its place.
    """
    try:
        return check_document(documents.read_document(path, Any))
    except ValueError as error:
        raise UserError(f"{path}: {error}") from error


def check_document(document: Any) -> dict:
    """Check that the content of a bench.json has all fields of reports, and return it.

    Raises:
        ValueError: as for ``read_document``.
    """
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise ValueError(f"not a result of 'gamba bench' (format is not {FORMAT})")
    try:
        msgspec.convert(document, _DOCUMENT)
    except msgspec.ValidationError as error:
        raise ValueError(f"damaged: {error}") from error
    for i, record in enumerate(document["records"]):
        if record["status"] == "ok" and None in [record[name] for name in TIMES]:
            raise ValueError(f"damaged: records[{i}] has no times, but its status is ok")
    return document


_Text = Annotated[str, Meta(max_length=10_000)]  # the longest is a compiler's message
_Number = Annotated[float, Meta(gt=-1e300, lt=1e300)]
_Time = Annotated[float, Meta(gt=0, lt=1e300)]


def _fields(kind: Any, *names: str) -> list[tuple[str, Any]]:
    return [(name, kind) for name in names]


_RECORD = msgspec.defstruct(
    "Record",
    [
        *_fields(_Text, "op", "case", "variant", "device", "dtype", "direction", "status"),
        *_fields(_Text, "oracle", "text"),
        *_fields(_Time | None, "ms_p20", "ms_p50", "ms_p80", "peer_ms"),
        *_fields(_Number | None, "jit_ms", "rel_rms_error", "max_error"),
        *_fields(_Text | None, "peer", "axis"),
        *_fields(bool, "is_peer", "is_default"),
        ("work", dict[str, _Number]),
        ("parameters", dict[str, bool | _Number | _Text | None]),
    ],
)
_MACHINE = msgspec.defstruct(
    "Machine",
    [
        *_fields(_Text, "cpu", "simd", "system", "python", "torch", "warp", "gamba_warp", "date"),
        *_fields(_Text | None, "gpu", "cuda"),
        *_fields(Annotated[int, Meta(ge=0, le=10**9)], "cores", "threads"),
        ("peers", dict[str, str], {}),
    ],
)
_DOCUMENT = msgspec.defstruct(
    "Document",
    [
        ("machine", _MACHINE),
        ("interrupted", bool),
        ("records", list[_RECORD]),
    ],
)


def write_document(
    document: dict, folder: Path, tables: Maker = markdown, charts: Maker = page
) -> None:
    """Write bench.json, bench.md and bench.html; ``tables`` and ``charts`` make the last two."""
    write_json(folder / "bench.json", document)
    write_pages([document], folder, tables, charts)


def write_pages(
    documents: Sequence[dict], out: Path, tables: Maker = markdown, charts: Maker = page
) -> list[Path]:
    """Write the tables and the page of documents.

    Args:
        documents: from ``read_document``.
        out: a .md or .html file, or a folder for bench.md and bench.html.
        tables: makes the Markdown.
        charts: makes the page.

    Returns:
        The files.

    Raises:
        UserError: a file cannot be written.
    """
    makers = {".md": tables, ".html": charts}
    if out.suffix in makers:
        paths = [out]
    else:
        paths = [output_folder(out) / f"bench{suffix}" for suffix in makers]
    for path in paths:
        write_text(path, makers[path.suffix](documents))
    return paths


def failed_records(document: dict) -> list[dict]:
    """Return the records whose check or run failed."""
    return [r for r in document["records"] if r["status"].startswith(("failed", "check"))]


def summary(document: dict, old: dict | None) -> str:
    """Return lines on failures, and the ratios of times to those of an older document."""
    lines = [] if old is None else [ratio_table(old, document)]
    for r in failed_records(document):
        lines.append(f"{r['op']}: {r['case']}: {r['variant']}, {r['direction']}: {r['status']}")
    measured = sum(r["status"] == "ok" for r in document["records"])
    return "\n".join([*lines, f"{measured} measured"])
