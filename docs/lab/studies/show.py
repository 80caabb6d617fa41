"""Tables and page of the studies: those of ``gamba bench``, with targets and parts."""

from __future__ import annotations

from collections.abc import Sequence

from gamba_warp.kernels.bench.core import report
from gamba_warp.measure import page as pages
from gamba_warp.measure import suites

from . import targets
from .parts import parts_table


def more(document: dict, records: Sequence[dict]) -> tuple[list[str], list[report.Table]]:
    """Return the parts of a case's runs; for a whole document (without records), its targets."""
    if not records:
        return [], targets.rows(document)
    table = parts_table(records)
    return [], [table] if table else []


def markdown(documents: Sequence[dict]) -> str:
    """Return the tables of studies as Markdown."""
    by = "`make study`, not by hand, of results of `gamba bench` and of the studies"
    return report.markdown(documents, more, by)


def page(documents: Sequence[dict]) -> str:
    """Return the tables and charts of studies as a self-contained HTML page."""
    return pages.page(documents, more)


def summary(document: dict) -> str:
    """Return lines on targets and failures."""
    return "\n".join([*targets.lines(document), suites.summary(document, None)])
