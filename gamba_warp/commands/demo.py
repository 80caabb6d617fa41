"""``gamba demo``: the whole pipeline on the starter set, by the same commands that a user types."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from ..errors import UserError
from ..files import CHECKOUT, output_folder
from ..formats.ply import load_ply
from ..gaussians import Gaussians
from ..images import load_rgba
from ..pages.page import Section, demo_page
from ..pages.turntable import turntable_frames

STARTER = CHECKOUT / "starter"
METRICS = {"psnr": "PSNR [dB]", "ssim": "SSIM", "lpips": "LPIPS", "mask_iou": "Mask IoU"}


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
    if minutes <= 0:
        raise UserError(f"--minutes is {minutes}, it must be positive")
    for name in ("data", "icons", "meshes"):
        if not (starter / name).is_dir():
            raise UserError(f"{starter / name}: no such folder; the starter set is in the checkout")
    out = output_folder(out)
    data, run, started = starter / "data", out / "run", time.perf_counter()
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
    _gamba("reconstruct", starter / "icons", "--checkpoint", model, "--out", out / "icons")
    views, shapes = out / "views", out / "geometry"
    _gamba(
        *("eval-views", "--checkpoint", model, "--data", data),
        *("--out", views, "--save-gaussians"),
    )
    _gamba(
        *("eval-geometry", views / "gaussians", _true_meshes(views, starter, out / "truth")),
        *("--frame", "reference", "--data", data, "--out", shapes),
        may_fail=True,
    )
    seconds = time.perf_counter() - started
    sections = [
        _numbers(views, shapes),
        _training(run),
        *(_held_out(strip, views) for strip in sorted((views / "strips").glob("*.png"))),
        *_icons(starter / "icons", out / "icons"),
    ]
    text = (
        f"A tiny model, trained here for {minutes:g} minutes on the starter set, shown pictures of "
        f"objects it has never seen. All of it took {seconds / 60:.1f} minutes."
    )
    demo_page(out / "index.html", sections, text=text)
    print(f"wrote {out / 'index.html'} after {seconds / 60:.1f} minutes")
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


def _report(folder: Path) -> dict:
    path = folder / "report.json"
    return json.loads(path.read_text()) if path.exists() else {}


def _cell(value: float | None) -> str:
    return "absent" if value is None else f"{value:.3f}"


def _numbers(views: Path, shapes: Path) -> Section:
    report = _report(views)
    candidates = {"this model": report["mean"], **report["baselines"]}
    rows = [
        [label, name, *(_cell(values.get(key)) for key in METRICS)]
        for label, values in candidates.items()
        for name, values in (("novel", values), ("input", values["input"]))
    ]
    geometry = _report(shapes).get("mean", {})
    keys = ("chamfer", "normal_consistency", "iou")
    found = [f"{key.replace('_', ' ')} {_cell(geometry[key])}" for key in keys if key in geometry]
    text = f"Held-out objects: {report['num_ok']}. "
    text += f"Geometry of this model: {', '.join(found)}." if found else "No geometry."
    return Section("Numbers", text, header=["", "views", *METRICS.values()], table=rows)


def _training(run: Path) -> Section:
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    curves = {
        "training": [(e["step"], e["loss"]) for e in lines if e["event"] == "train" and e["loss"]],
        "held out": [(e["step"], e["loss"]) for e in lines if e["event"] == "val" and e["loss"]],
    }
    steps = max((e["step"] for e in lines), default=0)
    return Section("Training", f"{steps} steps.", curves=curves, curves_label="loss")


def _held_out(strip: Path, views: Path) -> Section:
    """A strip's rows are input | prediction | truth, one view each."""
    rgb = load_rgba(strip)[..., :3]
    side = rgb.shape[1] // 3
    tiles = rgb.reshape(-1, side, 3, side, 3).transpose(2, 0, 1, 3, 4)
    gaussians = load_ply(views / "gaussians" / f"{strip.stem}.ply")
    record = next(o for o in _report(views)["objects"] if o["name"] == strip.stem)
    return Section(
        strip.stem,
        f"Novel views: {record['psnr']:.1f} dB; input view: {record['input']['psnr']:.1f} dB.",
        picture=tiles[0][0],
        gaussians=gaussians,
        turntable=_turntable(gaussians),
        views={"Predicted": tiles[1], "Truth": tiles[2]},
    )


def _icons(icons: Path, results: Path) -> list[Section]:
    sections = []
    for icon in sorted(icons.glob("*.png")):
        ply = results / f"{icon.stem}.ply"
        if ply.exists():
            gaussians = load_ply(ply)
            sections.append(
                Section(
                    f"Icon: {icon.stem}",
                    picture=load_rgba(icon),
                    turntable=_turntable(gaussians),
                    gaussians=gaussians,
                )
            )
    return sections


def _turntable(gaussians: Gaussians) -> np.ndarray:
    return turntable_frames(gaussians, size=192, frames=24)
