"""The evaluation ``gso``: models taken from a copy of Google Scanned Objects, then rendered.

A model is a folder ``<Name>/``, or its zip as the Fuel server gives it, with ``meshes/model.obj``
and ``model.mtl``, ``materials/textures/texture.png``, ``metadata.pbtxt`` and ``thumbnails/``. The
``.mtl`` names its texture as if it lay beside it. So mesh, materials and textures are put into one
folder, where every reader finds them.
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
from ..data.settings import Settings, Up

MESH = "meshes/model.obj"
METADATA = "metadata.pbtxt"
_FOLDERS = ("meshes", "materials/textures")  # what is taken of a model
_SUFFIXES = (".obj", ".mtl", ".png", ".jpg", ".jpeg")
_TEXT = 1 << 20  # bytes of the metadata, which have 1 kB
_ATTRIBUTION = {
    "creator": "Google",
    "licence": "Creative Commons Attribution 4.0 International",
    "licence_text": "https://creativecommons.org/licenses/by/4.0/",
    "source": "Google Scanned Objects",
}


def find_models(source: Path, names: Sequence[str] = gso.NAMES) -> dict[str, Path]:
    """The models of these names in a local copy of the set, as folders or as zips.

    Args:
        source: folder of the set; the models lie right in it or in ``models/``.
        names: which are looked for.

    Returns:
        A folder or zip by name; a name that is not there is left out.

    Raises:
        UserError: no such folder, or none of the models is in it.
    """
    if not source.is_dir():
        raise UserError(f"--source {source}: no such folder")
    found = {}
    for name in names:
        places = [folder / f"{name}{end}" for folder in (source, source / "models")
                  for end in ("", ".zip")]  # fmt: skip
        path = next((p for p in places if (p / MESH).is_file() or p.suffix and p.is_file()), None)
        if path is not None:
            found[name] = path
    if not found:
        raise UserError(
            f"--source {source}: holds none of the {len(names)} models "
            f"(such as {names[0]}/{MESH}, {names[0]}.zip or {names[0]}.glb)"
        )
    return found


def find_meshes_of(source: Path, names: Sequence[str]) -> list[Mesh]:
    """The meshes of these names in a folder that has not the set's own layout.

    Args:
        source: the folder; ``find_meshes`` names what is in it.
        names: which are looked for.

    Returns:
        Empty where the folder has the set's own layout, or none of them.
    """
    with suppress(UserError):
        find_models(source, names)
        return []
    with suppress(UserError):
        return [mesh for mesh in find_meshes(source) if mesh.uid in names]
    return []


def others_of(source: Path) -> int:
    """Number of the set's models in a folder that are not of the evaluation."""
    others = sorted(gso.all_names() - {*gso.NAMES})
    with suppress(UserError):
        return len(find_models(source, others))
    return len(find_meshes_of(source, others))


def up_of(meshes: Sequence[Mesh], up: Up) -> Up:
    """The axis that points up in meshes that have not the set's own layout.

    Args:
        meshes: their files.
        up: what was asked for; auto where the format has to tell.

    Raises:
        UserError: it does not, because only glTF has an axis of its own; .obj files of the set have
            z up where others have y.
    """
    for mesh in meshes:
        if up == "auto" and mesh.path.suffix.lower() not in (".glb", ".gltf"):
            raise UserError(f"{mesh.path}: may have y or z up; say which, with --up y or --up z")
    return "y" if up == "auto" else up


def take_model(name: str, path: Path, out: Path) -> None:
    """Puts mesh, materials and textures of a model into ``out/<name>``, whole or not at all.

    Args:
        name: of the model.
        path: its folder, or its zip.
        out: folder of the models.

    Raises:
        UserError: it is damaged, lacks its mesh, or two different files would have one name.
    """
    with atomic_folder(out / name) as part:
        for place, data in _files(path):
            target = inside(part, PurePosixPath(place).name, str(path))
            if target.exists() and target.read_bytes() != data:
                raise UserError(f"{path}: two files are called {target.name!r}")
            target.write_bytes(data)
        if not (part / "model.obj").is_file():
            raise UserError(f"{path}: holds no {MESH}")


