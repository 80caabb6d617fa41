"""``gamba demo``: the whole pipeline on the starter set, by the commands of a user."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

from ..errors import UserError
from ..files import STARTER, only_process, output_folder
from ..untrusted.ranges import Minutes, ranged

# An installed package has the shipped model and two pictures, but neither views nor meshes.
_MAKE = "make setup unpacks it in a checkout; elsewhere give the folder of one by --starter"


@ranged
def demo_command(
    out: Path = Path("out/demo"),
    minutes: Minutes = 2.0,
    starter: Path = STARTER,
    lpips: bool = True,
    fresh: bool = False,
) -> int:
    """Reconstruct and evaluate with the shipped model, then train one, and write a page.

    The page is written after the shipped model's part, and again at the end. An interrupted demo
    resumes and skips finished stages. An installed package lacks most of the starter set, and tells
    where to get it.

    Args:
        out: Folder for everything; OUT/index.html is the page.
        minutes: Training time.
        starter: The starter set's folder.
        lpips: Fetch the LPIPS weights (64 MB) for the evaluation, if they are missing.
        fresh: Remove the results of an earlier demo in OUT, and start again.
    """
    from ..model.checkpoint import DEFAULT_CHECKPOINT
    from ..pages.demo import DemoResults
    from ..pages.stages import Stages, Stopped

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
        run=out / "run",
        views_here=out / "views-here",
    )
    with only_process(out, "runs a demo"):
        stages = Stages(out)
        if fresh:
            stages.forget()
        started = time.perf_counter()
        try:
            if lpips:
                stages.gamba("weights", "lpips", may_fail=True)
            _shipped(stages, results, starter, out / "truth")
            _write(
                results, out, minutes, "Training still runs; the second half of this page follows."
            )
            _train_here(stages, results, starter / "data", minutes)
        except Stopped as stopped:
            print("stopped; the same command resumes from here")
            return stopped.code
        spent = f"{(time.perf_counter() - started + stages.seconds) / 60:.1f} minutes"
        _write(results, out, minutes, f"The whole demo took {spent}.")
        print(f"wrote {out / 'index.html'} after {spent}")
    return 0


def _shipped(stages, results, starter: Path, truth: Path) -> None:
    """Run the shipped model on pictures and objects outside its training set."""
    model, views, data = results.shipped, results.views, starter / "data"
    stages.gamba(
        *("reconstruct", results.icons, "--checkpoint", model, "--out", results.results),
        *("--turntable", "none", "--no-page"),
        makes=[results.results],
        reads=[model],
    )
    stages.gamba(
        *("eval-views", "--checkpoint", model, "--data", data, "--views", 9),
        *("--out", views, "--save-gaussians"),
        makes=[views / "report.json"],
        reads=[model],
    )
    # The true meshes of the predicted objects, so that the folders pair by name.
    output_folder(truth)
    for ply in (views / "gaussians").glob("*.ply"):
        shutil.copyfile(starter / "meshes" / ply.name, truth / ply.name)
    stages.gamba(
        *("eval-geometry", views / "gaussians", truth),
        # The starter set's meshes are in the world of its views.
        *("--frame", "reference", "--data", data, "--up", "z", "--out", results.shapes),
        makes=[results.shapes / "report.json"],
        may_fail=True,
    )


def _train_here(stages, results, data: Path, minutes: float) -> None:
    """Train a model from random weights, and evaluate it on the same objects."""
    model = results.run / "model.safetensors"
    stages.gamba(
        *("train", data, "--preset", "rays", "--minutes", minutes, "--out", results.run),
        # LPIPS in the loss would take most of a short CPU run; the evaluation has it.
        *("--resume", "auto", "--lpips", "off", "--no-radial-mask", "--ssim-weight", "0.2"),
        *("--batch-size", "4", "--views-per-object", "3", "--front-share", "0.5"),
        *("--mirror", "0.5", "--lr", "2e-3", "--warmup-steps", "30", "--cache"),
        *("--val-every", "40", "--val-objects", "4", "--save-every", "50", "--no-tensorboard"),
        makes=[model],
    )
    stages.gamba(
        *("eval-views", "--checkpoint", model, "--data", data, "--views", 9),
        *("--out", results.views_here, "--no-baselines"),
        makes=[results.views_here / "report.json"],
        name="eval-views of the model trained here",
    )


def _write(results, out: Path, minutes: float, state: str) -> None:
    from ..pages.demo import write_demo

    text = (
        f"First, results of the shipped model ({results.shipped.name}) on pictures of unseen "
        "objects; it was not trained on this machine. Then a model trained here from scratch for "
        f"{minutes:g} minutes. {state}"
    )
    write_demo(out / "index.html", results, text)
