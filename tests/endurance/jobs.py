"""Commands under test, and the small world of files that they work on."""

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from ablation.fake import write_plan
from helpers.images import cut_out
from helpers.micro import write_dataset
from helpers.nodes.processes import words
from helpers.released import make_released
from helpers.views import cloud_of

from gamba_warp.files import remove_folder
from gamba_warp.formats.ply import save_ply

from .child import gamba


class Job(NamedTuple):
    """Writing command.

    Attributes:
        line: the command and its arguments, with ``{world}`` for the folder of the small world and
            ``{out}`` for that of results.
        other: further arguments that change its output, so that older results can be recognised.
        undo: removes a part of the results, for commands that skip existing results.
    """

    line: str
    other: str = ""
    undo: Callable[[Path], None] | None = None

    def words(self, world: Path, out: Path) -> list[str]:
        """Return the command and its arguments."""
        return [word.format(world=world, out=out) for word in self.line.split()]


def without_one_object(out: Path) -> None:
    """Remove one rendered object, if any is left after several interrupted runs."""
    for path in sorted(out.glob("*/transforms.json"))[-1:]:
        remove_folder(path.parent)


SMALL = "--size 16 --frames 2 --device cpu"
JOBS = {
    "reconstruct": Job(
        "reconstruct {world}/images --out {out} --checkpoint {world}/run/model.safetensors "
        f"--splats ply splat spz {SMALL}",
        "--elevation 20",
    ),
    "export": Job(
        "export {world}/gaussians --out {out} --voxels 24 --views 8 --pixels 32 --mesh glb ply "
        f"--splats ply --page --turntable gif {SMALL}",
        "--axes opencv",
    ),
    "render": Job(
        "render {world}/gaussians --out {out} --kind png --size 32 --frames 3 --depth --device cpu",
        "--elevation 20",
    ),
    "data render": Job(
        "data render {world}/meshes --out {out} --views 2 --size 16 --workers 1",
        undo=without_one_object,
    ),
    "eval-views": Job(
        "eval-views --checkpoint {world}/run/model.safetensors --data {world}/data --out {out} "
        "--split all --lpips off --save-gaussians --device cpu",
        "--views 3",
    ),
    "eval-geometry": Job(
        "eval-geometry {world}/meshes {world}/meshes --out {out} --points 500", "--seed 1"
    ),
    "import-released": Job(
        "import-released {world}/released/theirs.pth --out {out} "
        "--encoder-weights {world}/released/vit.safetensors --depth 1"
    ),
    "data pack": Job("data pack {world}/data {out} --size 16 --workers 1"),
    "ablate": Job(
        "ablate {world}/plan.json {world}/data --out {out} --rows model --device cpu",
        undo=lambda out: remove_folder(out / "rows"),
    ),
    "data furniture": Job("data furniture --tree {world}/libraries --out {out}"),
    "view": Job("view {world}/gaussians/ball.ply --out {out}/page.html --no-open-browser"),
    "stress": Job("stress scan --cases 2 --device cpu --out {out}", "--seed 1"),
    "bench": Job("bench conv --only knobs --quick --device cpu --out {out}"),
}


def training(world: Path, out: Path, steps: int) -> list[str]:
    """Command that trains a tiny model, or resumes the training."""
    more = ("--views-per-object", 2, "--val-every", 10, "--workers", 1, "--save-every", 3)
    return ["train", *words(world / "data", out, *more, "--steps", steps)]


def undisturbed(*words: object):
    """Run a command, which must succeed."""
    end = gamba(*words)
    assert end.code == 0, end.said[-2000:]
    return end


def make_world(folder: Path, commands: list[str]) -> None:
    """Make data, a model, images, meshes and all other inputs of the commands."""
    rng = np.random.default_rng(0)
    for name in ("meshes", "images", "gaussians"):
        (folder / name).mkdir()
    solids = {"ball": trimesh.creation.icosphere(1), "box": trimesh.creation.box()}
    for name, mesh in (solids | {"cone": trimesh.creation.cone(1, 2)}).items():
        mesh.export(folder / "meshes" / f"{name}.ply")
    write_dataset(folder / "data")
    undisturbed(*training(folder, folder / "run", 2))
    for name in ("a", "b"):
        cut_out(folder / "images" / f"{name}.png")
    points = rng.normal(size=(200, 3))
    points *= 0.4 / np.linalg.norm(points, axis=1, keepdims=True)
    save_ply(folder / "gaussians" / "ball.ply", cloud_of(points, 0.08, 0.95, rng.random((200, 3))))
    if "ablate" in commands:
        base = {"options": {"steps": 2, "batch_size": 2}}
        chosen = {"split": "val", "objects": 1, "views": 3, "size": 16}
        write_plan(folder, "model", name="plan", base=base, evaluation=chosen)
    if "data furniture" in commands:
        make_library(folder / "libraries", folder / "images" / "a.png")
    if "import-released" in commands:
        make_released(folder / "released")


def make_library(folder: Path, icon: Path) -> None:
    """Make a furniture library of 20 models for ``gamba data furniture``."""
    folder.mkdir()
    lines = ["id=Some#Library", "name=Some"]
    with zipfile.ZipFile(folder / "Some.sh3f", "w") as archive:
        archive.write(icon, "m/icon.png")
        for number in range(20):
            lines += [f"name#{number}=Thing {number}", f"icon#{number}=/m/icon.png"]
            lines += [f"model#{number}=/m/{number}/a.obj", f"creator#{number}=me"]
            archive.writestr(f"m/{number}/a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n" * 99)
        archive.writestr("PluginFurnitureCatalog.properties", "\n".join(lines))
