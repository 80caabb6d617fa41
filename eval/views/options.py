"""Options of ``gamba eval-views``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from msgspec import Meta

from gamba_warp.conventions import DEFAULT_DISTANCE, Detail, DeviceChoice, Precision
from gamba_warp.errors import UserError
from gamba_warp.untrusted.ranges import check_options, option
from gamba_warp.versions import require

from ..presets import PRESETS


@dataclass(frozen=True, kw_only=True)
class ViewsOptions:
    """Options of ``gamba eval-views``.

    Attributes:
        checkpoint: A model; a folder of .ply files named by object; or a folder with a folder of
            images for each object, rendered by any method at the dataset's
            cameras (docs/evaluate.md).
        data: Dataset of posed views.
        out: Folder for report.json, objects.csv, table.md, contact_sheet.png and strips/ (input |
            prediction | ground truth); without it only the table is printed.
        protocol: gso: the 60 Google Scanned Objects of "gamba data gso" at 512 pixels, with the
            first view as the input; the report lists missing objects. It fixes split, size, limit,
            reference and number of views. splatter-image, leangaussian, gamba: these papers'
            values, as far as published (gamba eval-geometry --protocol NAME --explain); these
            options change them, and the report notes that.
        split: Split of the dataset.
        reference: Index of the input view; 0 by default.
        views: Number of views of an object, input included, evenly spaced; all by default.
        size: Height of the images compared; the files' own by default.
        limit: Number of objects, evenly spaced in the order of names; all by default.
        objects: Text file of the objects of --protocol gso in place of its own list, one name a
            line; the report states that.
        baselines: Also score an empty image, a copy of the input, the input as a billboard, and
            the nearest training object.
        retrieval_data: Datasets whose training objects the nearest one is taken from; by default
            DATA.
        lpips: Use of LPIPS: auto if its weights are installed (gamba weights lpips), on requires
            them.
        strips: Number of objects with comparison images, from the first.
        sheet: Number of best, median and worst objects each in the contact sheet; 0 for none.
        save_gaussians: Also write OUT/gaussians/NAME.ply, in the input camera's
            world (eval-geometry --frame reference reads them).
        save_retrieval: Folder of the meshes that DATA was rendered from (with catalogue.json, or
            named by object): also write OUT/retrieval/NAME.ply, the retrieval's training mesh,
            placed so that the input camera sees its nearest view (eval-geometry --frame reference).
        save_images: Also write OUT/images/NAME/OBJECT/VIEW.png: the compared images of the
            model and of each baseline, in the format of images of other methods.
        resize_images: Accept images under test of another size, and resize them.
        distance: Distance of the input camera, for .ply files; a checkpoint states its own.
        background_margin: For a model: drop 3DGS tokens of plain background farther than this many
            patches from the object. Models are not trained for it, except with the decoder "rays",
            which always does it.
        detail: For a model: number of Gaussians per side that each of the front may split into, as
            for gamba reconstruct; by default the most that the input's pixels allow, at the
            compared size.
        encoder_weights: The image encoder's file, for a checkpoint without it.
        precision: Precision of a model's matrix products; "auto" is bfloat16 if that is faster.
        device: Device of all computations.
    """

    checkpoint: Annotated[Path, tyro.conf.arg(aliases=["--predictions"])]
    data: Path
    out: Path | None = None
    protocol: Literal["default", "gso", "splatter-image", "leangaussian", "gamba"] = "default"
    split: Literal["all", "train", "val", "test"] = "test"
    reference: Annotated[int, Meta(ge=0, le=100_000)] | None = None
    views: Annotated[int, Meta(ge=1, le=100_000)] | None = None
    size: Annotated[int, Meta(ge=16, le=4096)] | None = None
    limit: Annotated[int, Meta(ge=1)] | None = None
    objects: Path | None = None
    baselines: bool = True
    retrieval_data: tuple[Path, ...] = ()
    lpips: Literal["auto", "on", "off"] = "auto"
    strips: Annotated[int, Meta(ge=0, le=1_000_000)] = 8
    sheet: Annotated[int, Meta(ge=0, le=100)] = 2
    save_gaussians: bool = False
    save_retrieval: Path | None = None
    save_images: bool = False
    resize_images: bool = False
    distance: Annotated[float, Meta(ge=0.01, le=1000)] = DEFAULT_DISTANCE
    background_margin: Annotated[int, Meta(ge=0, le=4096)] | None = None
    detail: Detail | None = None
    encoder_weights: Path | None = None
    precision: Precision = "float32"
    device: DeviceChoice = "auto"

    def check(self) -> None:
        """Check the ranges of the numbers.

        Raises:
            UserError: a number is out of its range; the message names the option.
            ModuleNotFoundError: an option needs a library that is not installed.
        """
        check_options(self)
        if self.protocol == "gso":
            for name in ("split", "reference", "views", "size", "limit"):
                if getattr(self, name) != getattr(ViewsOptions, name):
                    raise UserError(f"--protocol gso: has its own {option(name)}")
        elif self.objects is not None:
            raise UserError("--objects: needs --protocol gso")
        if self.retrieval_data and not self.baselines:
            raise UserError("--retrieval-data: needs the baselines")
        for name in ("save_gaussians", "save_images"):
            if getattr(self, name) and self.out is None:
                raise UserError(f"{option(name)}: needs --out")
        if self.save_retrieval and (self.out is None or not self.baselines):
            raise UserError("--save-retrieval: needs --out, and the baselines")
        if self.save_retrieval:
            require("trimesh")

    def filled(self) -> ViewsOptions:
        """Return these options with the protocol's values where none are given.

        Raises:
            UserError, ModuleNotFoundError: as for ``check``.
        """
        self.check()
        preset = {"reference": 0} | self._preset()
        return replace(self, **{k: v for k, v in preset.items() if getattr(self, k) is None})

    def changed(self) -> list[str]:
        """Return the names of the protocol's options that differ here."""
        return [name for name, value in self._preset().items() if getattr(self, name) != value]

    def _preset(self) -> dict[str, Any]:
        return PRESETS[self.protocol].views or {} if self.protocol in PRESETS else {}
