"""Evaluation ``gso``: models from a copy of Google Scanned Objects, and their renderings.

A model is a folder ``<Name>/``, or its zip from the Fuel server, with ``meshes/model.obj`` and
``model.mtl``, ``materials/textures/texture.png``, ``metadata.pbtxt`` and ``thumbnails/``. The
``.mtl`` expects the texture in its own folder, so mesh, materials and textures are put into
one folder, where every reader finds them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath

from gamba_warp.batch import progress_bar
from gamba_warp.data import gso
from gamba_warp.data.dataset import SPLIT_VERSION
from gamba_warp.errors import UserError
from gamba_warp.files import atomic_folder, output_folder, write_json
from gamba_warp.formats.catalogue import CATALOGUE, Mesh, find_meshes
from gamba_warp.untrusted.archives import open_zip
from gamba_warp.untrusted.documents import read_bytes
from gamba_warp.untrusted.names import inside

from ..data.render import render_meshes, still_missing
from ..data.settings import Settings

MESH = "meshes/model.obj"
METADATA = "metadata.pbtxt"
_FOLDERS = ("meshes", "materials/textures")  # folders of a model that are read
_SUFFIXES = (".obj", ".mtl", ".png", ".jpg", ".jpeg")
_MAX_METADATA = 1 << 20  # bytes; published ones have 1 kB
_ATTRIBUTION = {
    "creator": "Google",
    "licence": "Creative Commons Attribution 4.0 International",
    "licence_text": "https://creativecommons.org/licenses/by/4.0/",
    "source": "Google Scanned Objects",
}


def find_models(source: Path, names: Sequence[str] = gso.NAMES) -> dict[str, Path]:
    """Find models in a local copy of the set, as folders or as zips.

    Args:
        source: folder of the set; the models are in it or in ``models/``.
        names: names of the models.

    Returns:
        A folder or zip by name; missing names are left out.

    Raises:
        UserError: the folder does not exist, or contains none of the models.
    """
    if not source.is_dir():
        raise UserError(f"--source {source}: no such folder")
    models = {}
    for name in names:
        ends = [f"{name}{suffix}" for suffix in ("", ".zip")]
        paths = [folder / end for folder in (source, source / "models") for end in ends]
        path = next((p for p in paths if (p / MESH).is_file() or p.suffix and p.is_file()), None)
        if path is not None:
            models[name] = path
    if not models:
        raise UserError(
            f"--source {source}: contains none of the {len(names)} models "
            f"(such as {names[0]}/{MESH} or {names[0]}.zip)"
        )
    return models


def others_of(source: Path, names: Sequence[str] = gso.NAMES) -> int:
    """Number of the set's models in a folder that are outside the evaluation's ``names``."""
    others = sorted(gso.all_names() - {*names})
    with suppress(UserError):
        return len(find_models(source, others))
    return 0


def take_model(name: str, path: Path, out: Path) -> None:
    """Copy mesh, materials and textures of a model into ``out/<name>``, atomically.

    Args:
        name: name of the model.
        path: its folder, or its zip.
        out: folder of the models.

    Raises:
        UserError: it is damaged, lacks its mesh, or two different files would have one name.
    """
    with atomic_folder(out / name) as part:
        for member, data in _files(path):
            target = inside(part, PurePosixPath(member).name, str(path))
            if target.exists() and target.read_bytes() != data:
                raise UserError(f"{path}: two files are called {target.name!r}")
            target.write_bytes(data)
        if not (part / "model.obj").is_file():
            raise UserError(f"{path}: {MESH} is missing")


def _files(path: Path) -> Iterator[tuple[str, bytes]]:
    """Yield the files of a model that are copied: relative path and bytes."""
    if path.is_dir():
        paths = [p for f in _FOLDERS if (path / f).is_dir() for p in sorted((path / f).iterdir())]
        members = [p.relative_to(path).as_posix() for p in paths]
        members += [METADATA] if (path / METADATA).is_file() else []
        for member in filter(_max_size, members):
            yield member, read_bytes(inside(path, member, str(path)), _max_size(member))
        return
    with open_zip(path) as archive:
        # The zip has the model's folder, or its content, at the top.
        mesh = next((name for name in archive.names if f"/{name}".endswith(f"/{MESH}")), MESH)
        top = mesh.removesuffix(MESH)
        for name in archive.names:
            member = name.removeprefix(top)
            if name.startswith(top) and _max_size(member):
                yield member, archive.read(name, _max_size(member))


def _max_size(member: str) -> int:
    """Largest size of a file that is copied, bytes; 0 if it is not copied."""
    path = PurePosixPath(member)
    if str(path.parent) in _FOLDERS and path.suffix.lower() in _SUFFIXES:
        return 256 << 20  # meshes have 2 to 30 MB
    return _MAX_METADATA if member == METADATA else 0


def attribution_of(folder: Path) -> dict[str, str]:
    """Creator, licence and source of a model by its metadata, else the set's."""
    known = dict(_ATTRIBUTION)
    if (folder / METADATA).is_file():
        text = read_bytes(folder / METADATA, _MAX_METADATA).decode("utf-8", "replace")
        for key, pattern in (
            ("creator", r'authors\s*\{[^{}]*?\bname:\s*"([^"\\]{1,200})"'),
            ("licence", r'legal\s*\{[^{}]*?\blicense:\s*"([^"\\]{1,200})"'),
        ):
            if match := re.search(pattern, text):
                known[key] = " ".join(match[1].split())
    return known


