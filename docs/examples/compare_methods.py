"""Compares methods by their files in one table, with the expected form of images and meshes.

Run ``python docs/examples/compare_methods.py --out out/compare`` in a checkout; it uses the
starter set, and ends with the table of ``gamba compare``. The methods:

- **shipped**: the shipped model, evaluated as a model. Its images and Gaussians are written too.
- **retrieval**, **billboard**: two baselines in the form of external results, folders of images
  named like the true ones. They have no meshes, and "-" in the table.
- **hull**: the convex hull of the *true* shape, in grey. No method can make it from one image;
  it stands for an external program: images with their own cameras (``transforms.json``), and
  meshes in the frame of the true ones.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path

import trimesh

from gamba_warp.cli import run
from gamba_warp.files import STARTER


def gamba(*words: object) -> None:
    """Run a command like a user; exit on failure."""
    print("$ gamba", *words)
    name, *arguments = map(str, words)
    if name == "data":
        name, arguments = f"data {arguments[0]}", arguments[1:]
    if code := run(name, arguments):
        raise SystemExit(code)


def evaluate_shipped(out: Path, options: argparse.Namespace) -> list[str]:
    """Evaluate the shipped model's views; return the names of the objects."""
    gamba(
        *("eval-views", "--checkpoint", STARTER / "rays.safetensors", "--out", out / "shipped"),
        *("--save-gaussians", "--save-images", *common(options)),
    )
    report = json.loads((out / "shipped" / "report.json").read_text())
    return [record["name"] for record in report["objects"]]


def common(options: argparse.Namespace) -> list[object]:
    """Options common to all evaluations of views, as required by ``gamba compare``."""
    words: list[object] = ["--data", options.data, "--limit", options.objects]
    words += ["--views", options.views, "--device", "cpu", "--strips", 0, "--sheet", 0]
    return [*words, "--lpips", options.lpips]


def make_hulls(out: Path, meshes: Path, uids: list[str], cameras: int) -> None:
    """Make the fourth method's files: ``meshes/NAME.ply``, and ``images/NAME`` with cameras.

    ``data render`` uses the dataset's cameras, because it has the same seed.
    """
    (out / "meshes").mkdir(parents=True, exist_ok=True)
    for uid in uids:
        mesh = trimesh.load(meshes / f"{uid}.ply", force="mesh")
        mesh.convex_hull.export(out / "meshes" / f"{uid}.ply")
    shutil.rmtree(out / "images", ignore_errors=True)
    gamba(
        *("data", "render", out / "meshes", "--out", out / "images"),
        *("--views", cameras, "--workers", 1),
    )


def main(arguments: list[str] | None = None) -> None:
    """Make the files of all methods, evaluate them and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/compare"))
    parser.add_argument("--data", type=Path, default=STARTER / "data", help="posed views")
    parser.add_argument("--meshes", type=Path, default=STARTER / "meshes", help="their meshes")
    parser.add_argument("--objects", type=int, default=4, help="objects of the test split")
    parser.add_argument("--views", type=int, default=9, help="views per object, the input included")
    parser.add_argument("--points", type=int, default=100_000, help="points on each surface")
    parser.add_argument("--voxels", type=int, default=128, help="voxels per unit, for Gaussians")
    parser.add_argument("--lpips", choices=("auto", "on", "off"), default="auto")
    options = parser.parse_args(arguments)
    out: Path = options.out
    uids = evaluate_shipped(out, options)
    cameras = json.loads((options.data / uids[0] / "transforms.json").read_text())["frames"]
    make_hulls(out / "hull", options.meshes, uids, len(cameras))

    # Images: a folder for each method, in it a folder for each object.
    images = {
        "retrieval": out / "shipped" / "images" / "retrieval",
        "billboard": out / "shipped" / "images" / "billboard",
        "hull": out / "hull" / "images",
    }
    reports = {"shipped": [out / "shipped"]}
    for name, folder in images.items():
        place = out / f"{name}-views"
        words = ["--predictions", folder, "--no-baselines", "--out", place]
        gamba("eval-views", *words, *common(options))
        reports[name] = [place]

    # Shapes: a file for each object, named like the true ones.
    gts = out / "gt"
    gts.mkdir(exist_ok=True)
    for uid in uids:
        shutil.copy(options.meshes / f"{uid}.ply", gts)
    points = ["--points", options.points, "--voxels", options.voxels]
    shapes = {
        "shipped": [out / "shipped" / "gaussians", gts, "--frame", "reference"],
        "hull": [out / "hull" / "meshes", gts],
    }
    for name, words in shapes.items():
        place = out / f"{name}-shapes"
        data = ["--data", options.data] if name == "shipped" else []
        gamba("eval-geometry", *words, *data, *points, "--out", place)
        reports[name].append(place)

    words = [f"{name}={place}" for name, places in reports.items() for place in places]
    gamba("compare", *words, "--against", "shipped", "--out", out)


if __name__ == "__main__":
    main()
