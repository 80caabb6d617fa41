"""Google Scanned Objects in their published layout, made ready for rendering and evaluation.

A model is a folder ``<Name>/``, or its zip as the Fuel server gives it, with ``meshes/model.obj``
and ``model.mtl``, ``materials/textures/texture.png``, ``metadata.pbtxt`` and ``thumbnails/``. The
``.mtl`` names its texture as if it lay beside it. So mesh, materials and textures are put into one
folder, where every reader finds them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

from gamba_warp.data import gso
from gamba_warp.errors import UserError
from gamba_warp.files import atomic_folder, write_json
from gamba_warp.formats.catalogue import CATALOGUE
from gamba_warp.untrusted.archives import open_zip
from gamba_warp.untrusted.documents import read_bytes
from gamba_warp.untrusted.names import inside

MESH = "meshes/model.obj"
METADATA = "metadata.pbtxt"
_FOLDERS = ("meshes", "materials/textures")  # what is taken of a model
_SUFFIXES = (".obj", ".mtl", ".png", ".jpg", ".jpeg")
_MOST = 256 << 20  # bytes of a file; meshes have 2 to 30 MB
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
            f"(such as {names[0]}/{MESH} or {names[0]}.zip)"
        )
    return found


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
        if path.is_dir():
            _from_folder(path, part)
        else:
            _from_zip(path, part)
        if not (part / "model.obj").is_file():
            raise UserError(f"{path}: holds no {MESH}")


def _from_folder(folder: Path, part: Path) -> None:
    for within in _FOLDERS:
        place = folder / within
        for path in sorted(place.iterdir()) if place.is_dir() else ():
            if path.suffix.lower() in _SUFFIXES:
                source = inside(folder, f"{within}/{path.name}", str(folder))
                _write(part, path.name, read_bytes(source, _MOST), folder)
    if (folder / METADATA).is_file():
        _write(part, METADATA, read_bytes(inside(folder, METADATA, str(folder)), _TEXT), folder)


def _from_zip(path: Path, part: Path) -> None:
    with open_zip(path) as archive:
        for name, place in _members(archive.names):
            limit = _TEXT if place == METADATA else _MOST
            _write(part, place, archive.read(name, limit), path)


def _members(names: Sequence[str]) -> Iterator[tuple[str, str]]:
    """The files that are taken of a zip, which may hold the model's folder or what is in it."""
    mesh = next((name for name in names if f"/{name}".endswith(f"/{MESH}")), MESH)
    top = mesh.removesuffix(MESH)
    for name in names:
        path = PurePosixPath(name.removeprefix(top))
        taken = str(path.parent) in _FOLDERS and path.suffix.lower() in _SUFFIXES
        if name.startswith(top) and (taken or str(path) == METADATA):
            yield name, path.name


def _write(part: Path, name: str, data: bytes, source: Path) -> None:
    target = inside(part, name, str(source))
    if target.exists() and target.read_bytes() != data:
        raise UserError(f"{source}: two files are called {name!r}")
    target.write_bytes(data)


def write_catalogue(out: Path) -> list[str]:
    """Writes ``catalogue.json`` of the models that are in ``out``; returns their names."""
    names = [name for name in gso.NAMES if (out / name / "model.obj").is_file()]
    entries = []
    for name in names:
        entry = {"model": f"{name}/model.obj", "uid": name, "name": name.replace("_", " ")}
        entries.append({**entry, "group": name, "attribution": attribution_of(out / name)})
    write_json(out / CATALOGUE, {"objects": entries})
    return names


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