def take_models(source: Path, out: Path, names: Sequence[str]) -> dict[str, str]:
    """Copy missing models into ``out/meshes``, and write their catalogue.

    Args:
        source: a copy of the set.
        out: folder of the evaluation.
        names: names of the models.

    Returns:
        Failures by name.

    Raises:
        UserError: ``source`` cannot be read, or the catalogue cannot be written.
    """
    meshes = output_folder(out / "meshes")
    wanted = [name for name in names if not (meshes / name / "model.obj").is_file()]
    models = find_models(source, wanted) if wanted else {}
    failures = {name: f"not in {source}" for name in wanted if name not in models}
    for name, path in progress_bar(list(models.items()), unit="model"):
        try:
            take_model(name, path, meshes)
        except UserError as error:
            failures[name] = str(error)
    entries = [
        {
            "model": f"{name}/model.obj",
            "uid": name,
            "name": name.replace("_", " "),
            "group": name,
            "attribution": attribution_of(meshes / name),
        }
        for name in sorted({*gso.NAMES, *names})
        if (meshes / name / "model.obj").is_file()
    ]
    write_json(meshes / CATALOGUE, {"objects": entries})
    return failures


def taken(out: Path, names: Sequence[str]) -> list[Mesh]:
    """Models that ``take_models`` has copied into ``out/meshes``."""
    meshes = out / "meshes"
    if not any((meshes / name / "model.obj").is_file() for name in names):
        return []
    return [mesh for mesh in find_meshes(meshes) if mesh.uid in names]


def make_views(
    out: Path, meshes: Sequence[Mesh], size: int, workers: int
) -> tuple[int, dict[str, list[str]], dict[str, str]]:
    """Render models into ``out/views``; all objects are its test split.

    Args:
        out: folder of the evaluation.
        meshes: meshes of the models.
        size: pixels a side.
        workers: processes; 0 means one per core.

    Returns:
        The number of newly rendered objects, warnings by name about missing parts of a model's
        files, and failures by name.

    Raises:
        UserError: existing objects were rendered with other settings.
    """
    views = output_folder(out / "views")
    if not meshes:
        return 0, {}, {}
    # The same lights for an object in every run.
    settings = Settings(gso.VIEWS, size, gso.FOV, format="png", up=gso.UP, spread=0.0, poses="gso")
    todo, damaged = still_missing(meshes, views, settings)
    warnings, failures = render_meshes(todo, views, settings, workers)
    there = sorted(path.parent.name for path in views.glob("[!.]*/transforms.json"))
    split = {"version": SPLIT_VERSION, "train": [], "val": [], "test": there}
    write_json(views / "split.json", split)
    return len(todo) - len(failures), warnings, failures | damaged
