"""Options of ``gamba eval-views``; imports nothing that is slow."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from msgspec import Meta

from gamba_warp.conventions import DEFAULT_DISTANCE, DeviceChoice, Precision
from gamba_warp.errors import UserError
from gamba_warp.fitting.config import FitConfig, Steps
from gamba_warp.untrusted.ranges import check_options, option
from gamba_warp.versions import require


@dataclass(frozen=True, kw_only=True)
class ViewsOptions:
    """What to evaluate, and how."""

    checkpoint: Annotated[Path, tyro.conf.arg(aliases=["--predictions"])]
    """A model; a folder of .ply files named by object; or a folder with a folder of pictures for
    each object, rendered by any method at the dataset's cameras (docs/compare-methods.md)."""
    data: Path
    """Dataset of posed views."""
    out: Path | None = None
    """Folder for report.json, objects.csv, table.md, contact_sheet.png and strips/ (input |
    prediction | truth); without it the table is printed and that is all."""
    protocol: Literal["default", "gso"] = "default"
    """gso: the 60 Google Scanned Objects of "gamba data gso" at 512 pixels, the first view being
    the input, with what is missing of them in the report; --size, --reference, --views, --split
    and --limit are then its own."""
    split: Literal["all", "train", "val", "test"] = "test"
    """Split of the dataset."""
    reference: Annotated[int, Meta(ge=0, le=100_000)] = 0
    """Index of the input view."""
    views: Annotated[int, Meta(ge=1, le=100_000)] | None = None
    """Number of views of an object, input included, evenly spaced; all by default."""
    size: Annotated[int, Meta(ge=16, le=4096)] | None = None
    """Height of the pictures compared; the files' own by default."""
    limit: Annotated[int, Meta(ge=1)] | None = None
    """Only so many objects, evenly spaced in the order of names."""
    baselines: bool = True
    """Also score an empty picture, a copy of the input, the input as a billboard, and the nearest
    training object."""
    ceiling: str | None = None
    """Also score Gaussians fitted to all views: of so many objects (18 s each on two cores, kept in
    OUT/ceiling), or those in a folder that gamba fit wrote."""
    ceiling_steps: Steps = FitConfig.steps
    """Steps of each fit."""
    lpips: bool = True
    """LPIPS where its weights are there (gamba weights lpips)."""
    strips: Annotated[int, Meta(ge=0, le=1_000_000)] = 8
    """Comparison pictures for the first so many objects."""
    sheet: Annotated[int, Meta(ge=0, le=100)] = 2
    """So many best, median and worst objects in the contact sheet; 0 for none."""
    save_gaussians: bool = False
    """Also write OUT/gaussians/NAME.ply, in the input camera's world (eval-geometry --frame
    reference reads them)."""
    save_retrieval: Path | None = None
    """Folder of the meshes that DATA was rendered from (with catalogue.json, or named by object):
    also write OUT/retrieval/NAME.ply, the mesh of the training object that the retrieval takes,
    placed where the input camera sees it as it was found (eval-geometry --frame reference)."""
    save_pictures: bool = False
    """Also write OUT/pictures/NAME/OBJECT/VIEW.png: what was compared of the model and of each
    baseline, in the form in which pictures of other methods are read."""
    resize_pictures: bool = False
    """Pictures under test may have another size than those compared, and are resized to it."""
    distance: Annotated[float, Meta(ge=0.01, le=1000)] = DEFAULT_DISTANCE
    """Distance of the input camera, for .ply files; a checkpoint states its own."""
    background_margin: Annotated[int, Meta(ge=0, le=4096)] | None = None
    """Of a model: drop the 3DGS tokens of plain background, but for those within so many patches of
    the object. It was not trained for that, unless its decoder is "rays", which does it always."""
    encoder_weights: Path | None = None
    """The image encoder's file, for a checkpoint that does not hold it."""
    precision: Precision = "float32"
    """Precision of a model's products; "auto" is bfloat16 where that is faster."""
    device: DeviceChoice = "auto"
    """Device that everything runs on."""

    def check(self) -> None:
        """Checks the ranges of the numbers.

        Raises:
            UserError: a number is out of its range; the message names the option.
            ModuleNotFoundError: an option needs a library that is not installed.
        """
        check_options(self)
        if self.protocol != "default":
            for name in ("split", "reference", "views", "size", "limit"):
                if getattr(self, name) != getattr(ViewsOptions, name):
                    raise UserError(f"--protocol {self.protocol}: has its own {option(name)}")
        if self.save_gaussians and self.out is None:
            raise UserError("--save-gaussians: needs --out")
        if self.save_pictures and self.out is None:
            raise UserError("--save-pictures: needs --out")
        if self.save_retrieval and (self.out is None or not self.baselines):
            raise UserError("--save-retrieval: needs --out, and the baselines")
        if self.save_retrieval:
            require("trimesh")
