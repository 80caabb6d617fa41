"""``gamba demo``: the whole pipeline on the starter set, by the commands of a user."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

from .. import processes
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
) -> int:
    """Reconstruct and evaluate with the shipped model, then train one, and write a page.

    The page is written after the shipped model's part, and again at the end. An installed package
    lacks most of the starter set, and tells where to get it.

    Args:
        out: Folder for everything; OUT/index.html is the page.
        minutes: Training time.
        starter: The starter set's folder.
        lpips: Fetch the LPIPS weights (64 MB) for the evaluation, if they are missing.
    """
    from ..model.checkpoint import DEFAULT_CHECKPOINT
    from ..pages.demo import DemoResults

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
        started = time.perf_counter()
        if lpips:
            _gamba("weights", "lpips", may_fail=True)
        _shipped(results, starter, out / "truth")
        _write(results, out, minutes, "Training still runs; the second half of this page follows.")
        _train_here(results, starter / "data", minutes)
        spent = f"{(time.perf_counter() - started) / 60:.1f} minutes"
        _write(results, out, minutes, f"The whole demo took {spent}.")
        print(f"wrote {out / 'index.html'} after {spent}")
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


def _shipped(results, starter: Path, truth: Path) -> None:
    """Run the shipped model on pictures and objects outside its training set."""
    model, views, data = results.shipped, results.views, starter / "data"
    _gamba(
        *("reconstruct", results.icons, "--checkpoint", model, "--out", results.results),
        *("--turntable", "none", "--no-page"),
    )
    _gamba(
        *("eval-views", "--checkpoint", model, "--data", data, "--views", 9),
        *("--out", views, "--save-gaussians"),
    )
    # The true meshes of the predicted objects, so that the folders pair by name.
    output_folder(truth)
    for ply in (views / "gaussians").glob("*.ply"):
        shutil.copyfile(starter / "meshes" / ply.name, truth / ply.name)
    _gamba(
        *("eval-geometry", views / "gaussians", truth),
        # The starter set's meshes are in the world of its views.
        *("--frame", "reference", "--data", data, "--up", "z", "--out", results.shapes),
        may_fail=True,
    )


def _train_here(results, data: Path, minutes: float) -> None:
    """Train a model from random weights, and evaluate it on the same objects."""
    _gamba(
        *("train", data, "--preset", "rays", "--minutes", minutes, "--out", results.run),
        # LPIPS in the loss would take most of a short CPU run; the evaluation has it.
        *("--resume", "never", "--lpips", "off", "--no-radial-mask", "--ssim-weight", "0.2"),
        *("--batch-size", "4", "--views-per-object", "3", "--front-share", "0.5"),
        *("--mirror", "0.5", "--lr", "2e-3", "--warmup-steps", "30", "--cache"),
        *("--val-every", "40", "--val-objects", "4", "--save-every", "50"),
    )
    _gamba(
        *("eval-views", "--checkpoint", results.run / "model.safetensors", "--data", data),
        *("--views", 9, "--out", results.views_here, "--no-baselines"),
    )


def _write(results, out: Path, minutes: float, state: str) -> None:
    from ..pages.demo import write_demo

    text = (
        f"First, results of the shipped model ({results.shipped.name}) on pictures of unseen "
        "objects; it was not trained on this machine. Then a model trained here from scratch for "
        f"{minutes:g} minutes. {state}"
    )
    write_demo(out / "index.html", results, text)
