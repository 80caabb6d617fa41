"""The commands that are put to the test, and the small world of files that they work on."""

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from helpers.released import make_released

from gamba_warp.files import remove_folder, write_json
from gamba_warp.formats.ply import save_ply
from gamba_warp.gaussians import Gaussians
from gamba_warp.images import save_image

from .child import gamba, run_child


class Job(NamedTuple):
    """One command that writes.

    Attributes:
        words: the command and its arguments, by the folder of the small world and that of results.
        other: further arguments that change what it writes, so that older results can be told.
        undo: removes a part of the results, where a command does not do again what is done.
    """

    words: Callable[[Path, Path], list[object]]
    other: tuple[object, ...] = ()
    undo: Callable[[Path], None] | None = None


def without_one_object(out: Path) -> None:
    """Removes one rendered object; there may be none, as several in turn were not made again."""
    for path in sorted(out.glob("*/transforms.json"))[-1:]:
        remove_folder(path.parent)


CPU = ("--device", "cpu")
SMALL = ("--size", 16, "--frames", 2, *CPU)
MODEL = ("image_size=16", "patch_size=4", "width=16", "depth=1", "state_size=4", "scale_init=0.06")
JOBS = {
    "reconstruct": Job(
        lambda world, out: [
            *("reconstruct", world / "pictures", "--out", out, *SMALL),
            *("--checkpoint", world / "run" / "model.safetensors"),
            *("--splats", "ply", "splat", "glb"),
        ],
        ("--elevation", 20),
    ),
    "export": Job(
        lambda world, out: [
            *("export", world / "gaussians", "--out", out, "--voxels", 24, "--views", 8),
            *("--pixels", 32, "--mesh", "glb", "ply", "--splats", "ply", "--page"),
            *("--turntable", "gif", *SMALL),
        ],
        ("--frame", "opencv"),
    ),
    "render": Job(
        lambda world, out: [
            *("render", world / "gaussians", "--out", out, "--kind", "png", "--size", 32),
            *("--frames", 3, "--depth", *CPU),
        ],
        ("--elevation", 20),
    ),
    "fit": Job(
        lambda world, out: [
            *("fit", world / "data", "--out", out, "--steps", 4, "--gaussians", 60, *CPU)
        ],
        ("--seed", 1),
    ),
    "data render": Job(
        lambda world, out: [
            *("data", "render", world / "meshes", "--out", out, "--views", 2, "--size", 16),
            *("--workers", 1),
        ],
        undo=without_one_object,
    ),
    "eval-views": Job(
        lambda world, out: [
            *("eval-views", "--checkpoint", world / "run" / "model.safetensors"),
            *("--data", world / "data", "--out", out, "--split", "all"),
            *("--no-lpips", "--save-gaussians", *CPU),
        ],
        ("--views", 3),
    ),
    "eval-geometry": Job(
        lambda world, out: [
            *("eval-geometry", world / "meshes", world / "meshes", "--out", out, "--points", 500)
        ],
        ("--seed", 1),
    ),
    "import-released": Job(
        lambda world, out: [
            *("import-released", world / "released" / "theirs.pth", "--out", out),
            *("--encoder-weights", world / "released" / "vit.safetensors", "--depth", 1),
        ]
    ),
    "data pack": Job(
        lambda world, out: [*("data", "pack", world / "data", out, "--size", 16, "--workers", 1)],
        undo=remove_folder,
    ),
    "ablate": Job(
        lambda world, out: [
            *("ablate", world / "plan.json", world / "data", "--out", out, "--rows", "fit", *CPU)
        ],
        undo=lambda out: remove_folder(out / "rows"),
    ),
    "data furniture": Job(
        lambda world, out: ["data", "furniture", "--tree", world / "libraries", "--out", out]
    ),
    "view": Job(
        lambda world, out: [
            *("view", world / "gaussians" / "ball.ply", "--out", out / "page.html"),
            "--no-open-browser",
        ]
    ),
    "stress": Job(
        lambda world, out: ["stress", "scan", "--cases", 2, *CPU, "--out", out], ("--seed", 1)
    ),
    "bench": Job(
        lambda world, out: ["bench", "--render", world / "bench" / "bench.json", "--out", out]
    ),
}


