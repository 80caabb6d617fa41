"""``gamba demo``: the whole pipeline on the starter set, by the same commands that a user types."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from pathlib import Path

from ..errors import UserError
from ..files import CHECKOUT, output_folder

STARTER = CHECKOUT / "starter"


def demo_command(
    out: Path = Path("out/demo"), minutes: float = 5.0, starter: Path = STARTER, lpips: bool = True
) -> int:
    """Trains a tiny model, reconstructs held-out pictures, evaluates, and writes a page of it all.

    Args:
        out: Folder for everything; OUT/index.html is the page.
        minutes: Training time.
        starter: The starter set's folder.
        lpips: Fetch the LPIPS weights (59 MB) for the evaluation, if they are not there.
    """
    from ..pages.demo import write_demo

    if minutes <= 0:
        raise UserError(f"--minutes is {minutes}, it must be positive")
    for name in ("data", "icons", "meshes"):
        if not (starter / name).is_dir():
            raise UserError(f"{starter / name}: no such folder; the starter set is in the checkout")
    out = output_folder(out)
    data, icons, run = starter / "data", starter / "icons", out / "run"
    views, shapes, started = out / "views", out / "geometry", time.perf_counter()
    if lpips:
        _gamba("weights", "lpips", may_fail=True)
    # LPIPS in the loss would take most of a short CPU run; the evaluation has it.
    _gamba(
        *("train", data, "--preset", "tiny", "--minutes", minutes, "--out", run),
        *("--resume", "never", "--lpips", "off", "--cache", "--batch-size", "2"),
        *("--lr", "2e-3", "--warmup-steps", "30", "--rdist-steps", "100"),
        *("--val-every", "50", "--val-objects", "4", "--no-tensorboard"),
    )
    model = run / "model.safetensors"
    _gamba("reconstruct", icons, "--checkpoint", model, "--out", out / "icons")
    _gamba(
        *("eval-views", "--checkpoint", model, "--data", data),
        *("--out", views, "--save-gaussians"),
    )
    _gamba(
        *("eval-geometry", views / "gaussians", _true_meshes(views, starter, out / "truth")),
        *("--frame", "reference", "--data", data, "--out", shapes),
        may_fail=True,
    )
    spent = f"{(time.perf_counter() - started) / 60:.1f} minutes"
    text = (
        f"A tiny model, trained here for {minutes:g} minutes on the starter set, shown pictures of "
        f"objects it has never seen. All of it took {spent}."
    )
    write_demo(out / "index.html", run, views, shapes, icons, out / "icons", text)
    print(f"wrote {out / 'index.html'} after {spent}")
    return 0


def _gamba(*arguments: object, may_fail: bool = False) -> None:
    """Runs one command as its own process, its output going through."""
    words = [str(argument) for argument in arguments]
    print(f"\n$ gamba {' '.join(words)}", flush=True)
    code = subprocess.call([sys.executable, "-m", "gamba_warp", *words])
    if code and not may_fail:
        raise UserError(f"the command above ended with exit code {code}")


def _true_meshes(views: Path, starter: Path, folder: Path) -> Path:
    """Gathers the true meshes of the predicted objects, so that the folders pair by name."""
    output_folder(folder)
    for ply in (views / "gaussians").glob("*.ply"):
        shutil.copyfile(starter / "meshes" / ply.name, folder / ply.name)
    return folder
