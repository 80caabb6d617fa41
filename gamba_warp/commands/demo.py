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
    from ..model.checkpoint import DEFAULT_CHECKPOINT
    from ..pages.demo import DemoResults, write_demo

    for name in ("data", "icons", "meshes"):
        if not (starter / name).is_dir():
            raise UserError(f"{starter / name}: no such folder; {_MAKE}")
    if not DEFAULT_CHECKPOINT.exists():
        raise UserError(f"{DEFAULT_CHECKPOINT}: no such file, but it comes with the package")
    out = output_folder(out)
    results = DemoResults(
        shipped=DEFAULT_CHECKPOINT,
        icons=starter / "icons",
        results=out / "icons",
        views=out / "views",
        shapes=out / "geometry",
    )
    with only_process(out, "runs a demo"):
        started = time.perf_counter()
        if lpips == "on":
            _gamba("weights", "lpips", may_fail=True)
        _evaluate(results, starter, out / "truth", lpips)
        spent = f"{(time.perf_counter() - started) / 60:.1f} minutes"
        text = (
            f"Results of the shipped model ({results.shipped.name}) on images of unseen objects; "
            f"it was not trained on this machine. The whole demo took {spent}."
        )
        write_demo(out / "index.html", results, text)
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


def _evaluate(results, starter: Path, gt: Path, lpips: str) -> None:
    """Run the shipped model on images and objects outside its training set."""
    model, views, data = results.shipped, results.views, starter / "data"
    _gamba(
        *("reconstruct", results.icons, "--checkpoint", model, "--out", results.results),
        *("--turntable", "none", "--no-page"),
    )
    _gamba(
        *("eval-views", "--checkpoint", model, "--data", data, "--views", 9),
        *("--out", views, "--save-gaussians", "--lpips", "auto" if lpips == "on" else "off"),
    )
    # The true meshes of the predicted objects, so that the folders pair by name.
    output_folder(gt)
    for ply in (views / "gaussians").glob("*.ply"):
        shutil.copyfile(starter / "meshes" / ply.name, gt / ply.name)
    _gamba(
        *("eval-geometry", views / "gaussians", gt),
        # The starter set's meshes are in the world of its views.
        *("--frame", "reference", "--data", data, "--up", "z", "--out", results.shapes),
        may_fail=True,
    )
