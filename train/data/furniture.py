"""820 textured furniture models that are free to use, ready for ``gamba data render``.

They are Sweet Home 3D's furniture libraries as Debian's package ``sweethome3d-furniture`` carries
them: five ``.sh3f`` zip files of OBJ models, each with a 128x128 RGBA icon, a name and a creator.
All are CC BY 3.0 or CC0; the attribution goes into ``catalogue.json`` and from there into every
rendered object.
"""

from __future__ import annotations

import io
import re
import shutil
import subprocess
import tarfile
import tempfile
import zipfile
from collections import Counter
from pathlib import Path, PurePosixPath

import numpy as np
from tqdm import tqdm

from gamba_warp.errors import UserError
from gamba_warp.files import atomic_path, output_folder, write_json

from .render import CATALOGUE

PACKAGE = "sweethome3d-furniture"
INSTALLED = Path("/usr/share/sweethome3d/furniture")
_BY = "https://creativecommons.org/licenses/by/3.0/"

# By library: whom to name, if not each model's creator; the licence; where its text is.
LIBRARIES: dict[str, tuple[str, str, str]] = {
    "BlendSwap-CC-0": ("", "CC0 1.0", "https://creativecommons.org/publicdomain/zero/1.0/"),
    "BlendSwap-CC-BY": ("", "CC BY 3.0", _BY),
    "KatorLegaz": ("Andrew Kator & Jennifer Legaz", "CC BY 3.0 US", _BY + "us/"),
    "Reallusion": ("Reallusion, www.reallusion.com", "CC BY 3.0 US", _BY + "us/"),
    "Scopia": (
        "Scopia Visual Interfaces Systems, s.l. and Emmanuel Puybaret / eTeks",
        "CC BY 3.0",
        _BY,
    ),
}


def get_furniture(out: Path, deb: Path | None = None, tree: Path | None = None) -> int:
    """Unpacks the libraries, and writes the catalogue of all models.

    Args:
        out: folder for the models, their icons and catalogue.json.
        deb: the package file, or None.
        tree: a folder that holds the .sh3f files, or None; without either an installed package is
            used, or apt-get downloads it.

    Returns:
        The number of models.

    Raises:
        UserError: there are no libraries, one is damaged, or two models have one name.
    """
    out = output_folder(out)
    with tempfile.TemporaryDirectory(dir=out, prefix=".download-") as scratch:
        libraries = sorted(_find_libraries(deb, tree, Path(scratch)).glob("*.sh3f"))
        if not libraries:
            raise UserError(f"{deb or tree or INSTALLED}: holds no .sh3f libraries")
        objects = [entry for path in libraries for entry in unpack_library(path, out)]
    repeated = [uid for uid, n in Counter(entry["uid"] for entry in objects).items() if n > 1]
    if repeated:
        raise UserError(f"two models are called {repeated[0]}")
    write_json(out / CATALOGUE, {"objects": sorted(objects, key=lambda entry: entry["uid"])})
    return len(objects)


def _find_libraries(deb: Path | None, tree: Path | None, scratch: Path) -> Path:
    """The folder of the .sh3f files."""
    if tree is not None:
        if not tree.is_dir():
            raise UserError(f"{tree}: no such folder")
        found = next(iter(sorted(tree.rglob("*.sh3f"))), None)
        return found.parent if found else tree
    if deb is None:
        if INSTALLED.is_dir():
            return INSTALLED
        deb = _download(scratch)
    _unpack_deb(deb, scratch)
    return scratch


def _download(folder: Path) -> Path:
    """Debian's package by apt-get, which needs no root for this."""
    if shutil.which("apt-get") is None:
        raise UserError(
            f"no apt-get here: get {PACKAGE}_*_all.deb from a Debian mirror and give it by --deb"
        )
    print(f"downloading {PACKAGE} (125 MB) with apt-get")
    command = ["apt-get", "download", PACKAGE]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if result.returncode:  # a fresh container has no package lists
        subprocess.run(["apt-get", "update"], capture_output=True)
        result = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    files = sorted(folder.glob("*.deb"))
    if result.returncode or not files:
        reason = (result.stderr.strip().splitlines() or ["no file came"])[-1]
        raise UserError(f"apt-get download {PACKAGE}: {reason}; or give the file by --deb")
    return files[0]


