"""``gamba demo``: the whole pipeline on the starter set, by the same commands that a user types."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

from ..errors import UserError
from ..files import CHECKOUT, only_process, output_folder
from ..untrusted.ranges import Minutes, ranged

STARTER = CHECKOUT / "starter"


@ranged
def demo_command(
    out: Path = Path("out/demo"),
    minutes: Minutes = 5.0,
    starter: Path = STARTER,
    lpips: bool = True,
    fresh: bool = False,
) -> int:
    """Trains a tiny model, reconstructs held-out pictures, evaluates, and writes a page of it all.

    A demo that was interrupted goes on where it was; what is done is not done again.

    Args:
        out: Folder for everything; OUT/index.html is the page.
        minutes: Training time.
        starter: The starter set's folder.
        lpips: Fetch the LPIPS weights (59 MB) for the evaluation, if they are not there.
        fresh: Remove what an earlier demo made in OUT, and start anew.
    """
    from ..pages.stages import Stages

    for name in ("data", "icons", "meshes"):
        if not (starter / name).is_dir():
            raise UserError(f"{starter / name}: no such folder; the starter set is in the checkout")
    out = output_folder(out)
    with only_process(out, "runs a demo"):
        stages = Stages(out)
        if fresh:
            stages.forget()
        return _demo(stages, out, minutes, starter, lpips)


def _demo(stages, out: Path, minutes: float, starter: Path, lpips: bool) -> int:
    """Runs the stages that are not done yet; returns 0, or 128 + n where signal n ended it."""
    from ..pages.demo import write_demo
    from ..pages.stages import Stopped

    data, icons, run = starter / "data", starter / "icons", out / "run"
    views, shapes, started = out / "views", out / "geometry", time.perf_counter()
    model = run / "model.safetensors"
    try:
        if lpips:
            stages.gamba("weights", "lpips", may_fail=True)
        # LPIPS in the loss would take most of a short CPU run; the evaluation has it.
        stages.gamba(
            *("train", data, "--preset", "tiny", "--minutes", minutes, "--out", run),
            *("--resume", "auto", "--lpips", "off", "--cache", "--batch-size", "2"),
            *("--lr", "2e-3", "--warmup-steps", "30", "--rdist-steps", "100"),
            *("--val-every", "50", "--val-objects", "4", "--no-tensorboard"),
            *("--save-every", "50"),
            makes=[model],
        )
        stages.gamba(
            *("reconstruct", icons, "--checkpoint", model, "--out", out / "icons"),
            makes=[out / "icons"],
        )
        stages.gamba(
            *("eval-views", "--checkpoint", model, "--data", data),
            *("--out", views, "--save-gaussians"),
            makes=[views / "report.json"],
        )
        truth = _true_meshes(views, starter, out / "truth")
        stages.gamba(
            *("eval-geometry", views / "gaussians", truth),
            *("--frame", "reference", "--data", data, "--out", shapes),
            makes=[shapes / "report.json"],
            may_fail=True,
        )
    except Stopped as stopped:
        print("stopped; the same command goes on from here")
        return stopped.code
    spent = f"{(time.perf_counter() - started + stages.seconds) / 60:.1f} minutes"
    text = (
        f"A tiny model, trained here for {minutes:g} minutes on the starter set, shown pictures of "
        f"objects it has never seen. All of it took {spent}."
    )
    write_demo(out / "index.html", run, views, shapes, icons, out / "icons", text)
    print(f"wrote {out / 'index.html'} after {spent}")
    return 0


def _true_meshes(views: Path, starter: Path, folder: Path) -> Path:
    """Gathers the true meshes of the predicted objects, so that the folders pair by name."""
    output_folder(folder)
    for ply in (views / "gaussians").glob("*.ply"):
        shutil.copyfile(starter / "meshes" / ply.name, folder / ply.name)
    return folder
