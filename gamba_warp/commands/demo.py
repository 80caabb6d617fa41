"""``gamba demo``: the whole pipeline on the starter set, by the commands of a user."""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import Literal

from .. import processes
from ..errors import UserError
from ..files import STARTER, only_process, output_folder
from ..untrusted.ranges import ranged

# An installed package has the shipped model and two images, but neither views nor meshes.
# LPIPS in the loss would take most of a short CPU run.
_TRAINING = (
    "--preset rays --minutes 5 --lpips off --no-radial-mask --ssim-weight 0.2 --batch-size 4 "
    "--views-per-object 3 --front-fraction 0.5 --flip 0.5 --lr 2e-3 --warmup-steps 30 --cache"
)
SHEET = "icons.webp"  # of the images
_MAKE = "make setup unpacks it in a checkout; elsewhere give the folder of one by --starter"


@ranged
def demo_command(
    out: Path = Path("out/demo"),
    starter: Path = STARTER,
    lpips: Literal["on", "off"] = "off",
) -> int:
    """Reconstruct and evaluate images and objects with the shipped model, and write a page.

    An installed package lacks most of the starter set, and tells where to get it.

    Args:
        out: Folder for everything; OUT/index.html is the page.
        starter: The starter set's folder.
        lpips: Use of LPIPS; on fetches its weights (64 MB) if they are missing.
    """
    from ..model.checkpoint import DEFAULT_CHECKPOINT as MODEL

    for name in ("data", "icons", "meshes"):
        if not (starter / name).is_dir():
            raise UserError(f"{starter / name}: no such folder; {_MAKE}")
    if not MODEL.exists():
        raise UserError(f"{MODEL}: no such file, but it comes with the package")
    out = output_folder(out)
    with only_process(out, "runs a demo"):
        started = time.perf_counter()
        if lpips == "on":
            _gamba("weights", "lpips", may_fail=True)
        _evaluate(MODEL, starter, out, lpips)
        spent = f"{(time.perf_counter() - started) / 60:.1f} minutes"
        text = (
            f"Results of the shipped model ({MODEL.name}) on images of unseen objects; "
            f"it was not trained on this machine. The whole demo took {spent}."
        )
        write_demo(out, MODEL, text)
    print(f"\nwrote {out / 'index.html'} after {spent}")
    print(f"a training of five minutes: gamba train {starter / 'data'} {_TRAINING}")
    return 0


def _gamba(*words: object, may_fail: bool = False) -> None:
    """Run a command in a child process, with its output passed through.

    Raises:
        UserError: it failed, unless it may.
    """
    texts = [str(word) for word in words]
    print(f"\n$ gamba {' '.join(texts)}", flush=True)
    code = _call(texts)
    if code and not may_fail:
        raise UserError(f"the command above ended with exit code {code}")


def _call(words: list[str]) -> int:
    return processes.run_gamba(words, None, ())


def _evaluate(model: Path, starter: Path, out: Path, lpips: str) -> None:
    """Run a model on images and objects outside its training set."""
    views, gt, data = out / "views", output_folder(out / "gt"), starter / "data"
    _gamba(
        *("reconstruct", starter / "icons", "--checkpoint", model, "--out", out / "icons"),
        *("--turntable", "none", "--sheet", out / SHEET),
    )
    _gamba(
        *("eval-views", "--checkpoint", model, "--data", data, "--views", 9),
        *("--out", views, "--save-gaussians", "--lpips", "auto" if lpips == "on" else "off"),
    )
    # The true meshes of the predicted objects, so that the folders pair by name.
    for ply in (views / "gaussians").glob("*.ply"):
        shutil.copyfile(starter / "meshes" / ply.name, gt / ply.name)
    _gamba(
        *("eval-geometry", views / "gaussians", gt),
        # The starter set's meshes are in the world of its views.
        *("--frame", "reference", "--data", data, "--up", "z", "--out", out / "geometry"),
        may_fail=True,
    )


def write_demo(out: Path, model: Path, text: str) -> None:
    """Write the page with the results of the commands, ``index.html``.

    Args:
        out: folder of the results.
        model: the model's file.
        text: below the page's title.

    Raises:
        UserError: a file cannot be read or written.
    """
    from ..images import load_rgba
    from ..pages.card import about_model
    from ..pages.page import Section, write_page

    tables = {"views": out / "views" / "table.md", "shapes": out / "geometry" / "table.md"}
    figures = {
        f"Figures of the {name}": table.read_text(encoding="utf-8")
        for name, table in tables.items()
        if table.exists()
    }
    objects = Section(
        "Objects that the model has never seen",
        "The input, true views, and the same views of the result of one pass of the model.",
        strip=load_rgba(out / "views" / "contact_sheet.png")[..., :3],
        details=figures,
    )
    icons = Section(
        "Images by another renderer",
        "The input, and views around the result; icons/index.html has the 3D viewers.",
        strip=load_rgba(out / SHEET)[..., :3],
    )
    about = Section("The shipped model", table=about_model(model))
    write_page(out / "index.html", "Gamba demo", [objects, icons, about], text)