def _unpack_deb(deb: Path, folder: Path) -> None:
    """Puts the .sh3f files of a .deb (an ar archive that holds a tar) into ``folder``."""
    if not deb.is_file():
        raise UserError(f"{deb}: no such file")
    with deb.open("rb") as file:
        if file.read(8) != b"!<arch>\n":
            raise UserError(f"{deb}: not a Debian package")
        while len(header := file.read(60)) == 60:
            name, size = header[:16].decode("ascii", "replace").strip(), int(header[48:58])
            if not name.startswith("data.tar"):
                file.seek(size + size % 2, io.SEEK_CUR)
                continue
            try:
                with tarfile.open(fileobj=io.BytesIO(file.read(size))) as tar:
                    for member in tar:
                        source = tar.extractfile(member) if member.isfile() else None
                        if source and member.name.endswith(".sh3f"):
                            path = folder / PurePosixPath(member.name).name
                            with path.open("wb") as target:
                                shutil.copyfileobj(source, target)
            except (tarfile.TarError, EOFError, OSError) as error:
                raise UserError(f"{deb}: {name} cannot be unpacked ({error})") from error
            return
    raise UserError(f"{deb}: holds no data.tar")


def read_properties(data: bytes) -> dict[str, str]:
    """A Java ``.properties`` file: ``key=value`` lines in Latin-1, other letters escaped."""
    text = re.sub(r"\\\r?\n[ \t]*", "", data.decode("latin-1"))
    text = re.sub(r"\\u([0-9a-fA-F]{4})", lambda match: chr(int(match[1], 16)), text)
    pairs = (line.partition("=") for line in text.splitlines() if not line.lstrip().startswith("#"))
    return {key.strip(): value.strip() for key, sign, value in pairs if sign}


def unpack_library(path: Path, out: Path) -> list[dict]:
    """Unpacks one .sh3f into ``out/<library>`` and its icons into ``out/icons``.

    Returns:
        The library's catalogue entries.

    Raises:
        UserError: not a zip, or no furniture catalogue in it.
    """
    library = path.stem
    try:
        with zipfile.ZipFile(path) as archive:
            catalogue = read_properties(archive.read("PluginFurnitureCatalog.properties"))
            target = out / library
            shutil.rmtree(target, ignore_errors=True)
            members = [m for m in archive.namelist() if not m.endswith(".properties")]
            for member in tqdm(members, desc=library, unit="file", leave=False):
                archive.extract(member, target)
            numbers = [key.split("#")[1] for key in catalogue if key.startswith("model#")]
            entries = [_entry(library, catalogue, number) for number in numbers]
            icons = output_folder(out / "icons")
            for entry, number in zip(entries, numbers):
                with atomic_path(icons / f"{entry['uid']}.png") as temporary:
                    temporary.write_bytes(archive.read(catalogue[f"icon#{number}"].lstrip("/")))
    except (zipfile.BadZipFile, KeyError, OSError) as error:
        raise UserError(f"{path}: not a furniture library ({error})") from error
    return entries


def _entry(library: str, catalogue: dict[str, str], number: str) -> dict:
    """One model's entry in catalogue.json."""
    model = PurePosixPath(catalogue[f"model#{number}"].lstrip("/"))
    uid = f"{library}-{model.parent.name}".lower()
    name = catalogue.get(f"name#{number}", model.stem)
    credit, licence, text = LIBRARIES.get(library, ("", catalogue.get("license", ""), ""))
    source = catalogue.get("name", library)
    entry = {
        "uid": re.sub(r"[^\w.-]+", "_", uid),
        "name": name,
        "group": f"{library}-{_kind(name)}",
        "category": catalogue.get(f"category#{number}", ""),
        "model": f"{library}/{model}",
        "attribution": {
            "creator": credit or catalogue.get(f"creator#{number}", "unknown"),
            "licence": licence,
            "licence_text": text,
            "source": f"Sweet Home 3D furniture library '{source}'",
        },
    }
    if f"modelRotation#{number}" in catalogue:
        turn = [float(v) for v in catalogue[f"modelRotation#{number}"].split()]
        entry["rotation"] = np.reshape(turn, (3, 3)).tolist()
    return entry


def _kind(name: str) -> str:
    """What the thing is, coarsely: the last word before any number ("Concept Sedan 02": sedan).

    Libraries have many variants of one model under such names; they must not be split up.
    """
    words = re.findall(r"[^\W\d_]+", re.split(r"\d", name)[0]) or [name]
    return words[-1].lower()
