"""The commands that are put to the test, and the small world of files that they work on."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..files import remove_folder, write_json
from .child import run_child
from .released import make_released

MODEL = ("image_size=16", "patch_size=4", "width=16", "depth=1", "state_size=4", "scale_init=0.06")


@dataclass(frozen=True)
class Job:
    """One command that writes.

    Attributes:
        name: of the command.
        words: its arguments by the folder of the results.
        other: further arguments that change what it writes, so that older results can be told.
        undo: removes a part of the results from their folder, where a command does not do again
            what is done.
    """

    name: str
    words: Callable[[Path], list[object]]
    other: tuple[object, ...]
    undo: Callable[[Path], None] | None = None

    def function(self, out: Path, other: bool = False) -> Callable[[], int]:
        """What a child runs; with ``other``, under the further arguments."""
        return command(*self.name.split(), *self.words(out), *(self.other if other else ()))


def command(*words: object) -> Callable[[], int]:
    """What a child runs that is ``python -m gamba_warp WORDS``."""

    def run() -> int:
        sys.argv = ["gamba", *map(str, words)]
        try:
            runpy.run_module("gamba_warp", run_name="__main__", alter_sys=True)
        except SystemExit as stopped:
            return stopped.code if isinstance(stopped.code, int) else 1
        return 0

    return run


def training(world: Path, out: Path, steps: int) -> Callable[[], int]:
    """What a child runs that trains a tiny model, or goes on."""
    words = [*training_words(world), "--batch-size", 2, "--out", out, "--steps", steps]
    return command("train", *words, "--save-every", 3, "--log-every", 1)


def training_words(world: Path) -> list[object]:
    """Options of a training of a tiny model, but for its batch, folder, length and log."""
    words: list[object] = [world / "data", "--preset", "tiny", "--set", *MODEL]
    words += ["--size", 16, "--lpips", "off", "--views-last", 2, "--val-every", 10]
    return [*words, "--device", "cpu", "--workers", 1, "--no-tensorboard"]


def make_world(folder: Path) -> None:
    """Makes data, a model, pictures and meshes, each in a child, by our own commands.

    Raises:
        RuntimeError: one of them could not be made.
    """
    (folder / "meshes").mkdir(parents=True)
    for function in (lambda: _make_inputs(folder), training(folder, folder / "run", 2)):
        end = run_child(function)
        if end.code:
            raise RuntimeError(f"the small world cannot be made: {end.said[-2000:]}")


def _make_inputs(folder: Path) -> int:
    import numpy as np
    import trimesh

    from ..formats.ply import save_ply
    from ..images import save_image

    for number, name in enumerate(("ball", "box", "cone")):
        mesh = [trimesh.creation.icosphere(1), trimesh.creation.box(), trimesh.creation.cone(1, 2)][
            number
        ]
        mesh.export(folder / "meshes" / f"{name}.ply")
    options = ["--views", "4", "--size", "16", "--workers", "1", "--out", str(folder / "data")]
    code = command("data", "render", folder / "meshes", *options)()
    rgba = np.zeros((20, 30, 4))
    rgba[4:16, 8:24] = (0.8, 0.3, 0.1, 1)
    parts = {"version": 1, "train": ["ball", "box"], "val": ["cone"], "test": []}
    write_json(folder / "data" / "split.json", parts)
    (folder / "pictures").mkdir()
    for name in ("a", "b"):
        save_image(folder / "pictures" / f"{name}.png", rgba)
    (folder / "gaussians").mkdir()
    save_ply(folder / "gaussians" / "ball.ply", _ball())
    write_json(folder / "plan.json", _plan())
    _make_library(folder / "libraries", folder / "pictures" / "a.png")
    make_released(folder / "released")
    return code


def _without_one_object(out: Path) -> None:
    """Removes one rendered object."""
    found = sorted(out.glob("*/transforms.json"))
    if found:
        remove_folder(found[-1].parent)


def _plan() -> dict:
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


def _make_library(folder: Path, icon: Path) -> None:
    """A furniture library of 20 models, as ``gamba data furniture`` unpacks it."""
    import zipfile

    folder.mkdir()
    lines = ["id=Some#Library", "name=Some"]
    with zipfile.ZipFile(folder / "Some.sh3f", "w") as archive:
        archive.write(icon, "m/icon.png")
        for number in range(20):
            lines += [f"name#{number}=Thing {number}", f"icon#{number}=/m/icon.png"]
            lines += [f"model#{number}=/m/{number}/a.obj", f"creator#{number}=me"]
            archive.writestr(f"m/{number}/a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n" * 99)
        archive.writestr("PluginFurnitureCatalog.properties", "\n".join(lines))


def _ball():
    import torch

    from ..gaussians import Gaussians

    rng = torch.Generator().manual_seed(0)
    points = torch.randn(200, 3, generator=rng)
    return Gaussians(
        means=0.4 * points / points.norm(dim=1, keepdim=True),
        quats=None,
        scales=torch.full((200, 3), 0.08),
        opacities=torch.full((200,), 0.95),
        colors=torch.rand(200, 3, generator=rng),
    )


def _render_job(world: Path) -> Job:
    small = ("--kind", "png", "--size", 32, "--frames", 3, "--depth", "--device", "cpu")
    return Job(
        "render",
        lambda out: [world / "gaussians", "--out", out, *small],
        ("--elevation", 20),
    )


def jobs(world: Path) -> list[Job]:
    """The commands that write results, each small."""
    model, data = world / "run" / "model.safetensors", world / "data"
    small = ("--size", 16, "--frames", 2)
    return [
        Job(
            "reconstruct",
            lambda out: [
                *(world / "pictures", "--checkpoint", model, "--out", out, *small),
                *("--splats", "ply", "splat", "glb", "--device", "cpu"),
            ],
            ("--elevation", 20),
        ),
        Job(
            "export",
            lambda out: [
                *(world / "gaussians", "--out", out, "--voxels", 24, "--views", 8, "--pixels", 32),
                *("--mesh", "glb", "ply", "--splats", "ply", "--page", *small),
                *("--turntable", "gif", "--device", "cpu"),
            ],
            ("--frame", "opencv"),
        ),
        _render_job(world),
        Job(
            "fit",
            lambda out: [data, "--out", out, "--steps", 4, "--gaussians", 60, "--device", "cpu"],
            ("--seed", 1),
        ),
        Job(
            "data render",
            lambda out: [
                world / "meshes",
                "--out",
                out,
                "--views",
                2,
                "--size",
                16,
                "--workers",
                1,
            ],
            (),
            _without_one_object,
        ),
        Job(
            "eval-views",
            lambda out: [
                *("--checkpoint", model, "--data", data, "--out", out, "--split", "all"),
                *("--no-lpips", "--save-gaussians", "--device", "cpu"),
            ],
            ("--views", 3),
        ),
        Job(
            "eval-geometry",
            lambda out: [world / "meshes", world / "meshes", "--out", out, "--points", 500],
            ("--seed", 1),
        ),
        *_other_jobs(world),
    ]


def _other_jobs(world: Path) -> list[Job]:
    """The commands that neither render nor evaluate."""
    return [
        Job(
            "import-released",
            lambda out: [
                *(world / "released" / "theirs.pth", "--out", out),
                *("--encoder-weights", world / "released" / "vit.safetensors", "--depth", 1),
            ],
            (),
        ),
        Job(
            "data pack",
            lambda out: [world / "data", out, "--size", 16, "--workers", 1],
            (),
            remove_folder,
        ),
        Job(
            "ablate",
            lambda out: [
                *(world / "plan.json", world / "data", "--out", out),
                *("--rows", "fit", "--device", "cpu"),
            ],
            (),
            lambda out: remove_folder(out / "rows"),
        ),
        Job("data furniture", lambda out: ["--tree", world / "libraries", "--out", out], ()),
        Job(
            "view",
            lambda out: [
                *(world / "gaussians" / "ball.ply", "--out", out / "page.html"),
                "--no-open-browser",
            ],
            (),
        ),
        Job(
            "stress",
            lambda out: ["scan", "--cases", 2, "--device", "cpu", "--out", out],
            ("--seed", 1),
        ),
        Job("bench", lambda out: ["--render", world / "bench.json", "--out", out], ()),
    ]
