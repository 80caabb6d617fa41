"""``gamba eval-views``: predicted views against true ones.

``--help`` answers at once, so what is slow to import is imported by the command itself.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from msgspec import Meta

from gamba_warp.conventions import DEFAULT_DISTANCE, DeviceChoice, Precision
from gamba_warp.errors import UserError
from gamba_warp.fitting.config import FitConfig, Steps
from gamba_warp.untrusted.ranges import check_options, option, ranged
from gamba_warp.versions import require

from ..presets import PRESETS


@dataclass(frozen=True, kw_only=True)
class ViewsOptions:
    """What to evaluate, and how.

    Attributes:
        checkpoint: A model; a folder of .ply files named by object; or a folder with a folder of
            pictures for each object, rendered by any method at the dataset's
            cameras (docs/compare-methods.md).
        data: Dataset of posed views.
        out: Folder for report.json, objects.csv, table.md, contact_sheet.png and strips/ (input |
            prediction | truth); without it the table is printed and that is all.
        protocol: gso: the 60 Google Scanned Objects of "gamba data gso" at 512 pixels, the first
            view being the input, with what is missing of them in the report;
            then --size, --reference, --views, --split and --limit are its own. splatter-image,
            gamba: those of these papers, as far as they say them (gamba eval-geometry --protocol
            NAME --explain); such options change them, and the report says so.
        split: Split of the dataset.
        reference: Index of the input view; 0 by default.
        views: Number of views of an object, input included, evenly spaced; all by default.
        size: Height of the pictures compared; the files' own by default.
        limit: Only so many objects, evenly spaced in the order of names.
        baselines: Also score an empty picture, a copy of the input, the input as a billboard, and
            the nearest training object.
        ceiling: Also score Gaussians fitted to all views: of so many objects (18 s each on two
            cores, written into OUT/ceiling), or those in a folder that gamba fit wrote.
        ceiling_steps: Steps of each fit.
        lpips: LPIPS where its weights are there (gamba weights lpips).
        strips: Comparison pictures for the first so many objects.
        sheet: So many best, median and worst objects in the contact sheet; 0 for none.
        save_gaussians: Also write OUT/gaussians/NAME.ply, in the input camera's
            world (eval-geometry --frame reference reads them).
        save_retrieval: Folder of the meshes that DATA was rendered from (with catalogue.json, or
            named by object): also write OUT/retrieval/NAME.ply, the mesh of the training object
            that the retrieval takes, placed where the input camera sees it as it was
            found (eval-geometry --frame reference).
        save_pictures: Also write OUT/pictures/NAME/OBJECT/VIEW.png: what was compared of the model
            and of each baseline, in the form in which pictures of other methods are read.
        resize_pictures: Pictures under test may have another size than those compared, and are
            resized to it.
        distance: Distance of the input camera, for .ply files; a checkpoint states its own.
        background_margin: Of a model: drop the 3DGS tokens of plain background, but for those
            within so many patches of the object. It was not trained for that, unless its decoder is
            "rays", which does it always.
        encoder_weights: The image encoder's file, for a checkpoint that does not hold it.
        precision: Precision of a model's products; "auto" is bfloat16 where that is faster.
        device: Device that everything runs on.
    """

    checkpoint: Annotated[Path, tyro.conf.arg(aliases=["--predictions"])]
    data: Path
    out: Path | None = None
    protocol: Literal["default", "gso", "splatter-image", "gamba"] = "default"
    split: Literal["all", "train", "val", "test"] = "test"
    reference: Annotated[int, Meta(ge=0, le=100_000)] | None = None
    views: Annotated[int, Meta(ge=1, le=100_000)] | None = None
    size: Annotated[int, Meta(ge=16, le=4096)] | None = None
    limit: Annotated[int, Meta(ge=1)] | None = None
    baselines: bool = True
    ceiling: str | None = None
    ceiling_steps: Steps = FitConfig.steps
    lpips: bool = True
    strips: Annotated[int, Meta(ge=0, le=1_000_000)] = 8
    sheet: Annotated[int, Meta(ge=0, le=100)] = 2
    save_gaussians: bool = False
    save_retrieval: Path | None = None
    save_pictures: bool = False
    resize_pictures: bool = False
    distance: Annotated[float, Meta(ge=0.01, le=1000)] = DEFAULT_DISTANCE
    background_margin: Annotated[int, Meta(ge=0, le=4096)] | None = None
    encoder_weights: Path | None = None
    precision: Precision = "float32"
    device: DeviceChoice = "auto"

    def check(self) -> None:
        """Checks the ranges of the numbers.

        Raises:
            UserError: a number is out of its range; the message names the option.
            ModuleNotFoundError: an option needs a library that is not installed.
        """
        check_options(self)
        if self.protocol == "gso":
            for name in ("split", "reference", "views", "size", "limit"):
                if getattr(self, name) != getattr(ViewsOptions, name):
                    raise UserError(f"--protocol gso: has its own {option(name)}")
        for name in ("save_gaussians", "save_pictures"):
            if getattr(self, name) and self.out is None:
                raise UserError(f"{option(name)}: needs --out")
        if self.save_retrieval and (self.out is None or not self.baselines):
            raise UserError("--save-retrieval: needs --out, and the baselines")
        if self.save_retrieval:
            require("trimesh")

    def filled(self) -> ViewsOptions:
        """These options, with the protocol's own where none are given.

        Raises:
            UserError, ModuleNotFoundError: as for ``check``.
        """
        self.check()
        own = {"reference": 0} | self._own()
        return replace(self, **{k: v for k, v in own.items() if getattr(self, k) is None})

    def changed(self) -> list[str]:
        """Those of the protocol's own options that are others here."""
        return [name for name, value in self._own().items() if getattr(self, name) != value]

    def _own(self) -> dict[str, Any]:
        return PRESETS[self.protocol].views or {} if self.protocol in PRESETS else {}


@ranged
def eval_views_command(
    options: Annotated[ViewsOptions, tyro.conf.arg(name="")],
    json: bool = False,
    csv: bool = False,
) -> int:
    """PSNR, SSIM, LPIPS and mask IoU of predicted views; the input view and novel views apart.

    Args:
        options: what to evaluate, and how.
        json: Print the report, as report.json holds it, in place of the table.
        csv: Print the objects, as objects.csv holds them, in place of the table.
    """
    options = options.filled()
    if json and csv:
        raise UserError("--json and --csv: give one of them")
    from ..report import count_line, csv_of, json_of
    from .evaluate import evaluate_views
    from .table import page

    report = evaluate_views(options)
    text = json_of(report) if json else csv_of(report) if csv else page(report)
    print(text, end="")
    for name, reason in report["left_out_baselines"].items():
        print(f"left out: {name}: {reason}", file=sys.stderr)
    for item in report["failures"]:
        print(f"failed: {item['name']}: {item['reason']}", file=sys.stderr)
    beside = len(report["failures"]) - report["num_failed"]
    print(count_line(report, options.out, beside), file=sys.stderr if json or csv else sys.stdout)
    if report["interrupted"]:
        print("gamba: interrupted; the report has what was evaluated before", file=sys.stderr)
        return 130
    return 1 if report["failures"] else 0
