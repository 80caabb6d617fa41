"""The views of the evaluation ``gso``: models taken from a copy of the set, then rendered."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gamba_warp.batch import progress_bar
from gamba_warp.data import gso
from gamba_warp.data.dataset import SPLIT_VERSION
from gamba_warp.errors import UserError
from gamba_warp.files import output_folder, write_json
from gamba_warp.formats.catalogue import find_meshes

from ..data.render import Settings, render_meshes, still_missing
from .gso_models import find_models, take_model, write_catalogue


def settings_of(size: int) -> Settings:
    """How the views are rendered; the same light for an object at each run."""
    return Settings(
        views=gso.VIEWS,
        size=size,
        fov=gso.FOV,
        seed=0,
        depth=False,
        format="png",
        up=gso.UP,
        fronts=1,
        spread=0.0,
        poses="gso",
    )


def take_models(source: Path, out: Path, names: Sequence[str]) -> dict[str, str]:
    """Puts models that are not there yet into ``out/meshes``.

    Args:
        source: a copy of the set.
        out: folder of the evaluation.
        names: of the models.

    Returns:
        By name, why a model could not be had.

    Raises:
        UserError: nothing can be read of ``source``, or nothing written.
    """
    meshes = output_folder(out / "meshes")
    wanted = [name for name in names if not (meshes / name / "model.obj").is_file()]
    found = find_models(source, names) if wanted else {}
    failures = {name: f"not in {source}" for name in wanted if name not in found}
    for name in progress_bar([name for name in wanted if name in found], unit="model"):
        try:
            take_model(name, found[name], meshes)
        except UserError as error:
            failures[name] = str(error)
    write_catalogue(meshes)
    return failures


def make_views(
    out: Path, names: Sequence[str], size: int, workers: int
) -> tuple[int, dict[str, list[str]], dict[str, str]]:
    """Renders those of the models that are in ``out/meshes`` into ``out/views``.

    All objects that are there are its test split.

    Args:
        out: folder of the evaluation.
        names: of the models.
        size: pixels a side.
        workers: processes; 0 means one per core.

    Returns:
        The number of objects rendered now; by name, what was missing in a model's files; and by
        name, why an object could not be rendered.

    Raises:
        UserError: objects are there that were rendered otherwise.
    """
    views, meshes = output_folder(out / "views"), out / "meshes"
    if not any((meshes / name / "model.obj").is_file() for name in names):
        return 0, {}, {}
    wanted = [mesh for mesh in find_meshes(meshes) if mesh.uid in names]
    settings = settings_of(size)
    todo, damaged = still_missing(wanted, views, settings)
    warnings, failures = render_meshes(todo, views, settings, workers)
    there = sorted(path.parent.name for path in views.glob("[!.]*/transforms.json"))
    split = {"version": SPLIT_VERSION, "train": [], "val": [], "test": there}
    write_json(views / "split.json", split)
    return len(todo) - len(failures), warnings, failures | damaged
