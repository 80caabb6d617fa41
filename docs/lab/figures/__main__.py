"""``make figures``, or ``python -m lab.figures`` with docs/ on the path of modules."""

from __future__ import annotations

import sys
from pathlib import Path

import tyro

from gamba_warp.errors import UserError

from . import model_card


def figures(
    views: Path | None = None, geometry: Path | None = None, retrieval: Path | None = None
) -> None:
    """Rewrite the tables of the pages from the stored results.

    Args:
        views: report of eval-views, whose figures are first written into the shipped model's card.
        geometry: likewise, report of eval-geometry of the model.
        retrieval: likewise, report of eval-geometry of the retrieval.
    """
    model_card.main(views, geometry, retrieval)


if __name__ == "__main__":
    try:
        tyro.cli(figures)
    except (UserError, ValueError) as error:
        sys.exit(f"gamba: {error}")
