"""Downloads objects of Objaverse with its package ``objaverse``, and catalogues them."""

from __future__ import annotations

import importlib
import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gamba_warp.batch import progress_bar
from gamba_warp.data.layouts import one_line
from gamba_warp.errors import UserError, first_line
from gamba_warp.files import atomic_path, output_folder, write_json
from gamba_warp.formats.catalogue import CATALOGUE
from gamba_warp.untrusted.documents import read_document
from gamba_warp.untrusted.names import plain_name

PACKAGE = "objaverse"
ANNOTATIONS = "annotations"  # folder beside the meshes: Objaverse's metadata of each
_BATCH = 64  # objects per request; a stopped run loses no more
_FIELDS = {"creator": "user", "licence": "license", "source": "viewerUrl"}


def load_package() -> Any:
    """Import the package ``objaverse``. Raises UserError if it is not installed."""
    try:
        return importlib.import_module(PACKAGE)
    except ImportError as error:
        raise UserError(
            f"--source {PACKAGE}: needs the package of that name: pip install {PACKAGE}"
        ) from error


def take_meshes(names: Sequence[str], out: Path, processes: int) -> tuple[int, dict[str, str]]:
    """Download missing objects, and write the catalogue of all.

    Args:
        names: uids of Objaverse.
        out: folder for ``<uid>.glb``.
        processes: number of parallel downloads.

    Returns:
        The number of new objects, and failures by uid.

    Raises:
        UserError: the package is not installed, or nothing can be downloaded.
    """
    package = load_package()
    output_folder(out / ANNOTATIONS)
    wanted = [name for name in names if not (out / f"{plain_name(name, '--uids')}.glb").is_file()]
    failures: dict[str, str] = {}
    # The package reads 160 large files for this, so ask for all at once.
    known = _call(package.load_annotations, uids=wanted) if wanted else {}
    with progress_bar(total=len(wanted), unit="object") as progress:
        for start in range(0, len(wanted), _BATCH):
            batch = wanted[start : start + _BATCH]
            paths = _call(package.load_objects, uids=batch, download_processes=processes)
            for name in batch:
                try:
                    _store(name, paths.get(name), known.get(name), out)
                except UserError as error:
                    failures[name] = str(error)
            progress.update(len(batch))
    annotations = sorted((out / ANNOTATIONS).glob("[!.]*.json"))
    there = [path for path in annotations if (out / f"{path.stem}.glb").is_file()]
    entries = [read_document(path, dict[str, Any]) for path in there]
    write_json(out / CATALOGUE, {"objects": entries})
    return len(wanted) - len(failures), failures


def _call(function: Callable[..., dict[str, Any]], **arguments: Any) -> dict[str, Any]:
    """Call the package; convert its errors, and those of the network, to one line."""
    try:
        return function(**arguments)
    except Exception as error:
        reason = f"{type(error).__name__}: {first_line(error)}"
        raise UserError(
            f"--source {PACKAGE}: nothing can be downloaded ({reason}); the same command "
            "continues from here"
        ) from error


def _store(name: str, path: str | None, known: Any, out: Path) -> None:
    """Store one file, as a hard link to the package's cache if possible."""
    if path is None or not Path(path).is_file():
        raise UserError("Objaverse has no such object")
    known = known if isinstance(known, dict) else {}
    user = known.get("user")
    values = {**known, "user": user.get("displayName") if isinstance(user, dict) else user}
    entry = {
        "model": f"{name}.glb",
        "uid": name,
        "name": " ".join(str(known.get("name") or name).split())[:200],
        "attribution": {f: one_line(values[key]) for f, key in _FIELDS.items() if values.get(key)},
    }
    write_json(out / ANNOTATIONS / f"{name}.json", entry)
    with atomic_path(out / f"{name}.glb") as temporary:
        try:
            os.link(path, temporary)
        except OSError:
            shutil.copyfile(path, temporary)
