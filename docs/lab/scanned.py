"""Evaluates a model on a folder of scanned objects, and writes the table of docs/model-card.md.

    make scanned MESHES=FOLDER
    PYTHONPATH=docs python -m lab.scanned FOLDER --checkpoint MODEL --page none

It renders the meshes at 128² (nine views each, the first from the front), and compares five of them
and the shapes, as described on the page. Existing views are kept.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Literal

import tyro
from PIL import Image

from gamba_warp import cli
from gamba_warp.errors import UserError
from gamba_warp.files import atomic_path, write_text
from gamba_warp.image_metrics import METRICS
from gamba_warp.kernels.runtime.tables import markdown
from gamba_warp.model.checkpoint import DEFAULT_CHECKPOINT
from gamba_warp.untrusted.documents import read_document

from .figures.parts import with_parts

PAGE = Path(__file__).parents[1] / "model-card.md"
SHAPES = {"chamfer": ("Chamfer", 4), "normal_consistency": ("normals", 3), "iou": ("Volume IoU", 3)}
_SKIPPED = ("retrieval",)  # of the same set, so meaningless here


def main(
    folder: tyro.conf.Positional[Path],
    data: Path | None = None,
    out: Path = Path("out/scanned"),
    checkpoint: Path = DEFAULT_CHECKPOINT,
    limit: int | None = None,
    lpips: Literal["auto", "on", "off"] = "auto",
    up: Literal["auto", "y", "z"] = "auto",
    page: Path | Literal["none"] = PAGE,
) -> int:
    """Renders, evaluates and writes the page's table and its image of all objects.

    Args:
        folder: of the meshes, named by object.
        data: their views, if already rendered.
        out: folder of the results.
        checkpoint: the model.
        limit: number of objects, evenly spaced by name.
        lpips: as for eval-views; LPIPS takes most of the time.
        up: the axis that points up in the files; auto depends on their format.
        page: the page to update; none only prints the table.

    Returns:
        0, or the exit code of an evaluation in which objects failed.
    """
    views = data or out / "views"
    if data is None:
        words = ["--views", 9, "--size", 128, "--up", up]
        _run("data render", folder, "--out", views, *words)
    model = ["--checkpoint", checkpoint, "--data", views, "--split", "all", "--views", 5]
    few = [] if limit is None else ["--limit", limit]
    more = ["--save-gaussians", "--strips", 0, "--sheet", 100, "--out", out / "eval"]
    code = _run("eval-views", *model, *more, *few, "--lpips", lpips)
    words = ["--frame", "reference", "--data", views, "--out", out / "shapes"]
    gaussians = out / "eval" / "gaussians"
    code |= _run(
        "eval-geometry", gaussians, folder, *words, *([] if up == "auto" else ["--up", up])
    )
    found = [read_document(out / n / "report.json", dict[str, Any]) for n in ("eval", "shapes")]
    parts = {"figures": figures(*found)}
    if str(page) == "none":
        print("\n\n".join(parts.values()))
    else:
        write_text(page, with_parts(page.read_text(encoding="utf-8"), "make scanned", parts))
        with Image.open(out / "eval" / "contact_sheet.png") as sheet:
            half = sheet.convert("RGB").reduce(2)
        with atomic_path(page.parent / "images" / "scanned.webp") as path:
            half.save(path, "WEBP", quality=80, method=6)
    return code


def _run(command: str, *words: object) -> int:
    """Run a command, which reports failed objects; these are not an error here."""
    code = cli.run(command, [*map(str, words)])
    if code not in (0, 1):
        raise UserError(f"gamba {command}: failed with exit code {code}")
    return code


def figures(views: dict[str, Any], shapes: dict[str, Any]) -> str:
    """Table of means: new views of the model and the baselines, and the model's shapes.

    Args:
        views: report of eval-views.
        shapes: report of eval-geometry.
    """
    rows = []
    for row in views["table"]:
        if row["views"] != "novel" or row["name"] in _SKIPPED:
            continue
        own = row["name"] == "model"
        cells = [_text((row[key] or {}).get("mean"), m.digits) for key, m in METRICS.items()]
        mean = shapes["mean"] if own else {}
        cells += [_text(mean.get(key), digits) for key, (_, digits) in SHAPES.items()]
        rows.append(["**this project**" if own else row["name"].replace("_", " "), *cells])
    source, count = views["protocol"]["source"], views["num_ok"]
    head = [
        f"{count} objects",
        *(m.head for m in METRICS.values()),
        *(n for n, _ in SHAPES.values()),
    ]
    return f"{markdown(head, rows)}\n\nWeights `{source['path']}`, SHA-256 {source['sha256'][:16]}."


def _text(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


if __name__ == "__main__":
    try:
        sys.exit(tyro.cli(main))
    except (UserError, ValueError) as error:
        sys.exit(f"gamba: {error}")
