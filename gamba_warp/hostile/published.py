"""Readers of published sets, for ``gamba stress files``: G-Objaverse with its lists, and GSO."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..errors import UserError
from . import sound


def copy_of_gobjaverse(path: Path, out: Path) -> Any:
    """Makes a dataset of a copy of G-Objaverse, as the lists beside it choose; loads its objects.

    Returns:
        What ``sound.views`` checks: the objects' views, and why others were left out.

    Raises:
        UserError: a list is bad, or nothing is there.
    """
    from gamba_warp.train.sources.objaverse_lists import Lists
    from gamba_warp.train.sources.objaverse_views import find_rendered, take_views

    from ..data.dataset import open_dataset

    files = {name: path / name for name in ("index.json", "quality.json")}
    index, quality = (file if file.exists() else None for file in files.values())
    lists = Lists(index, tuple(sorted(path.glob("list*"))), (), quality)
    objects = find_rendered(path)
    target = out / "dataset"
    target.mkdir()
    taken, failures = take_views(objects, lists.choose(objects).names, target, 1, True)
    loaded = [open_dataset(target).load(uid) for uid in open_dataset(target).uids] if taken else []
    return loaded, list(failures.values())


def copy_of_gso(path: Path, out: Path) -> Any:
    """Takes models of a copy of GSO, and reads their meshes.

    Returns:
        A mesh or an error for each model.

    Raises:
        UserError: no model is there.
    """
    from gamba_warp.train.sources.gso_views import take_models

    from ..data import gso
    from ..formats.catalogue import find_meshes
    from ..formats.meshes import load_mesh

    names = gso.NAMES[:2]
    failures = take_models(path, out / "gso", names)
    results: list[Any] = [UserError(reason) for reason in failures.values()]
    for mesh in find_meshes(out / "gso" / "meshes") if len(failures) < len(names) else ():
        try:
            results.append(load_mesh(mesh.path).normalized(gso.UP)[0])
        except UserError as error:
            # The file is a copy: it has the name of that in the set, but not its place.
            results.append(UserError(str(error).replace(str(out), str(path))))
    return results


def meshes(result: Any, path: Path, out: Path) -> str | None:
    """Sound meshes, and nothing of a model in the folder but its own files."""
    for folder in (out / "gso" / "meshes").iterdir():
        if folder.name.startswith("."):
            return f"{folder.name} is left behind"
        strange = [p.name for p in (folder.iterdir() if folder.is_dir() else ()) if p.is_symlink()]
        if strange:
            return f"{strange[0]} is a link"
    return sound.each(sound.mesh)(result, path, out)