def training(world: Path, out: Path, steps: int) -> list[object]:
    """The command that trains a tiny model, or goes on."""
    words: list[object] = ["train", world / "data", "--preset", "tiny", "--set", *MODEL]
    words += ["--size", 16, "--lpips", "off", "--views-last", 2, "--val-every", 10, *CPU]
    words += ["--workers", 1, "--no-tensorboard", "--batch-size", 2, "--save-every", 3]
    return [*words, "--log-every", 1, "--out", out, "--steps", steps]


def undisturbed(*words: object):
    """Runs a command, which must end well."""
    end = run_child(gamba, *words)
    assert end.code == 0, end.said[-2000:]
    return end


def make_world(folder: Path, commands: list[str]) -> None:
    """Makes data, a model, pictures, meshes and what else the commands need."""
    rng = np.random.default_rng(0)
    (folder / "meshes").mkdir()
    solids = {"ball": trimesh.creation.icosphere(1), "box": trimesh.creation.box()}
    for name, mesh in (solids | {"cone": trimesh.creation.cone(1, 2)}).items():
        mesh.export(folder / "meshes" / f"{name}.ply")
    data = ("--views", 4, "--size", 16, "--workers", 1, "--out", folder / "data")
    undisturbed("data", "render", folder / "meshes", *data)
    parts = {"version": 1, "train": ["ball", "box"], "val": ["cone"], "test": []}
    write_json(folder / "data" / "split.json", parts)
    undisturbed(*training(folder, folder / "run", 2))
    rgba = np.zeros((20, 30, 4))
    rgba[4:16, 8:24] = (0.8, 0.3, 0.1, 1)
    for name in ("a", "b"):
        (folder / "pictures").mkdir(exist_ok=True)
        save_image(folder / "pictures" / f"{name}.png", rgba)
    points = rng.normal(size=(200, 3))
    points *= 0.4 / np.linalg.norm(points, axis=1, keepdims=True)
    (folder / "gaussians").mkdir()
    save_ply(folder / "gaussians" / "ball.ply", ball(points))
    if "ablate" in commands:
        write_json(folder / "plan.json", plan())
    if "data furniture" in commands:
        make_library(folder / "libraries", folder / "pictures" / "a.png")
    if "import-released" in commands:
        make_released(folder / "released")
    if "bench" in commands:
        undisturbed("bench", "conv", "--quick", *CPU, "--out", folder / "bench")


def ball(points: np.ndarray) -> Gaussians:
    """Opaque Gaussians at points ``[N, 3]``."""
    import torch

    size = len(points)
    return Gaussians(
        means=torch.from_numpy(points).float(),
        quats=None,
        scales=torch.full((size, 3), 0.08),
        opacities=torch.full((size,), 0.95),
        colors=torch.rand(size, 3, generator=torch.Generator().manual_seed(0)),
    )


def plan() -> dict:
    """An ablation of one fit of a few steps."""
    fit = {"steps": 3, "limit": 1, "held_out": 3, "size": 16}
    return {
        "name": "small",
        "title": "One fit",
        "seeds": [0],
        "base": {"preset": "tiny", "options": {"steps": 2, "batch_size": 2}, "fit": fit},
        "evaluation": {"split": "val", "objects": 1, "views": 3, "size": 16},
        "compare_with": "model",
        "rows": [{"name": "model"}, {"name": "fit", "kind": "fit", "options": {"gaussians": 20}}],
    }


def make_library(folder: Path, icon: Path) -> None:
    """A furniture library of 20 models, as ``gamba data furniture`` unpacks it."""
    folder.mkdir()
    lines = ["id=Some#Library", "name=Some"]
    with zipfile.ZipFile(folder / "Some.sh3f", "w") as archive:
        archive.write(icon, "m/icon.png")
        for number in range(20):
            lines += [f"name#{number}=Thing {number}", f"icon#{number}=/m/icon.png"]
            lines += [f"model#{number}=/m/{number}/a.obj", f"creator#{number}=me"]
            archive.writestr(f"m/{number}/a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n" * 99)
        archive.writestr("PluginFurnitureCatalog.properties", "\n".join(lines))
