r"""Puts figures into the card of the shipped model; writes docs/model-card.md and README's table.

After ``gamba eval-views`` and ``gamba eval-geometry`` of the model that ships:

    make figures REPORTS="--views out/eval/report.json --geometry out/shapes/report.json \
        --retrieval out/shapes-retrieval/report.json"

Without an option it only updates the tables. Everything else in the card, ``NAME.json`` beside the
weights, is written by hand.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from gamba_warp.errors import UserError
from gamba_warp.files import write_json, write_text
from gamba_warp.image_metrics import METRICS as OF_IMAGES
from gamba_warp.image_metrics import on_grounds
from gamba_warp.kernels.runtime.tables import cell as figure
from gamba_warp.kernels.runtime.tables import markdown
from gamba_warp.model.checkpoint import DEFAULT_CHECKPOINT
from gamba_warp.pages.card import (
    METRICS,
    ModelCard,
    Row,
    card_path,
    read_card,
)
from gamba_warp.untrusted.documents import read_document

from .parts import with_parts

DOCS = Path(__file__).parents[2]
PAGE, README = DOCS / "model-card.md", DOCS.parent / "README.md"
TITLES = {"novel": "New views", "input": "The input view", "shape": "Shape"}


def main(
    views: Path | None = None, geometry: Path | None = None, retrieval: Path | None = None
) -> None:
    """Put figures of reports into the card, and write the tables.

    Args:
        views: report of eval-views.
        geometry: report of eval-geometry of the model.
        retrieval: report of eval-geometry of the retrieval.
    """
    card = read_card(DEFAULT_CHECKPOINT)
    if card is None:
        raise UserError(f"{card_path(DEFAULT_CHECKPOINT)}: no such file")
    rows = list(card.figures)
    if views is not None:
        rows = [row for row in rows if row.views == "shape"]
        rows = [*map(_row, read_document(views, dict[str, Any])["table"]), *rows]
    for name, path in (("model", geometry), ("retrieval", retrieval)):
        if path is not None:
            rows = [row for row in rows if (row.views, row.name) != ("shape", name)]
            rows.append(_shape(name, read_document(path, dict[str, Any])))
    card = msgspec.structs.replace(card, figures=rows)
    write_json(card_path(DEFAULT_CHECKPOINT), msgspec.to_builtins(card))
    write_text(PAGE, page_of(PAGE.read_text(encoding="utf-8"), card))
    write_text(README, readme_of(README.read_text(encoding="utf-8"), card))


def page_of(text: str, card: ModelCard) -> str:
    """Update the parts of the page between its marks from the card.

    Args:
        text: of the page.
        card: of the model.

    Raises:
        ValueError: the page lacks a mark.
    """
    facts = [
        f"- **Weights:** `starter/{DEFAULT_CHECKPOINT.name}`, "
        f"{DEFAULT_CHECKPOINT.stat().st_size / 1e6:.1f} MB",
        f"- **Data:** {card.data}",
        f"- **Training:** {card.objects:,} objects, {card.steps:,} steps, seed {card.seed}",
        f"- **Compute:** {card.compute}",
        f"- **Meant for:** {card.use}",
    ]
    parts = {
        "facts": "\n".join(facts),
        "command": f"```bash\n{card.command}\n```",
        "figures": "\n\n".join([card.measured, *_tables(card)]),
        "limits": "\n".join(f"- {limit}" for limit in card.limits),
    }
    return with_parts(text, "make figures", parts)


def readme_of(text: str, card: ModelCard) -> str:
    """Update the README's table of results from the card: new views beside shapes.

    Args:
        text: of the README.
        card: of the model.

    Raises:
        ValueError: the README lacks the mark.
    """
    novel = [row for row in card.figures if row.views == "novel"]
    shapes = {row.name: row for row in card.figures if row.views == "shape"}
    of_views, of_shapes = tuple(OF_IMAGES), ("chamfer", "iou")
    heads = [METRICS[key][0] for key in (*of_views, *of_shapes)]
    rows = []
    for row in novel:
        cells = [getattr(row, key) for key in of_views]
        cells += [getattr(shapes.get(row.name), key, None) for key in of_shapes]
        texts = [
            f"{cell.mean:.{METRICS[key][1]}f}" if cell else "–"
            for key, cell in zip((*of_views, *of_shapes), cells)
        ]
        name = "**shipped model**" if row.name == "model" else row.name.replace("_", " ")
        rows.append([name, *texts])
    results = markdown([f"{novel[0].objects} objects", *heads], rows)
    return with_parts(text, "make figures", {"results": results})


def _tables(card: ModelCard) -> list[str]:
    tables, first = [], [key for key in METRICS if key not in on_grounds()]
    for views, title in TITLES.items():
        rows = [row for row in card.figures if row.views == views]
        both = [(first, ""), ([*on_grounds()], " on other grounds")]
        if views == "input":  # trivial for baselines that copy the input
            rows, both = [row for row in rows if row.name == "model"], both[:1]
        for metrics, where in both:
            keys = [key for key in metrics if any(getattr(row, key) for row in rows)]
            if not keys:
                continue
            header = [f"{title}{where}, {rows[0].objects:,} objects"]
            lines = []
            for row in rows:
                cells = [(getattr(row, key), METRICS[key][1]) for key in keys]
                texts = [
                    figure(cell.mean, cell.interval, digits) if cell else "–"
                    for cell, digits in cells
                ]
                name = "**this model**" if row.name == "model" else row.name.replace("_", " ")
                lines.append([name, *texts])
            tables.append(markdown([*header, *(METRICS[key][0] for key in keys)], lines))
    return tables


def _row(found: dict[str, Any]) -> Row:
    """A line of a report's table."""
    figures = {
        key: {"mean": found[key]["mean"], "interval": found[key]["interval"]}
        for key in METRICS
        if (found.get(key) or {}).get("mean") is not None
    }
    return msgspec.convert({**{k: found[k] for k in ("views", "name", "objects")}, **figures}, Row)


def _shape(name: str, report: dict[str, Any]) -> Row:
    figures = {
        key: {"mean": report["mean"][key], "interval": report.get("interval", {}).get(key)}
        for key in METRICS
        if report["mean"].get(key) is not None
    }
    return msgspec.convert(
        {"views": "shape", "name": name, "objects": report["num_ok"], **figures}, Row
    )