def _files(path: Path) -> Iterator[tuple[str, bytes]]:
    """What is taken of a model: the place of each file in it, and its bytes."""
    if path.is_dir():
        found = [p for f in _FOLDERS if (path / f).is_dir() for p in sorted((path / f).iterdir())]
        places = [p.relative_to(path).as_posix() for p in found]
        places += [METADATA] if (path / METADATA).is_file() else []
        for place in filter(_most, places):
            yield place, read_bytes(inside(path, place, str(path)), _most(place))
        return
    with open_zip(path) as archive:
        # It holds the model's folder, or what is in it.
        mesh = next((name for name in archive.names if f"/{name}".endswith(f"/{MESH}")), MESH)
        top = mesh.removesuffix(MESH)
        for name in archive.names:
            place = name.removeprefix(top)
            if name.startswith(top) and _most(place):
                yield place, archive.read(name, _most(place))


def _most(place: str) -> int:
    """Largest size of a file that is taken, bytes; 0 of one that is not."""
    path = PurePosixPath(place)
    if str(path.parent) in _FOLDERS and path.suffix.lower() in _SUFFIXES:
        return 256 << 20  # meshes have 2 to 30 MB
    return _TEXT if place == METADATA else 0


def attribution_of(folder: Path) -> dict[str, str]:
    """Creator, licence and source of a model, as its metadata state them, else as the set does."""
    known = dict(_ATTRIBUTION)
    if (folder / METADATA).is_file():
        text = read_bytes(folder / METADATA, _TEXT).decode("utf-8", "replace")
        for key, pattern in (
            ("creator", r'authors\s*\{[^{}]*?\bname:\s*"([^"\\]{1,200})"'),
            ("licence", r'legal\s*\{[^{}]*?\blicense:\s*"([^"\\]{1,200})"'),
        ):
            if match := re.search(pattern, text):
                known[key] = " ".join(match[1].split())
    return known


def take_models(source: Path, out: Path, names: Sequence[str]) -> dict[str, str]:
    """Puts models that are not there yet into ``out/meshes``, and writes their catalogue.

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
    found = find_models(source, wanted) if wanted else {}
    failures = {name: f"not in {source}" for name in wanted if name not in found}
    for name, path in progress_bar(list(found.items()), unit="model"):
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
        for name in gso.NAMES
        if (meshes / name / "model.obj").is_file()
    ]
    write_json(meshes / CATALOGUE, {"objects": entries})
    return failures


def taken(out: Path, names: Sequence[str]) -> list[Mesh]:
    """Those of the models that ``take_models`` has put into ``out/meshes``."""
    meshes = out / "meshes"
    if not any((meshes / name / "model.obj").is_file() for name in names):
        return []
    return [mesh for mesh in find_meshes(meshes) if mesh.uid in names]


def make_views(
    out: Path, meshes: Sequence[Mesh], size: int, workers: int, up: Up = gso.UP
) -> tuple[int, dict[str, list[str]], dict[str, str]]:
    """Renders models into ``out/views``.

    All objects that are there are its test split.

    Args:
        out: folder of the evaluation.
        meshes: of the models.
        size: pixels a side.
        workers: processes; 0 means one per core.
        up: the axis that points up in the files.

    Returns:
        The number of objects rendered now; by name, what was missing in a model's files; and by
        name, why an object could not be rendered.

    Raises:
        UserError: objects are there that were rendered otherwise.
    """
    views = output_folder(out / "views")
    if not meshes:
        return 0, {}, {}
    # The same light for an object at each run.
    settings = Settings(gso.VIEWS, size, gso.FOV, format="png", up=up, spread=0.0, poses="gso")
    todo, damaged = still_missing(meshes, views, settings)
    warnings, failures = render_meshes(todo, views, settings, workers)
    there = sorted(path.parent.name for path in views.glob("[!.]*/transforms.json"))
    split = {"version": SPLIT_VERSION, "train": [], "val": [], "test": there}
    write_json(views / "split.json", split)
    return len(todo) - len(failures), warnings, failures | damaged
